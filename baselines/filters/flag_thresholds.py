"""Thresholds of the flag logic, calibrated on fault-free flights.

J_i is the 99 % quantile, over 100 fault-free flights, of the largest smoothed estimate |s_i| in a flight, the initial
transient included. `calibrate` computes it for any configuration; the table holds what it gave for the hovering
helicopter at its three levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym.diagnosis import Diagnoser
from fdi_gym.engine import simulate
from fdi_gym.estimation.flags import largest
from fdi_gym.estimation.propagation import FaultInputs
from fdi_gym.plant import Array, Plant

MRAD = 1e-3
CALIBRATION_SEEDS = range(5000, 5100)

# (plant, channels, options: kappa, K_B) -> filter -> J [mrad]
TABLE: dict[tuple[str, tuple[str, ...], tuple[float, ...]], dict[str, tuple[float, ...]]] = {
    ("HUAVHover", ("lon", "lat", "ped"), (0.0, 0.84)): {
        "ascdkf": (0.793, 0.614, 1.843),
        "three_stage_cdkf": (0.793, 0.614, 1.842),
        "three_stage_ekf": (0.793, 0.614, 1.842),
        "robust_three_stage_cdkf": (0.531, 0.333, 1.267),
        "robust_three_stage_ekf": (0.531, 0.333, 1.267),
    },
    ("HUAVHover", ("col", "lon", "lat", "ped"), (0.0, 0.84)): {
        "ascdkf": (2.415, 0.793, 0.614, 2.476),
        "three_stage_cdkf": (2.412, 0.793, 0.614, 2.484),
        "three_stage_ekf": (2.412, 0.793, 0.614, 2.483),
        "robust_three_stage_cdkf": (5.190, 0.526, 0.363, 5.288),
        "robust_three_stage_ekf": (5.190, 0.526, 0.363, 5.288),
    },
    ("HUAVHover", ("lon", "lat", "ped"), (0.3, 0.84)): {
        "ascdkf": (0.792, 0.616, 11.654),
        "three_stage_cdkf": (0.792, 0.616, 11.657),
        "three_stage_ekf": (0.792, 0.616, 11.657),
        "robust_three_stage_cdkf": (0.646, 0.333, 41.794),
        "robust_three_stage_ekf": (0.646, 0.333, 41.794),
    },
    ("HUAVHover", ("col", "lon", "lat", "ped"), (0.3, 0.84)): {
        "ascdkf": (2.684, 0.792, 0.617, 11.449),
        "three_stage_cdkf": (2.681, 0.792, 0.617, 11.441),
        "three_stage_ekf": (2.681, 0.792, 0.617, 11.441),
        "robust_three_stage_cdkf": (5.190, 0.643, 0.363, 42.409),
        "robust_three_stage_ekf": (5.189, 0.643, 0.363, 42.409),
    },
    ("HUAVHover", ("lon", "lat", "ped"), (1.0, 0.84)): {
        "ascdkf": (0.791, 0.622, 21.877),
        "three_stage_cdkf": (0.791, 0.622, 21.863),
        "three_stage_ekf": (0.791, 0.622, 21.863),
        "robust_three_stage_cdkf": (1.395, 0.333, 141.685),
        "robust_three_stage_ekf": (1.395, 0.333, 141.686),
    },
    ("HUAVHover", ("col", "lon", "lat", "ped"), (1.0, 0.84)): {
        "ascdkf": (3.508, 0.791, 0.621, 21.808),
        "three_stage_cdkf": (3.505, 0.791, 0.621, 21.809),
        "three_stage_ekf": (3.505, 0.791, 0.621, 21.809),
        "robust_three_stage_cdkf": (5.189, 1.375, 0.363, 142.803),
        "robust_three_stage_ekf": (5.189, 1.375, 0.363, 142.803),
    },
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
    from fdi_gym.plants.huav_hover import prescribed_noise  # the table's flights are numbered ones

    process = plant.process("fault-free")
    scenarios = [process.sample(np.random.default_rng([s, 1])).replace(noise_seed=s + 1_000_000) for s in seeds]
    noise = [prescribed_noise(np.random.default_rng(s.noise_seed), s.steps) for s in scenarios]
    obs = simulate(plant, scenarios, noise).obs
    return np.quantile(largest(diagnoser, obs), quantile, axis=0)


def thresholds_for(plant: Plant, name: str, inputs: FaultInputs, given: Sequence[float] | None) -> Sequence[float] | None:
    """The thresholds that were given, else those of the table; None where it has none."""
    rows: Any = TABLE.get((plant.id, inputs.names, tuple(plant.options.values())), {})
    return given if given is not None or name not in rows else [MRAD * value for value in rows[name]]

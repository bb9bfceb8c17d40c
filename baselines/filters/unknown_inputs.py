"""What the filters of state x, fault b and unknown disturbance d take from a plant, and the diagnoser that they become.

The tuning that a method's paper gives for its plant is the caller's. What nobody gives comes from the plant's fault
process (`fdi_gym.estimation.prior`): initial spreads, random walks, noise that stands for the model's errors, and the
thresholds of the decision.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, NotApplicableError
from fdi_gym.estimation.alarm import Estimate, FaultFilter
from fdi_gym.estimation.calibration import FIRST, calibrated_filter, once
from fdi_gym.estimation.flags import largest, tells_apart, with_flags
from fdi_gym.estimation.prior import flights_of, prior
from fdi_gym.estimation.propagation import FaultInputs, fault_inputs, linear_output
from fdi_gym.plant import Array, Plant

TUNING = ("x0_std", "b0_std", "d0_std", "b_step", "d_step")
ABSENT = 1e-3  # initial spread of a disturbance that the process has none of, in units of its scale; it does not walk
FLIGHTS, QUANTILE = 100, 0.99  # thresholds of the flags: this quantile, over so many healthy flights, of the largest |s_i|


class Known(NamedTuple):
    """What the filter knows before its first sample. n_x states, p faults, q disturbances, m sensors with noise."""

    inputs: FaultInputs
    sensors: Array  # (m,) which those are
    H: Array  # (m, n_x)
    x0: Array  # (n_x,)
    P0: Array  # (n_x, n_x)
    Q: Array  # (n_x, n_x)
    R: Array  # (m, m)
    P0b: Array  # (p, p)
    Qb: Array  # (p, p) of the fault's random walk, per step
    P0d: Array  # (q, q)
    Qd: Array  # (q, q)


def initial_covariance(plant: Plant, std: Sequence[float]) -> Array:
    """diag(std^2).

    Raises:
        NotApplicableError: Not one standard deviation per state of this plant.
    """
    if len(std) != len(plant.states):
        raise NotApplicableError(f"x0_std needs one entry per state of {plant.id} ({len(plant.states)}), not {len(std)}")
    return np.diag(np.square(std))


def known_of(
    plant: Plant,
    channels: Sequence[str] | None,
    process: str,
    given: Mapping[str, Any],
    used: Sequence[str] = TUNING,
) -> Known:
    """What a filter knows of the plant: what is given, else what the fault process says.

    Args:
        plant: A plant with sensors y = H x and additive faults.
        channels: The fault channels. Default: all.
        process: The fault process that will be met.
        given: Standard deviations by their name in TUNING, one or one per entry; None where not given.
        used: Those that the filter uses.

    Raises:
        NotApplicableError: The plant is not of that kind, or x0_std does not fit its states.
        ValueError: Another list does not fit, or an unknown process.
    """
    plant.process(process)
    inputs = fault_inputs(plant, channels)
    sensors = np.flatnonzero([s.sigma > 0 for s in plant.outputs])
    if not sensors.size:
        raise NotApplicableError(f"needs sensor noise; {plant.id} has none with {dict(plant.options)}")
    H = linear_output(plant, sensors)
    if plant.measured_disturbance is not None:
        raise NotApplicableError(f"has no place for a disturbance that is known; that of {plant.id} is measured")
    p, q = len(inputs.names), len(plant.disturbances)
    std = {name: given.get(name) for name in used}
    Q, R, P0 = plant.Q, plant.R[np.ix_(sensors, sensors)], None
    if any(value is None for value in std.values()):
        found = prior(plant, process)
        Q, R = found.Q, found.R
        d0, d_walk = ABSENT * np.array([s.scale for s in plant.disturbances]), np.zeros(q)
        d0[found.disturbances], d_walk[found.disturbances] = found.d0, found.d_walk
        size, walk = found.z_size[inputs.estimated], found.z_walk[inputs.estimated]
        P0 = found.P0
        ours = {"b0_std": 0.1 * size, "d0_std": d0, "b_step": walk, "d_step": d_walk}
        std = {name: ours.get(name) if value is None else value for name, value in std.items()}

    def square(name: str, n: int) -> Array:
        value = np.asarray(std.get(name, 0.0), float)
        if value.ndim and value.shape != (n,):
            raise ValueError(f"{name} needs one entry or {n} for {plant.id}, not {value.tolist()}")
        return np.diag(np.broadcast_to(value * value, n))

    if std["x0_std"] is not None:
        P0 = initial_covariance(plant, std["x0_std"])
    assert P0 is not None
    return Known(
        inputs, sensors, H, plant.trim_state, P0, Q, R,
        square("b0_std", p), square("b_step", p), square("d0_std", q), square("d_step", q),
    )  # fmt: skip


def judged(
    plant: Plant,
    inputs: FaultInputs,
    first: Callable[[int], Any],
    advance: Callable[[Any, float, Array, Array], Any],
    read: Callable[[Any], tuple[Array, Array]],
    *,
    decision: str | None,
    process: str,
    alpha: float,
    thresholds: Sequence[float] | None,
    source: str,
    what: str,
) -> Diagnoser:
    """The diagnoser of a filter of the fault vector.

    Args:
        plant, inputs, first, advance, read, alpha: As in `fdi_gym.estimation.flags.with_flags`.
        decision: "flags", or "distance" (see `fdi_gym.estimation.alarm`). Default: flags where thresholds are known or
            flags can tell the plant's labels apart, else distance.
        process: The fault process that will be met: decisions are calibrated on its healthy flights when first used.
        thresholds: Of the flags, one per channel, where they are known.
        source: The method's file.
        what: Its name and tuning.

    Raises:
        NotApplicableError: The distance, and not all fault channels.
        ValueError: Unknown decision, or not one threshold per channel.
    """
    if decision is None:
        decision = "flags" if thresholds is not None or tells_apart(plant, inputs) else "distance"
    if decision == "flags":

        def calibrate() -> list[float]:
            record = flights_of(plant, process, FIRST, FLIGHTS, False)[1]
            bare = with_flags(plant, inputs, first, advance, read, alpha=alpha, thresholds=np.ones(len(inputs.names)))
            return np.quantile(largest(bare, record.obs, record.length), QUANTILE, axis=0).tolist()

        J = functools.cache(lambda: once(plant, process, source, f"{what} {alpha} flags", calibrate))
        return with_flags(
            plant, inputs, first, advance, read, alpha=alpha, thresholds=J if thresholds is None else thresholds
        )
    if decision != "distance":
        raise ValueError(f"unknown decision {decision!r}; there are flags, distance")
    if len(inputs.names) < len(plant.estimated):
        raise NotApplicableError(
            f"the distance to labels needs all fault channels of {plant.id}: {', '.join(s.name for s in plant.estimated)}"
        )
    order = np.argsort(inputs.estimated)  # the channels as the plant declares them

    def start(n: int) -> Any:
        return 0, first(n)

    def step(state: Any, obs: Array) -> Any:
        k, s = state
        y, u, _ = plant.split(obs)
        return k + 1, s if k == 0 else advance(s, (k - 1) * plant.dt, u, y)  # at first no interval has ended

    def estimate(state: Any) -> Estimate:
        b, P = read(state[1])
        none = np.zeros((len(b), 0))
        return Estimate(b[:, order], P[:, order[:, None], order], none, none[:, :, None])

    filter = FaultFilter(start, step, estimate)
    return calibrated_filter(
        plant, filter, "distance", np.ones(len(order)), process=process, source=source, what=f"{what} distance"
    )

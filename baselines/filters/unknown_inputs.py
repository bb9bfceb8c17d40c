"""What the filters of state x, fault b and unknown disturbance d know of a plant, and the diagnoser that they become.

The tuning that a method's paper gives for its plant is the caller's. What nobody gives comes from the belief: initial
spreads, random walks, noise that stands for the model's errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser_of
from fdi_gym.estimation.belief import Belief, FaultInputs, fault_inputs, noisy_sensors
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.channels import by_channels
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.labels import tells_apart
from fdi_gym.estimation.linear import linear_output
from fdi_gym.plant import Array, Plant

TUNING = ("x0_std", "b0_std", "d0_std", "b_step", "d_step")
ABSENT = 1e-3  # initial spread of a disturbance that is not believed to occur, in units of its scale; it does not walk


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
    plant: Plant, belief: Belief, channels: Sequence[str] | None, given: Mapping[str, Any], used: Sequence[str] = TUNING
) -> Known:
    """What a filter knows of the plant: what is given, else what is believed.

    Args:
        plant: A plant with sensors y = H x and additive faults.
        belief: What is believed of it.
        channels: The fault channels. Default: all.
        given: Standard deviations by their name in TUNING, one or one per entry; None where not given.
        used: Those that the filter uses.

    Raises:
        NotApplicableError: The plant is not of that kind, or x0_std does not fit its states.
        ValueError: Another list does not fit, or the belief is another plant's.
    """
    inputs, sensors = fault_inputs(plant, channels), noisy_sensors(plant)
    H = linear_output(plant, sensors)
    if plant.measured_disturbance is not None:
        raise NotApplicableError(f"has no place for a disturbance that is known; that of {plant.id} is measured")
    p, q = len(inputs.names), len(plant.disturbances)
    std = {name: given.get(name) for name in used}
    Q, R, P0 = plant.Q, plant.R[np.ix_(sensors, sensors)], None
    if any(value is None for value in std.values()):
        if len(belief.x0) != len(plant.states) or len(belief.z_size) != len(plant.estimated):
            raise ValueError(f"the belief is not one of {plant.id}: its states or faults are others")
        Q, R, P0 = belief.Q, belief.R, belief.P0
        d0, d_walk = ABSENT * np.array([s.scale for s in plant.disturbances]), np.zeros(q)
        d0[belief.disturbances], d_walk[belief.disturbances] = belief.d0, belief.d_walk
        size, walk = belief.z_size[inputs.estimated], belief.z_walk[inputs.estimated]
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


def of_all_channels(plant: Plant, inputs: FaultInputs, r: Reading) -> Reading:
    """A reading of the fault channels (n, p) as one of the whole estimated space: the others are healthy for sure."""
    assert r.z is not None
    assert r.P is not None
    n, width = len(r.z), len(plant.estimated)
    z, P = np.zeros((n, width)), np.zeros((n, width, width))
    z[:, inputs.estimated] = r.z
    P[:, inputs.estimated[:, None], inputs.estimated] = r.P
    return r._replace(z=z, P=P)


def decided(
    plant: Plant,
    inputs: FaultInputs,
    filter: Filter,
    calibration: Calibration,
    *,
    decision: str | None,
    alpha: float,
    thresholds: Sequence[float] | None,
) -> Diagnoser:
    """The diagnoser of a filter of the fault channels.

    Args:
        plant: The plant.
        inputs: The channels, in which the filter's readings are.
        filter: The filter.
        calibration: When it alarms.
        decision: "channels": each smoothed and compared with its threshold. "distance": to the labels. Default: channels
            where thresholds are given or they can tell the plant's labels apart, else distance.
        alpha: Smoothing of the channels.
        thresholds: Of the channels, one each. Default: the calibration's; a channel without any never turns on.

    Raises:
        NotApplicableError: The distance, and not all fault channels.
        ValueError: Unknown decision, or not one threshold per channel.
    """
    if decision is None:
        decision = "channels" if thresholds is not None or tells_apart(plant, inputs) else "distance"
    if decision == "channels":
        found = [calibration.channels.get(name, np.inf) for name in inputs.names]
        rule = by_channels(plant, inputs, alpha, np.array(found if thresholds is None else thresholds))
    elif decision == "distance":
        if len(inputs.names) < len(plant.estimated):
            names = ", ".join(s.name for s in plant.estimated)
            raise NotApplicableError(f"the distance to labels needs all fault channels of {plant.id}: {names}")
        rule = by_labels(plant, calibration)
    else:
        raise ValueError(f"unknown decision {decision!r}; there are channels, distance")
    return diagnoser_of(plant, filter._replace(read=lambda s: of_all_channels(plant, inputs, filter.read(s))), rule)

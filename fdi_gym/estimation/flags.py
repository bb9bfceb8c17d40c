"""Flags: each entry of an estimated fault vector is smoothed and compared with a threshold, with hysteresis.

    s_k = (1 - alpha) s_{k-1} + alpha b_k

Entry i is flagged when |s_i| > J_i for some consecutive samples, and cleared when |s_i| < J_i / 2 for some more. The
set of flagged entries is the label.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.estimation.propagation import FaultInputs
from fdi_gym.plant import Array, Plant


class Flags(NamedTuple):
    """State of the logic."""

    s: Array  # (n, p) smoothed estimate
    over: Array  # (n, p) consecutive samples above the threshold
    under: Array  # (n, p) consecutive samples below half of it
    on: Array  # (n, p) bool


def start(n: int, p: int) -> Flags:
    """Nothing flagged, nothing smoothed yet."""
    return Flags(np.zeros((n, p)), np.zeros((n, p), np.int64), np.zeros((n, p), np.int64), np.zeros((n, p), bool))


def step(flags: Flags, b: Array, alpha: float, thresholds: Array, *, raise_after: int = 3, clear_after: int = 20) -> Flags:
    """The logic after an estimate b (n, p)."""
    s = (1 - alpha) * flags.s + alpha * b
    size = np.abs(s)
    over = np.where(size > thresholds, flags.over + 1, 0)
    under = np.where(size < 0.5 * thresholds, flags.under + 1, 0)
    return Flags(s, over, under, (flags.on | (over >= raise_after)) & (under < clear_after))


def label_sets(plant: Plant, inputs: FaultInputs) -> tuple[Array, Array]:
    """The labels that these channels can express, and their channels: (labels,) indices, (labels, p) bool.

    A fault mode's channel is the entry of the estimated space along which it lies.
    """
    channel = {mode.name: int(np.argmax(np.abs(mode.direction))) for mode in plant.modes}
    order = [int(i) for i in inputs.estimated]
    found, sets = [], []
    for index, label in enumerate(plant.labels):
        members = {channel[name] for name in label.modes}
        if len(members) == len(label.modes) and members <= set(order):
            found.append(index)
            sets.append([i in members for i in order])
    return np.array(found), np.array(sets)


def label_of_flags(labels: Array, sets: Array, on: Array, severity: Array) -> Array:
    """The label (n,) whose channels are flagged: exactly the set where there is such a label.

    With more channels flagged than any label has, it is the most severe part of them that has one.
    """
    fits = ~(sets[None] & ~on[:, None]).any(axis=2)
    weight = np.where(sets[None], 1.0 + severity[:, None], 0.0).sum(axis=2)
    return labels[np.argmax(np.where(fits, weight, -1.0), axis=1)]


def tells_apart(plant: Plant, inputs: FaultInputs) -> bool:
    """Whether flags on these channels can say which fault it is: each mode moves one of them at most, no two the same."""
    moved = np.array([np.add(np.abs(mode.offset), np.abs(mode.direction)) > 0 for mode in plant.modes])[:, inputs.estimated]
    return bool((moved.sum(axis=1) <= 1).all() and (moved.sum(axis=0) <= 1).all())


def with_flags(
    plant: Plant,
    inputs: FaultInputs,
    first: Callable[[int], Any],
    advance: Callable[..., Any],
    read: Callable[[Any], tuple[Array, Array]],
    *,
    alpha: float,
    thresholds: Sequence[float] | Array | Callable[[], Sequence[float]],
) -> Diagnoser:
    """A diagnoser from a filter of the fault vector and the flag logic. Its state is (k, filter's state, Flags).

    Args:
        plant: The plant.
        inputs: The fault channels.
        first: first(n) gives the filter's state.
        advance: advance(state, t, u, y) gives the next one, t [s] being where the interval that has just ended began.
        read: The fault vector (n, p) and its covariance (n, p, p), from the filter's state.
        alpha: Smoothing factor.
        thresholds: One per channel, in the unit of the estimate; or what gives them when the diagnoser is first used.

    Raises:
        ValueError: Not one threshold per channel.
    """
    p = len(inputs.names)
    if not callable(thresholds) and np.shape(thresholds) != (p,):
        raise ValueError(f"one threshold per channel ({', '.join(inputs.names)}) is needed, not {list(thresholds)}")
    labels, sets = label_sets(plant, inputs)

    def init(n: int) -> Any:
        return 0, first(n), start(n, p)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        J = np.asarray(thresholds() if callable(thresholds) else thresholds, float)
        k, s, flags = state
        y, u, _ = plant.split(obs)
        n = len(obs)
        if k == 0:  # no interval has ended: the filter starts from its prior
            b, cov = np.zeros((n, p)), np.full((n, p, p), np.nan)
        else:
            s = advance(s, (k - 1) * plant.dt, u, y)
            b, cov = read(s)
            flags = step(flags, b, alpha, J)
        label = label_of_flags(labels, sets, flags.on, np.abs(flags.s) / J)
        std = np.zeros((n, len(plant.estimated)))
        std[:, inputs.estimated] = np.sqrt(np.einsum("npp->np", cov))
        theta = plant.estimate_target(inputs.theta(plant, b), u)
        return (k + 1, s, flags), Diagnosis(np.any(flags.on, axis=1), label, theta, std)

    return Diagnoser(init, update)


def largest(diagnoser: Diagnoser, obs: Array, length: Array | None = None) -> Array:
    """The largest smoothed estimate |s_i| of each flight (n, p), for a diagnoser as `with_flags` gives it.

    Args:
        diagnoser: The diagnoser; its thresholds don't matter.
        obs: Observations (n, samples, n_obs).
        length: Last sample of each flight (n,). Default: all are whole.
    """
    state = diagnoser.init(len(obs))
    most = np.zeros_like(state[-1].s)
    for k in range(obs.shape[1]):
        state, _ = diagnoser.update(state, obs[:, k])
        size = np.abs(state[-1].s)
        np.maximum(most, size if length is None else np.where((k <= length)[:, None], size, 0.0), out=most)
    return most

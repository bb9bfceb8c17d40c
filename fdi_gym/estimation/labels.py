"""The labels as sets: what each looks like in the space of the estimate, and which channels it moves.

A label of f simultaneous faults spans offset + directions m, low <= m <= high, in the estimated space; how well it fits an
estimate is its distance in the metric of the estimate's covariance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.belief import FaultInputs
from fdi_gym.plant import Array, FaultMode, Plant, contiguous


class Manifolds(NamedTuple):
    """The sets that labels of f simultaneous faults span in the estimated space: offset + directions m, low <= m <= high."""

    labels: Array  # (h,) label indices
    offset: Array  # (h, p)
    direction: Array  # (h, p, f)
    low: Array  # (h, f)
    high: Array  # (h, f)


def manifolds(plant: Plant) -> list[Manifolds]:
    """The faulty labels of a plant as sets, from the lines of their modes, grouped by the number of faults."""
    modes = {mode.name: mode for mode in plant.modes}
    groups: dict[int, list[tuple[int, list[FaultMode]]]] = {}
    for index, label in enumerate(plant.labels):
        if label.modes:
            groups.setdefault(len(label.modes), []).append((index, [modes[name] for name in sorted(label.modes)]))
    return [
        Manifolds(
            np.array([index for index, _ in group]),
            np.array([np.sum([line.offset for line in lines], axis=0) for _, lines in group]),
            np.array([np.transpose([line.direction for line in lines]) for _, lines in group]),
            np.array([[line.reach[0] for line in lines] for _, lines in group]),
            np.array([[line.reach[1] for line in lines] for _, lines in group]),
        )
        for _, group in sorted(groups.items())
    ]


def nearest_of(I: Array, Iz: Array, sets: Manifolds) -> tuple[Array, Array]:  # noqa: E741
    """min over m in its box of q' I q - 2 q' Iz with q = offset + D m, the log likelihood ratio of a set, times -2.

    I (n or 1, p, p) information about the deviation from healthy, Iz (n, p) what it says. Returns (n, h) and m (n, h, f).
    """
    from fdi_gym.estimation import compiled

    D, offset = sets.direction, sets.offset
    Io = (I @ offset.T).swapaxes(1, 2)  # (n, h, p)
    base = (Io * offset).sum(axis=2) - 2 * Iz @ offset.T
    g = ((Iz[:, None, :] - Io)[:, :, None, :] @ D)[:, :, 0, :]  # (n, h, f)
    G = np.swapaxes(D, 1, 2) @ I[:, None] @ D  # (n, h, f, f)
    G = G if len(G) == len(g) else np.repeat(G, len(g), axis=0)  # the kernel does not repeat the only row of I
    m, value = np.zeros_like(g), np.empty_like(base)
    compiled.box_minimum(*(contiguous(a) for a in (G, g, sets.low, sets.high)), m, value)
    return base + value, m


def closest(z: Array, I: Array, sets: Manifolds) -> tuple[Array, Array]:  # noqa: E741
    """Distance of each estimate to each set: min over m in its box of (z - offset - D m)' I (z - offset - D m).

    z (n, p), I = P^-1 (n, p, p). Returns (J (n, h), m (n, h, f)).
    """
    Iz = (I @ z[..., None])[..., 0]
    value, m = nearest_of(I, Iz, sets)
    return (Iz * z).sum(axis=1)[:, None] + value, m


class Distances(NamedTuple):
    """The faulty labels ranked by distance, over all groups."""

    labels: Array  # (h,)
    J: Array  # (n, h)
    J_healthy: Array  # (n,)
    deviation: Array  # (n, h, p) the closest point of each label's set


def distances(z: Array, P: Array, groups: list[Manifolds]) -> Distances:
    """Distances of the estimate to healthy and to every faulty label, in the metric of its covariance."""
    I = np.linalg.inv(P)  # noqa: E741 (the metric itself is needed: it weighs many residuals)
    parts = [closest(z, I, sets) for sets in groups]
    points = [sets.offset + (sets.direction @ m[..., None])[..., 0] for sets, (_, m) in zip(groups, parts, strict=True)]
    return Distances(
        np.concatenate([sets.labels for sets in groups]),
        np.concatenate([J for J, _ in parts], axis=1),
        (z[:, None, :] @ I @ z[:, :, None])[:, 0, 0],
        np.concatenate(points, axis=1),
    )


# ------------------------------------------------------------------------------------------
# Channels: labels told apart by which entries of the fault vector they move


def channel_sets(plant: Plant, inputs: FaultInputs) -> tuple[Array, Array]:
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


def label_of_channels(labels: Array, sets: Array, on: Array, severity: Array) -> Array:
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

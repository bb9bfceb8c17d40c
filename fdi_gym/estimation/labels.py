"""The labels as sets: what each looks like in the space of the estimate, and which channels it moves.

A label of f simultaneous faults spans offset + directions m, low <= m <= high, in the estimated space; how well it fits an
estimate is its distance in the metric of the estimate's covariance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation import label_kernels
from fdi_gym.estimation.belief import FaultInputs
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant


class Manifolds(NamedTuple):
    """The sets that the faulty labels span in the estimated space: offset + direction m, low <= m <= high.

    They have up to f simultaneous faults; what is beyond a label's own number is 0.
    """

    labels: Array  # (h,) label indices
    faults: Array  # (h,) simultaneous faults of each
    offset: Array  # (h, p)
    direction: Array  # (h, p, f)
    low: Array  # (h, f)
    high: Array  # (h, f)

    def points(self, m: Array) -> Array:
        """The points of the magnitudes m (..., h, f): (..., h, p)."""
        return self.offset + (self.direction @ m[..., None])[..., 0]


def manifolds(plant: Plant) -> Manifolds:
    """The faulty labels of a plant as sets, from the lines of their modes, those with fewer faults first."""
    modes = {mode.name: mode for mode in plant.modes}
    faulty = sorted((i for i, label in enumerate(plant.labels) if label.modes), key=lambda i: len(plant.labels[i].modes))
    faults = np.array([len(plant.labels[i].modes) for i in faulty], np.int64)
    h, p, f = len(faulty), len(plant.estimated), int(faults.max(initial=0))
    offset, direction, low, high = np.zeros((h, p)), np.zeros((h, p, f)), np.zeros((h, f)), np.zeros((h, f))
    for row, index in enumerate(faulty):
        for column, name in enumerate(sorted(plant.labels[index].modes)):
            line = modes[name]
            offset[row] += line.offset
            direction[row, :, column] = line.direction
            low[row, column], high[row, column] = line.reach
    return Manifolds(np.array(faulty, np.int64), faults, offset, direction, low, high)


def nearest_of(I: Array, Iz: Array, sets: Manifolds) -> tuple[Array, Array]:  # noqa: E741
    """min over m in its box of q' I q - 2 q' Iz with q = offset + D m, the log likelihood ratio of a set, times -2.

    I (n or 1, p, p) information about the deviation from healthy, Iz (n, p) what it says. Returns (n, h) and m (n, h, f).
    """
    n, (h, _, f) = len(Iz), sets.direction.shape
    value, m = np.empty((n, h)), np.empty((n, h, f))
    label_kernels.nearest(contiguous(I), contiguous(Iz), *sets[1:], value, m)
    return value, m


class Distances(NamedTuple):
    """Squared distances of estimates to healthy and to the faulty labels."""

    J: Array  # (n, 1 + h) to healthy, and to the sets in their order
    m: Array  # (n, h, f) magnitudes of the closest point of each set


def distances(z: Array, P: Array, sets: Manifolds, excess: Array | None = None) -> Distances:
    """Distances of the estimate to healthy and to every faulty label, in the metric of its covariance.

    Args:
        z: Deviation from healthy (n, p).
        P: Its covariance, (n, p, p) or (1, p, p) for all.
        sets: The labels.
        excess: What the covariance lacks (p, p). Default: nothing.
    """
    n, (h, p, f) = len(z), sets.direction.shape
    J, m = np.empty((n, 1 + h)), np.empty((n, h, f))
    nothing = np.zeros((p, p)) if excess is None else excess
    label_kernels.distances(contiguous(z), contiguous(P), nothing, *sets[1:], J, m)
    return Distances(J, m)


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

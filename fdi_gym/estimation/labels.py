"""The labels as sets: what each looks like in the space of the estimate, and which channels it moves.

A label whose faults have f magnitudes spans offset + directions m, low <= m <= high, in the estimated space, a line, a plane
or more; how well it fits an estimate is its distance in the metric of the estimate's covariance.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from fdi_gym.estimation import label_kernels
from fdi_gym.estimation.belief import FaultInputs
from fdi_gym.kernels import address
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant


class Manifolds(NamedTuple):
    """The sets that the faulty labels span in the estimated space: offset + direction m, low <= m <= high.

    They have up to f magnitudes; what is beyond a label's own number is 0.
    """

    labels: Array  # (h,) label indices
    magnitudes: Array  # (h,) how many each has: one a fault, more for a fault that is a plane
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
    magnitudes = magnitudes_of_labels(plant)[faulty]
    h, p, f = len(faulty), len(plant.estimated), int(magnitudes.max(initial=0))
    offset, direction, low, high = np.zeros((h, p)), np.zeros((h, p, f)), np.zeros((h, f)), np.zeros((h, f))
    for row, index in enumerate(faulty):
        column = 0
        for name in sorted(plant.labels[index].modes):
            mode = modes[name]
            mine = slice(column, column := column + len(mode.directions))
            offset[row] += mode.offset
            direction[row, :, mine] = mode.directions.T
            low[row, mine], high[row, mine] = mode.reaches.T
    return Manifolds(np.array(faulty, np.int64), magnitudes, offset, direction, low, high)


def magnitudes_of_labels(plant: Plant) -> Array:
    """How many magnitudes the faults of each label have together (labels,)."""
    count = {mode.name: len(mode.directions) for mode in plant.modes}
    return np.array([sum(count[name] for name in label.modes) for label in plant.labels], np.int64)


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
    label_kernels.distances(
        address(label_kernels.fit_lanes), contiguous(z), contiguous(P), nothing, np.arange(1, 1 + h), *sets[1:], J, m
    )
    return Distances(J, m)


# ------------------------------------------------------------------------------------------
# Channels: labels told apart by which entries of the fault vector they move


def channel_sets(plant: Plant, inputs: FaultInputs) -> tuple[Array, Array]:
    """The labels that these channels can express, and their channels: (labels,) indices, (labels, p) bool.

    A fault mode's channel is the entry of the estimated space along which it lies; of a plane there is one a direction.
    """
    channels = {mode.name: np.argmax(np.abs(mode.directions), axis=1).tolist() for mode in plant.modes}
    order, count = [int(i) for i in inputs.estimated], magnitudes_of_labels(plant)
    found, sets = [], []
    for index, label in enumerate(plant.labels):
        members = {channel for name in label.modes for channel in channels[name]}
        if len(members) == count[index] and members <= set(order):
            found.append(index)
            sets.append([i in members for i in order])
    return np.array(found), np.array(sets)


def flags_of(plant: Plant, inputs: FaultInputs) -> tuple[Array, Array]:
    """Which flags on these channels say which label: (rows,) labels, (rows, p) bool, as `label_of_channels` takes them.

    As `channel_sets`; of a plane a flag on any of its channels says it, so a label with planes has several rows.
    """
    labels, sets = channel_sets(plant, inputs)
    planes = {m.name: m.moves[inputs.estimated] for m in plant.modes if len(m.directions) > 1}
    found, rows = [labels], [sets]
    for index, row in zip(labels, sets, strict=True):
        parts = [planes[name] for name in plant.labels[index].modes if name in planes]
        for left in itertools.product(*(_proper_parts(part) for part in parts)):
            less = row & ~np.any(left, axis=0)
            if (less != row).any():
                found.append(np.array([index]))
                rows.append(less[None])
    return np.concatenate(found), np.concatenate(rows)


def _proper_parts(mask: Array) -> list[Array]:
    """All masks of a part of True entries that is not the whole."""
    where = np.flatnonzero(mask)
    chosen = itertools.chain.from_iterable(itertools.combinations(where, n) for n in range(len(where)))
    return [np.isin(np.arange(len(mask)), part) for part in chosen]


def label_of_channels(labels: Array, sets: Array, on: Array, severity: Array) -> Array:
    """The label (n,) whose channels are flagged: exactly the set where there is such a label.

    With more channels flagged than any label has, it is the most severe part of them that has one.
    """
    fits = ~(sets[None] & ~on[:, None]).any(axis=2)
    weight = np.where(sets[None], 1.0 + severity[:, None], 0.0).sum(axis=2)
    return labels[np.argmax(np.where(fits, weight, -1.0), axis=1)]


def tells_apart(plant: Plant, inputs: FaultInputs) -> bool:
    """Whether flags on these channels can say which fault it is: each magnitude moves one of them, no two modes the same."""
    moved = np.array([mode.moves for mode in plant.modes])[:, inputs.estimated]
    count = np.array([len(mode.directions) for mode in plant.modes])
    return bool((moved.sum(axis=1) <= count).all() and (moved.sum(axis=0) <= 1).all())

"""What a fault does to a healthy model: linearised signatures, and the labels that residuals with such signatures speak for.

A residual r with covariance S that a fault vector z moves by V z says V' S^-1 V about z (information) and V' S^-1 r. Sums
of these over time have a log likelihood ratio for every label (`labels.nearest_of`). When a fault began is not known: sums
that forget at several paces are kept, and each label takes the one that speaks most for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, times
from fdi_gym.estimation.labels import Manifolds, nearest_of
from fdi_gym.plant import Array, Plant


def secants(plant: Plant, size: Array) -> tuple[Array, Array]:
    """The two magnitudes (p,) between which the signature of each entry is taken.

    Between healthy and a typical fault where the modes on that entry have one sign; else symmetric about healthy.
    """
    up, down = np.zeros(len(size), bool), np.zeros(len(size), bool)
    for mode in plant.modes:
        ends = mode.directions[:, :, None] * mode.reaches[:, None]  # (f, p, 2)
        up |= mode.offset + ends.max(axis=2).sum(axis=0) > 0
        down |= mode.offset + ends.min(axis=2).sum(axis=0) < 0
    return np.where(down | ~up, -size, 0.0), np.where(up | ~down, size, 0.0)


class Signatures(NamedTuple):
    """How a function of the augmented model changes."""

    mean: Array  # (n, m)
    A: Array  # (n, m, N) with state and disturbance
    E: Array  # (n, m, p) with a unit of each fault entry


def linearised(
    model: AugmentedModel, g: Callable[[Array], Array], X: Array, low: Array, high: Array, images: slice | list[int]
) -> Signatures:
    """A function g of the model at the healthy estimate X (n, N) of state and disturbance; `images`: entries that count."""
    n, p, rest, zs = len(X), len(low), model.rest, model.z
    N = len(rest)
    points = np.zeros((n, 1 + 2 * N + 2 * p, len(model.scale)))
    points[:, :, rest] = X[:, None]
    step = model.compiled.step[rest]
    for j, i in enumerate(rest):
        points[:, 1 + j, i] += step[j]
        points[:, 1 + N + j, i] -= step[j]
    for j in range(p):
        points[:, 1 + 2 * N + j, zs.start + j] = high[j]
        points[:, 1 + 2 * N + p + j, zs.start + j] = low[j]
    F = g(points)[..., images]
    A = T((F[:, 1 : 1 + N] - F[:, 1 + N : 1 + 2 * N]) / (2 * step[:, None]))
    E = T((F[:, 1 + 2 * N : 1 + 2 * N + p] - F[:, 1 + 2 * N + p :]) / (high - low)[:, None])
    return Signatures(F[:, 0], A, E)


class Local(NamedTuple):
    """The model about a healthy path: one sample ahead, and at the sensors."""

    model: AugmentedModel
    low: Array  # (p,) magnitudes between which a fault's signature is taken
    high: Array  # (p,)

    def f(self, X: Array, at: Interval) -> Signatures:
        """One sample after X (n, N), states and disturbances."""
        return linearised(self.model, lambda points: self.model.f(points, at), X, self.low, self.high, self.model.rest)

    def h(self, X: Array, at: Interval) -> Signatures:
        """What the sensors read at X (n, N)."""
        H, n = self.model.H, len(X)
        if H is None:
            return linearised(self.model, lambda points: self.model.h(points, at), X, self.low, self.high, slice(None))
        A, E = H[:, self.model.rest], H[:, self.model.z]
        return Signatures(times(A, X), np.tile(A, (n, 1, 1)), np.tile(E, (n, 1, 1)))


def local(model: AugmentedModel, size: Array) -> Local:
    """The model of a plant about a path; size (p,): of its typical faults."""
    return Local(model, *secants(model.plant, size))


class Sums(NamedTuple):
    """What residuals have said about the fault vector, at each of several paces of forgetting."""

    G: Array  # (n, paces, p, p) information
    g: Array  # (n, paces, p)


def nothing_said(n: int, paces: int, p: int) -> Sums:
    """Before any residual."""
    return Sums(np.zeros((n, paces, p, p)), np.zeros((n, paces, p)))


def heard(s: Sums, keep: Array, I: Array, Iz: Array, new: Array) -> Sums:  # noqa: E741
    """The sums after a residual.

    Args:
        s: Before it.
        keep: What each pace keeps of the past (paces,).
        I, Iz: V' S^-1 V (n, p, p) and V' S^-1 r (n, p).
        new: (n,) bool: where there is a residual; elsewhere nothing changes.
    """
    G, g = keep[:, None, None] * s.G + I[:, None], keep[:, None] * s.g + Iz[:, None]
    return Sums(np.where(new[:, None, None, None], G, s.G), np.where(new[:, None, None], g, s.g))


def spoken_for(G: Array, g: Array, sets: Manifolds, labels: int) -> tuple[Array, Array]:
    """The cost of each label (n, labels) and the fault vector of the one that fits best (n, p).

    Args:
        G, g: Sums (n, alternatives, p, p) and (n, alternatives, p): of onsets or paces; each label has its best.
        sets: The faulty labels.
        labels: How many there are; health costs 0.
    """
    n, many, p = g.shape
    h = len(sets.labels)
    cost, z = np.zeros((n, labels)), np.zeros((n, labels, p))
    value, magnitude = nearest_of(G.reshape(n * many, p, p), g.reshape(n * many, p), sets)
    value, magnitude = value.reshape(n, many, h), magnitude.reshape(n, many, h, -1)
    rows, columns, when = np.arange(n)[:, None], np.arange(h), np.argmin(value, axis=1)  # (n, h)
    cost[:, sets.labels] = value[rows, when, columns]
    z[:, sets.labels] = sets.points(magnitude[rows, when, columns])
    return cost, z[np.arange(n), np.argmin(cost, axis=1)]

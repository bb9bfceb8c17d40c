"""Decision logic: from an estimate of the fault parameter and its covariance to an alarm and a label.

Each logic is a part that any parameter-estimating filter can use: `start(n)` gives its state for n episodes, and
`step(state, k, z, P)` takes the estimate's deviation from healthy z (n, p) and covariance P (n, p, p) at sample k and
returns (state, Decision).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.plant import Array, Plant


class Decision(NamedTuple):
    """What a logic says after a sample."""

    alarm: Array  # (n,) bool
    label: Array  # (n,) int
    structured: Array  # (n, p) the deviation that the label's own line explains best; 0 without alarm


class Logic(NamedTuple):
    """A pair of functions; see the module's docstring."""

    start: Callable[[int], Any]
    step: Callable[[Any, int, Array, Array], tuple[Any, Decision]]


class Manifolds(NamedTuple):
    """The set that each label spans in the estimated space: offset + directions @ m, m between low and high."""

    labels: list[int]
    offset: list[Array]  # (p,)
    direction: list[Array]  # (p, faults)
    low: list[Array]  # (faults,)
    high: list[Array]


def manifolds(plant: Plant) -> Manifolds:
    """The faulty labels of a plant as sets, from the lines of their modes."""
    found = Manifolds([], [], [], [], [])
    modes = {mode.name: mode for mode in plant.modes}
    for index, label in enumerate(plant.labels):
        lines = [modes[name] for name in sorted(label.modes)]
        if lines:
            found.labels.append(index)
            found.offset.append(np.sum([line.offset for line in lines], axis=0))
            found.direction.append(np.array([line.direction for line in lines]).T)
            found.low.append(np.array([line.reach[0] for line in lines]))
            found.high.append(np.array([line.reach[1] for line in lines]))
    return found


def closest(z: Array, I: Array, offset: Array, D: Array, low: Array, high: Array) -> tuple[Array, Array]:  # noqa: E741
    """Least squares in a box: min over low <= m <= high of (z - offset - D m)' I (z - offset - D m).

    z (n, p), I (n, p, p), D (p, f). Returns (cost (n,), m (n, f)). Exact: the minimum of a convex quadratic over a
    box lies where some coordinates are free and the others at a bound, and all such choices are tried.
    """
    q = z - offset
    ID = I @ D  # (n, p, f)
    G = np.swapaxes(ID, 1, 2) @ D  # (n, f, f)
    g = np.einsum("npf,np->nf", ID, q)
    base = np.einsum("np,npr,nr->n", q, I, q)
    f = D.shape[1]
    cost, best = np.full(len(z), np.inf), np.zeros((len(z), f))
    for choice in itertools.product((None, 0, 1), repeat=f):
        m = np.array([0.0 if c is None else (low, high)[c][i] for i, c in enumerate(choice)])
        m = np.tile(m, (len(z), 1))
        free = [i for i, c in enumerate(choice) if c is None]
        fixed = [i for i, c in enumerate(choice) if c is not None]
        if free:
            right = g[:, free] - np.einsum("nij,nj->ni", G[:, free][:, :, fixed], m[:, fixed])
            m[:, free] = np.linalg.solve(G[:, free][:, :, free], right[..., None])[..., 0]
            # what rounding puts a hair outside is inside; the rest is another choice's business
            inside = ((m >= low - 1e-12) & (m <= high + 1e-12)).all(axis=1)
        else:
            inside = np.ones(len(z), bool)
        value = base - 2 * np.einsum("nf,nf->n", g, m) + np.einsum("ni,nij,nj->n", m, G, m)
        better = inside & (value < cost)
        cost, best = np.where(better, value, cost), np.where(better[:, None], m, best)
    return cost, best


def _count(condition: Array, counter: Array) -> Array:
    """Consecutive samples on which the condition has held."""
    return np.where(condition, counter + 1, 0)


def distance_logic(
    plant: Plant,
    *,
    threshold: float = 8.0,
    alarm_after: int = 5,
    switch_after: int = 10,
    release_after: int = 50,
    warmup: int = 150,
) -> Logic:
    """Mahalanobis distance of the estimate to the faulty labels' manifolds against its distance to healthy.

    G = J_0 - min J_h is the gain in fit of the best faulty label. Alarm at the `alarm_after`-th consecutive sample with
    G > threshold; in alarm, the label follows the best one after it differed for `switch_after` samples, and is
    released after `release_after` samples with G < threshold / 2 (a release wins over a switch). Silent and not
    counting for the first `warmup` samples.
    """
    sets = manifolds(plant)
    labels = np.array(sets.labels)
    p = len(plant.estimated)

    def start(n: int) -> tuple[Array, ...]:
        return tuple(np.zeros(n, np.int64) for _ in range(4))

    def step(state: tuple[Array, ...], k: int, z: Array, P: Array) -> tuple[tuple[Array, ...], Decision]:
        label, over, other, under = state
        n = len(z)
        if k <= warmup:
            return state, Decision(np.zeros(n, bool), label, np.zeros((n, p)))
        I = np.linalg.inv(P)  # noqa: E741 (the metric itself is needed: it weighs many residuals)
        fits = [closest(z, I, *line) for line in zip(*sets[1:], strict=True)]
        J = np.stack([cost for cost, _ in fits], axis=1)
        best = np.argmin(J, axis=1)
        gain = np.einsum("np,npr,nr->n", z, I, z) - J[np.arange(n), best]
        best = labels[best]
        on = label > 0
        over = _count((gain > threshold) & ~on, over)
        other = _count((best != label) & on, other)
        under = _count((gain < threshold / 2) & on, under)
        raised, released = over == alarm_after, under == release_after
        switched = other == switch_after
        label = np.where(released, 0, np.where(raised | switched, best, label))
        over, other, under = (
            np.where(raised, 0, over),
            np.where(switched | released, 0, other),
            np.where(released, 0, under),
        )
        structured = np.zeros((n, p))
        for i, (_, m) in enumerate(fits):
            mine = label == labels[i]
            structured[mine] = sets.offset[i] + m[mine] @ sets.direction[i].T
        return (label, over, other, under), Decision(label > 0, label, structured)

    return Logic(start, step)

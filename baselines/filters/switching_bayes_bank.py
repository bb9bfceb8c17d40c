"""Switching Bayes bank: the Boeing 747's faults come and go at unknown times.

Hypotheses "healthy", "active since tau" and "recovering since off"; every 10 samples old recoveries are merged into
healthy, long-lived faults may end, and a new fault may begin. It takes the gaps as geometric with a mean of 25 s and
cuts the transient of a recovery after 4 s, so the optimum of a causal diagnoser lies somewhat above it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from baselines.filters import kalman_filter
from baselines.filters.bayes_bank import LOG_WEIGHT, Sizes, check, label_probabilities, marginals, most_probable
from baselines.filters.kalman_filter import Healthy, Nominal, sense
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.diagnosis.contract import map_arrays
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant

START, GRID = 200, 10  # first sample and period of the bookkeeping
SHORTEST, LONGEST = 150, 310  # age at which a fault may end, and by which it has
MERGE_AFTER = 40  # samples after which a recovery is healthy again
P_BEGIN = 10.0 / 250.0  # probability of a new fault per period


class Turn(NamedTuple):
    """What the bookkeeping does at a step: the hypotheses are the same in every flight, since they follow from the clock."""

    before: int  # hypotheses before it
    old: Array  # (before,) bool: recoveries that merge into healthy
    stays: Array  # indices that stay, and
    staying: Array  # their log probabilities of doing so
    ends: Array  # indices of faults that may end, and
    leaving: Array  # the log probabilities
    begun: Array  # steps at which the hypotheses after it began
    ended: Array  # and ended, -1 for active ones


def first_turn() -> Turn:
    """Before anything has begun."""
    none = np.zeros(0, np.int64)
    return Turn(0, np.zeros(0, bool), none, np.zeros(0), none, np.zeros(0), none, none)


@functools.lru_cache(maxsize=4096)
def turn(step: int) -> Turn:
    """The bookkeeping at a step, a multiple of GRID from START on."""
    last = turn(step - GRID) if step - GRID >= START else first_turn()
    begun, ended = last.begun, last.ended
    old = (ended >= 0) & (step - ended >= MERGE_AFTER)
    age = step - begun
    may_end = (ended < 0) & (age >= SHORTEST)
    h = np.where(may_end, np.minimum(1.0, GRID / np.maximum(LONGEST - age, GRID)), 0.0)
    with np.errstate(divide="ignore"):
        leaving, staying = np.log(h), np.log1p(-h)
    stays, ends = np.flatnonzero(~old & np.isfinite(staying)), np.flatnonzero(may_end)
    return Turn(
        len(begun), old, stays, staying[stays], ends, leaving[ends],
        np.concatenate([begun[stays], begun[ends], [step]]),
        np.concatenate([ended[stays], np.full(len(ends), step), [-1]]),
    )  # fmt: skip


def latest(k: int) -> Turn:
    """The bookkeeping that is in force at sample k."""
    step = (k - 1) // GRID * GRID
    return turn(step) if step >= START else first_turn()


MOST = max(len(turn(step).begun) for step in range(START, START + 1000, GRID))  # hypotheses there can be


class Switching(NamedTuple):
    """State: the nominal filter and the hypotheses, as many as the clock says in the first of MOST places."""

    healthy: Healthy
    w_healthy: Array  # (n,) log weight
    M: Array  # (n, MOST, 4, 4)
    G: Array  # (n, MOST, 4, 4)
    g: Array  # (n, MOST, 4)
    u_onset: Array  # (n, MOST, 2)
    w: Array  # (n, MOST) log weights
    probs: Array  # (n, 5)
    z: Array  # (n, 4)


def keep_books(s: Switching, step: int, u: Array, sizes: Sizes) -> Switching:
    """Merge, end, begin: of episodes at the same step."""
    at, n = turn(step), len(u)
    M, G, g, u_onset, w = (a[:, : at.before] for a in (s.M, s.G, s.g, s.u_onset, s.w))
    w_healthy = s.w_healthy
    if at.old.any():
        ratio, _ = marginals(G[:, at.old], g[:, at.old], u_onset[:, at.old], sizes)
        merged = w[:, at.old] + logsumexp(ratio + LOG_WEIGHT, axis=2)
        w_healthy = logsumexp(np.column_stack([w_healthy, merged]), axis=1)
    w = np.concatenate(
        [w[:, at.stays] + at.staying, w[:, at.ends] + at.leaving, (w_healthy + np.log(P_BEGIN))[:, None]], axis=1
    )
    fresh = (np.zeros((n, 1, 4, 4)), np.zeros((n, 1, 4, 4)), np.zeros((n, 1, 4)), u[:, None])
    moved = [
        np.concatenate([a[:, at.stays], a[:, at.ends], new], axis=1)
        for a, new in zip((M, G, g, u_onset), fresh, strict=True)
    ]
    whole = [a.copy() for a in (s.M, s.G, s.g, s.u_onset, s.w)]
    for a, new in zip(whole, (*moved, w), strict=True):
        a[:, : new.shape[1]] = new
    M, G, g, u_onset, w = whole
    return Switching(s.healthy, w_healthy + np.log1p(-P_BEGIN), M, G, g, u_onset, w, s.probs, s.z)


def weigh(s: Switching, k: int, E: Array, f: Nominal, sizes: Sizes) -> Switching:
    """The hypotheses' information at sample k, and the answer where one is due."""
    now = latest(k)
    h, gone = len(now.begun), now.ended >= 0
    if not h:
        return s
    M, G, g = s.M.copy(), s.G.copy(), s.g.copy()
    M[:, :h], G[:, :h], g[:, :h] = sense(f, s.healthy, M[:, :h], G[:, :h], g[:, :h], E[:, None] * ~gone[:, None, None])
    s = s._replace(M=M, G=G, g=g)
    if k % GRID:
        return s
    ratio, z = marginals(G[:, :h], g[:, :h], s.u_onset[:, :h], sizes)
    each = ratio + LOG_WEIGHT + s.w[:, :h, None]
    top = np.maximum(each.max(axis=(1, 2)), s.w_healthy)
    p = np.exp(each - top[:, None, None])
    healthy = np.exp(s.w_healthy - top) + p[:, gone].sum(axis=(1, 2))
    active = p[:, ~gone]
    probs = np.column_stack([healthy, label_probabilities(active).sum(axis=1)])
    total = probs.sum(axis=1, keepdims=True)
    mean = (active[..., None] * z[:, ~gone]).sum(axis=(1, 2)) / total
    return s._replace(probs=probs / total, z=mean)


def by_clock(function: Callable[..., Switching], s: Switching, at: Interval, *arrays: Array) -> Switching:
    """Apply to the episodes of each sample number together: there is one, but for episodes that began later."""
    if (at.k == at.k[0]).all():
        return function(s, int(at.k[0]), *arrays)
    out = map_arrays(np.copy, s)
    for k in np.unique(at.k):
        rows = at.k == k
        part = function(map_arrays(lambda a, rows=rows: a[rows], s), int(k), *(a[rows] for a in arrays))
        map_arrays(lambda whole, new, rows=rows: whole.__setitem__(rows, new), out, part)
    return out


@diagnoser("switching_bayes_bank", "Bayes bank with fault and recovery hypotheses: reference for intermittent faults")
def switching_bayes_bank(
    plant: Plant, *, gamma: tuple[float, float] = (-0.7, -0.2), b_max: tuple[float, float] = (4.0, 2.0)
) -> Diagnoser:
    """The switching bank; it knows the nominal plant only.

    Args:
        plant: The Boeing 747 with single-fault labels.
        gamma: Range of the loss of effectiveness.
        b_max: Largest random stuck position of aileron and rudder [deg].

    Raises:
        NotApplicableError: Another plant.
    """
    check(plant)
    f, sizes = kalman_filter.nominal_filter(plant), Sizes((gamma[0], gamma[1]), (b_max[0], b_max[1]))

    def start(n: int) -> Switching:
        return Switching(
            kalman_filter.start(f, plant, n), np.zeros(n), np.zeros((n, MOST, 4, 4)), np.zeros((n, MOST, 4, 4)),
            np.zeros((n, MOST, 4)), np.zeros((n, MOST, 2)), np.zeros((n, MOST)), np.tile([1.0, 0, 0, 0, 0], (n, 1)),
            np.zeros((n, 4)),
        )  # fmt: skip

    def predict(s: Switching, at: Interval) -> Switching:
        def books(s: Switching, k: int, u: Array) -> Switching:
            return keep_books(s, k - 1, u, sizes) if k - 1 >= START and (k - 1) % GRID == 0 else s

        s = by_clock(books, s, at, at.u)
        return s._replace(healthy=kalman_filter.predict(f, s.healthy, at))

    def update(s: Switching, at: Interval, y: Array, seen: Array) -> Switching:
        s = s._replace(healthy=kalman_filter.correct(f, s.healthy, y, seen))
        return by_clock(lambda s, k, E: weigh(s, k, E, f, sizes), s, at, f.model.E(at.u))

    def read(s: Switching) -> Reading:
        return Reading(s.z, x=s.healthy.x, Px=s.healthy.P, nu=s.healthy.nu, probs=s.probs)

    return diagnoser_of(plant, Filter(start, predict, update, read, first_sample=False), most_probable())

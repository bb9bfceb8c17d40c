"""Curves of many flights with their 95 % intervals, from outcomes alone: how soon faults show, and which are found.

Flights are the units that were drawn, within strata (`fdi_gym.intervals`). A share is given Wilson's interval with as many
independent answers as have the variance that the flights say.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special

from fdi_gym.intervals import CONFIDENCE, balanced_interval, resamples, wilson
from fdi_gym.metrics import BANDS, Outcome
from fdi_gym.plant import Array
from fdi_gym.scores import answers, asked, strata_of

RESAMPLES = 400
POINTS = 80  # of a curve, at most


class Curve(NamedTuple):
    """Shares with their intervals."""

    x: Array  # (points,) times [s], or positions
    share: Array  # (points,) nan where nothing was asked
    low: Array
    high: Array
    count: Array  # (points,) faults that are still watched, decisions or samples


def delay_curve(outcomes: Sequence[Outcome], kind: str, dt: float) -> Curve:
    """The share of faults that has shown by a time after the onset: 1 less Kaplan & Meier's, right-censored at faults' ends.

    Args:
        outcomes: The flights.
        kind: "detection" or "isolation"; faults that begin under an alarm, or with their label declared, are left out.
        dt: Sample time [s].
    """
    waited = [[(getattr(o, kind), o.length) for o in asked(flight.onsets, kind)] for flight in outcomes]
    ends = [(i, length if delay is None else delay, delay is not None)
            for i, flight in enumerate(waited) for delay, length in flight]  # fmt: skip
    if not ends:
        empty = np.zeros(0)
        return Curve(empty, empty, empty, empty, empty)
    of, time, seen = (np.array(column) for column in zip(*ends, strict=True))
    times = np.unique(time[seen])
    events, watched = np.zeros((2, len(outcomes), len(times)))
    np.add.at(events, (of[seen], np.searchsorted(times, time[seen])), 1)
    for i, end in zip(of, time, strict=True):
        watched[i] += end >= times

    def missing(weights: Array) -> Array:
        left = weights @ watched
        return np.cumprod(1 - (weights @ events) / np.maximum(left, 1e-300), axis=-1)

    share = 1 - missing(np.ones(len(outcomes)))
    again = missing(resamples(strata_of(outcomes), RESAMPLES))
    units = np.maximum((watched > 0).sum(axis=0), 1)
    low, high = _around(share, again.var(axis=0), units)
    kept = np.unique(np.linspace(0, len(times) - 1, POINTS).round().astype(int)) if len(times) else np.zeros(0, int)
    x, count = (
        np.array([0, *times[kept], time.max()]) * dt,
        [len(time), *watched.sum(axis=0)[kept], (time == time.max()).sum()],
    )
    if not len(times):  # none has shown: as sure of that as the flights allow
        share = low = np.zeros(1)
        high = _around(share, np.zeros(1), np.array([len(set(of))]))[1]
        return Curve(x, np.zeros(2), np.zeros(2), np.array([0.0, high[0]]), np.array(count))
    share, low, high = (np.array([0.0, *line[kept], line[-1]]) for line in (share, low, high))
    return Curve(x, share, low, high, np.array(count))


def _around(share: Array, variance: Array, units: Array) -> tuple[Array, Array]:
    """Wilson's intervals of shares; where nothing has varied there are as many answers as flights."""
    spread = share * (1 - share)
    size = np.where((variance > 1e-12) & (spread > 1e-12), spread / np.maximum(variance, 1e-300), units)
    return wilson(share, size, scipy.special.ndtri(0.5 + CONFIDENCE / 2))


def severity_curve(outcomes: Sequence[Outcome], kind: str) -> Curve:
    """The share of right labels among faults that are small, medium and large.

    Args:
        outcomes: The flights.
        kind: "per_sample" or "per_decision".
    """
    if kind == "per_sample":
        asked_of, right = (np.array([[pair[j] for pair in f.banded] for f in outcomes], float) for j in (0, 1))
    else:
        asked_of, right = np.zeros((2, len(outcomes), len(BANDS)))
        for i, flight in enumerate(outcomes):
            for d in flight.decisions:
                if d.band is not None:
                    asked_of[i, d.band] += 1
                    right[i, d.band] += d.declared == d.label
    return _shares(right, asked_of, strata_of(outcomes))


def label_curve(outcomes: Sequence[Outcome], labels: int, kind: str) -> Curve:
    """The share of right answers about each label: the diagonal of the confusion matrix."""
    matrix = answers(outcomes, labels, kind)
    return _shares(np.diagonal(matrix[..., :-1], axis1=1, axis2=2), matrix.sum(axis=2), strata_of(outcomes))


def _shares(right: Array, asked_of: Array, stratum: Array) -> Curve:
    count = asked_of.sum(axis=0)
    share, low, high = np.full((3, len(count)), np.nan)
    for j in np.flatnonzero(count):
        share[j] = right[:, j].sum() / count[j]
        low[j], high[j] = balanced_interval(right[:, [j]], asked_of[:, [j]], stratum)
    return Curve(np.arange(len(count)), share, low, high, count)

"""Covariance adaptation: where a filter has grown too sure of a parameter that jumped, raise its variance by search.

At a step whose fault flag is up, the step is repeated from covariances with some elements raised, and the candidate
that explains the measurement best is kept. A search asks for those steps through `run(rows, P) -> Trial`: `rows` (c,)
says for which of the m flagged episodes, P (c, n_x, n_x) from which covariance; all candidates of all episodes that do
not depend on each other go in one call.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fdi_gym.plant import Array

BETA_0, MEMORY = 9.0, 50  # fault flag: threshold of the innovation statistic's weighted mean, and its length in steps
CAP = 0.25  # largest variance that is ever given to an effectiveness
EPS_R = 1e-3  # a residual below this needs no further pass
INC_JOINT, INC_DUAL = 1e-2, 1e-5  # increments of the variance in the joint and the dual filter


class Trial(NamedTuple):
    """Outcome of a filter step from a candidate covariance."""

    x: Array  # (m, n_x) estimate after the step
    P: Array  # (m, n_x, n_x) its covariance
    v: Array  # (m,) weighted squares of the residuals after the step
    base: Array  # (m, n_x, n_x) the candidate covariance before the step


class FaultFlag(NamedTuple):
    """Exponentially weighted mean of an innovation statistic, and whether it says that there is a fault."""

    beta: Array  # (n,)
    samples: Array  # (n,) with an innovation so far
    up: Array  # (n,) bool


def unflagged(n: int) -> FaultFlag:
    """The flag before any sample."""
    return FaultFlag(np.zeros(n), np.zeros(n, np.int64), np.zeros(n, bool))


def flagged(s: FaultFlag, b: Array, counts: Array, beta_0: float) -> FaultFlag:
    """The flag after a sample with the statistic b (n,), in the episodes in which it counts (n,)."""
    beta, samples = np.where(counts, s.beta + (b - s.beta) / MEMORY, s.beta), s.samples + counts
    return FaultFlag(beta, samples, (beta > beta_0) & (samples > MEMORY + 1))


Run = Callable[[Array, Array], Trial]
Search = Callable[[Array, Array, Run], Trial]  # (P_base (m, n_x, n_x), adapted steps so far (m,), run) -> the kept ones


def _score(v: Array) -> Array:
    """A residual that is not a number never wins."""
    return np.where(np.isnan(v), np.inf, v)


def _take(trial: Trial, rows: Array) -> Trial:
    return Trial(*(a[rows] for a in trial))


def _where(mask: Array, yes: Trial, no: Trial) -> Trial:
    return Trial(*(np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(yes, no, strict=True)))


def repeated(search: Search, passes: int) -> Search:
    """Passes of a search, each from the covariance that the one before kept, until the residual is below EPS_R.

    Raises:
        ValueError: No pass.
    """
    if passes < 1:
        raise ValueError(f"a search needs at least 1 pass, not {passes}")

    def again(P: Array, count: Array, run: Run) -> Trial:
        trial = search(P, count, run)
        for _ in range(passes - 1):
            trial = _where(trial.v < EPS_R, trial, search(trial.base, count, run))
        return trial

    return again


def binary_grid(entries: Array, inc: float | Array, choices: Callable[[Array], Array], cap: float | Array = CAP) -> Search:
    """Raise or do not raise: P_ii = min(P_ii + inc, cap) on the chosen elements; the first best candidate is kept.

    Args:
        entries: The diagonal elements (D,) that may be raised.
        inc: The increment, one or one per element.
        choices: Maps the adapted steps so far (m,) to (m, c, D) bool: which entries each candidate raises.
        cap: The largest variance that is given, one or one per element.
    """

    def search(P: Array, count: Array, run: Run) -> Trial:
        masks = choices(count)
        m, c, _ = masks.shape
        tried = np.repeat(P[:, None], c, axis=1)
        diagonal = tried[:, :, entries, entries]
        tried[:, :, entries, entries] = np.where(masks, np.minimum(diagonal + inc, cap), diagonal)
        trial = run(np.repeat(np.arange(m), c), tried.reshape(m * c, *P.shape[1:]))
        best = np.argmin(_score(trial.v).reshape(m, c), axis=1)
        return _take(trial, np.arange(m) * c + best)

    return search


def element_grid(
    entries: Array,
    inc: float | Array,
    factors: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0),
    cap: float | Array = CAP,
) -> Search:
    """Element by element: each distinct element of the block tries increments and keeps the best before the next.

    Row by row, diagonal elements by factor * inc, off-diagonal ones by half of it in both entries; the increment of an
    off-diagonal element is the geometric mean of its two. A candidate that is not positive definite, or whose raised
    diagonal element exceeds the cap, is skipped. The best of all is kept.
    """
    D = len(entries)
    numbers = list(itertools.combinations_with_replacement(range(D), 2))
    incs, caps = np.broadcast_to(inc, D), np.broadcast_to(cap, D)

    def search(P: Array, count: Array, run: Run) -> Trial:
        m, c = len(P), len(factors)
        current, kept = P, None
        for a, b in numbers:
            i, j = entries[a], entries[b]
            tried = np.repeat(current[:, None], c, axis=1)
            step = (incs[a] if a == b else np.sqrt(incs[a] * incs[b])) * np.array(factors)
            allowed = np.ones((m, c), bool)
            if i == j:
                tried[:, :, i, i] += step
                allowed[:, 1:] = tried[:, 1:, i, i] <= caps[a]
            else:
                tried[:, :, i, j] += 0.5 * step
                tried[:, :, j, i] += 0.5 * step
                allowed[:, 1:] = np.linalg.eigvalsh(tried[:, 1:])[..., 0] > 0.0
            rows, _ = np.nonzero(allowed)
            trial = run(rows, tried[allowed])
            v = np.full((m, c), np.inf)
            v[allowed] = _score(trial.v)
            where = np.cumsum(allowed).reshape(m, c) - 1
            best = _take(trial, where[np.arange(m), np.argmin(v, axis=1)])
            current = best.base
            kept = best if kept is None else _where(_score(best.v) < _score(kept.v), best, kept)
        assert kept is not None
        return kept

    return search

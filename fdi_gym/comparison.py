"""Which differences between methods are more than chance: all methods are drawn again on the same flights.

The difference of two scores is held against its standard error over bootstrap resamples of the flights within strata, the
same resamples for both, so that what is hard for both cancels (Efron & Tibshirani, 1993, ch. 14). Of many comparisons each
is asked for more, by Holm's step-down procedure (Holm, 1979, Scand. J. Stat. 6(2):65-70): the chance that any difference
called one is none stays below 5 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.special

from fdi_gym.intervals import CONFIDENCE, recalls, resamples
from fdi_gym.metrics import Outcome
from fdi_gym.plant import Array
from fdi_gym.scores import answers, strata_of

RESAMPLES = 2000


class Drawn(NamedTuple):
    """Balanced accuracy of methods on the same flights, and on resamples of them."""

    names: tuple[str, ...]
    score: Array  # (methods,)
    again: Array  # (RESAMPLES, methods)

    def difference(self, a: str, b: str) -> tuple[float, float, float]:
        """Score of a less that of b, and its paired 95 % interval."""
        i, j = self.names.index(a), self.names.index(b)
        gap = float(self.score[i] - self.score[j])
        reach = float(scipy.special.ndtri(0.5 + CONFIDENCE / 2) * np.std(self.again[:, i] - self.again[:, j]))
        return gap, gap - reach, gap + reach

    def p_values(self) -> Array:
        """Two-sided (methods, methods), of no difference."""
        gap = self.score[:, None] - self.score
        spread = np.array([np.std(self.again - column[:, None], axis=0) for column in self.again.T])
        with np.errstate(invalid="ignore", divide="ignore"):
            p = 2 * scipy.special.ndtr(-np.abs(gap) / spread)
        return np.where(np.abs(gap) < 1e-12, 1.0, np.where(spread < 1e-12, 0.0, p))


def draw_again(found: Mapping[str, Sequence[Outcome]], labels: int, kind: str = "per_sample") -> Drawn:
    """Scores of methods on resamples of the flights that they share.

    Args:
        found: Outcomes by method, of the same flights in the same order.
        labels: Number of labels.
        kind: "per_sample" or "per_decision".

    Raises:
        ValueError: The flights are not the same.
    """
    score, again = [], []
    weights: Array | None = None
    flights: list[list[int]] | None = None
    for name, outcomes in found.items():
        mine = [[d.label for d in flight.decisions] for flight in outcomes]
        if weights is None or flights is None:
            flights, weights = mine, resamples(strata_of(outcomes), RESAMPLES)
        if mine != flights:
            raise ValueError(f"{name} was shown other flights: only methods on the same ones are compared")
        matrix = answers(outcomes, labels, kind)
        hits, counts = np.diagonal(matrix[..., :-1], axis1=1, axis2=2), matrix.sum(axis=2)
        kept = counts.sum(axis=0) > 0
        hits, counts = hits[:, kept], counts[:, kept]
        share, total = recalls(hits, counts), weights @ counts
        # a label that a resample lacks stays as it is: it is never dropped
        recall = np.where(total > 0, (weights @ hits) / np.maximum(total, 1), share)
        score.append(share.mean() if kept.any() else 0.0)
        again.append(recall.mean(axis=1) if kept.any() else np.zeros(RESAMPLES))
    return Drawn(tuple(found), np.array(score), np.array(again).reshape(len(found), RESAMPLES).T)


def holm(p: Array) -> Array:
    """Holm's adjusted p-values (n,)."""
    order = np.argsort(p)
    steps = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    found = np.empty(len(p))
    found[order] = np.minimum(steps, 1.0)
    return found


def tied_with_best(drawn: Drawn) -> set[str]:
    """The best method and those that cannot be told from it: each is compared with the best, Holm-corrected."""
    if not drawn.names:
        return set()
    best = int(np.argmax(drawn.score))
    others = [i for i in range(len(drawn.names)) if i != best]
    adjusted = holm(drawn.p_values()[best, others])
    return {drawn.names[best], *(drawn.names[i] for i, p in zip(others, adjusted, strict=True) if p >= 1 - CONFIDENCE)}


def cliques(drawn: Drawn) -> list[tuple[int, int]]:
    """Bars of a critical-difference picture: (first, last) in the order of the scores, best first, of the runs of methods no
    two of which can be told apart, all pairs Holm-corrected; each as long as it can be.
    """
    order, n = np.argsort(-drawn.score, kind="stable"), len(drawn.names)
    p = drawn.p_values()[np.ix_(order, order)]
    upper = np.triu_indices(n, 1)
    same = np.eye(n, dtype=bool)
    same[upper] = holm(p[upper]) >= 1 - CONFIDENCE
    found: list[tuple[int, int]] = []
    for first in range(n):
        last = first
        while last + 1 < n and same[first : last + 1, last + 1].all():
            last += 1
        if last > first and (not found or last > found[-1][1]):
            found.append((first, last))
    return found

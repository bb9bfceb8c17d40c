"""How sure a score is: intervals for the mean of the labels' recalls, from flights as the units that were drawn.

A flight may hold samples and decisions of several labels, and those of one flight are alike: flights are the units,
samples are not. A suite is drawn by label, so flights are drawn again within strata: those with the same rarest label.

A balanced accuracy is a mean of shares, often close to one: its interval is Wilson's (1927) [1], with as many independent
answers as have the variance that the spread between flights says (Korn & Graubard, 1998 [2]; Dean & Pagano, 2015 [3]), and
Student's quantile with Satterthwaite's degrees of freedom. `benchmarks/coverage.py` measures how often it holds the truth,
beside the percentile bootstrap.

[1] J. Am. Stat. Assoc. 22(158):209-212. [2] Survey Methodology 24(2):193-201. [3] J. Surv. Stat. Methodol. 3(4):484-503.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence

import numpy as np
import scipy.special

from fdi_gym.plant import Array

CONFIDENCE = 0.95


def strata(truths: Sequence[Sequence[int]]) -> Array:
    """Stratum (N,) of each flight, from the true labels of its decisions: the label that the fewest flights hold.

    A stratum of one flight says nothing of its spread: such flights are put together, one that is left to the largest.
    """
    sets = [set(labels) for labels in truths]
    flights = Counter(label for held in sets for label in held)
    found = np.array([min(held, key=lambda v: (flights[v], v)) if held else -1 for held in sets], int)
    values, counts = np.unique(found, return_counts=True)
    found[np.isin(found, values[counts == 1])] = -1
    values, counts = np.unique(found, return_counts=True)
    if (found == -1).sum() == 1:
        found[found == -1] = values[np.argmax(np.where(values == -1, 0, counts))]
    return found


def within(values: Array, stratum: Array) -> Array:
    """Variance of the sum of values (N, ...) over flights, drawn anew within strata."""
    total = np.zeros(values.shape[1:])
    for s in np.unique(stratum):
        mine = values[stratum == s]
        if len(mine) > 1:
            total = total + len(mine) / (len(mine) - 1) * ((mine - mine.mean(axis=0)) ** 2).sum(axis=0)
    return total


def wilson(share: Array, size: Array, quantile: Array) -> tuple[Array, Array]:
    """Wilson's interval of shares seen in so many independent answers."""
    z2 = quantile**2
    centre = (share + z2 / (2 * size)) / (1 + z2 / size)
    half = quantile / (1 + z2 / size) * np.sqrt(share * (1 - share) / size + z2 / (4 * size**2))
    return np.maximum(centre - half, 0.0), np.minimum(centre + half, 1.0)


def recalls(hits: Array, counts: Array) -> Array:
    """Share of right answers per label (labels,); nan where a label does not occur."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return hits.sum(axis=0) / counts.sum(axis=0)


def balanced_interval(hits: Array, counts: Array, stratum: Array) -> list[float]:
    """The 95 % interval of the mean of the labels' recalls.

    Args:
        hits: Right answers (N, labels) per flight and true label.
        counts: Answers (N, labels).
        stratum: Of each flight.
    """
    kept = counts.sum(axis=0) > 0
    hits, counts = hits[:, kept], counts[:, kept]
    share, total, flights = recalls(hits, counts), counts.sum(axis=0), (counts > 0).sum(axis=0)
    influence = (hits - share * counts) / total  # of each flight on each recall
    apart, together = within(influence, stratum), float(within(influence.sum(axis=1), stratum))
    middle, labels = float(share.mean()), len(share)
    variance = max(together, float(apart.sum())) / labels**2  # labels of one flight err together, never less than apart
    if variance > 0 and 0 < middle < 1:
        size = middle * (1 - middle) / variance
        freedom = apart.sum() ** 2 / (apart**2 / np.maximum(flights - 1, 1)).sum()  # Satterthwaite's
    else:  # nothing has varied: as many answers as flights, each label weighing the same
        size = labels**2 / (1 / flights).sum()
        freedom = max(flights.min() - 1, 1)
    quantile = scipy.special.stdtrit(max(freedom, 1.0), 0.5 + CONFIDENCE / 2)
    low, high = wilson(np.array(middle), np.array(size), quantile)
    return [float(low), float(high)]


def resamples(stratum: Array, count: int, seed: int = 0) -> Array:
    """How often each flight is drawn (count, N) in bootstrap resamples within strata; the same for all rows of a suite.

    The array is shared, not to be written.
    """
    return _resamples(tuple(stratum.tolist()), count, seed)


@functools.lru_cache(maxsize=4)
def _resamples(stratum: tuple[int, ...], count: int, seed: int) -> Array:
    rng, of = np.random.default_rng(seed), np.array(stratum)
    found = np.zeros((count, len(of)))
    for s in np.unique(of):
        mine = np.flatnonzero(of == s)
        found[:, mine] = rng.multinomial(len(mine), np.full(len(mine), 1 / len(mine)), count)
    found.flags.writeable = False
    return found


def mean_interval(values: Array) -> tuple[float, float, float]:
    """The mean of one value per flight (N,), and its interval by Student's quantile; of one flight the mean alone."""
    middle, n = float(np.mean(values)), len(values)
    half = float(scipy.special.stdtrit(n - 1, 0.5 + CONFIDENCE / 2) * np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else 0.0
    return middle, middle - half, middle + half

"""The rows of a suite whose flights are acted on, and what they are compared by: cost, delay, what is recovered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.comparison import Drawn, draw_again
from fdi_gym.diagnosis import probers
from fdi_gym.entrants import NOTHING, TRUTH
from fdi_gym.intervals import mean_interval
from fdi_gym.metrics import Outcome
from fdi_gym.plant import Array, Plant
from fdi_gym.row import Row
from fdi_gym.scores import costs
from fdi_gym.suite import ActingSuite
from fdi_gym.tables import clairvoyant

BLIND = ("periodic_probes", "random_probes")  # builders of probers that look at nothing: others are held against them
NEVER = "never"  # the family of those that don't probe


class Acted(NamedTuple):
    """The rows of a suite with what they are compared by."""

    suite: ActingSuite
    plant: Plant
    rows: list[Row]
    outcomes: Mapping[str, list[Outcome]]

    def cost(self, name: str) -> Array:
        """The cost of each flight."""
        return costs(self.outcomes[name])

    def drawn(self, kind: str = "per_sample") -> Drawn:
        """All rows on resamples of the flights."""
        return draw_again(dict(self.outcomes), len(self.plant.labels), kind)

    def passive(self, *, told: bool = False) -> Row | None:
        """The best row that never probes and is told nothing, or a part of the truth."""
        mine = [row for row in self.rows if family(row) == NEVER and clairvoyant(row) == told]
        return max(mine, key=accuracy, default=None)

    def chosen(self) -> Row | None:
        """The best row of a prober that looks; of any where none does."""
        mine = [row for row in self.rows if family(row) != NEVER]
        return max([row for row in mine if family(row) not in BLIND] or mine, key=accuracy, default=None)


def accuracy(row: Row) -> float:
    """Balanced accuracy per sample."""
    return row.metrics["per_sample"]["balanced_accuracy"] or 0.0


def family(row: Row) -> str:
    """Whose curve a row is on: the builder of its prober, its own where it is not installed, or `NEVER`."""
    entry = probers().get(row.diagnoser)
    if entry is not None:
        return entry.build.__name__
    return row.diagnoser if ":" in row.diagnoser and row.metrics["acting"]["probed"] > 0 else NEVER


def delays(outcomes: Sequence[Outcome], horizon: int, dt: float) -> Array:
    """Time [s] from each flight's first onset to its right label, the horizon [samples] where longer; nan where healthy."""
    found = []
    for flight in outcomes:
        first = flight.onsets[0] if flight.onsets else None
        late = horizon if first is None or first.isolation is None else min(first.isolation, horizon)
        found.append(np.nan if first is None else 0.0 if first.labelled else late * dt)
    return np.array(found)


def horizon(outcomes: Sequence[Outcome]) -> int:
    """Samples of the median flight's first fault."""
    lengths = [flight.onsets[0].length for flight in outcomes if flight.onsets]
    return int(np.median(lengths)) if lengths else 0


def at_this_cost(acted: Acted, drawn: Drawn, row: Row) -> tuple[float, float, float] | None:
    """Accuracy of a row more than that of the best mixture of two rows which do not look and cost the same on average.

    None where no two have its cost between them.
    """
    if family(row) in (*BLIND, NEVER):
        return None
    passive, mine = acted.passive(), float(acted.cost(row.diagnoser).mean())
    blind = [r.diagnoser for r in acted.rows if family(r) in BLIND] + ([passive.diagnoser] if passive else [])
    price = {name: float(acted.cost(name).mean()) for name in blind}
    best: tuple[float, Array] | None = None
    for a in blind:
        for b in blind:
            if price[a] <= mine < price[b]:
                share = (price[b] - mine) / (price[b] - price[a])
                i, j = drawn.names.index(a), drawn.names.index(b)
                score = share * drawn.score[i] + (1.0 - share) * drawn.score[j]
                if best is None or score > best[0]:
                    best = float(score), share * drawn.again[:, i] + (1.0 - share) * drawn.again[:, j]
    if best is None:
        return None
    k = drawn.names.index(row.diagnoser)
    gap, reach = float(drawn.score[k] - best[0]), 1.96 * float(np.std(drawn.again[:, k] - best[1]))
    return gap, gap - reach, gap + reach


def truths(outcomes: Sequence[Outcome]) -> Array:
    """The label of each flight's first fault, 0 where it has none."""
    return np.array([flight.onsets[0].label if flight.onsets else 0 for flight in outcomes])


def recovered(nothing: Array, mine: Array, truth: Array) -> tuple[float, float, float] | None:
    """The share of what the truth recovers, of sums over flights, with its interval from resampled flights.

    None where the truth recovers no more than chance.
    """
    if len(truth) < 2 or mean_interval(nothing - truth)[1] <= 0:
        return None
    drawn = np.random.default_rng(0).integers(len(mine), size=(2000, len(mine)))
    gained, possible = (nothing - mine)[drawn].sum(axis=1), (nothing - truth)[drawn].sum(axis=1)
    low, high = np.percentile(gained / np.maximum(possible, 1e-12), [2.5, 97.5])
    return float((nothing - mine).sum() / (nothing - truth).sum()), float(low), float(high)


def shares(acted: Acted, name: str, mask: Array | None = None) -> tuple[float, float, float] | None:
    """What an entrant recovers, of some of the flights; None where nothing or the truth has no row, too."""
    if not {NOTHING, TRUTH.name} <= set(acted.outcomes):
        return None
    chosen = np.ones(acted.suite.episodes, bool) if mask is None else mask
    return recovered(*(acted.cost(n)[chosen] for n in (NOTHING, name, TRUTH.name)))

"""The ceiling of `onset_bank`: Bayes' rule over kind and size of the process's faults, told when each begins and ends.

All else is the same, the model, the prior and the decision: the two differ by what not knowing the onsets costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from baselines.filters.event_bank import Bank, Hypotheses, events_of_process, most_telling, one_after_another
from baselines.filters.hypothesis_kernels import NEVER
from baselines.oracles.told_onset_ekf import label_changes
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.mixing import mixture
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


class Told(NamedTuple):
    """State: the bank, and the truth that each episode carries."""

    bank: Hypotheses
    changes: Array  # (n, K + 1) bool: the label does, at the interval that ends at a sample
    acts: Array  # (n, K + 1) bool: a fault does over it


@diagnoser(
    "told_events_oracle",
    "Bayes' rule over kind and size of the process's faults, told when each begins and ends",
    knows="when each fault begins and ends",
    ceiling=True,
)
def told_events_oracle(
    plant: Plant, belief: Belief, process: str, *, scenarios: Sequence[FaultScenario], courses: int = 4, sizes: int = 2
) -> Diagnoser:
    """The oracle.

    Args:
        plant: As of `onset_bank`.
        belief: As of `onset_bank`.
        process: The fault process, of which it is told all but the draws.
        scenarios: One per episode; when the label changes, and whether a fault acts, is all that is read of them.
        courses: Cells of kinds whose course in time varies.
        sizes: Cells of each of those by the size.

    Raises:
        NotApplicableError: As of `onset_bank`.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    events = one_after_another(events_of_process(plant, process, courses, sizes))
    bank = Bank(plant, belief, events, onsets=2, every=1)

    def start(n: int) -> Told:
        return Told(bank.start(n), *label_changes(plant, scenarios, n))

    def over(s: Hypotheses, ends: Array) -> Hypotheses:
        """No fault acts any more in some episodes: the healthy filter is the mixture of all."""
        own, each = slice(bank.m, bank.m + bank.width), np.arange(len(ends))
        part, found = (s.X[ends], s.P[ends]), (s.X.copy(), s.P.copy(), s.log.copy())
        part[0][..., own], part[1][..., own, :], part[1][..., own] = 0.0, 0.0, 0.0
        (X, P), log = mixture(np.exp(s.log[ends])[:, None], *part), np.full((len(ends), bank.count), NEVER)
        log[:, 0] = 0.0
        found[0][ends, 0], found[1][ends, 0], found[2][ends] = X[each, 0], P[each, 0], log
        return s._replace(X=found[0], P=found[1], log=found[2])

    def predict(s: Told, at: Interval) -> Told:
        each, k = np.arange(len(at.k)), np.minimum(at.k, s.acts.shape[1] - 1)
        found, ends = s.bank, np.flatnonzero(s.changes[each, k])
        if ends.size:
            found = over(found, ends)
        begins = ends[s.acts[ends, k[ends]]]
        if begins.size:  # of whichever kind: nothing else is possible any more
            found, _ = bank.begun(found, begins, at.k[begins] - 1, at.u[begins], np.ones((len(begins), 1)), np.zeros(0))
        return s._replace(bank=bank.moved(found, at, np.empty(found.X.shape), np.empty(found.P.shape)))

    def update(s: Told, at: Interval, y: Array, seen: Array) -> Told:
        return s._replace(bank=bank.update(s.bank, at, y, seen))

    def read(s: Told) -> Reading:
        return bank.read(s.bank)

    filter = Filter(
        start, predict, update, read, expect=lambda s, at: bank.expect(s.bank, at),
        innovation=lambda s: (s.bank.nu, s.bank.S),
    )  # fmt: skip
    return diagnoser_of(plant, filter, most_telling(events))

"""The ceiling of `onset_bank`: Bayes' rule over kind and size of the process's faults, told when each begins and ends.

All else is the same, the model, the prior and the decision: the two differ by what not knowing the onsets costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from baselines.filters.hypotheses import NEVER
from baselines.filters.onset_bank import Bank, Onsets, events_of_process, most_telling
from baselines.oracles.told_onset_ekf import label_changes
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


class Told(NamedTuple):
    """State: the bank, and the truth that each episode carries."""

    bank: Onsets
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
    events = events_of_process(plant, process, courses, sizes)
    bank = Bank(plant, belief, events, onsets=2, every=1)

    def start(n: int) -> Told:
        return Told(bank.start(n), *label_changes(plant, scenarios, n))

    def begun(s: Onsets, step: Array, u: Array) -> Onsets:
        """A fault begins, of whichever kind: nothing else is possible any more."""
        s = bank.begun(s, step, u)
        log = np.full(s.log.shape, NEVER)
        log[:, bank.s :: bank.s] = events.log_prior
        return s._replace(log=log)

    def over(s: Onsets) -> Onsets:
        """No fault acts any more: the healthy filter is the mixture of all."""
        s = bank.healed(s, s.log)
        log = np.full(s.log.shape, NEVER)
        log[:, 0] = 0.0
        return s._replace(log=log)

    def predict(s: Told, at: Interval) -> Told:
        each, k = np.arange(len(at.k)), np.minimum(at.k, s.acts.shape[1] - 1)
        changes, acts = s.changes[each, k], s.acts[each, k]
        found = s.bank
        for rows, turn in (
            (np.flatnonzero(changes), lambda part, rows: over(part)),
            (np.flatnonzero(changes & acts), lambda part, rows: begun(part, at.k[rows] - 1, at.u[rows])),
        ):
            if rows.size:
                found = Onsets(*(a.copy() for a in found))
                for a, new in zip(found, turn(Onsets(*(a[rows] for a in found)), rows), strict=True):
                    a[rows] = new
        return s._replace(bank=bank.moved(found, at))

    def update(s: Told, at: Interval, y: Array, seen: Array) -> Told:
        return s._replace(bank=bank.update(s.bank, at, y, seen))

    def read(s: Told) -> Reading:
        return bank.read(s.bank)

    filter = Filter(
        start, predict, update, read, expect=lambda s, at: bank.expect(s.bank, at),
        innovation=lambda s: (s.bank.nu, s.bank.S),
    )  # fmt: skip
    return diagnoser_of(plant, filter, most_telling(events))

"""Which flights make a suite: drawn by what is true of them, so that every label has enough decisions."""

from __future__ import annotations

from collections import Counter

import msgspec

from fdi_gym.faults import FaultScenario
from fdi_gym.metrics import scored_samples, windows
from fdi_gym.plant import Plant
from fdi_gym.suite import Suite

DECISIONS = 30  # of every label: the least that a label's share of right ones can be told from
SEARCHED = 5000  # flights that are looked through: a label that none of them has is none of the process's


def truths(plant: Plant, process: str, scenario: FaultScenario) -> list[int]:
    """The true labels of a flight's decisions, from its scenario alone."""
    label, scoring = plant.label_rows(scenario), plant.process(process).scoring
    scored = scored_samples(label, scenario.steps, scoring)
    return [value for _, _, value in windows(label, scenario.steps, scored)]


def by_label(suite: Suite, decisions: int = DECISIONS, healthy: bool = True, first_seed: int = 1_000_000) -> Suite:
    """A suite with so many decisions of every label at least, of the flights from `first_seed` on.

    The seeds are gone through in turn; a flight is taken if a decision of it is about a label that has not enough yet. Where
    healthy flights are still too few, the seeds that follow are flown without their faults.

    Args:
        suite: All but its seeds.
        decisions: Of every label that the process draws.
        healthy: Add healthy flights where the process draws too few.
        first_seed: The first seed that is looked at.

    Raises:
        ValueError: A label that the process does draw has not enough decisions in 5000 flights.
    """
    if decisions < 1:
        raise ValueError(f"decisions is 1 or more, not {decisions}")
    plant, w = suite.build(), suite.windows
    seeds: list[int] = []
    held: Counter[int] = Counter()
    for i in range(SEARCHED):
        group = [first_seed + i * w + j for j in range(w)]
        flight = msgspec.structs.replace(suite, seeds=group, healthy=[])
        labels = truths(plant, suite.process, flight.scenarios(plant, [0])[0])
        if any(held[label] < decisions for label in labels):
            held.update(labels)
            seeds += group
        if all(held[label] >= decisions for label in range(len(plant.labels))):
            break
    short = [plant.labels[v].name for v, count in sorted(held.items()) if count < decisions and (v or not healthy)]
    if short:
        raise ValueError(f"{suite.name}: fewer than {decisions} decisions about {', '.join(short)} in {SEARCHED} flights")
    first, count = (seeds[-1] if seeds else first_seed - 1) + 1, max(0, decisions - held[0]) * w if healthy else 0
    return msgspec.structs.replace(suite, seeds=seeds, healthy=[first + j for j in range(count)])

"""Bayes' rule over what a fault process does, one event after the other: which kind, since when, how large.

The bank of `event_bank` for any declared plant whose faults do not overlap. One filter flies healthy; a kind of event keeps
so many onsets. With a linear model, Gaussian sizes and as many onsets as samples this is the Bayes diagnoser of the process,
what any method could attain that is told no more: the line by which others are measured, as far as its score stands still
when onsets, cells of the sizes and of the courses are made more. The label is the most probable one in proportion to its
share of all samples, which is the decision that balanced accuracy asks for.
"""

from __future__ import annotations

from baselines.filters.event_bank import FIRST, Bank, at_least, diagnosing, events_of_process, one_after_another
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.diagnosis.fitting import VALIDATION_SEED
from fdi_gym.estimation.belief import Belief
from fdi_gym.plant import NotApplicableError, Plant

FEW = 10  # scenarios that show whether faults begin at different times
GRID = 200  # onsets in a flight, where it is not said how far they are apart


@diagnoser("onset_bank", "Bayes' rule over onset, kind and size of the process's faults: what can be attained")
@diagnoser("onset_bank_fine", "The onset bank with an onset at every sample: for plants that a fault moves at once", every=1)
def onset_bank(
    plant: Plant,
    belief: Belief,
    process: str,
    *,
    onsets: int = 6,
    courses: int = 3,
    sizes: int = 1,
    every: int | None = None,
) -> Diagnoser:
    """The bank.

    Args:
        plant: Any plant whose faults act through theta, one event after the other.
        belief: Model errors, and what is unknown beside faults.
        process: The fault process, of which it is told all but the draws.
        onsets: How many of each kind are kept, 2 or more.
        courses: Cells of kinds whose course in time varies.
        sizes: Cells of each of those by the size.
        every: Samples from one onset to the next. Default: a two-hundredth of the flight. Where a fault moves the sensors
            within a sample, a filter that is wrong by a few about its onset is soon sure of what is not so; where it takes
            long to show, the onsets that are kept must reach further back.

    Raises:
        ValueError: A number out of range.
        NotApplicableError: Faults overlap, one has no course that could be known, or the process says
            when they begin.
    """
    at_least(2, onsets=onsets)
    if every is not None:
        at_least(1, every=every)
    drawn = [plant.draw(process, VALIDATION_SEED + FIRST + i) for i in range(FEW)]
    if any(s.faults for s in drawn) and len({tuple(f.onset for f in s.faults) for s in drawn}) == 1:
        raise NotApplicableError(
            "in this process faults begin at the same time in all flights: who is told it knows the onset"
        )
    events = one_after_another(events_of_process(plant, process, courses, sizes))
    return diagnosing(Bank(plant, belief, events, onsets, every or max(1, len(events.onset) // GRID)))

"""Bayes' rule over faults that overlap: which kinds of event act, since when, how large. For any declared plant.

As `onset_bank`, whose faults follow one another; here others may begin while some act. How likely another event is to begin
depends on how many act, and for the first on the time; how likely one is to end, on its age. That is less than a process may
say.

Multiple hypotheses in limited number: S. S. Blackman, R. Popoli, Design and Analysis of Modern Tracking Systems, Artech
House, 1999, chapter 6.
"""

from __future__ import annotations

import msgspec

from baselines.filters.event_bank import Bank, at_least, diagnosing, events_of_process
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.belief import Belief
from fdi_gym.plant import NotApplicableError, Plant


@diagnoser("overlap_bank", "Bayes' rule over onsets, kinds and sizes of faults that overlap: what can be attained, nearly")
def overlap_bank(
    plant: Plant,
    belief: Belief,
    process: str,
    *,
    onsets: int = 2,
    filters: int | None = None,
    courses: int = 3,
    sizes: int = 1,
    every: int = 1,
    disturbance: float = 2.0,
) -> Diagnoser:
    """The bank.

    Args:
        plant: Any plant whose faults act through theta.
        belief: Model errors, and what is unknown beside faults.
        process: The fault process, of which it is told kinds, sizes and how long one thing takes after the other.
        onsets: How many hypotheses with the same kinds of event are kept, 2 or more.
        filters: How many hypotheses are, in all: more than the kinds of event. Default: three for two kinds, 100 at least.
        courses: Cells of kinds whose course varies.
        sizes: Cells of each of those by the size.
        every: Samples from one onset to the next.
        disturbance: Factor on the standard deviation of the disturbances' walks. Gusts come in bursts, for which a walk that
            goes as far in the long run is too slow, and a fault is seen where there is none. Chosen on validation flights of
            the helicopter: log score -0.57, -0.16, -0.14, -0.18 with 1, 2, 4, 6, accuracy 89.2, 89.6, 87.8, 86.3.

    Raises:
        ValueError: A number out of range.
        NotApplicableError: A fault has no course that could be known, or no two faults overlap.
    """
    at_least(2, onsets=onsets)
    at_least(1, every=every)
    if not disturbance > 0.0:
        raise ValueError(f"disturbance is above 0, not {disturbance}")
    events = events_of_process(plant, process, courses, sizes)
    if not events.more.size:
        raise NotApplicableError("in this process no two faults overlap: onset_bank is for those that follow one another")
    kinds = len(events.label)
    if filters is None:
        filters = max(100, 3 * kinds // 2)
    if filters <= kinds:
        raise ValueError(f"filters are more than the {kinds} kinds of event, not {filters}")
    belief = msgspec.structs.replace(belief, d_walk=disturbance * belief.d_walk)
    return diagnosing(Bank(plant, belief, events, onsets, every, filters))

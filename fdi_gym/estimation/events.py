"""What a fault process does, as a filter can use it: kinds of events, how likely each is at any time, and how large.

An event is what begins and ends together: one fault, or several at once. Events of a kind move the same entries of theta in
the same way: at once to a value, or along a course of time. Within a kind the values are Gaussian along a few directions;
a kind whose values or courses are spread widely is cut into cells. All of it is counted in scenarios that are drawn from the
process; nothing is flown.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.faults import Abrupt, Fault, FaultScenario, Hold, Incipient, Intermittent, Ramp
from fdi_gym.plant import Array, NotApplicableError, Plant

FEWEST = 10  # events from which a cell is made
NEGLIGIBLE = 1e-6  # share of the largest variance below which a direction is left out
MOVED = 0.1  # what a held command may have moved since the onset, in units of its scale: it is not known to the sample
MANY = 8  # parameters, beyond which they are left to the noise that stands for errors of the model
BINS = 100  # of a flight, over which the onsets are counted
AT_ONCE, SATURATES, RISES, COMES_AND_GOES = range(4)  # courses
OF_EFFECT = {Incipient: SATURATES, Ramp: RISES, Intermittent: COMES_AND_GOES}


class Events(NamedTuple):
    """The events of a process, in r cells; p entries of theta, f magnitudes, standard normal while an event acts."""

    entries: Array  # (p,) positions in theta
    label: Array  # (r,)
    offset: Array  # (r, p) deviation of the entries from healthy at magnitudes of zero
    direction: Array  # (r, p, f)
    held: Array  # (r, p) the command at whose value an entry is held from the onset on; -1: none
    lag: Array  # (r, p) how many steps before the onset that is
    course: Array  # (r,) one of the courses
    first: Array  # (r,) 1 / rate, duration or period of the course [s]
    second: Array  # (r,) duty
    log_prior: Array  # (r,) of an event to be of the cell
    onset: Array  # (K,) probability that the first event begins at a step, and
    again: Array  # (K,) that another begins so many steps after one has ended
    end: Array  # (ages,) probability that it ends at an age [samples] that it has reached; empty: events stay
    share: Array  # (labels,) of the samples
    physical: Array  # (e,) positions in p of the physical parameters that are drawn for a flight, and
    spread: Array  # (e, c) how: standard normal numbers times this, added to the nominal ones; c = 0: none, or too many

    def at(self, age: Array) -> Array:
        """The courses at an age [s]: (..., r, slots) of ages (..., r, slots), as shares of the values."""
        first, second = self.first[:, None], self.second[:, None]
        found = np.ones(age.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            for course, values in (
                (SATURATES, -np.expm1(-age / first)),
                (RISES, np.minimum(age / first, 1.0)),
                (COMES_AND_GOES, ((age / first) % 1.0 < second).astype(float)),
            ):
                found = np.where(self.course[:, None] == course, values, found)
        return found


class _Count:
    """How often what has lasted for so many steps is over then."""

    def __init__(self, most: int):
        self.over, self.reached = np.zeros(most), np.zeros(most)

    def add(self, steps: int, over: bool) -> None:
        """It has lasted so long, and is over or not."""
        self.reached[: steps + 1] += 1
        self.over[steps] += over

    def rate(self, width: int) -> Array:
        """The probability to be over after each number of steps, the mean over so many of them."""
        starts = range(0, len(self.over), width)
        rate = np.add.reduceat(self.over, starts) / np.maximum(np.add.reduceat(self.reached, starts), 1.0)
        return np.repeat(rate, width)[: len(self.over)]


class _Event(NamedTuple):
    label: int
    kind: tuple[Any, ...]
    values: Array  # (p,) deviations
    first: float
    second: float


def _groups(scenario: FaultScenario) -> list[tuple[int, int, list[Fault]]]:
    """Onset, end and faults of each event."""
    found: dict[tuple[int, int], list[Fault]] = {}
    for fault in scenario.faults:
        end = scenario.steps if fault.end is None else min(fault.end, scenario.steps)
        if fault.onset < end:
            found.setdefault((fault.onset, end), []).append(fault)
    return [(onset, end, faults) for (onset, end), faults in sorted(found.items())]


def _event(plant: Plant, entries: list[int], faults: list[Fault]) -> _Event:
    names, nominal = plant.theta_entries, plant.nominal_theta
    values, held, lag = np.zeros(len(entries)), [-1] * len(entries), [0] * len(entries)
    course, first, second = AT_ONCE, 1.0, 1.0
    commands = [s.name for s in plant.commands]
    for effect in itertools.chain.from_iterable(fault.effects for fault in faults):
        j = entries.index(names.index(effect.entry))
        match effect:
            case Hold(command=command):
                held[j], lag[j], values[j] = commands.index(command), effect.lag, -nominal[entries[j]]
                continue
            case Abrupt():
                pass
            case Incipient(rate=rate):
                course, first = SATURATES, 1.0 / rate
            case Ramp(duration=duration):
                course, first = RISES, duration
            case Intermittent(period=period, duty=duty):
                course, first, second = COMES_AND_GOES, period, duty
            case _:
                raise NotApplicableError(f"a fault that is {type(effect).__name__} has no course that could be known")
        values[j] = effect.value - nominal[entries[j]]
    label = plant.label_of(frozenset(fault.mode for fault in faults))
    kind = (label, tuple(sorted(fault.kind for fault in faults)), course, tuple(held), tuple(lag))
    return _Event(label, kind, values, first, second)


def _cells(events: list[_Event], courses: int, sizes: int) -> list[list[_Event]]:
    """Events of one kind, cut by their courses, and those by their values along the direction of most variance."""
    found = []
    for part in _quantiles(np.array([e.first for e in events]), courses):
        some = [events[i] for i in part]
        values = np.array([e.values for e in some])
        spread = values - values.mean(axis=0)
        along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
        found += [[some[i] for i in cell] for cell in _quantiles(along, sizes)]
    return found


def _quantiles(values: Array, count: int) -> list[Array]:
    """Indices of the values in `count` equally filled groups, in order; one group where they are alike, or few."""
    count = min(count, len(values) // FEWEST) if np.ptp(values) > 1e-9 * np.abs(values).max() else 1
    return np.array_split(np.argsort(values, kind="stable"), max(count, 1))


def _parameters(plant: Plant, scenarios: Sequence[FaultScenario]) -> tuple[Array, Array]:
    """Which physical parameters vary from flight to flight (e,), and along which directions (e, c)."""
    drawn = np.array([plant.physical(s.physical) if s.physical else plant.nominal_p for s in scenarios]) - plant.nominal_p
    which = np.flatnonzero(drawn.any(axis=0))
    var, axes = np.linalg.eigh(np.atleast_2d(drawn[:, which].T @ drawn[:, which] / len(drawn)))
    spread = (axes * np.sqrt(np.maximum(var, 0.0)))[:, var > NEGLIGIBLE * max(var.max(initial=0.0), 1e-300)]
    return (which, spread) if spread.shape[1] <= MANY else (which[:0], np.zeros((0, 0)))


def events_of(plant: Plant, scenarios: Sequence[FaultScenario], *, courses: int = 2, sizes: int = 1) -> Events:
    """The events of a process, from scenarios that it drew.

    Args:
        plant: The plant.
        scenarios: Thousands of them, of one length.
        courses: Cells of a kind whose course varies, by the time that it takes.
        sizes: Cells of each of those, by the values.

    Raises:
        NotApplicableError: Events overlap, or a fault has no course that could be known.
    """
    names = plant.theta_entries
    entries = sorted({names.index(e.entry) for s in scenarios for fault in s.faults for e in fault.effects})
    K, labels = max(s.steps for s in scenarios), len(plant.labels)
    first, again = _Count(K), _Count(K)
    samples, lasts = np.zeros(labels), _Count(K + 1)
    kinds: dict[tuple[Any, ...], list[_Event]] = {}
    for scenario in scenarios:
        groups, free = _groups(scenario), 0
        if any(later[0] < earlier[1] for earlier, later in itertools.pairwise(groups)):
            raise NotApplicableError("faults of this process overlap in time: it has no events one after the other")
        for onset, end, faults in groups:
            event = _event(plant, entries, faults)
            kinds.setdefault(event.kind, []).append(event)
            (again if free else first).add(onset - free, True)
            lasts.add(end - onset, end < scenario.steps)
            samples[event.label] += end - onset
            free = end
        if free < scenario.steps:
            (again if free else first).add(scenario.steps - free - 1, False)
    samples[0] = sum(s.steps for s in scenarios) - samples[1:].sum()
    if not kinds:
        raise NotApplicableError("the process has no faults")
    cells = [cell for key in sorted(kinds, key=str) for cell in _cells(kinds[key], courses, sizes)]
    r, p = len(cells), len(entries)
    offset, held, lag = np.zeros((r, p)), np.zeros((r, p), np.int64), np.zeros((r, p), np.int64)
    lines = []
    for i, cell in enumerate(cells):
        values = np.array([e.values for e in cell])
        offset[i], held[i], lag[i] = values.mean(axis=0), cell[0].kind[3], cell[0].kind[4]
        var, axes = np.linalg.eigh(np.cov(values, rowvar=False, bias=True).reshape(p, p))
        moved = np.diag([MOVED * plant.commands[c].scale if c >= 0 else 0.0 for c in held[i]])[:, held[i] >= 0]
        lines.append(
            np.hstack([(axes * np.sqrt(np.maximum(var, 0.0)))[:, var > NEGLIGIBLE * max(var.max(), 1e-300)], moved])
        )
    direction = np.zeros((r, p, max(1, *(line.shape[1] for line in lines))))
    for each, line in zip(direction, lines, strict=True):
        each[:, : line.shape[1]] = line
    size = np.array([len(cell) for cell in cells], float)
    longest = int(np.flatnonzero(lasts.over)[-1]) + 1 if lasts.over.any() else 0
    return Events(
        np.array(entries), np.array([cell[0].label for cell in cells]), offset, direction, held, lag,
        np.array([cell[0].kind[2] for cell in cells]), np.array([np.mean([e.first for e in cell]) for cell in cells]),
        np.array([np.mean([e.second for e in cell]) for cell in cells]), np.log(size / size.sum()),
        first.rate(max(1, K // BINS)), again.rate(max(1, K // BINS)), lasts.rate(1)[:longest], samples / samples.sum(),
        *_parameters(plant, scenarios),
    )  # fmt: skip

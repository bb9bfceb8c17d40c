"""What a fault process does, as a filter can use it: kinds of events, how likely each is at any time, and how large.

An event is what begins and ends together: one fault, or several at once. Events of a kind move the same entries of theta in
the same way: at once to a value, or along a course of time. Within a kind the values are Gaussian along a few directions;
a kind whose values or courses are spread widely is cut into cells. Events follow one another, or overlap: then others may
begin while some act. All of it is counted in scenarios that are drawn from the process; nothing is flown.

Sensors that fail (`fdi_gym.sensors`) are events like others: a bias, a drift and a gain move theta; more noise is a bias
that is another at each sample, and spikes one that wanders; of a sensor that is frozen the last reading stays.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.faults import Abrupt, Fault, FaultScenario, Hold, Incipient, Intermittent, Ramp, Samples, Square
from fdi_gym.model import SENSOR_FAULTS
from fdi_gym.plant import Array, NotApplicableError, Plant

FEWEST = 10  # events from which a cell is made
NEGLIGIBLE = 1e-6  # share of the largest variance below which a direction is left out
MOVED = 0.1  # what a held command may have moved since the onset, in units of its scale: it is not known to the sample
MANY = 8  # parameters, beyond which they are left to the noise that stands for errors of the model
BINS = 100  # of a flight, over which the onsets are counted
WHITE = 2.0**0.5 * np.array([1.0, 0.0, -1.0, 0.0])  # has the moments of white noise of variance 1
AT_ONCE, SATURATES, RISES, COMES_AND_GOES, ALTERNATES, WANDERS = range(6)  # courses


class Events(NamedTuple):
    """The events of a process, in r cells; p entries of theta, f magnitudes, standard normal while an event acts."""

    entries: Array  # (p,) positions in theta
    label: Array  # (r,)
    modes: Array  # (r,) the modes as bits
    offset: Array  # (r, p) deviation of the entries from healthy at magnitudes of zero, times the course, and
    steady: Array  # (r, p) deviation that has none
    direction: Array  # (r, p, f) what a magnitude adds to the first, and
    steady_direction: Array  # (r, p, f) to the second
    held: Array  # (r, p) the command at whose value an entry is held from the onset on; -1: none
    lag: Array  # (r, p) how many steps before the onset that is
    frozen: Array  # (r,) the output whose last reading stays; -1: none does
    course: Array  # (r,) one of the courses
    first: Array  # (r,) 1 / rate, duration or period of the course [s]; of one that wanders, its correlation over a sample
    second: Array  # (r,) duty
    log_prior: Array  # (r,) of an event to be of the cell
    onset: Array  # (K,) probability that the first event begins at a step, and
    again: Array  # (K,) that another begins so many steps after one has ended
    more: Array  # (most - 1,) that another begins at a step at which 1, 2, ... act; empty: they follow one another
    end: Array  # (ages,) probability that it ends at an age [samples] that it has reached; empty: events stay
    share: Array  # (labels,) of the samples
    physical: Array  # (e,) positions in p of the physical parameters that a flight has other than nominal; none: or too many
    mean: Array  # (e,) their mean deviation, and
    spread: Array  # (e, c) how they vary around it: this times standard normal numbers

    def at(self, age: Array) -> Array:
        """The courses at an age [s]: (..., r, slots) of ages (..., r, slots), as shares of the values."""
        return self.of(np.arange(len(self.course))[:, None], age)

    def of(self, kind: Array, age: Array) -> Array:
        """Those of some kinds, by number, of the shape of their ages [s]."""
        course, first, second = self.course[kind], self.first[kind], self.second[kind]
        found = np.ones(age.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            for which, values in (
                (SATURATES, -np.expm1(-age / first)),
                (RISES, np.minimum(age / first, 1.0)),
                (COMES_AND_GOES, ((age / first) % 1.0 < second).astype(float)),
                (ALTERNATES, np.where((age / first) % 1.0 < 0.5, 1.0, -1.0)),
            ):
                found = np.where(course == which, values, found)
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
    modes: frozenset[str]
    label: int
    kind: tuple[Any, ...]  # events alike in it are of one kind
    course: int
    held: list[int]  # (p,) commands
    lag: list[int]  # (p,)
    frozen: int  # output; -1: none
    values: Array  # (p,) deviations
    steady: Array  # (p,) those without a course
    first: float
    second: float
    walker: int  # position of the entry that wanders; -1: none does
    walk: Array  # (samples,) its deviations


def _groups(scenario: FaultScenario) -> list[tuple[int, int, list[Fault]]]:
    """Onset, end and faults of each event."""
    found: dict[tuple[int, int], list[Fault]] = {}
    for fault in scenario.faults:
        end = scenario.steps if fault.end is None else min(fault.end, scenario.steps)
        if fault.onset < end:
            found.setdefault((fault.onset, end), []).append(fault)
    return [(onset, end, faults) for (onset, end), faults in sorted(found.items())]


def _moved(plant: Plant, name: str) -> tuple[int, str, int]:
    """Which entry of theta stands for one, and of a sensor's how that fails and its output: the bias stands for the rest."""
    entry, own, n_y = plant.theta_entries.index(name), plant.own_theta, len(plant.outputs)
    if entry < own:
        return entry, "", -1
    column, output = divmod(entry - own, n_y)
    how = SENSOR_FAULTS[column]
    return entry if how == "gain" else own + SENSOR_FAULTS.index("bias") * n_y + output, how, output


def _event(plant: Plant, entries: list[int], faults: list[Fault]) -> _Event:
    names, nominal = plant.theta_entries, plant.nominal_theta
    values, steady, held, lag = np.zeros(len(entries)), np.zeros(len(entries)), [-1] * len(entries), [0] * len(entries)
    course, first, second, walker, walk, frozen = AT_ONCE, 1.0, 1.0, -1, np.zeros(0), -1
    commands = [s.name for s in plant.commands]
    for effect in itertools.chain.from_iterable(fault.effects for fault in faults):
        entry, how, output = _moved(plant, effect.entry)
        j = entries.index(entry)
        match effect:
            case Abrupt(value=value) if how == "frozen":
                frozen = output if value else -1
                continue
            case Abrupt(value=value) if how == "noise":
                first = plant.outputs[output].sigma * np.sqrt((1.0 + value) ** 2 - 1.0)
                course, walker, walk = WANDERS, j, first * WHITE
                continue
            case _ if how not in ("", "gain", "bias"):
                raise NotApplicableError(f"{effect.entry} by {type(effect).__name__} has no course that could be known")
            case Hold(command=command):
                held[j], lag[j], values[j] = commands.index(command), effect.lag, -nominal[entries[j]]
                continue
            case Square(value=value, other=other, period=period):
                course, first = ALTERNATES, period
                values[j], steady[j] = (value - other) / 2, (value + other) / 2 - nominal[entries[j]]
                continue
            case Samples(values=samples):
                course, walker, walk = WANDERS, j, np.array(samples) - nominal[entries[j]]
                values[j] = walk.mean()
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
    if course == ALTERNATES:  # nothing else of the fault does
        waves = np.array(
            [any(isinstance(e, Square) and names[i] == e.entry for f in faults for e in f.effects) for i in entries]
        )
        values, steady = np.where(waves, values, 0.0), np.where(waves, steady, values)
    modes = frozenset(fault.mode for fault in faults)
    label = plant.label_of(modes)
    kind = (label, tuple(sorted(fault.kind for fault in faults)), course, tuple(held), tuple(lag), walker, frozen)
    return _Event(modes, label, kind, course, held, lag, frozen, values, steady, first, second, walker, walk)


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


def _parameters(plant: Plant, scenarios: Sequence[FaultScenario]) -> tuple[Array, Array, Array]:
    """Which physical parameters are not nominal (e,), by how much on average, and how they vary around it (e, c)."""
    drawn = np.array([plant.physical(s.physical) if s.physical else plant.nominal_p for s in scenarios]) - plant.nominal_p
    which = np.flatnonzero(drawn.any(axis=0))
    drawn = drawn[:, which]
    mean = drawn.mean(axis=0)
    var, axes = np.linalg.eigh(np.atleast_2d((drawn - mean).T @ (drawn - mean) / len(drawn)))
    spread = (axes * np.sqrt(np.maximum(var, 0.0)))[:, var > NEGLIGIBLE * (drawn**2).sum() / len(drawn)]
    return (which, mean, spread) if spread.shape[1] <= MANY else (which[:0], mean[:0], np.zeros((0, 0)))


def events_of(plant: Plant, scenarios: Sequence[FaultScenario], *, courses: int = 2, sizes: int = 1) -> Events:
    """The events of a process, from scenarios that it drew.

    Args:
        plant: The plant.
        scenarios: Thousands of them, of one length.
        courses: Cells of a kind whose course varies, by the time that it takes.
        sizes: Cells of each of those, by the values.

    Raises:
        NotApplicableError: The process has no faults, or one has no course that could be known.
    """
    moved = {e.entry for s in scenarios for fault in s.faults for e in fault.effects}
    entries = sorted({_moved(plant, name)[0] for name in moved})
    K, labels = max(s.steps for s in scenarios), len(plant.labels)
    first, again = _Count(K), _Count(K)
    samples, lasts, begun, acted = np.zeros(labels), _Count(K + 1), np.zeros(0), np.zeros(0)
    kinds: dict[tuple[Any, ...], list[_Event]] = {}
    for scenario in scenarios:
        groups, free, acting = _groups(scenario), 0, []  # free: since when; acting: ends of those that act
        for onset, end, faults in groups:
            acting = [other for other in acting if other > onset]
            event = _event(plant, entries, faults)
            kinds.setdefault(event.kind, []).append(event)
            if acting:
                begun = _longer(begun, len(acting))
                begun[len(acting) - 1] += 1
            else:
                (again if free else first).add(onset - free, True)
            lasts.add(end - onset, end < scenario.steps)
            acting.append(end)
            free = max(free, end)
        if free < scenario.steps:
            (again if free else first).add(scenario.steps - free - 1, False)
        for label, count, length in _pieces(plant, groups):
            samples[label] += length
            acted = _longer(acted, count)
            acted[count - 1] += length
    samples[0] = sum(s.steps for s in scenarios) - samples[1:].sum()
    if not kinds:
        raise NotApplicableError("the process has no faults")
    cells = [cell for key in sorted(kinds, key=str) for cell in _cells(kinds[key], courses, sizes)]
    r, p = len(cells), len(entries)
    offset, held, lag = np.zeros((r, 2, p)), np.zeros((r, p), np.int64), np.zeros((r, p), np.int64)
    rates, lines = np.array([np.mean([e.first for e in cell]) for cell in cells]), []
    for i, cell in enumerate(cells):
        held[i], lag[i] = cell[0].held, cell[0].lag
        offset[i, 1] = np.mean([e.steady for e in cell], axis=0)
        if cell[0].course == WANDERS:
            offset[i, 0], line, rates[i] = _wandering(cell)
        else:
            offset[i, 0], line = _spread(cell)
        moved = np.diag([MOVED * plant.commands[c].scale if c >= 0 else 0.0 for c in held[i]])[:, held[i] >= 0]
        lines.append(np.hstack([line, np.vstack([moved, np.zeros_like(moved)])]))
    direction = np.zeros((r, 2 * p, max(1, *(line.shape[1] for line in lines))))
    for each, line in zip(direction, lines, strict=True):
        each[:, : line.shape[1]] = line
    size = np.array([len(cell) for cell in cells], float)
    longest = int(np.flatnonzero(lasts.over)[-1]) + 1 if lasts.over.any() else 0
    bits = [mode.name for mode in plant.modes]
    return Events(
        np.array(entries), np.array([cell[0].label for cell in cells]),
        np.array([sum(1 << bits.index(name) for name in cell[0].modes) for cell in cells]),
        offset[:, 0], offset[:, 1], direction[:, :p], direction[:, p:], held, lag,
        np.array([cell[0].frozen for cell in cells]), np.array([cell[0].course for cell in cells]), rates,
        np.array([np.mean([e.second for e in cell]) for cell in cells]), np.log(size / size.sum()),
        first.rate(max(1, K // BINS)), again.rate(max(1, K // BINS)),
        (_longer(begun, len(acted)) / np.maximum(acted, 1.0))[: len(begun)],
        lasts.rate(1)[:longest], samples / samples.sum(), *_parameters(plant, scenarios),
    )  # fmt: skip


def _longer(counts: Array, length: int) -> Array:
    return counts if len(counts) >= length else np.pad(counts, (0, length - len(counts)))


def _pieces(plant: Plant, groups: Sequence[tuple[int, int, list[Fault]]]) -> list[tuple[int, int, int]]:
    """Label, number of events that act, and length of each piece of a flight in which some do."""
    edges = sorted({edge for onset, end, _ in groups for edge in (onset, end)})
    found = []
    for low, high in itertools.pairwise(edges):
        acting = [faults for onset, end, faults in groups if onset <= low < end]
        if acting:
            modes = frozenset(fault.mode for faults in acting for fault in faults)
            found.append((plant.label_of(modes), len(acting), high - low))
    return found


def _spread(cell: list[_Event]) -> tuple[Array, Array]:
    """Mean (p,) of a cell's values, and along which directions (2 p, c) they and what is steady vary."""
    values = np.array([e.values for e in cell])
    both = values if not np.ptp([e.steady for e in cell]) else np.hstack([values, [e.steady for e in cell]])
    var, axes = np.linalg.eigh(np.cov(both, rowvar=False, bias=True).reshape(both.shape[1], -1))
    line = (axes * np.sqrt(np.maximum(var, 0.0)))[:, var > NEGLIGIBLE * max(var.max(), 1e-300)]
    return values.mean(axis=0), np.pad(line, [(0, 2 * values.shape[1] - len(line)), (0, 0)])


def _wandering(cell: list[_Event]) -> tuple[Array, Array, float]:
    """Mean (p,), direction (2 p, 1) and correlation over a sample of values that wander, those of all events together."""
    mean, middle = np.mean([e.values for e in cell], axis=0), np.concatenate([e.walk for e in cell]).mean()
    around = [e.walk - middle for e in cell]
    power = sum(float(a @ a) for a in around)
    line = np.zeros((2 * len(mean), 1))
    line[cell[0].walker] = np.sqrt(power / sum(len(a) for a in around))
    return mean, line, sum(float(a[1:] @ a[:-1]) for a in around) / power if power > 0.0 else 1.0

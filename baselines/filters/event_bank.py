"""A bank of filters over what a fault process does: which events act, since when, how large.

A filter is told the process (`fdi_gym.estimation.events`). A hypothesis is a set of events with their onsets, and an
extended Kalman filter of the state, of the events' magnitudes and of the physical parameters that differ from flight to
flight. At every few samples each kind of event may begin, beside those that act, and each that acts may end. A hypothesis in
which one begins starts from what the other knows, with the magnitudes' prior; its weight is the probability of that
beginning, times the likelihood of what was measured since. Of the hypotheses with the same kinds of event so many are kept,
and of all of them so many: those two become one, mean and covariance matched, that are least likely for how close their
onsets are, and the least likely give way. What an event leaves when it ends becomes one with the likeliest hypothesis
without it. Of a sensor that is frozen nothing is heard, and its reading must come again.

The bank of hypotheses is D. T. Magill's, IEEE TAC 10(4), 1965; onsets kept in limited number: A. S. Willsky, H. L. Jones,
IEEE TAC 21(1), 1976, and the generalised pseudo-Bayes estimators of J. K. Tugnait, Automatica 18(5), 1982; sets of them:
D. B. Reid, IEEE TAC 24(6), 1979.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from baselines.filters.bank_kernels import move, tell, weigh
from baselines.filters.event_kernels import renew
from baselines.filters.hypothesis_kernels import NEVER
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser_of
from fdi_gym.diagnosis.fitting import VALIDATION_SEED, floored
from fdi_gym.estimation.augmented import augmented, on_lines
from fdi_gym.estimation.belief import Belief, fault_inputs
from fdi_gym.estimation.decision import Reading, Rule, by_candidate
from fdi_gym.estimation.events import WANDERS, Events, events_of
from fdi_gym.estimation.gaussian_step import predict_lanes, update_lanes
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.sensor_checks import REPEATED
from fdi_gym.kernels import address
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, NotApplicableError, Plant

FIRST, DRAWN = 700_000, 2000  # scenarios from VALIDATION_SEED + FIRST on
GIVEN_UP = -1000.0  # log weight, as a share of all, below which a hypothesis is: at -100 some still come back


class Hypotheses(NamedTuple):
    """State: the healthy filter first, then hypotheses in no order; up to E events act at once."""

    X: Array  # (n, count, N)
    P: Array  # (n, count, N, N)
    log: Array  # (n, count) log weights; NEVER where nothing is
    kind: Array  # (n, count, E) of the events, in rising order, then -1
    onset: Array  # (n, count, E) steps at which they began; between two, where those became one
    held: Array  # (n, count, E, p) deviation of held entries
    first: Array  # (n,) share of the healthy weight that no event came before
    since: Array  # (n,) step at which the last one ended for the others, on average
    length: Array  # (n, count, E) of the courses
    u: Array  # (n, n_u) the command before the last
    y: Array  # (n, m) the last readings; NaN before the first
    nu: Array  # (n, m) innovation of the healthy filter
    S: Array  # (n, m, m) its covariance


class Bank:
    """The filter's functions for a plant, a belief and events.

    onsets: How many hypotheses with the same kinds of event are kept. count: How many in all; None: that many of each kind,
    where events follow one another. every: Samples from one onset to the next.
    """

    def __init__(self, plant: Plant, belief: Belief, events: Events, onsets: int, every: int, count: int | None = None):
        self.plant, self.events, self.keep, self.every = plant, events, onsets, every
        (r, p, self.f), (e, c) = events.direction.shape, events.spread.shape
        self.E, self.count = 1 + len(events.more), 1 + r * onsets if count is None else count
        self.width = self.E * self.f
        if (1 + r) ** self.E >= 2**62:  # the number of a node
            raise NotApplicableError(f"events of {r} kinds, {self.E} at once, are more sets than can be numbered")
        R = plant.R[np.ix_(belief.sensors, belief.sensors)]  # errors of the model are known or estimated, not noise
        base = augmented(plant, msgspec.structs.replace(belief, Q=floored(plant, plant.Q), R=R) if e else belief)
        entries = np.concatenate([events.entries, len(plant.theta) + events.physical])
        line = np.zeros((1, p + e)), np.zeros((1, p + e, self.width + c)), np.zeros((1, self.width + c))
        model = on_lines(base, *line, 1.0, entries)
        self.m, P0 = model.z.start, model.P0.copy()  # magnitudes, then parameters
        own = range(self.m + self.width, model.z.stop)
        P0[own, own] = 1.0
        self.model = model.replace(P0=P0)
        moves = (events.direction != 0.0).any(axis=1) | (events.steady_direction != 0.0).any(axis=1)
        self.M0 = moves.astype(float)
        self.does = tuple(contiguous(a) for a in (
            events.offset, events.direction, events.steady, events.steady_direction, events.mean, events.spread
        ))  # fmt: skip
        self.rates = np.where(events.course == WANDERS, events.first, 1.0)
        heard = [plant.outputs[i] for i in belief.sensors]
        self.inside = np.array([[s.low for s in heard], [s.high for s in heard]])
        self.again = (
            np.where([s.sigma > 0.0 for s in heard], REPEATED / 2.0, 0.0),
            -0.5 * np.log(2 * np.pi * np.diag(self.model.R)),
        )
        self.frozen = np.array([[*belief.sensors.tolist(), i].index(i) for i in events.frozen], np.int64)
        ends = np.log1p(-np.minimum(events.end, 1 - 1e-12))
        self.stays = np.concatenate([[0.0], np.cumsum(ends)]) if ends.size else ends
        names, theta = [mode.name for mode in plant.modes], fault_inputs(plant).entries.tolist()
        sets = {sum(1 << names.index(name) for name in label.modes): i for i, label in enumerate(plant.labels)}
        sets |= dict(zip(events.modes.tolist(), events.label.tolist(), strict=True))
        self.sets, self.labels = np.array(list(sets)), np.array(list(sets.values()))  # of modes, and what says them
        known = [(j, events.entries.tolist().index(e)) for j, e in enumerate(theta) if e in events.entries]
        self.p, self.known = len(theta), np.ascontiguousarray(np.array(known, np.int64).reshape(-1, 2).T)

    def start(self, n: int) -> Hypotheses:
        """Healthy, and nothing has begun."""
        model, shape, m = self.model, (n, self.count, self.E), len(self.model.R)
        log = np.full((n, self.count), NEVER)
        log[:, 0] = 0.0
        return Hypotheses(
            np.tile(model.X0, (n, self.count, 1)), np.tile(model.P0, (n, self.count, 1, 1)), log,
            np.full(shape, -1, np.int64), np.zeros(shape), np.zeros((*shape, len(self.events.entries))), np.ones(n),
            np.zeros(n), np.ones(shape), np.tile(self.plant.trim_command, (n, 1)),
            np.full((n, m), np.nan), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
        )  # fmt: skip

    def chances(self, s: Hypotheses, turn: Array, step: Array) -> Array:
        """That another event begins within the period from a step on, by how many act (turns, E), in these episodes."""
        e, ahead, first = self.events, np.arange(self.every), s.first[turn]
        last = len(e.onset) - 1
        gap = np.maximum(step - s.since[turn], 0.0).astype(np.int64)
        none = first * e.onset[np.minimum(step[:, None] + ahead, last)].sum(axis=1)
        none += (1.0 - first) * e.again[np.minimum(gap[:, None] + ahead, last)].sum(axis=1)
        more = np.broadcast_to(self.every * e.more, (len(step), self.E - 1))
        return np.clip(np.concatenate([none[:, None], more], axis=1), 1e-12, 0.5)

    def renewed(self, s: Hypotheses, turn: Array, step: Array, u: Array) -> Hypotheses:
        """Events end and begin in some episodes (turns,), at their steps and with their commands."""
        found, before = self.begun(s, turn, step, u, self.chances(s, turn, step), self.stays)
        stayed, first, since = np.exp(np.minimum(before, 0.0)), s.first.copy(), s.since.copy()
        since[turn] = (1.0 - first[turn]) * stayed * since[turn] + (1.0 - stayed) * (step - self.every / 2)
        first[turn] *= stayed
        since[turn] /= np.maximum(1.0 - first[turn], 1e-12)
        return found._replace(first=first, since=since)

    def begun(
        self, s: Hypotheses, turn: Array, step: Array, u: Array, chance: Array, stays: Array
    ) -> tuple[Hypotheses, Array]:
        """Events end, where `stays` is not empty, and begin, with chances (turns, E) by how many act.

        With it (turns,) the log of what the healthy weight was before events ended, as a share of what it was then.
        """
        e = self.events
        commands = np.where(e.lag[None] > 0, s.u[turn][:, np.maximum(e.held, 0)], u[:, np.maximum(e.held, 0)])
        fresh, healed = contiguous(np.where(e.held >= 0, commands, 0.0)), np.empty(len(turn))
        X, P, log, kind, onset, held = (a.copy() for a in s[:6])
        renew(
            turn, X, P, log, kind, onset, held, step.astype(float), contiguous(chance), stays, self.every, self.m, self.f,
            self.keep, e.modes, self.sets, e.log_prior, self.M0, fresh, healed,
        )  # fmt: skip
        return s._replace(X=X, P=P, log=log, kind=kind, onset=onset, held=held), s.log[turn, 0] - healed

    def predict(self, s: Hypotheses, at: Interval) -> Hypotheses:
        """Over the interval: what may end or begin at its start does."""
        step = at.k - 1
        turn = np.flatnonzero(step % self.every == 0)
        if turn.size:
            s = self.renewed(s, turn, step[turn], at.u[turn])
        return self.moved(s, at, s.X, s.P) if turn.size else self.moved(s, at, np.empty(s.X.shape), np.empty(s.P.shape))

    def given(self, at: Interval) -> tuple[Array, Array]:
        """The commands, and what is measured of the disturbances."""
        return contiguous(at.u), contiguous(self.model.compiled.known(at.d))

    def moved(self, s: Hypotheses, at: Interval, X: Array, P: Array) -> Hypotheses:
        """All filters, over the interval: into X and P, which may be those of the state if nobody else has it."""
        bound, age = self.model.compiled, np.maximum(at.k[:, None, None] - s.onset, 0.0) * self.plant.dt
        length = contiguous(self.events.of(np.maximum(s.kind, 0), age))
        move(
            address(predict_lanes), *bound.constants[:3], bound.limit, bound.linear, self.does, self.rates, self.m,
            at.noise(self.model.noises[0]), (at.k - 1) * self.plant.dt, *self.given(at), s.X, s.P, s.log, s.kind, length,
            s.held, X, P,
        )  # fmt: skip
        return s._replace(X=X, P=P, u=at.u, length=length)

    def update(self, s: Hypotheses, at: Interval, y: Array, seen: Array) -> Hypotheses:
        """Weigh and correct those that run; of those that have become negligible the place is free."""
        bound, heard = self.model.compiled, self.model.sensors
        y, seen = y.take(heard, axis=1), seen.take(heard, axis=1)
        X, P, log, nu, S = np.empty(s.X.shape), np.empty(s.P.shape), s.log.copy(), np.empty(s.nu.shape), np.empty(s.S.shape)
        weigh(
            address(update_lanes), *bound.constants[:3], bound.H, bound.plain, self.does, GIVEN_UP, self.model.noises[1],
            at.k * self.plant.dt, *self.given(at), y, seen, self.frozen, self.repeated(s.y, y, seen), s.X, s.P, s.kind,
            s.length, s.held, X, P, log, nu, S,
        )  # fmt: skip
        return s._replace(X=X, P=P, log=log, y=np.where(seen, y, s.y), nu=nu, S=S)

    def repeated(self, before: Array, y: Array, seen: Array) -> Array:
        """The log density of readings y (n, m) if their sensors are frozen (n, m + 1), in the last column of none.

        A reading that comes again is likelier than its noise's most likely one by what `sensor_checks` has for it, but for
        ends of the range and for sensors without noise. Another reading is impossible; what did not report says nothing.
        """
        surprise, density = self.again
        inside = (y > self.inside[0]) & (y < self.inside[1])
        found = np.where(y == before, density + surprise * inside, NEVER)
        return np.pad(np.where(seen & np.isfinite(before), found, 0.0), [(0, 0), (0, 1)])

    def read(self, s: Hypotheses) -> Reading:
        """Probabilities of the labels, and the mean of the fault vector."""
        n, (j, at) = len(s.log), self.known
        probs, z, x = np.zeros((n, len(self.plant.labels))), np.zeros((n, self.p)), np.zeros((n, len(self.plant.states)))
        tell(
            s.log, s.kind, s.length, s.held, s.X, self.m, self.does, self.events.modes, self.sets, self.labels, j, at,
            probs, z, x,
        )  # fmt: skip
        return Reading(z, x=x, nu=s.nu, S=s.S, probs=probs)

    def expect(self, s: Hypotheses, at: Interval) -> Array:
        """What the healthy filter expects the sensors to read."""
        return self.model.expect(s.X[:, 0, self.model.x], at)


def events_of_process(plant: Plant, process: str, courses: int, sizes: int) -> Events:
    """The events of a fault process, counted in scenarios with validation seeds.

    Raises:
        ValueError: Cells are one or more.
        NotApplicableError: A fault has no course that could be known.
    """
    at_least(1, courses=courses, sizes=sizes)
    drawn = [plant.draw(process, VALIDATION_SEED + FIRST + i) for i in range(DRAWN)]
    return events_of(plant, drawn, courses=courses, sizes=sizes)


def one_after_another(events: Events) -> Events:
    """The events, which follow one another.

    Raises:
        NotApplicableError: They overlap.
    """
    if events.more.size:
        raise NotApplicableError("faults of this process overlap in time: overlap_bank is for those")
    return events


def at_least(least: int, **numbers: int) -> None:
    """Refuses numbers below one that is allowed."""
    for name, value in numbers.items():
        if value < least:
            raise ValueError(f"{name} is {least} or more, not {value}")


def most_telling(events: Events) -> Rule:
    """The most probable label in proportion to its share of all samples, at once."""
    balanced = np.where(events.share > 0, 1.0 / np.maximum(events.share, 1e-12), 0.0)
    return by_candidate(lambda reading, label: np.argmax(np.asarray(reading.probs) * balanced, axis=1), 1)


def diagnosing(bank: Bank) -> Diagnoser:
    """The bank's filter with that decision."""
    filter = Filter(bank.start, bank.predict, bank.update, bank.read, expect=bank.expect, innovation=lambda s: (s.nu, s.S))
    return diagnoser_of(bank.plant, filter, most_telling(bank.events))

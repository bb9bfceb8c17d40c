"""Bayes' rule over faults that overlap: which kinds of event act, since when, how large. For any declared plant.

As `onset_bank`, which is for events that follow one another; here others may begin while some act. A hypothesis is a set of
events with their onsets, and a filter of the state and their magnitudes. At every few samples each kind of event may begin
beside those that act, and each that acts may end; of the hypotheses with the same kinds of event so many are kept, and of
all of them so many: those two become one, mean and covariance matched, that are least likely for how close their onsets are,
and the least likely give way.

How likely another event is to begin depends on how many act, and for the first on the time; how likely one is to end, on its
age. That is less than a process may say. Physical parameters that differ from flight to flight are left to the belief.

Multiple hypotheses in limited number: S. S. Blackman, R. Popoli, Design and Analysis of Modern Tracking Systems, Artech
House, 1999, chapter 6; D. B. Reid, IEEE TAC 24(6), 1979.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from baselines.filters.hypotheses import NEVER, deviations_of, known_entries, live, put, taken, weighed
from baselines.filters.onset_bank import events_of_process, most_telling
from baselines.filters.overlap_kernels import lines, renew, wander
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented, on_lines
from fdi_gym.estimation.belief import Belief, fault_inputs
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.events import WANDERS, Events
from fdi_gym.estimation.interval import Interval
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, NotApplicableError, Plant

GIVEN_UP = -100.0  # log weight, as a share of all, below which a hypothesis is


class Hypotheses(NamedTuple):
    """State: the healthy filter first, then hypotheses in no order; up to E events act at once."""

    X: Array  # (n, count, N)
    P: Array  # (n, count, N, N)
    log: Array  # (n, count) log weights
    kind: Array  # (n, count, E) of the events, in rising order, then -1
    onset: Array  # (n, count, E) steps at which they began; between two, where those became one
    held: Array  # (n, count, E, p) deviation of held entries
    first: Array  # (n,) share of the healthy weight that no event came before
    since: Array  # (n,) step at which the last one ended for the others, on average
    length: Array  # (n, count, E) of the courses
    u: Array  # (n, n_u) the command before the last
    nu: Array  # (n, m) innovation of the healthy filter
    S: Array  # (n, m, m) its covariance


class Bank:
    """The filter's functions for a plant, a belief and events."""

    def __init__(self, plant: Plant, belief: Belief, events: Events, onsets: int, count: int, every: int):
        self.plant, self.events, self.keep, self.every = plant, events, onsets, every
        (_, p, f), self.E = events.direction.shape, 1 + len(events.more)
        self.f, self.count = f, count
        width = self.E * f
        base = augmented(plant, belief)
        self.model = on_lines(base, np.zeros((1, p)), np.zeros((1, p, width)), np.zeros((1, width)), 1.0, events.entries)
        self.m = self.model.z.start
        moves = (events.direction != 0.0).any(axis=1) | (events.steady_direction != 0.0).any(axis=1)
        self.M0 = moves.astype(float)
        self.labels = np.full(1 << len(plant.modes), -1)
        names = [mode.name for mode in plant.modes]
        for i, label in enumerate(plant.labels):
            self.labels[sum(1 << names.index(name) for name in label.modes)] = i
        self.stays = np.concatenate([[0.0], np.cumsum(np.log1p(-np.minimum(events.end, 1 - 1e-12)))])
        self.rates = np.where(events.course == WANDERS, events.first, 1.0)
        self.p, self.known, self.deviations = (
            len(fault_inputs(plant).entries),
            known_entries(plant, events),
            deviations_of(events),
        )

    def start(self, n: int) -> Hypotheses:
        """Healthy, and nothing has begun."""
        model, shape, m = self.model, (n, self.count, self.E), len(self.model.R)
        log = np.full((n, self.count), NEVER)
        log[:, 0] = 0.0
        return Hypotheses(
            np.tile(model.X0, (n, self.count, 1)), np.tile(model.P0, (n, self.count, 1, 1)), log,
            np.full(shape, -1, np.int64), np.zeros(shape), np.zeros((*shape, len(self.events.entries))), np.ones(n),
            np.zeros(n), np.ones(shape), np.tile(self.plant.trim_command, (n, 1)), np.zeros((n, m)),
            np.tile(model.R, (n, 1, 1)),
        )  # fmt: skip

    def on(self, s: Hypotheses, rows: Array) -> AugmentedModel:
        """The model on the lines of these filters."""
        _, p, f = self.events.direction.shape
        offset, direction = np.zeros((len(rows), p)), np.zeros((len(rows), p, self.E * f))
        lines(rows, s.kind, s.length, s.held, *self.deviations, offset, direction)
        return self.model.on(offset, direction)

    def chances(self, s: Hypotheses, step: Array) -> Array:
        """That another event begins within the period from a step (n,) on, by how many act (n, E)."""
        e, ahead = self.events, np.arange(self.every)
        last = len(e.onset) - 1
        gap = np.maximum(step - s.since, 0.0).astype(np.int64)
        none = s.first * e.onset[np.minimum(step[:, None] + ahead, last)].sum(axis=1)
        none += (1.0 - s.first) * e.again[np.minimum(gap[:, None] + ahead, last)].sum(axis=1)
        more = np.broadcast_to(self.every * e.more, (len(step), self.E - 1))
        return contiguous(np.clip(np.concatenate([none[:, None], more], axis=1), 1e-12, 0.5))

    def renewed(self, s: Hypotheses, step: Array, u: Array) -> Hypotheses:
        """Events end and begin."""
        e, healed = self.events, np.empty(len(step))
        commands = np.where(e.lag[None] > 0, s.u[:, np.maximum(e.held, 0)], u[:, np.maximum(e.held, 0)])
        fresh = contiguous(np.where(e.held >= 0, commands, 0.0))
        before, chance = s.log[:, 0], self.chances(s, step)
        X, P, log, kind, onset, held = (a.copy() for a in s[:6])
        renew(
            X, P, log, kind, onset, held, step.astype(float), chance, self.stays if e.end.size else np.zeros(0), self.every,
            self.m, self.f, self.keep, e.modes, self.labels, e.log_prior, self.M0, fresh, healed,
        )  # fmt: skip
        stayed = np.exp(np.minimum(before - healed, 0.0))
        first = s.first * stayed
        others = np.maximum(1.0 - first, 1e-12)
        since = ((1.0 - s.first) * stayed * s.since + (1.0 - stayed) * (step - self.every / 2)) / others
        return s._replace(X=X, P=P, log=log, kind=kind, onset=onset, held=held, first=first, since=since)

    def predict(self, s: Hypotheses, at: Interval) -> Hypotheses:
        """Over the interval: what may end or begin at its start does."""
        step = at.k - 1
        turn = np.flatnonzero(step % self.every == 0)
        if turn.size == len(step):
            s = self.renewed(s, step, at.u)
        elif turn.size:
            part = self.renewed(Hypotheses(*(a[turn] for a in s)), step[turn], at.u[turn])
            s = Hypotheses(*(a.copy() for a in s))
            for a, new in zip(s, part, strict=True):
                a[turn] = new
        age = np.maximum(at.k[:, None, None] - s.onset, 0.0) * self.plant.dt
        s = s._replace(u=at.u, length=contiguous(self.events.of(np.maximum(s.kind, 0), age)))
        rows = live(s.log)
        X, P = self.on(s, rows).predict("extended", taken(s.X, rows), taken(s.P, rows), at.of(rows // self.count))
        if (self.rates < 1.0).any():
            wander(rows, s.kind, self.rates, self.m, self.f, X, P)
        return s._replace(X=put(s.X, rows, X), P=put(s.P, rows, P))

    def update(self, s: Hypotheses, at: Interval, y: Array, seen: Array) -> Hypotheses:
        """Weigh and correct those that run; of those that have become negligible the place is free."""
        rows = live(s.log)
        return weighed(self.on(s, rows), s, rows, at, y, seen, GIVEN_UP)

    def read(self, s: Hypotheses) -> Reading:
        """Probabilities of the labels, and the mean of the fault vector."""
        e, w, (j, at) = self.events, np.exp(s.log), self.known
        acts, kind = s.kind >= 0, np.maximum(s.kind, 0)
        label = self.labels[np.bitwise_or.reduce(np.where(acts, e.modes[kind], 0), axis=2)]
        probs = np.zeros((len(w), len(self.plant.labels)))
        np.add.at(probs, (np.arange(len(w))[:, None], label), w)
        probs /= probs.sum(axis=1, keepdims=True)
        m = s.X[..., self.m : self.m + self.E * self.f].reshape(*kind.shape, self.f, 1)
        offset, direction, steady, steady_direction = (a[:, at][kind] for a in self.deviations)
        z = np.zeros((len(w), self.p))
        theta = (
            s.length[..., None] * (offset + (direction @ m)[..., 0])
            + steady
            + (steady_direction @ m)[..., 0]
            + s.held[..., at]
        )
        z[:, j] = (w[:, :, None] * (theta * acts[..., None]).sum(axis=2)).sum(axis=1)
        x = (w[..., None] * s.X[..., self.model.x]).sum(axis=1)
        return Reading(z, x=x, nu=s.nu, S=s.S, probs=probs)

    def expect(self, s: Hypotheses, at: Interval) -> Array:
        """What the healthy filter expects the sensors to read."""
        return self.model.expect(s.X[:, 0, self.model.x], at)


@diagnoser("overlap_bank", "Bayes' rule over onsets, kinds and sizes of faults that overlap: what can be attained, nearly")
def overlap_bank(
    plant: Plant,
    belief: Belief,
    process: str,
    *,
    onsets: int = 4,
    filters: int = 200,
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
        filters: How many hypotheses are, in all: more than the kinds of event.
        courses: Cells of kinds whose course varies.
        sizes: Cells of each of those by the size.
        every: Samples from one onset to the next.
        disturbance: Factor on the standard deviation of the disturbances' walks. Gusts come in bursts, for which a walk that
            goes as far in the long run is too slow, and a fault is seen where there is none. Chosen on validation flights of
            the helicopter: log score -0.57, -0.16, -0.14, -0.18 with 1, 2, 4, 6, accuracy 89.2, 89.6, 87.8, 86.3.

    Raises:
        ValueError: A number out of range.
        NotApplicableError: Sensors may fail too, a fault has no course that could be known, or no two faults overlap.
    """
    for name, value, least in (("onsets", onsets, 2), ("courses", courses, 1), ("sizes", sizes, 1), ("every", every, 1)):
        if value < least:
            raise ValueError(f"{name} is {least} or more, not {value}")
    events = events_of_process(plant, process, courses, sizes, overlapping=True)
    if not events.more.size:
        raise NotApplicableError("in this process no two faults overlap: onset_bank is for those that follow one another")
    if not disturbance > 0.0:
        raise ValueError(f"disturbance is above 0, not {disturbance}")
    if filters <= len(events.label):
        raise ValueError(f"filters are more than the {len(events.label)} kinds of event, not {filters}")
    belief = msgspec.structs.replace(belief, d_walk=disturbance * belief.d_walk)
    bank = Bank(plant, belief, events, onsets, filters, every)
    filter = Filter(bank.start, bank.predict, bank.update, bank.read, expect=bank.expect, innovation=lambda s: (s.nu, s.S))
    return diagnoser_of(plant, filter, most_telling(events))

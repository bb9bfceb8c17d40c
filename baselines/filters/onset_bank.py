"""Bayes' rule over what a fault process does: which kind of event, since when, how large. For any declared plant.

A filter is told the process (`fdi_gym.estimation.events`): how likely a fault is to begin at any time, of which kind, how
large, how long it lasts, and which physical parameters differ from flight to flight: those are estimated too. One extended
Kalman filter flies healthy. At every few samples each kind of event may have begun: a filter starts from what the healthy
one knows, with the magnitudes' prior, and goes on by itself; its weight is the probability of that beginning, times the
likelihood of what was measured since. A kind keeps so many onsets: of neighbours those two become one, mean and covariance
matched, that are least likely for how close they are; one whose weight has become negligible is given up. Where events end,
the filters' weight goes back to the healthy one, which becomes the mixture.

With a linear model, Gaussian sizes and as many onsets as samples this is the Bayes diagnoser of the process, what any method
could attain that is told no more: the line by which others are measured, as far as its score stands still when onsets, cells
of the sizes and of the courses are made more. The label is the most probable one in proportion to its share of all samples,
which is the decision that balanced accuracy asks for.

The bank of hypotheses is D. T. Magill's, IEEE TAC 10(4), 1965; onsets kept in limited number: A. S. Willsky, H. L. Jones,
IEEE TAC 21(1), 1976, and the generalised pseudo-Bayes estimators of J. K. Tugnait, Automatica 18(5), 1982.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from baselines.filters.hypotheses import NEVER, deviations_of, known_entries, live, merged, put, taken, weighed
from baselines.filters.onset_kernels import lines
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.diagnosis.fitting import VALIDATION_SEED, floored
from fdi_gym.estimation.augmented import AugmentedModel, augmented, on_lines
from fdi_gym.estimation.belief import Belief, fault_inputs
from fdi_gym.estimation.decision import Reading, Rule, by_candidate
from fdi_gym.estimation.events import Events, events_of
from fdi_gym.estimation.interval import Interval
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, NotApplicableError, Plant

FIRST, DRAWN = 700_000, 2000  # scenarios from VALIDATION_SEED + FIRST on
FEW = 10  # of them that show whether faults begin at different times
GRID = 200  # onsets in a flight, where it is not said how far they are apart
NEGLIGIBLE = -1000.0  # log weight, as a share of all, below which a filter is given up: at -100 some still come back


class Onsets(NamedTuple):
    """State: the healthy filter, and r kinds of events with s onsets each."""

    X: Array  # (n, 1 + r s, N), the healthy one first, then kind by kind, the latest onset last
    P: Array  # (n, 1 + r s, N, N)
    log: Array  # (n, 1 + r s) log weights
    onset: Array  # (n, r, s) steps at which they began; between two, where those became one
    held: Array  # (n, r, s, p) deviation of held entries
    length: Array  # (n, r, s) of the courses
    first: Array  # (n,) share of the healthy weight that no event came before
    since: Array  # (n,) step at which the last one ended for the others, on average
    u: Array  # (n, n_u) the command before the last
    nu: Array  # (n, m) innovation of the healthy filter
    S: Array  # (n, m, m) its covariance


def on_model(plant: Plant, belief: Belief) -> Belief:
    """The belief with the declared noises alone: the errors of the model are estimated, not covered by noise."""
    R = plant.R[np.ix_(belief.sensors, belief.sensors)]
    return msgspec.structs.replace(belief, Q=floored(plant, plant.Q), R=R)


class Bank:
    """The filter's functions for a plant, a belief and events."""

    def __init__(self, plant: Plant, belief: Belief, events: Events, onsets: int, every: int):
        self.plant, self.events, self.s, self.every = plant, events, onsets, every
        (r, p, f), (e, c) = events.direction.shape, events.spread.shape
        entries = np.concatenate([events.entries, len(plant.theta) + events.physical])
        base = augmented(plant, belief if c == 0 else on_model(plant, belief))
        model = on_lines(base, np.zeros((1, p + e)), np.zeros((1, p + e, f + c)), np.zeros((1, f + c)), 1.0, entries)
        self.m = slice(model.z.start, model.z.start + f)  # magnitudes of the event; then those of the parameters
        P0 = model.P0.copy()
        P0[range(self.m.stop, model.z.stop), range(self.m.stop, model.z.stop)] = 1.0
        self.model, self.r, self.count = model.replace(P0=P0), r, 1 + r * onsets
        self.M0 = np.zeros((r, f, f))
        self.M0[:, range(f), range(f)] = (events.direction != 0.0).any(axis=1) | (events.steady_direction != 0.0).any(axis=1)
        self.p, self.known, self.deviations = (
            len(fault_inputs(plant).entries),
            known_entries(plant, events),
            deviations_of(events),
        )

    def start(self, n: int) -> Onsets:
        """Healthy, and nothing has begun."""
        model, (r, p, _), s = self.model, self.events.direction.shape, self.s
        log = np.full((n, self.count), NEVER)
        log[:, 0] = 0.0
        m = len(model.R)
        return Onsets(
            np.tile(model.X0, (n, self.count, 1)), np.tile(model.P0, (n, self.count, 1, 1)), log, np.zeros((n, r, s)),
            np.zeros((n, r, s, p)), np.ones((n, r, s)), np.ones(n), np.zeros(n),
            np.tile(self.plant.trim_command, (n, 1)), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
        )  # fmt: skip

    def on(self, s: Onsets, rows: Array) -> AugmentedModel:
        """The model on the lines of these filters."""
        (_, p, f), (e, c) = self.events.direction.shape, self.events.spread.shape
        offset, direction = np.zeros((len(rows), p + e)), np.zeros((len(rows), p + e, f + c))
        lines(
            rows,
            self.s,
            contiguous(s.length),
            contiguous(s.held),
            *self.deviations,
            contiguous(self.events.spread),
            offset,
            direction,
        )
        return self.model.on(offset, direction)

    def ended(self, s: Onsets, step: Array) -> Onsets:
        """The weight of events that end within the period before a step goes back to the healthy filter."""
        end = self.events.end
        age = np.clip((step[:, None, None] - s.onset).astype(np.int64), 0, None)
        stays = np.concatenate([[0.0], np.cumsum(np.log1p(-np.minimum(end, 1 - 1e-12)))])
        last = len(stays) - 1
        log_stay = stays[np.minimum(age, last)] - stays[np.clip(age - self.every, 0, last)]
        log_stay = np.where(age > last, -30.0, log_stay).reshape(len(step), -1)
        with np.errstate(divide="ignore"):
            leaving = np.maximum(s.log[:, 1:] + np.log(-np.expm1(log_stay)), NEVER)
        healed = self.healed(s, np.concatenate([s.log[:, :1], leaving], axis=1))
        total = healed.log[:, :1]
        stayed = np.exp(s.log[:, 0] - total[:, 0])
        log = np.concatenate([total, np.maximum(s.log[:, 1:] + log_stay, NEVER)], axis=1)
        first, others = s.first * stayed, np.maximum(1.0 - s.first * stayed, 1e-12)
        since = ((1.0 - s.first) * stayed * s.since + (1.0 - stayed) * (step - self.every / 2)) / others
        return healed._replace(log=log, first=first, since=since)

    def healed(self, s: Onsets, log: Array) -> Onsets:
        """The healthy filter becomes the mixture of all, with these weights (n, 1 + r s), and gets their sum."""
        X, P = s.X.copy(), s.P.copy()
        X[..., self.m], P[..., self.m, :], P[..., :, self.m] = 0.0, 0.0, 0.0
        total, mean, covariance = merged(log, X, P)
        X, P, weights = s.X.copy(), s.P.copy(), s.log.copy()
        X[:, 0], P[:, 0], weights[:, 0] = mean, covariance, total
        return s._replace(X=X, P=P, log=weights)

    def begun(self, s: Onsets, step: Array, u: Array) -> Onsets:
        """Each kind of event may have begun at a step: the newest onset; two older ones become one."""
        n, r, slots, N, e = len(step), self.r, self.s, len(self.model.scale), self.events
        X, P = s.X[:, 1:].reshape(n, r, slots, N), s.P[:, 1:].reshape(n, r, slots, N, N)
        log, z = s.log[:, 1:].reshape(n, r, slots), self.m
        each = np.arange(n)[:, None], np.arange(r)
        # which of the neighbours become one: least likely, and close for their age
        age = step[:, None, None] - s.onset
        gap = np.diff(s.onset, axis=2) / (age[..., 1:] + self.every)
        pair = np.logaddexp(log[..., :-1], log[..., 1:]) + 2.0 * np.log(np.maximum(gap, 1e-9))
        pair = np.where(np.minimum(log[..., :-1], log[..., 1:]) <= NEVER, -np.inf, pair)  # empty places first
        j = np.argmin(pair, axis=2)
        two = np.stack([j, j + 1], axis=2)
        at = (each[0][..., None], each[1][:, None], two)
        both = log[at].reshape(-1, 2)
        total, mean, covariance = merged(both, X[at].reshape(-1, 2, N), P[at].reshape(-1, 2, N, N))
        share = np.exp(both[:, 1] - total).reshape(n, r)
        middle = (1 - share) * s.onset[(*each, j)] + share * s.onset[(*each, j + 1)]
        heavier = np.where(share > 0.5, j + 1, j)
        held_one = s.held[(*each, heavier)]
        # the places after the pair move up by one, the last is free
        order = np.arange(slots) + (np.arange(slots) > j[..., None])
        order[..., -1] = slots - 1
        take = (each[0][..., None], each[1][:, None], order)
        X, P, log, onset, held = X[take], P[take], log[take], s.onset[take], s.held[take]
        X[(*each, j)], P[(*each, j)] = mean.reshape(n, r, N), covariance.reshape(n, r, N, N)
        log[(*each, j)], onset[(*each, j)], held[(*each, j)] = total.reshape(n, r), middle, held_one
        # the newest
        X[:, :, -1], P[:, :, -1] = s.X[:, :1], s.P[:, :1]
        X[:, :, -1, z] = 0.0
        P[:, :, -1, z, :], P[:, :, -1, :, z] = 0.0, 0.0
        P[:, :, -1, z, z] = self.M0
        ahead, last = np.arange(self.every), len(e.onset) - 1
        rate = s.first * e.onset[np.minimum(step[:, None] + ahead, last)].sum(axis=1)
        gap = np.maximum(step - s.since, 0.0).astype(np.int64)
        rate += (1.0 - s.first) * e.again[np.minimum(gap[:, None] + ahead, last)].sum(axis=1)
        rate = np.clip(rate, 1e-12, 0.5)
        log[:, :, -1] = np.maximum(s.log[:, :1] + np.log(rate)[:, None] + e.log_prior, NEVER)
        onset[:, :, -1] = step[:, None]
        commands = np.where(e.lag[None] > 0, s.u[:, np.maximum(e.held, 0)], u[:, np.maximum(e.held, 0)])
        held[:, :, -1] = np.where(e.held >= 0, commands, 0.0)
        whole_X, whole_P = s.X.copy(), s.P.copy()
        whole_X[:, 1:], whole_P[:, 1:] = X.reshape(n, -1, N), P.reshape(n, -1, N, N)
        weights = np.concatenate([s.log[:, :1] + np.log1p(-rate)[:, None], log.reshape(n, -1)], axis=1)
        return s._replace(X=whole_X, P=whole_P, log=weights, onset=onset, held=held)

    def predict(self, s: Onsets, at: Interval) -> Onsets:
        """Over the interval: what may end or begin at its start does."""
        n, step = len(at.k), at.k - 1
        turn = np.flatnonzero(step % self.every == 0)
        if turn.size:
            part = Onsets(*(a[turn] for a in s))
            if self.events.end.size:
                part = self.ended(part, step[turn])
            part = self.begun(part, step[turn], at.u[turn])
            if turn.size == n:
                s = part
            else:
                whole = Onsets(*(a.copy() for a in s))
                for a, new in zip(whole, part, strict=True):
                    a[turn] = new
                s = whole
        return self.moved(s, at)

    def moved(self, s: Onsets, at: Interval) -> Onsets:
        """All filters, over the interval."""
        age = (at.k[:, None, None] - s.onset) * self.plant.dt
        s = s._replace(length=self.events.at(np.maximum(age, 0.0)), u=at.u)
        rows = live(s.log)
        X, P = self.on(s, rows).predict("extended", taken(s.X, rows), taken(s.P, rows), at.of(rows // self.count))
        return s._replace(X=put(s.X, rows, X), P=put(s.P, rows, P))

    def update(self, s: Onsets, at: Interval, y: Array, seen: Array) -> Onsets:
        """Weigh and correct those that run; of those that have become negligible the place is free."""
        rows = live(s.log)
        return weighed(self.on(s, rows), s, rows, at, y, seen, NEGLIGIBLE)

    def read(self, s: Onsets) -> Reading:
        """Probabilities of the labels, and the mean of the fault vector."""
        n, w = len(s.X), np.exp(s.log)
        probs = np.zeros((n, len(self.plant.labels)))
        probs[:, 0] = w[:, 0]
        by_kind = w[:, 1:].reshape(n, self.r, self.s).sum(axis=2)
        for kind, label in enumerate(self.events.label.tolist()):
            probs[:, label] += by_kind[:, kind]
        probs /= probs.sum(axis=1, keepdims=True)
        z, (j, at) = np.zeros((n, self.p)), self.known
        m = s.X[:, 1:, self.m].reshape(n, self.r, self.s, -1, 1)
        offset, direction, steady, steady_direction = (a[:, None, at] for a in self.deviations)
        along, beside = offset + (direction @ m)[..., 0], steady + (steady_direction @ m)[..., 0]
        theta = s.length[..., None] * along + s.held[..., at] + beside  # (n, r, s, entries)
        z[:, j] = (w[:, 1:, None] * theta.reshape(n, self.count - 1, len(at))).sum(axis=1)
        x = (w[..., None] * s.X[..., self.model.x]).sum(axis=1)
        return Reading(z, x=x, nu=s.nu, S=s.S, probs=probs)

    def expect(self, s: Onsets, at: Interval) -> Array:
        """What the healthy filter expects the sensors to read."""
        return self.model.expect(s.X[:, 0, self.model.x], at)


def events_of_process(plant: Plant, process: str, courses: int, sizes: int, overlapping: bool = False) -> Events:
    """The events of a fault process, counted in scenarios with validation seeds.

    Raises:
        NotApplicableError: Sensors may fail too, faults overlap, or one has no course that could be known.
    """
    if plant.bare is not None:
        raise NotApplicableError("sensors that fail by noise, freezing or spikes are no lines in theta")
    drawn = [plant.draw(process, VALIDATION_SEED + FIRST + i) for i in range(DRAWN)]
    return events_of(plant, drawn, courses=courses, sizes=sizes, overlapping=overlapping)


def most_telling(events: Events) -> Rule:
    """The most probable label in proportion to its share of all samples, at once."""
    balanced = np.where(events.share > 0, 1.0 / np.maximum(events.share, 1e-12), 0.0)
    return by_candidate(lambda reading, label: np.argmax(np.asarray(reading.probs) * balanced, axis=1), 1)


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
        NotApplicableError: Sensors may fail too, faults overlap, one has no course that could be known, or the process says
            when they begin.
    """
    for name, value, least in (("onsets", onsets, 2), ("courses", courses, 1), ("sizes", sizes, 1)):
        if value < least:
            raise ValueError(f"{name} is {least} or more, not {value}")
    if every is not None and every < 1:
        raise ValueError(f"every is a sample or more, not {every}")
    drawn = [plant.draw(process, VALIDATION_SEED + FIRST + i) for i in range(FEW)]
    if any(s.faults for s in drawn) and len({tuple(f.onset for f in s.faults) for s in drawn}) == 1:
        raise NotApplicableError(
            "in this process faults begin at the same time in all flights: who is told it knows the onset"
        )
    events = events_of_process(plant, process, courses, sizes)
    bank = Bank(plant, belief, events, onsets, max(1, len(events.onset) // GRID) if every is None else every)
    filter = Filter(bank.start, bank.predict, bank.update, bank.read, expect=bank.expect, innovation=lambda s: (s.nu, s.S))
    return diagnoser_of(plant, filter, most_telling(events))

"""An oracle for any plant: an extended Kalman filter per hypothesis, told when the label changes, not to what.

The hypotheses are those of the multiple models: each label with the magnitudes of its own faults. Where the plant's sensors
may fail, each sensor has seven: its bias, a drift that reaches it soon, later or late, its gain (a line in theta beside the
estimated space), and noise that has grown little or much. At a change all of them start from what the healthy filter knows,
with the magnitudes' prior, and the label is the one whose likelihood since then is the largest on average over its
hypotheses. While there is no fault that is known.

On a plant whose linearisation is exact over the magnitudes this is the Bayes classifier within the known windows, up to
the shape of the prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from baselines.filters.multiple_model import hypotheses
from baselines.oracles.told_onset_ekf import label_changes
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.sensor_checks import Checks, SensorChecks
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.sensors import GAIN, failing, sensor_mode

GROWN = (2.0, 7.0)  # by how many healthy standard deviations a noise has grown
RISES = (0.13, 0.2, 0.27)  # how long a drift goes on, as shares of the flight


class Rows(NamedTuple):
    """The hypotheses, stacked."""

    model: AugmentedModel
    label: Array  # (r,) of each
    m0: Array  # (r, f) prior of its magnitudes
    M0: Array  # (r, f, f)
    R: Array  # (r, m, m) noise of its sensors
    log_prior: Array  # (r,) within its label
    rise: Array  # (r,) share of the flight in which its line grows to its length; 0: at once


def rows(plant: Plant, belief: Belief) -> Rows:
    """The hypotheses of a plant.

    Raises:
        NotApplicableError: The fault vector does not enter additively.
    """
    b = hypotheses(plant, belief)
    model, labels = b.model, np.arange(len(b.m0))
    assert model.lines is not None
    if plant.bare is None:
        R = np.tile(belief.R, (len(labels), 1, 1))
        return Rows(model, labels, b.m0, b.M0, R, np.zeros(len(labels)), np.zeros(len(labels)))
    offset, direction = model.lines
    sensors, severity = [s.name for s in failing(plant)], float(plant.options.get("sensor_severity", 1.0))
    entries = [plant.theta_entries.index(f"gain_{name}") for name in sensors]
    count, kinds = len(sensors), 1 + len(GROWN) + len(RISES)
    of = np.array([plant.label_of(frozenset({sensor_mode(name)})) for name in sensors])
    label = np.concatenate([labels, np.repeat(of, kinds)])
    more, f = count * kinds, direction.shape[2]
    wide_offset = np.zeros((len(label), offset.shape[1] + count))
    wide_offset[: len(labels), : offset.shape[1]] = offset
    wide = np.zeros((len(label), offset.shape[1] + count, f))
    wide[: len(labels), : offset.shape[1]] = direction
    m0, M0 = np.concatenate([b.m0, np.zeros((more, f))]), np.concatenate([b.M0, np.zeros((more, f, f))])
    R, Q = np.tile(belief.R, (len(label), 1, 1)), np.concatenate([model.Q, np.tile(model.Q[:1], (more, 1, 1))])
    rise, share = np.zeros(len(label)), np.ones(len(label))
    heard = {plant.outputs[i].name: column for column, i in enumerate(belief.sensors)}
    for i, name in enumerate(sensors):
        first = len(labels) + kinds * i
        wide[first, offset.shape[1] + i, 0], M0[first, 0, 0] = 1.0, (severity * GAIN[1]) ** 2 / 3
        noisy, drifts = slice(first + 1, first + 1 + len(GROWN)), slice(first + 1 + len(GROWN), first + kinds)
        if name in heard:
            R[noisy, heard[name], heard[name]] *= (1.0 + severity * np.array(GROWN)) ** 2
        wide[drifts, : offset.shape[1]], m0[drifts], M0[drifts] = direction[of[i]], b.m0[of[i]], b.M0[of[i]]
        Q[drifts], rise[drifts] = model.Q[of[i]], RISES
        share[noisy], share[drifts] = 1 / len(GROWN), 1 / len(RISES)
    inputs = model.inputs._replace(entries=np.concatenate([model.inputs.entries, entries]).astype(np.int64))
    model = model.replace(inputs=inputs, Q=Q, H=None, lines=(wide_offset, wide))
    return Rows(model, label, m0, M0, R, np.log(share / np.bincount(label, share)[label]), rise)


class Bank(NamedTuple):
    """State of the oracle; each episode carries its own truth."""

    X: Array  # (n, r, N), the healthy one first; the others are 0 where none of them can be
    P: Array  # (n, r, N, N)
    log: Array  # (n, r) log likelihood since the last change
    changes: Array  # (n, K + 1) bool
    acts: Array  # (n, K + 1) bool
    course: Array  # (n, K + 1) size of what acts, as a share of its largest; (n, 1) where that is not told
    allowed: Array  # (n, K + 1, labels) bool: which can be; (n, 1, labels) where that is not told
    now: Array  # (n,) bool: a fault acts
    since: Array  # (n,) samples since the label has changed
    length: Array  # (n, r) of the lines, as shares of their own
    among: Array  # (n, labels) bool, of the allowed
    nu: Array  # (n, m) innovation of the healthy filter
    S: Array  # (n, m, m) its covariance
    checks: Checks | None
    rise: Array  # (n, r) samples in which the lines grow


@diagnoser(
    "told_onset_bank",
    "Extended Kalman filters, one per hypothesis, told when the label changes; for any plant",
    knows="when the label changes",
)
def told_onset_bank(plant: Plant, belief: Belief, *, scenarios: Sequence[FaultScenario]) -> Diagnoser:
    """The oracle.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        scenarios: One per episode; when the label changes, and whether a fault acts, is all that is read of them.

    Raises:
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    return told_bank(plant, rows(plant, belief), scenarios)


def told_bank(
    plant: Plant, r: Rows, scenarios: Sequence[FaultScenario], course: Array | None = None, allowed: Array | None = None
) -> Diagnoser:
    """The bank, told of n flights.

    Args:
        plant: The plant.
        r: Its hypotheses.
        scenarios: n of them.
        course: (n, K + 1) by which the hypotheses' lines are scaled at each sample; None: they keep their lengths.
        allowed: (n, K + 1, labels) which labels can be from one change of the label to the next; None: all.
    """
    bank = _Told(plant, r, scenarios, course, allowed)
    rule = by_candidate(lambda reading, label: np.argmax(np.asarray(reading.probs), axis=1), 1)
    filter = Filter(bank.start, bank.predict, bank.update, bank.read, expect=bank.expect, innovation=lambda s: (s.nu, s.S))
    return diagnoser_of(plant, filter, rule)


class _Told:
    """The filter's functions."""

    def __init__(
        self, plant: Plant, r: Rows, scenarios: Sequence[FaultScenario], course: Array | None, allowed: Array | None
    ):
        self.plant, self.r, self.scenarios, self.course, self.allowed = plant, r, scenarios, course, allowed
        assert r.model.lines is not None
        self.offset, self.direction = r.model.lines
        self.healthy = r.model.replace(Q=r.model.Q[:1], lines=(self.offset[:1], self.direction[:1]))
        self.own = self.offset.shape[1] if plant.bare is None else len(plant.estimated)
        self.rise = r.rise * np.array([scenario.steps for scenario in scenarios])[:, None]
        self.checks = None if plant.bare is None else SensorChecks(plant)
        self.order = np.argsort(r.label, kind="stable")
        self.sorted_label = r.label[self.order]
        self.first = np.searchsorted(self.sorted_label, np.arange(len(plant.labels)))

    def start(self, n: int) -> Bank:
        """Healthy, and what n flights are told."""
        r, model, count = self.r, self.r.model, len(self.r.label)
        changes, acts = label_changes(self.plant, self.scenarios, n)
        X, P = np.tile(model.X0, (n, count, 1)), np.tile(model.P0, (n, count, 1, 1))
        every = np.ones((n, len(self.plant.labels)), bool)
        return Bank(
            X, P, np.zeros((n, count)), changes, acts, np.ones((n, 1)) if self.course is None else self.course,
            every[:, None] if self.allowed is None else self.allowed, np.zeros(n, bool), np.zeros(n), np.ones((n, count)),
            every, np.zeros((n, r.R.shape[-1])), np.tile(r.R[0], (n, 1, 1)),
            None if self.checks is None else self.checks.start(n), self.rise,
        )  # fmt: skip

    def sized(self, length: Array) -> AugmentedModel:
        """The model whose lines are as long as what acts is large."""
        if (length == 1.0).all():
            return self.r.model
        wide, n = length.reshape(-1, 1), len(length)
        return self.r.model.on(wide * np.tile(self.offset, (n, 1)), wide[..., None] * np.tile(self.direction, (n, 1, 1)))

    def parts(self, s: Bank) -> Iterator[tuple[Array, AugmentedModel, int]]:
        """The episodes in which something can be that has hypotheses, and the others, which need the healthy one alone.

        Of each: which they are, the model and how many rows it has.
        """
        open_ = s.now & s.among[:, 1:].any(axis=1)
        if open_.any():
            yield np.flatnonzero(open_), self.sized(s.length[open_]), len(self.r.label)
        if not open_.all():
            yield np.flatnonzero(~open_), self.healthy, 1

    def predict(self, s: Bank, at: Interval) -> Bank:
        """Over the interval; at a change of the label all start from what the healthy one knows."""
        r, z, n = self.r, self.r.model.z, len(at.k)
        each, k = np.arange(n), np.minimum(at.k, s.acts.shape[1] - 1)
        changed, now = s.changes[each, k], s.acts[each, k]
        since = np.where(changed, 1.0, s.since + 1.0)
        share = s.course[each, np.minimum(k, s.course.shape[1] - 1)]
        length = share[:, None] * np.where(now[:, None], np.minimum(since[:, None] / np.maximum(s.rise, 1.0), 1.0), 1.0)
        log = np.where(changed[:, None], 0.0, s.log)
        among = s.allowed[each, np.minimum(k, s.allowed.shape[1] - 1)]
        X, P, N = np.zeros(s.X.shape), np.zeros(s.P.shape), s.X.shape[-1]
        moved = s._replace(X=X, P=P, log=log, now=now, since=since, length=length, among=among)
        for of, model, count in self.parts(moved):
            X0, P0, fresh = s.X[of, :count], s.P[of, :count], changed[of]
            X0[fresh], P0[fresh] = X0[fresh, :1], P0[fresh, :1]
            X0[fresh, :, z] = r.m0[:count]
            P0[fresh, :, z, :] = 0.0
            P0[fresh, :, :, z] = 0.0
            P0[fresh, :, z, z] = r.M0[:count]
            X1, P1 = model.predict("extended", X0.reshape(-1, N), P0.reshape(-1, N, N), at.of(of))
            X[of, :count], P[of, :count] = X1.reshape(-1, count, N), P1.reshape(-1, count, N, N)
        return moved

    def update(self, s: Bank, at: Interval, y: Array, seen: Array) -> Bank:
        """Weigh and correct all that predicted."""
        N, m = s.X.shape[-1], s.nu.shape[-1]
        X, P, log, nu, S = np.zeros(s.X.shape), np.zeros(s.P.shape), s.log.copy(), s.nu.copy(), s.S.copy()
        for of, model, count in self.parts(s):
            wide = s.X[of, :count].reshape(-1, N), s.P[of, :count].reshape(-1, N, N)
            done = model.update("extended", *wide, at.of(of), y[of], seen[of], self.r.R[:count])
            X[of, :count], P[of, :count] = done.X.reshape(-1, count, N), done.P.reshape(-1, count, N, N)
            log[of, :count] += done.log_likelihood.reshape(-1, count)
            nu[of], S[of] = done.nu.reshape(-1, count, m)[:, 0], done.S.reshape(-1, count, m, m)[:, 0]
        found = s._replace(X=X, P=P, nu=nu, S=S, log=log)
        if self.checks is None or s.checks is None:
            return found
        return found._replace(checks=self.checks.update(s.checks, y, seen, nu, S))

    def by_label(self, s: Bank, log: Array) -> Array:
        """Log likelihood (n, labels) of each label that can be, on average over its hypotheses."""
        sorted_log = log[:, self.order]
        largest = np.maximum.reduceat(sorted_log, self.first, axis=1)
        found = largest + np.log(np.add.reduceat(np.exp(sorted_log - largest[:, self.sorted_label]), self.first, axis=1))
        found[:, 0] = -np.inf
        if self.checks is not None and s.checks is not None:
            gain = self.checks.repeated(s.checks)
            least = s.log[:, :1] if self.allowed is None else s.log.max(axis=1, keepdims=True)  # the reading was certain
            found = np.where(gain > 0, np.maximum(found, least + 0.5 * gain), found)
        found[~s.among] = -np.inf
        found[~s.now] = -np.inf
        found[~np.isfinite(found[:, 1:]).any(axis=1), 0] = 0.0
        return found

    def read(self, s: Bank) -> Reading:
        """Probabilities of the labels, and the mean of the fault vector."""
        model, log = self.r.model, s.log + self.r.log_prior
        by_label = self.by_label(s, log)
        probs = np.exp(by_label - logsumexp(by_label, axis=1, keepdims=True))
        mean, of = np.zeros((len(log), self.own)), np.flatnonzero(s.now)
        weight = np.exp(log[of, 1:] - logsumexp(log[of, 1:], axis=1, keepdims=True)) * s.length[of, 1:]
        on_line = (self.direction[1:, : self.own] @ s.X[of, 1:, model.z, None])[..., 0]
        mean[of] = (weight[..., None] * (self.offset[1:, : self.own] + on_line)).sum(axis=1)
        return Reading(mean, x=s.X[:, 0, model.x], nu=s.nu, S=s.S, probs=probs)

    def expect(self, s: Bank, at: Interval) -> Array:
        """What the healthy filter expects the sensors to read."""
        return self.r.model.expect(s.X[:, 0, self.r.model.x], at)

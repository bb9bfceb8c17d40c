"""Bayesian reference of the missile that knows when a fault acts, but not which.

A filter of the nominal, healthy model produces innovations; `innovation_evidence` says what they tell. The label with the
largest evidence is the answer. A jam changes the model too much for that and has a filter of its own, whose fin stands
where it was at the onset.

It linearises and uses Gaussian priors: a good reference, and no ceiling. Bayes' rule with filters that are told nothing of
the times (`onset_bank_fine`) is above it where faults come and go; told them (`told_events_oracle`) it frames the tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from baselines.filters import missile_model as model
from baselines.filters.missile_model import Known
from baselines.oracles.innovation_evidence import (
    LINEAR,
    Information,
    Priors,
    Tracked,
    evidence,
    nothing,
    predict,
    priors,
    update,
)
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DT

PSEUDO_ONSET = 1000  # of a flight without a fault
SETTLE = 100  # samples after a window that don't count as fault-free
NEVER = 1 << 40
CERTAIN = np.where(np.arange(6) == 0, 0.0, -np.inf)  # log evidence where there is no fault


class Told(NamedTuple):
    """State after a sample."""

    windows: Array  # (n, w, 2) first and end step of each
    known: Known
    first: Tracked  # nominal model
    second: Tracked  # with the fin where it was at the last onset
    jam: Array  # (n,) that angle
    free: Information  # of fault-free samples about rho
    window: Information  # of the samples since the onset, fault columns included
    jammed: Information  # the same of the second filter
    log: Array  # (n, 6) log evidence of the labels
    size: Array  # (n, 4) size of each linear label


class Question(NamedTuple):
    """What the oracle is asked, and what it expects."""

    priors: Priors
    every: int  # samples between two evaluations
    none_allowed: bool  # label 0 is among the candidates inside a window
    R: Array  # (2, 2) noise of alpha and q

    @property
    def m(self) -> int:
        """Coefficient errors."""
        return len(self.priors.rho)


def expectation(plant: Plant, hard: bool) -> Priors:
    """The priors of the process "hard", or of "standard"."""
    scale = float(plant.options["fault_scale"])
    if hard:
        sizes, rates, rho, fin = [(0.08, 0.30), (0.08, 0.30), (0.05, 0.20), (0.15, 0.45)], (0.5, 3.0), 0.08, 0.05
    else:
        sizes, rates, rho, fin = [(0.1, 0.7), (0.1, 0.7), (0.05, 0.40), (0.3, 1.0)], (0.15, 2.0), 0.05, 0.0
    return priors([(scale * low, scale * high) for low, high in sizes], rates, rho, fin)


def windows_of(scenarios: Sequence[FaultScenario], always: bool) -> Array:
    """First and end step (n, w, 2) of the faults; with `always` a flight without one is asked about from PSEUDO_ONSET on."""
    times = [[(f.onset, NEVER if f.end is None else f.end) for f in sorted(s.faults, key=lambda f: f.onset)]
             for s in scenarios]  # fmt: skip
    if always:
        times = [windows or [(PSEUDO_ONSET, NEVER)] for windows in times]
    longest = max((1, *(len(windows) for windows in times)))
    return np.array([windows + [(NEVER, NEVER)] * (longest - len(windows)) for windows in times], np.int64)


def inside(o: Told, k: Array) -> Array:
    """(n, w): the interval that ends at k was under this window's fault."""
    on, end = o.windows[..., 0], o.windows[..., 1]
    return (on < k[:, None]) & (k[:, None] <= end)


def since_onset(o: Told, k: Array, within: Array) -> Array:
    """Seconds (n,) since the latest onset of the windows that k is in; 0 outside."""
    latest = np.where(within, o.windows[..., 0], 0).max(axis=1)
    return np.where(within.any(axis=1), k - latest, 0) * DT


def at_first(q: Question, windows: Array) -> Told:
    """Nothing is known yet."""
    n, m, p = len(windows), q.m, q.priors
    columns = m + len(LINEAR) * len(p.rates)
    x, P = np.zeros((n, 2)), np.tile(q.R, (n, 1, 1))
    first, second = Tracked(x, P, np.zeros((n, 2, columns))), Tracked(x, P, np.zeros((n, 2, m)))
    return Told(windows, model.unknown(n), first, second, np.zeros(n), nothing(n, m), nothing(n, columns), nothing(n, m),
                np.tile(CERTAIN, (n, 1)), np.zeros((n, len(LINEAR))))  # fmt: skip


def begin(q: Question, o: Told, at: Interval, y: Array) -> Told:
    """Both filters from the first sample."""
    now, x = model.known(at, o.known), y[:, :2]
    o = o._replace(known=now, first=o.first._replace(x=x), second=o.second._replace(x=x), jam=now.delta)
    return observe(q, o, at, y, np.ones(y.shape, bool))


def forward(q: Question, o: Told, at: Interval) -> Told:
    """Both filters over an interval."""
    now, within = model.known(at, o.known), inside(o, at.k)
    since = since_onset(o, at.k, within)
    earlier, beta = (1 - np.exp(-q.priors.rates * np.maximum(t, 0.0)[:, None]) for t in (since - DT, since))
    first = predict(o.first, o.known, now, q.m, (earlier, beta))
    active = np.asarray(within.any(axis=1))
    before, after = (known._replace(delta=np.where(active, o.jam, known.delta)) for known in (o.known, now))
    return o._replace(known=now, first=first, second=predict(o.second, before, after, q.m, None))


def afresh(o: Told, opens: Array, m: int) -> Told:
    """Where a window opens the faults' sensitivities begin at 0, and the second filter is the first, its fin where it is."""
    if not opens.any():
        return o
    first, second, fresh = o.first, o.second, opens[:, None, None]
    clean = np.concatenate([first.s[..., :m], np.zeros_like(first.s[..., m:])], axis=-1)
    first = first._replace(s=np.where(fresh, clean, first.s))
    second = Tracked(np.where(opens[:, None], first.x, second.x), np.where(fresh, first.P, second.P),
                     np.where(fresh, first.s[..., :m], second.s))  # fmt: skip
    return o._replace(first=first, second=second, jam=np.where(opens, o.known.delta, o.jam))


def answer(q: Question, o: Told, k: Array, within: Array) -> Told:
    """The evidence of the labels where it is time; outside the windows the answer is none."""
    active = np.asarray(within.any(axis=1))
    log, size, due = o.log, o.size, active & (k % q.every == 0)
    if due.any():
        beta = 1 - np.exp(-q.priors.rates * since_onset(o, k, within)[:, None])
        found = evidence(o.free, o.window, o.jammed, beta, q.priors)
        candidates = found.log if q.none_allowed else np.where(np.arange(6) == 0, -np.inf, found.log)
        log, size = np.where(due[:, None], candidates, log), np.where(due[:, None], found.size, size)
    return o._replace(log=np.where(active[:, None], log, CERTAIN), size=size)


def observe(q: Question, o: Told, at: Interval, y: Array, seen: Array) -> Told:
    """Both filters with a sample, and what its innovations say."""
    k, m, within, (on, end) = at.k, q.m, inside(o, at.k), np.moveaxis(o.windows, 2, 0)
    active, opens = np.asarray(within.any(axis=1)), np.asarray((on == k[:, None]).any(axis=1))
    settled = ~(active | ((end < k[:, None]) & (k[:, None] <= end + SETTLE)).any(axis=1))
    first, told = update(o.first, y[:, :2], seen[:, :2], q.R)
    second, told_jammed = update(o.second, y[:, :2], seen[:, :2], q.R)
    free = o.free.add(Information(told.A[:, :m, :m], told.b[:, :m], told.c), settled)
    window = o.window.keep(~opens).add(told, active)
    jammed = o.jammed.keep(~opens).add(told_jammed, active)
    o = o._replace(first=first, second=second, free=free, window=window, jammed=jammed)
    return answer(q, afresh(o, opens, m), k, within)


def read(o: Told) -> Reading:
    """The probabilities of the labels, and the size of the most probable one."""
    probs = np.exp(o.log - logsumexp(o.log, axis=1, keepdims=True))
    label, z = np.argmax(o.log, axis=1), np.zeros((len(probs), 5))
    for i, l in enumerate(LINEAR):  # noqa: E741
        z[:, l - 1] = np.where(label == l, o.size[:, i], 0.0)
    z[:, 3] = label == 4
    return Reading(z, cost=-2.0 * o.log, probs=probs)


def most_probable() -> Rule:
    """The most probable label at every sample: the times are known, so nothing has to persist."""

    def step(s: None, k: Array, r: Reading, informed: Array) -> tuple[None, Verdict]:
        label = np.argmax(np.asarray(r.probs), axis=1)
        return None, Verdict(label > 0, label)

    return Rule(lambda n: None, step)


@diagnoser(
    "innovation_oracle",
    "Evidence of the innovations under the process's priors, within the known windows of faults",
    knows="when each fault begins and ends",
)
def innovation_oracle(
    plant: Plant, *, scenarios: Sequence[FaultScenario], hard: bool = False, every: int = 1, none_allowed: bool = True
) -> Diagnoser:
    """The oracle.

    Args:
        plant: The missile.
        scenarios: One per episode; onsets and ends are all that is read of them.
        hard: Priors of the process "hard" and no question asked outside its windows; else those of "standard", with a
            question asked from 10 s on where there is no fault.
        every: Samples between two evaluations.
        none_allowed: Label 0 is among the candidates inside a window.

    Raises:
        NotApplicableError: Another plant, or one without sensor noise.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    model.require_missile(plant, "the innovation oracle", noisy=True)
    q = Question(expectation(plant, hard), every, none_allowed, plant.R[:2, :2])

    def start(n: int) -> Told:
        if n != len(scenarios):
            raise ValueError(f"the oracle was told of {len(scenarios)} flights, not {n}")
        return at_first(q, windows_of(scenarios, always=not hard))

    filter = Filter(
        start,
        lambda o, at: forward(q, o, at),
        lambda o, at, y, seen: observe(q, o, at, y, seen),
        read,
        begin=lambda o, at, y: begin(q, o, at, y),
        needs=model.SENSORS,
    )
    return diagnoser_of(plant, filter, most_probable())

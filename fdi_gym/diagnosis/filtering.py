"""A diagnoser from a filter and a decision rule: the one contract of all filters, gaps included.

A filter says what it starts from, how it predicts over an interval from the model alone, how it uses the sensors that
reported, and what it then knows. Counters, gaps, the first sample and the decision are not its business: a sensor that did
not report arrives as 0 with `seen` False, a command or a known signal that is missing is held, and each episode has its own
sample number. Of measurements that mean the same (a quaternion and its negative, an angle a turn later) it gets the one
nearest what it expects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis.contract import Diagnoser, Diagnosis, choose
from fdi_gym.estimation.augmented import Interval
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.equivalent import has_equivalents, nearest
from fdi_gym.plant import Array, Plant


class Filter(NamedTuple):
    """Functions, batched over n episodes; states are nests of arrays with the episodes first.

    A filter that starts from a measurement rather than from a prior has `begin`: its state, at the first sample at which all
    sensors of `needs` reported; until then it stays at its start.
    """

    start: Callable[[int], Any]  # before any sample
    predict: Callable[[Any, Interval], Any]  # over the interval that has just ended: the model only
    update: Callable[[Any, Interval, Array, Array], Any]  # (state, interval, y (n, n_y), seen (n, n_y) bool)
    read: Callable[[Any], Reading]
    first_sample: bool = True  # the sample before any interval is a measurement; False: the prior stands there
    begin: Callable[[Any, Interval, Array], Any] | None = None  # (start, interval, y)
    needs: Array | None = None  # (n_y,) bool, for `begin`. Default: all sensors
    expect: Callable[[Any, Interval], Array] | None = None  # what the sensors will read (n, n_y); NaN where that is open


class Running(NamedTuple):
    """State of a filter that runs: n episodes."""

    k: Array  # (n,) number of the sample to come
    begun: Array  # (n,) bool
    u: Array  # (n, n_u) the last command that was reported, and
    stale: Array  # (n, n_u) for how many samples it has been missing since
    known: Array  # (n, n_known) the last known signals
    filter: Any
    rule: Any


def _start(plant: Plant, filter: Filter, rule: Rule, n: int) -> Running:
    known = np.tile([s.nominal for s in plant.known], (n, 1)) if plant.known else np.zeros((n, 0))
    begun = np.full(n, filter.begin is None)
    u = np.tile(plant.trim_command, (n, 1))
    return Running(np.zeros(n, np.int64), begun, u, np.zeros(u.shape), known, filter.start(n), rule.start(n))


def _step(plant: Plant, filter: Filter, rule: Rule, s: Running, obs: Array) -> tuple[Running, Reading, Verdict]:
    y, u, known = plant.split(obs)
    seen = np.isfinite(y)
    whole = bool(seen.all())
    held: Array | None = None
    stale = s.stale if np.isfinite(u).all() and not s.stale.any() else np.where(np.isfinite(u), 0.0, s.stale + 1.0)
    if not (np.isfinite(u).all() and np.isfinite(known).all()):
        held = np.any(~np.isfinite(np.concatenate([u, known], axis=1)), axis=1)
        u, known = np.where(np.isfinite(u), u, s.u), np.where(np.isfinite(known), known, s.known)
    if not whole:
        y = np.where(seen, y, 0.0)
    first = s.k == 0
    d = None
    if plant.measured_disturbance is not None:
        before = np.where(first[:, None], known, s.known)
        d = plant.measured_disturbance((s.k - 1) * plant.dt, before, known)  # type: ignore[arg-type]
    at = Interval(s.k, u, d, known, held, stale if stale.any() else None)
    state, begun = s.filter, s.begun
    ready = begun & ~first
    if ready.all():
        state = filter.predict(state, at)
    elif ready.any():
        state = choose(ready, filter.predict(state, at), state)
    if filter.expect is not None and has_equivalents(plant):
        y = nearest(plant, y, seen, filter.expect(state, at))
    measures = begun if filter.first_sample else ready
    if filter.begin is not None and not begun.all():
        needs = seen if filter.needs is None else seen[:, filter.needs]
        fresh = ~begun & needs.all(axis=1)
        if fresh.any():
            state = choose(fresh, filter.begin(state, at, y), state)
        begun = begun | fresh
    if measures.all():
        state = filter.update(state, at, y, seen)
    elif measures.any():
        state = choose(measures, filter.update(state, at, y, seen), state)
    reading = filter.read(state)
    informed = measures & (seen.any(axis=1) if reading.seen is None else reading.seen > 0)
    if at.stale is not None:  # what a command that did not report has changed is no evidence of a fault
        informed &= (at.stale == 0).all(axis=1)
    ruled, verdict = rule.step(s.rule, s.k, reading, informed)
    return Running(s.k + 1, begun, u, stale, known, state, ruled), reading, verdict


def diagnoser_of(plant: Plant, filter: Filter, rule: Rule) -> Diagnoser:
    """The diagnoser that declares what a rule makes of a filter's readings."""
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)

    def update(s: Running, obs: Array) -> tuple[Running, Diagnosis]:
        s, r, verdict = _step(plant, filter, rule, s, obs)
        z = r.z if verdict.z is None else verdict.z
        P = r.P if verdict.P is None else verdict.P
        std = None if P is None else np.sqrt(np.maximum(np.einsum("npp->np", P), 0.0))
        estimate = None if z is None else healthy + z
        signals = {**(r.signals or {}), **(verdict.signals or {})}
        return s, Diagnosis(verdict.alarm, verdict.label, estimate, std, r.probs, r.x, signals or None)

    return Diagnoser(lambda n: _start(plant, filter, rule, n), update, gaps=True, filter=filter, rule=rule)


def readings(plant: Plant, diagnoser: Diagnoser, obs: Array) -> Iterator[tuple[Reading, Verdict]]:
    """What the filter and the rule of a diagnoser say at each sample of recorded observations (N, K + 1, n_obs)."""
    s = _start(plant, diagnoser.filter, diagnoser.rule, len(obs))
    for k in range(obs.shape[1]):
        s, reading, verdict = _step(plant, diagnoser.filter, diagnoser.rule, s, obs[:, k])
        yield reading, verdict

"""A diagnoser from a filter and a decision rule: the one contract of all filters, gaps included.

A filter says what it starts from, how it predicts over an interval from the model alone, how it uses the sensors that
reported, and what it then knows. Counters, gaps, the first sample and the decision are not its business: a sensor that did
not report arrives as 0 with `seen` False, a command or a known signal that is missing is held, and each episode has its own
sample number. What a held command does to the state is part of the interval's process noise (`Interval.noise`). Of
measurements that mean the same (a quaternion and its negative, an angle a turn later) it gets the one nearest what it
expects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import compiled
from fdi_gym.diagnosis.contract import Diagnoser, Diagnosis, among
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.equivalent import has_equivalents, nearest
from fdi_gym.estimation.interval import Interval, held_command_covariance
from fdi_gym.estimation.sensor_checks import Checks, SensorChecks
from fdi_gym.estimation.sweep import Sweep
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

NO_P, NO_STD = np.zeros((0, 0, 0)), np.zeros((0, 0))


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
    innovation: Callable[[Any], tuple[Array, Array]] | None = None  # nu and S of the reading, where that is cheaper


class Running(NamedTuple):
    """State of a filter that runs: n episodes."""

    k: Array  # (n,) number of the sample to come
    begun: Array  # (n,) bool
    u: Array  # (n, n_u) the last command that was reported, and
    stale: Array  # (n, n_u) for how many samples it has been missing since
    known: Array  # (n, n_known) the last known signals
    filter: Any
    rule: Any


Step = Callable[[Running, Array], tuple[Running, Reading, Verdict]]


def shell(plant: Plant, filter: Filter, rule: Rule) -> tuple[Callable[[int], Running], Step]:
    """start(n) and step(state, obs (n, n_obs)) -> (state, reading, verdict) of a filter and a rule."""
    n_y, n_u, n_known = len(plant.outputs), len(plant.commands), len(plant.known)
    nominal = np.array([s.nominal for s in plant.known], float)
    turns = filter.expect is not None and has_equivalents(plant)

    def start(n: int) -> Running:
        u, known, begun = np.tile(plant.trim_command, (n, 1)), np.tile(nominal, (n, 1)), np.full(n, filter.begin is None)
        return Running(np.zeros(n, np.int64), begun, u, np.zeros(u.shape), known, filter.start(n), rule.start(n))

    def interval(s: Running, u: Array, known: Array, held: Array | None, stale: Array | None) -> Interval:
        """What is known of the interval that has just ended."""
        d, Q_held = None, None
        if plant.measured_disturbance is not None:
            before = np.where((s.k == 0)[:, None], known, s.known)
            d = plant.measured_disturbance((s.k - 1) * plant.dt, before, known)  # type: ignore[arg-type]
        if stale is not None:
            x = filter.read(s.filter).x
            Q_held = held_command_covariance(plant, plant.trim_state if x is None else x, s.k, u, d, stale)
        return Interval(s.k, u, d, known, held, stale, Q_held)

    def moved(s: Running, at: Interval, y: Array, seen: Array) -> tuple[Any, Array, Array]:
        """The filter's state after the sample, where it has begun, and where the sample was measured."""
        state, begun, ready = s.filter, s.begun, s.begun & (s.k > 0)
        state = among(ready, lambda: filter.predict(state, at), state)
        if turns:
            y = nearest(plant, y, seen, filter.expect(state, at))  # type: ignore[misc]
        measures = begun if filter.first_sample else ready
        if filter.begin is not None and not begun.all():
            needs = seen if filter.needs is None else seen[:, filter.needs]
            fresh = ~begun & needs.all(axis=1)
            state, begun = among(fresh, lambda: filter.begin(state, at, y), state), begun | fresh  # type: ignore[misc]
        return among(measures, lambda: filter.update(state, at, y, seen), state), begun, measures

    def step(s: Running, obs: Array) -> tuple[Running, Reading, Verdict]:
        n = len(obs)
        y, seen, heard, held = np.empty((n, n_y)), np.empty((n, n_y), bool), np.empty(n, bool), np.empty(n, bool)
        u, stale, known, following = np.empty((n, n_u)), np.empty((n, n_u)), np.empty((n, n_known)), np.empty(n, np.int64)
        flags = compiled.receive(
            contiguous(obs), s.k, s.begun, s.u, s.known, s.stale, following, y, seen, u, known, stale, heard, held
        )
        at = interval(s, u, known, held if flags & compiled.HELD else None, stale if flags & compiled.STALE else None)
        if flags & compiled.RUNNING == compiled.RUNNING:
            state, begun, measures = filter.predict(s.filter, at), s.begun, None
            if turns:
                y = nearest(plant, y, seen, filter.expect(state, at))  # type: ignore[misc]
            state = filter.update(state, at, y, seen)
        else:
            state, begun, measures = moved(s, at, y, seen)
        reading = filter.read(state)
        informed = heard if reading.seen is None else reading.seen > 0
        if measures is not None:
            informed = informed & measures
        if at.stale is not None:  # what a command that did not report has changed is no evidence of a fault
            informed = informed & (at.stale == 0).all(axis=1)
        ruled, verdict = rule.step(s.rule, s.k, reading, informed)
        return Running(following, begun, u, stale, known, state, ruled), reading, verdict

    return start, step


class Checked(NamedTuple):
    """State of a filter whose sensors are checked."""

    filter: Any
    checks: Checks


def checked(plant: Plant, filter: Filter) -> Filter:
    """The filter, whose readings say too what its sensors show of their own faults."""
    checks = SensorChecks(plant)

    def innovation(state: Any) -> tuple[Array | None, Array | None]:
        if filter.innovation is not None:
            return filter.innovation(state)
        reading = filter.read(state)
        return reading.nu, reading.S

    def update(s: Checked, at: Interval, y: Array, seen: Array) -> Checked:
        state = filter.update(s.filter, at, y, seen)
        return Checked(state, checks.update(s.checks, y, seen, *innovation(state)))

    begin, expect = filter.begin, filter.expect
    return filter._replace(
        start=lambda n: Checked(filter.start(n), checks.start(n)),
        predict=lambda s, at: s._replace(filter=filter.predict(s.filter, at)),
        update=update,
        read=lambda s: filter.read(s.filter)._replace(gain=checks.gain(s.checks)),
        begin=None if begin is None else lambda s, at, y: s._replace(filter=begin(s.filter, at, y)),
        expect=None if expect is None else lambda s, at: expect(s.filter, at),
    )


def diagnoser_of(plant: Plant, filter: Filter, rule: Rule, sweep: Sweep | None = None) -> Diagnoser:
    """The diagnoser that declares what a rule makes of a filter's readings.

    Where the plant's sensors may fail, the rule hears `fdi_gym.estimation.sensor_checks` too.

    Args:
        plant: The plant.
        filter: The filter.
        rule: The decision.
        sweep: Both over many samples at once, to the same numbers: of `fdi_gym.estimation.sweep`.
    """
    if plant.bare is not None:
        filter, sweep = checked(plant, filter), None
    start, step = shell(plant, filter, rule)
    healthy = contiguous(plant.healthy)

    def update(s: Running, obs: Array) -> tuple[Running, Diagnosis]:
        s, r, verdict = step(s, obs)
        z = r.z if verdict.z is None else verdict.z
        P = r.P if verdict.P is None else verdict.P
        estimate, std = None, None
        if z is not None:
            z = contiguous(z)
            estimate = np.empty(z.shape)
            std = None if P is None else np.empty(z.shape)
            compiled.report(z, NO_P if P is None else contiguous(P), healthy, estimate, NO_STD if std is None else std)
        signals = {**(r.signals or {}), **(verdict.signals or {})} if r.signals or verdict.signals else None
        return s, Diagnosis(verdict.alarm, verdict.label, estimate, std, r.probs, r.x, signals)

    along = None if sweep is None else swept(plant, sweep)
    return Diagnoser(start, update, gaps=True, filter=filter, rule=rule, sweep=along)


def swept(plant: Plant, sweep: Sweep) -> Callable[[Running, Array], tuple[Running, Diagnosis] | None]:
    """Many samples at once: where all episodes run and all commands and known signals reported."""
    n_y, n_u = len(plant.outputs), len(plant.commands)

    def along(s: Running, obs: Array) -> tuple[Running, Diagnosis] | None:
        if not (s.begun & (s.k > 0)).all() or not np.isfinite(obs[:, :, n_y:]).all():
            return None
        n, K, _ = obs.shape
        u, known, d = obs[:, -1, n_y : n_y + n_u].copy(), obs[:, :, n_y + n_u :], None
        if plant.measured_disturbance is not None:
            before = np.concatenate([s.known[:, None], known[:, :-1]], axis=1)
            t = (s.k[:, None] + np.arange(K) - 1) * plant.dt
            flat = (a.reshape(n * K, *a.shape[2:]) for a in (t, before, known))
            d = plant.measured_disturbance(*flat).reshape(n, K, -1)  # type: ignore[arg-type]
        declared, tested, waiting = s.rule
        done = sweep(obs, d, s.k, s.filter, declared, waiting)
        said = Diagnosis(done.alarm, done.label, done.estimate, done.std, None, done.state)
        rule = (done.declared, tested, done.waiting)
        return Running(s.k + K, s.begun, u, np.zeros(u.shape), known[:, -1].copy(), type(s.filter)(*done.filter), rule), said

    return along


def readings(plant: Plant, diagnoser: Diagnoser, obs: Array) -> Iterator[tuple[Reading, Verdict]]:
    """What the filter and the rule of a diagnoser say at each sample of recorded observations (N, K + 1, n_obs)."""
    start, step = shell(plant, diagnoser.filter, diagnoser.rule)
    s = start(len(obs))
    for k in range(obs.shape[1]):
        s, reading, verdict = step(s, obs[:, k])
        yield reading, verdict

"""Fitting: the only place that flies flights for a method. What comes of it is plain data, shipped for the shipped suites.

`fit(method, plant, process)` gives a `Belief` (what a filter may assume of the plant, from its declaration and from flights
of the process) and a `Calibration` (thresholds that 5 % of its healthy flights reach). All flights have validation seeds.
Nothing of a test flight is used. `fdi_gym.diagnosis.knowledge` ships and keeps what is found.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fdi_gym.diagnosis.filtering import readings
from fdi_gym.diagnosis.registry import Entry, find_diagnoser
from fdi_gym.engine import Record, simulate
from fdi_gym.estimation.belief import Belief, fault_inputs, noisy_sensors
from fdi_gym.estimation.calibration import Calibration, thresholds_from
from fdi_gym.estimation.data import rounded
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Array, Plant

VALIDATION_SEED = 2_000_000
FLIGHTS = 32  # of a belief
FLOOR = 1e-5  # process noise of a state that has none, in units of its scale: covariances stay definite
START = 0.1  # initial standard deviation of a state, in units of its scale, on top of what the flights show
FIRST = 100_000  # calibration flights begin at VALIDATION_SEED + FIRST
SAMPLES = 100_000  # about so many samples are flown, in 20 to 60 flights
CHANNEL_FLIGHTS, QUANTILE = 100, 0.99  # of channels: this quantile, over so many healthy flights, of the largest magnitude


def floored(plant: Plant, Q: Array) -> Array:
    """The process noise Q (n_x, n_x), a little of it where a state has none."""
    floor = (FLOOR * np.array([s.scale for s in plant.states])) ** 2
    return Q + np.diag(np.where(np.diag(Q) > 0, 0.0, floor))


def flights_of(plant: Plant, process: str, first: int, count: int, faults: bool) -> tuple[list[FaultScenario], Record]:
    """Flights of a process, with the validation seeds from VALIDATION_SEED + first on; healthy ones if asked."""
    scenarios = [draw(plant.process(process), VALIDATION_SEED + first + i) for i in range(count)]
    if not faults:
        scenarios = [scenario.without_faults() for scenario in scenarios]
    return scenarios, simulate(plant, scenarios)


# ---------------------------------------------------------------------------------------------------------------
# Beliefs


def long_run(e: Array, valid: Array, block: int) -> Array:
    """Second moment per step (m, m) of the sums over blocks of e (N, K, m): of white noise, its covariance.

    An error that lasts counts for more than its square: this is the white noise with the same effect over a block.
    """
    n, K, m = e.shape
    blocks = K // block
    whole = valid[:, : blocks * block].reshape(n, blocks, block).all(axis=2)
    sums = e[:, : blocks * block].reshape(n, blocks, block, m).sum(axis=2)[whole]
    return sums.T @ sums / (block * max(len(sums), 1))


def _model_error(plant: Plant, scenarios: list[FaultScenario], record: Record, valid: Array) -> tuple[Array, Array]:
    """Truth less model, one sample ahead (N, K, n_x) and at the sensors (N, K, n_y), on flights off the model."""
    n, K = valid.shape
    dx, dy = np.zeros((n, K, len(plant.states))), np.zeros((n, K, len(plant.outputs)))
    for i, scenario in enumerate(scenarios):
        if not scenario.physical:
            continue
        steps = int(record.length[i])
        t = plant.dt * np.arange(steps)
        x, u = record.state[i, :steps], plant.split(record.obs[i])[1][1 : steps + 1]
        d = plant.disturbance(scenario)[:steps] if plant.disturbance else None
        p = plant.physical(scenario.physical)[None]
        dx[i, :steps] = plant.propagate(t, x, u, None, d, p) - plant.propagate(t, x, u, None, d)
        dy[i, :steps] = plant.measure(t, x, u, None, d, p) - plant.measure(t, x, u, None, d)
    return dx, dy


def _magnitudes(plant: Plant, z: Array, record: Record, block: int) -> tuple[Array, Array, Array]:
    """Mean, standard deviation and walk of each magnitude, over the samples where its mode acts (n_magnitudes,)."""
    count, m = plant.n_magnitudes, plant.magnitudes(record.label, z)
    mean, std, walk = np.zeros(count), np.zeros(count), np.zeros(count)
    for i, (low, high) in enumerate(plant.reaches.tolist()):
        values = np.clip(m[..., i][np.isfinite(m[..., i])], low, high)
        if values.size:
            mean[i], std[i] = values.mean(), values.std()
            steps = np.diff(m[..., i : i + 1], axis=1)
            acting = np.isfinite(steps[..., 0])
            walk[i] = np.sqrt(long_run(np.nan_to_num(steps), acting, block)[0, 0])
        else:  # too rare to have been drawn: uniform within its reach
            mean[i], std[i] = 0.5 * (low + high), (high - low) / 12**0.5
    return mean, std, walk


class _Sizes(NamedTuple):
    """What is found of the faults: of the entries of the fault vector (p,), and of the magnitudes (n_magnitudes,)."""

    z_size: Array
    z_walk: Array
    m_mean: Array
    m_std: Array
    m_walk: Array


def _alike(plant: Plant, bare: Plant, z: Array, flown: Array, block: int, s: _Sizes) -> _Sizes:
    """The same, for biases of sensors: all of them as one, in the units of their scales, since a process draws each rarely.

    z (N, K, estimated).
    """
    own, modes, magnitudes = len(bare.estimated), len(bare.modes), bare.n_magnitudes
    units = np.array([e.scale for e in plant.estimated[own:]])
    bias = z[..., own:] / units
    values = np.abs(bias[bias != 0.0])
    steps = np.sqrt(np.diag(long_run(np.diff(bias, axis=1), flown, block)).mean())
    walk = steps if steps > 0 else 0.02
    of_mode = np.array([units[np.argmax(line[own:])] for mode in plant.modes[modes:] for line in mode.directions])
    std = float(np.sqrt((values**2).mean())) if values.size else 1.0
    size = float(np.median(values)) if values.size else 1.0
    more = (size * units, walk * units, 0.0 * of_mode, std * of_mode, walk * of_mode)
    firsts = (own, own, magnitudes, magnitudes, magnitudes)
    return _Sizes(*(np.concatenate([a[:n], b]) for a, n, b in zip(s, firsts, more, strict=True)))


def fit_belief(plant: Plant, process: str) -> Belief:
    """What the declarations of a plant and of one of its fault processes let a filter believe.

    The data sheet declares the noises; the process declares how large the faults are, when they come, how far the truth lies
    off the model and what the world does to it. Flights turn the latter into numbers: the walk that follows its faults and
    disturbances, and the noise that stands for the model's errors.

    Raises:
        NotApplicableError: No sensor has noise, or the fault vector does not enter additively.
    """
    sensors, inputs = noisy_sensors(plant), fault_inputs(plant)
    scale = np.array([s.scale for s in plant.states])
    scenarios, faulty = flights_of(plant, process, 0, FLIGHTS, True)
    healthy = [s.without_faults() for s in scenarios]
    record = simulate(plant, healthy)
    K = record.obs.shape[1] - 1
    block = max(1, K // 100)

    valid = np.arange(K) < record.length[:, None]
    dx, dy = _model_error(plant, healthy, record, valid)
    Q = floored(plant, plant.Q + long_run(dx, valid, block))
    R = (plant.R + long_run(dy, valid, block))[np.ix_(sensors, sensors)]
    P0 = np.diag((START * scale) ** 2 + ((record.state[:, 0] - plant.trim_state) ** 2).mean(axis=0))

    z = faulty.target - plant.healthy
    z = np.where((faulty.label > 0)[..., None], z, 0.0)[..., inputs.estimated]
    seen = [np.abs(z[..., j][z[..., j] != 0]) for j in range(z.shape[-1])]
    size = np.array([
        np.median(v) if v.size else plant.estimated[i].scale for v, i in zip(seen, inputs.estimated, strict=True)
    ])  # fmt: skip
    flown = np.arange(K) < faulty.length[:, None]
    z_walk = np.sqrt(np.diag(long_run(np.diff(z, axis=1), flown, block)))
    z_walk = np.where(z_walk > 0, z_walk, 0.02 * size)

    sizes = _Sizes(size, z_walk, *_magnitudes(plant, z, faulty, block))
    if plant.bare is not None:
        sizes = _alike(plant, plant.bare, z, flown, block, sizes)
    changes = float(((np.diff(faulty.label, axis=1) != 0) & flown).sum() / flown.sum())

    d = np.zeros((FLIGHTS, K + 1, len(plant.disturbances)))
    if plant.disturbance is not None and plant.measured_disturbance is None:
        for i, scenario in enumerate(healthy):
            rows = plant.disturbance(scenario)
            d[i, : len(rows)], d[i, len(rows) :] = rows, rows[-1]
    which = np.flatnonzero(np.abs(d).max(axis=(0, 1)) > 0)
    d = d[..., which]
    floor = 1e-3 * np.array([plant.disturbances[i].scale for i in which])
    d_walk = np.sqrt(np.diag(long_run(np.diff(d, axis=1), valid, block)) + floor**2 / K)
    d0 = np.sqrt((d[:, 0] ** 2).mean(axis=0) + floor**2)
    found = {
        "x0": plant.trim_state, "P0": P0, "Q": Q, "R": R, **sizes._asdict(), "changes": changes, "d0": d0,
        "d_walk": d_walk,
    }  # fmt: skip
    return Belief(sensors=sensors, disturbances=which, **{name: rounded(value) for name, value in found.items()})


# ---------------------------------------------------------------------------------------------------------------
# Calibrations


def _healthy(plant: Plant, process: str, count: int | None = None) -> Record:
    if count is None:
        steps = draw(plant.process(process), VALIDATION_SEED + FIRST).steps
        count = int(np.clip(SAMPLES // steps, 20, 60))
    return flights_of(plant, process, FIRST, count, False)[1]


def _excess(plant: Plant, build: Any, record: Record) -> Array | None:
    """By how much the spread of a healthy estimate exceeds the filter's own covariance (p, p); zero if it does not."""
    own, found, count = 0.0, 0.0, 0
    for k, (reading, _) in enumerate(readings(plant, build(Calibration()), record.obs)):
        if reading.cost is not None or reading.P is None or reading.z is None:
            return None
        flown = (k <= record.length) & np.isfinite(reading.z).all(axis=1)
        z = reading.z[flown]
        own, found, count = own + reading.P[flown].sum(axis=0), found + z.T @ z, count + len(z)
    values, vectors = np.linalg.eigh((found - own) / max(count, 1))
    return rounded((vectors * np.maximum(values, 0.0)) @ vectors.T)


def fit_calibration(
    entry: Entry, plant: Plant, process: str, settings: Mapping[str, Any], belief: Belief | None
) -> Calibration:
    """When a method alarms: thresholds from healthy flights of the process, flown on and off the model as the test's are."""
    given: dict[str, Any] = {} if belief is None else {"belief": belief}
    if entry.takes("process"):
        given["process"] = process

    def build(calibration: Calibration) -> Any:
        return entry.build(plant, calibration=calibration, **given, **settings)

    first = next(readings(plant, build(Calibration()), _healthy(plant, process, 1).obs))[1].evidence
    if first.channels is not None:
        record, most = _healthy(plant, process, CHANNEL_FLIGHTS), np.zeros((CHANNEL_FLIGHTS, first.channels.shape[1]))
        for k, (_, verdict) in enumerate(readings(plant, build(Calibration()), record.obs)):
            found = np.asarray(verdict.evidence.channels)
            np.maximum(most, np.where((k <= record.length)[:, None], found, 0.0), out=most)
        names = fault_inputs(plant, settings.get("channels")).names
        levels = rounded(np.quantile(most, QUANTILE, axis=0))
        return Calibration(channels=dict(zip(names, levels.tolist(), strict=True)))
    record = _healthy(plant, process)
    n, samples, _ = record.obs.shape
    silent = Calibration(excess=_excess(plant, build, record))
    cost, rise = np.zeros((n, samples, len(plant.labels))), None
    for k, (_, verdict) in enumerate(readings(plant, build(silent), record.obs)):
        now = np.asarray(verdict.evidence.cost)
        flown = (k <= record.length) & np.isfinite(now).all(axis=1)
        cost[:, k] = np.where(flown[:, None], now, cost[:, max(k - 1, 0)])
        if verdict.evidence.rise is not None:
            rise = np.full((n, samples), -np.inf) if rise is None else rise
            rise[:, k] = np.where(flown, verdict.evidence.rise, -np.inf)
    thresholds, level = thresholds_from(plant, cost, rise, silent.persistence)
    return msgspec.structs.replace(silent, thresholds=thresholds, rise=level)


def fit(method: str, plant: Plant, process: str = "standard", **tuning: Any) -> tuple[Belief | None, Calibration | None]:
    """What a method may know of a plant and one of its fault processes, found anew from flights.

    Args:
        method: Name of a diagnoser, or "module:function".
        plant: The plant.
        process: The fault process that will be met.
        tuning: Keyword arguments of its builder.

    Returns:
        Belief and calibration; None for what its builder does not take.

    Raises:
        ValueError: Unknown method, process or keyword; `NotApplicableError` where the method cannot run on this plant.
    """
    entry = find_diagnoser(method)
    plant.process(process)
    settings = entry.resolve(plant, **tuning)
    belief = fit_belief(plant, process) if entry.takes("belief") else None
    return belief, fit_calibration(entry, plant, process, settings, belief) if entry.takes("calibration") else None

"""What a filter may believe of a plant before its first sample, from the plant's declaration and its fault process.

The data sheet declares the noises; a fault process declares how large the faults are, when they come, how far the truth
lies off the model and what the world does to it. Flights drawn from that process with validation seeds turn the latter
into numbers: the walk that follows its faults and disturbances, and the noise that stands for the model's errors.
Nothing of a test flight is used.
"""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.engine import Record, simulate
from fdi_gym.estimation.propagation import FaultInputs, fault_inputs
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Array, Plant

VALIDATION_SEED = 2_000_000
FLIGHTS = 32
FLOOR = 1e-5  # process noise of a state that has none, in units of its scale: covariances stay definite
START = 0.1  # initial standard deviation of a state, in units of its scale, on top of what the flights show


class Prior(NamedTuple):
    """Means and covariances; all standard deviations in the units of the data sheet, walks per step."""

    x0: Array  # (n_x,) initial state
    P0: Array  # (n_x, n_x)
    Q: Array  # (n_x, n_x) process noise, model errors included
    R: Array  # (m, m) noise of the sensors that have any, model errors included
    sensors: Array  # (m,) which those are
    inputs: FaultInputs  # where the fault vector z enters
    z_size: Array  # (p,) median size of a fault while it acts
    z_walk: Array  # (p,)
    m_mean: Array  # (modes,) magnitude of each fault mode along its line, while it acts
    m_std: Array  # (modes,)
    m_walk: Array  # (modes,) its walk, while it acts
    changes: float  # changes of the label per sample
    disturbances: Array  # (q,) the disturbances that occur and are not measured
    d0: Array  # (q,) their initial standard deviations
    d_walk: Array  # (q,)


def flights_of(plant: Plant, process: str, first: int, count: int, faults: bool) -> tuple[list[FaultScenario], Record]:
    """Flights of a process, with the validation seeds from VALIDATION_SEED + first on; healthy ones if asked."""
    scenarios = [draw(plant.process(process), VALIDATION_SEED + first + i) for i in range(count)]
    if not faults:
        scenarios = [scenario.without_faults() for scenario in scenarios]
    return scenarios, simulate(plant, scenarios)


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
    """Mean, standard deviation and walk of each mode's magnitude, over the samples where it acts (modes,)."""
    count = len(plant.modes)
    m = np.full((*z.shape[:2], count), np.nan)
    for index, label in enumerate(plant.labels):
        active = [i for i, mode in enumerate(plant.modes) if mode.name in label.modes]
        if active:
            mine = record.label == index
            offset = np.sum([plant.modes[i].offset for i in active], axis=0)
            D = np.transpose([plant.modes[i].direction for i in active])
            values = (z[mine] - offset) @ np.linalg.pinv(D).T
            for column, i in enumerate(active):
                m[mine, i] = values[:, column]
    mean, std, walk = np.zeros(count), np.zeros(count), np.zeros(count)
    for i, mode in enumerate(plant.modes):
        low, high = mode.reach
        values = np.clip(m[..., i][np.isfinite(m[..., i])], low, high)
        if values.size:
            mean[i], std[i] = values.mean(), values.std()
            steps = np.diff(m[..., i : i + 1], axis=1)
            acting = np.isfinite(steps[..., 0])
            walk[i] = np.sqrt(long_run(np.nan_to_num(steps), acting, block)[0, 0])
        else:  # too rare to have been drawn: uniform within its reach
            mean[i], std[i] = 0.5 * (low + high), (high - low) / 12**0.5
    return mean, std, walk


def _prior(plant: Plant, process: str) -> Prior:
    sensors = np.flatnonzero([s.sigma > 0 for s in plant.outputs])
    if not sensors.size:
        raise NotApplicableError(f"needs sensor noise; {plant.id} has none with {dict(plant.options)}")
    inputs = fault_inputs(plant)
    scale = np.array([s.scale for s in plant.states])
    scenarios, faulty = flights_of(plant, process, 0, FLIGHTS, True)
    healthy = [s.without_faults() for s in scenarios]
    record = simulate(plant, healthy)
    K = record.obs.shape[1] - 1
    block = max(1, K // 100)

    valid = np.arange(K) < record.length[:, None]
    dx, dy = _model_error(plant, healthy, record, valid)
    Q = plant.Q + long_run(dx, valid, block)
    Q[np.diag_indices_from(Q)] += np.where(np.diag(Q) > 0, 0.0, (FLOOR * scale) ** 2)
    R = (plant.R + long_run(dy, valid, block))[np.ix_(sensors, sensors)]
    P0 = np.diag((START * scale) ** 2 + ((record.state[:, 0] - plant.trim_state) ** 2).mean(axis=0))

    z = faulty.target - plant.estimate_target(plant.nominal_theta, plant.trim_command)
    z = np.where((faulty.label > 0)[..., None], z, 0.0)[..., inputs.estimated]
    seen = [np.abs(z[..., j][z[..., j] != 0]) for j in range(z.shape[-1])]
    size = np.array([
        np.median(v) if v.size else plant.estimated[i].scale for v, i in zip(seen, inputs.estimated, strict=True)
    ])  # fmt: skip
    flown = np.arange(K) < faulty.length[:, None]
    z_walk = np.sqrt(np.diag(long_run(np.diff(z, axis=1), flown, block)))
    z_walk = np.where(z_walk > 0, z_walk, 0.02 * size)

    mean, std, m_walk = _magnitudes(plant, z, faulty, block)
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
    return Prior(plant.trim_state, P0, Q, R, sensors, inputs, size, z_walk, mean, std, m_walk, changes, which, d0, d_walk)


_found: dict[str, Prior] = {}


def prior(plant: Plant, process: str = "standard") -> Prior:
    """What the declaration of a plant and of one of its fault processes say; computed once per session.

    A plant is what its id, version and options say: a copy with other fields has the same prior.

    Raises:
        NotApplicableError: No sensor has noise, or the fault vector does not enter additively.
        ValueError: Unknown process.
    """
    plant.process(process)
    key = json.dumps([plant.env_id, dict(plant.options), process], sort_keys=True)
    if key not in _found:
        _found[key] = _prior(plant, process)
    return _found[key]

"""Calibration on healthy flights: one rate of false alarms for every method, whatever its statistic.

Flights of the fault process that will be met are flown without their faults, with validation seeds, and shown to the
method. What it takes to keep quiet on all but a small share of them is its threshold. The truth may lie off the model
there as it will in the test, so a method that is too sure of itself is given the thresholds that this costs.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fdi_gym.diagnosis import Diagnoser
from fdi_gym.engine import Record
from fdi_gym.estimation.alarm import (
    LEAST,
    PERSISTENCE,
    Detector,
    FaultFilter,
    Persistence,
    Thresholds,
    decide,
    gain,
    penalties,
    watch,
)
from fdi_gym.estimation.prior import flights_of
from fdi_gym.kernels import cache_folder
from fdi_gym.plant import Array, Plant, plant_sources

RATE = 0.05  # share of the healthy flights with a false alarm
FIRST = 100_000  # calibration flights begin at VALIDATION_SEED + FIRST
SAMPLES = 100_000  # about so many samples are flown, in 20 to 60 flights


def _healthy_flights(plant: Plant, process: str) -> Record:
    steps = flights_of(plant, process, FIRST, 1, False)[0][0].steps
    return flights_of(plant, process, FIRST, int(np.clip(SAMPLES // steps, 20, 60)), False)[1]


def excess_covariance(plant: Plant, process: str, filter: FaultFilter) -> Array:
    """By how much the spread of a healthy estimate exceeds the filter's own covariance (p, p); zero if it does not."""
    record = _healthy_flights(plant, process)
    n, samples, _ = record.obs.shape
    s, own, found, count = filter.start(n), 0.0, 0.0, 0
    for k in range(samples):
        s = filter.step(s, record.obs[:, k])
        e = filter.read(s)
        flown = (k <= record.length) & np.isfinite(e.z).all(axis=1)
        z = e.z[flown]
        own, found, count = own + e.P[flown].sum(axis=0), found + z.T @ z, count + len(z)
    values, vectors = np.linalg.eigh((found - own) / max(count, 1))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def held(values: Array, after: int) -> Array:
    """The largest level that a statistic (N, K) stays above for `after` consecutive samples, per flight (N,)."""
    lowest = np.lib.stride_tricks.sliding_window_view(values, after, axis=1).min(axis=2)
    return lowest.max(axis=1)


def thresholds_of(
    plant: Plant, process: str, detector: Detector, persistence: Persistence = PERSISTENCE, rate: float = RATE
) -> Thresholds:
    """The thresholds that a share `rate` of the healthy flights of a process reaches, to four digits.

    Each mode's is what it reaches alone; one factor on them all brings the share of flights with any alarm to `rate`.
    """
    record = _healthy_flights(plant, process)
    n, samples, _ = record.obs.shape
    cost, rise = np.zeros((n, samples, len(plant.labels))), None
    s = detector.start(n)
    for k in range(samples):
        s, e = detector.step(s, record.obs[:, k])
        flown = (k <= record.length) & np.isfinite(e.cost).all(axis=1)
        cost[:, k] = np.where(flown[:, None], e.cost, cost[:, max(k - 1, 0)])
        if e.rise is not None:
            rise = np.full((n, samples), -np.inf) if rise is None else rise
            rise[:, k] = np.where(flown, e.rise, -np.inf)

    def reached(statistic: Array, least: float) -> float:
        return max(float(np.quantile(held(statistic, persistence.rise), 1 - rate, method="higher")), least)

    alone = {next(iter(label.modes)): i for i, label in enumerate(plant.labels) if len(label.modes) == 1}
    modes = [
        reached(cost[..., 0] - cost[..., alone[m.name]], LEAST) if m.name in alone else LEAST for m in plant.modes
    ]  # fmt: skip
    share = reached(gain(cost, penalties(plant, Thresholds(tuple(modes)))), 0.5)
    return Thresholds(
        tuple(float(f"{share * level:.4g}") for level in modes),
        None if rise is None else float(f"{reached(rise, 1e-3):.4g}"),
    )


_kept: dict[str, Any] = {}


def _source_of(plant: Plant) -> str:
    """Digest of the file that declares the plant; nothing for one that was never registered."""
    source = plant_sources().get(plant.id)
    file = importlib.import_module(source.builder.split(":")[0]).__file__ if source else None
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16] if file else ""


def once(plant: Plant, process: str, source: str, what: str, compute: Callable[[], Any]) -> Any:
    """The result of a calibration: kept in memory and on disk, where an edit of any source that it came from shows.

    Args:
        plant, process: What it was calibrated on.
        source: The method's file.
        what: Everything else that it depends on: the method's name and tuning.
        compute: Gives the result, JSON data.
    """
    key = json.dumps([plant.env_id, _source_of(plant), dict(plant.options), process, source, what], sort_keys=True)
    if key not in _kept:
        folder = cache_folder(source)
        path = folder / f"calibration-{hashlib.sha256(key.encode()).hexdigest()[:24]}.json" if folder else None
        if path is not None and path.is_file():
            _kept[key] = json.loads(path.read_bytes())
        else:
            _kept[key] = compute()
            if path is not None:
                part = path.with_name(f"{path.name}.{os.getpid()}.part")
                part.write_bytes(msgspec.json.encode(_kept[key]))
                part.replace(path)
    return _kept[key]


def calibrated(plant: Plant, detector: Detector, *, process: str, source: str, what: str) -> Diagnoser:
    """The diagnoser of a detector at its calibrated thresholds; the calibration is flown when it is first used.

    Args:
        plant: The plant.
        detector: The detector.
        process: The fault process that will be met.
        source: The method's file.
        what: Its name and tuning.

    Raises:
        ValueError: Unknown process.
    """
    plant.process(process)

    @functools.cache
    def thresholds() -> Thresholds:
        found = once(plant, process, source, what, lambda: thresholds_of(plant, process, detector)._asdict())
        return Thresholds(tuple(found["modes"]), found["rise"])

    return decide(plant, detector, thresholds)


def calibrated_filter(
    plant: Plant, filter: FaultFilter, decision: str, size: Array, *, process: str, source: str, what: str
) -> Diagnoser:
    """The diagnoser of a filter of the fault vector, with a decision logic at its calibrated thresholds.

    Args:
        plant: The plant.
        filter: The filter.
        decision, size: As in `fdi_gym.estimation.alarm.watch`.
        process, source, what: As in `calibrated`.

    Raises:
        ValueError: Unknown process or decision.
    """
    p = len(plant.estimated)

    @functools.cache
    def excess() -> Array:
        found = once(plant, process, source, f"{what}: excess", lambda: excess_covariance(plant, process, filter).tolist())
        return np.array(found).reshape(p, p)

    detector = watch(plant, filter, decision, size, excess)
    return calibrated(plant, detector, process=process, source=source, what=f"{what} {decision}")

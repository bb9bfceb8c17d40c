"""Calibrations: plain data that says at what evidence a method alarms; and how they are found from recorded evidence.

One rate of false alarms for every method, whatever its statistic: what it takes to keep quiet on all but a small share of
healthy flights is its threshold. The truth may lie off the model there as it will in the test, so a method that is too
sure of itself is given the thresholds that this costs. `fdi_gym.diagnosis.fitting` flies those flights.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from scipy.special import chdtri

from fdi_gym.plant import Array, FaultMode, Plant

LEAST = 3.84  # the 95 % point of one degree of freedom
RATE = 0.05  # share of the healthy flights with a false alarm


def least(mode: FaultMode) -> float:
    """What a threshold of a mode is never below: the 95 % point of as many degrees of freedom as it has magnitudes."""
    return round(float(chdtri(len(mode.directions), 0.05)), 2)


class Persistence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Consecutive samples until an alarm is raised, its label changes, and it is given up.

    `warmup` samples at first neither decide nor count. With `same` the samples must agree on the label too.

    Raises:
        ValueError: A length below 1.
    """

    rise: int = 3
    switch: int = 5
    release: int = 10
    warmup: int = -1
    same: bool = False

    def __post_init__(self) -> None:
        if min(self.rise, self.switch, self.release) < 1:
            raise ValueError(f"rise, switch and release are at least one sample, not {self}")


class Calibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a method alarms.

    Args:
        thresholds: By how much a fault of each mode must fit better than health, by its name. An alarm is given up where
            the best label has less than half of its threshold left.
        rise: Threshold of a statistic that raises the alarm in place of these; None raises none.
        excess: By how much the covariance of a healthy estimate is too small (p, p).
        channels: Thresholds of the smoothed entries of the fault vector, by name.
        persistence: Samples in a row.
    """

    thresholds: Mapping[str, float] = {}
    rise: float | None = None
    excess: np.ndarray | None = None
    channels: Mapping[str, float] = {}
    persistence: Persistence = Persistence()

    def penalties(self, plant: Plant) -> Array:
        """What each label must gain (labels,): the thresholds of its modes; without bound where there is none.

        Raises:
            ValueError: Thresholds of modes that the plant does not have.
        """
        names = {mode.name for mode in plant.modes}
        if unknown := sorted(set(self.thresholds) - names):
            raise ValueError(f"a calibration of another plant: {plant.id} has no modes {unknown}")
        return np.array([sum(self.thresholds.get(name, np.inf) for name in label.modes) for label in plant.labels])


def uniform(plant: Plant, threshold: float, persistence: Persistence) -> Calibration:
    """One threshold for every mode: that of a paper."""
    return Calibration(thresholds={mode.name: threshold for mode in plant.modes}, persistence=persistence)


def gain(cost: Array, penalty: Array) -> Array:
    """The gain in fit over healthy of the best faulty label, as a share of what it must be (..., from (..., labels))."""
    with np.errstate(invalid="ignore"):  # an infinite cost, of a label that cannot be
        return ((cost[..., :1] - cost[..., 1:]) / penalty[1:]).max(axis=-1)


def sustained(values: Array, after: int) -> Array:
    """The largest level that a statistic (N, K) stays above for `after` consecutive samples, per flight (N,)."""
    lowest = np.lib.stride_tricks.sliding_window_view(values, after, axis=1).min(axis=2)
    return lowest.max(axis=1)


def _reached(statistic: Array, after: int, least: float) -> float:
    return max(float(np.quantile(sustained(statistic, after), 1 - RATE, method="higher")), least)


def thresholds_from(
    plant: Plant, cost: Array, rise: Array | None, persistence: Persistence
) -> tuple[dict[str, float], float | None]:
    """Thresholds that a share RATE of healthy flights reaches, to four digits: of the modes, and of the rising statistic.

    Each mode's is what it reaches alone; one factor on them all brings the share of flights with any alarm to RATE.

    Args:
        plant: The plant.
        cost: (N, K, labels) of healthy flights.
        rise: (N, K), or None.
        persistence: Samples in a row that raise the alarm.
    """
    alone = {next(iter(label.modes)): i for i, label in enumerate(plant.labels) if len(label.modes) == 1}
    after = persistence.rise
    levels = {
        m.name: _reached(cost[..., 0] - cost[..., alone[m.name]], after, least(m)) if m.name in alone else least(m)
        for m in plant.modes
    }
    share = _reached(gain(cost, Calibration(thresholds=levels).penalties(plant)), after, 0.5)
    found = {name: float(f"{share * level:.4g}") for name, level in levels.items()}
    return found, None if rise is None else float(f"{_reached(rise, after, 1e-3):.4g}")

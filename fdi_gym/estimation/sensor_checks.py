"""What a failing sensor shows that is no line in the estimated space: it repeats itself, or its noise has grown.

A reading of a noisy sensor never comes twice, so each repetition counts. The noise is seen in the differences of successive
innovations, which a bias or a fault of the plant leaves small: the mean square of so many of them, in units of what the
filter expects, is a likelihood ratio of a larger variance. Both are gains in fit of the sensor's label over healthy, on the
scale of -2 log likelihood, and thresholds are found for them as for any other evidence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.belief import noisy_sensors
from fdi_gym.plant import Array, Plant
from fdi_gym.sensors import sensor_mode

MEMORY = 30  # samples of the mean square
REPEATED = 20.0  # gain of a reading that comes again
MOST = 1e4  # gain; nothing is more certain


class Checks(NamedTuple):
    """What is kept of each noisy sensor (n, m)."""

    y: Array  # its last reading; NaN before the first
    repeats: Array  # how often that has come in a row
    nu: Array  # its last innovation; NaN before the first
    square: Array  # weighted mean square of the differences; 1 is what is expected


class SensorChecks:
    """The checks of a plant whose sensors may fail.

    Args:
        plant: The plant.

    Raises:
        NotApplicableError: No sensor has noise.
    """

    def __init__(self, plant: Plant):
        self.sensors = noisy_sensors(plant)
        said = [plant.outputs[i] for i in self.sensors]
        self._ends = np.array([[s.low for s in said], [s.high for s in said]])
        self._labels = np.array([plant.label_of(frozenset({sensor_mode(s.name)})) for s in said])
        self._count = len(plant.labels)

    def start(self, n: int) -> Checks:
        """Before the first sample of n episodes."""
        m = len(self.sensors)
        return Checks(np.full((n, m), np.nan), np.zeros((n, m)), np.full((n, m), np.nan), np.ones((n, m)))

    def update(self, s: Checks, y: Array, seen: Array, innovation: Array | None, S: Array | None) -> Checks:
        """After a sample: y and seen (n, n_y), and the filter's innovation with its covariance, where it has one."""
        y, seen = y[:, self.sensors], seen[:, self.sensors]
        inside = (y > self._ends[0]) & (y < self._ends[1])
        repeats = np.where(seen, np.where((y == s.y) & inside, s.repeats + 1.0, 0.0), s.repeats)
        nu, square = s.nu, s.square
        if innovation is not None and S is not None and innovation.shape == y.shape:
            variance = np.einsum("nmm->nm", S)
            with np.errstate(invalid="ignore", divide="ignore"):
                change = (innovation - s.nu) ** 2 / (2.0 * variance)
            use = seen & np.isfinite(change)
            square = np.where(use, square + (np.minimum(change, MOST) - square) / MEMORY, square)
            nu = np.where(seen, innovation, s.nu)
        return Checks(np.where(seen, y, s.y), repeats, nu, square)

    def gain(self, s: Checks) -> Array:
        """By how much each label fits better than healthy (n, labels)."""
        square = np.maximum(s.square, 1.0)
        return self._by_label(np.maximum(MEMORY * (square - 1.0 - np.log(square)), REPEATED * s.repeats))

    def repeated(self, s: Checks) -> Array:
        """The part of it that comes of readings that repeat themselves (n, labels)."""
        return self._by_label(REPEATED * s.repeats)

    def _by_label(self, gain: Array) -> Array:
        found = np.zeros((len(gain), self._count))
        found[:, self._labels] = np.minimum(gain, MOST)
        return found

"""Measurements that mean the same: a quaternion and its negative, an angle and itself a turn later.

A plant declares which of its outputs are such (`Plant.quaternions`, `Signal.period`). A sensor may report either at any
sample; a filter gets the one nearest its prediction. Where neither a quaternion nor its negative is clearly nearer, it is
the one with the expected sign.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.plant import Array, Plant

CLEAR = 4.0  # ratio of squared distances: noise about zero turns no sign, nor does a prior that says little


def has_equivalents(plant: Plant) -> bool:
    """Whether any of its outputs is known up to a sign or whole turns only."""
    return bool(plant.quaternions) or bool(plant.periods.any())


def nearest(plant: Plant, y: Array, seen: Array, expected: Array) -> Array:
    """The equivalent of a measurement that is nearest what is expected.

    Args:
        plant: The plant that declares its equivalents.
        y: Measurement (n, n_y), any number where a sensor did not report.
        seen: Which sensors reported (n, n_y) bool.
        expected: What they are expected to read (n, n_y); NaN where nothing is: then it is as reported.
    """
    found = y
    if plant.periods.any():
        periods = np.where(plant.periods > 0.0, plant.periods, np.inf)
        turns = np.round((y - expected) / periods)
        turns = np.where(seen & np.isfinite(turns), turns, 0.0)
        if turns.any():
            found = np.where(turns != 0.0, y - np.where(np.isfinite(periods), periods, 0.0) * turns, y)
    for quaternion in plant.quaternions:
        vector, sign = list(quaternion[:3]), quaternion[3]
        parts = [*vector, sign]
        p, there = np.nan_to_num(expected[:, parts]), seen[:, parts] & np.isfinite(expected[:, parts])
        q = y[:, parts]
        opposite = there[:, 3] & (q[:, 3] * p[:, 3] < 0.0)
        p[:, 3] *= _scalar(p[:, :3])
        q[:, 3] *= np.where(there[:, :3].all(axis=1), _scalar(q[:, :3]), np.abs(p[:, 3]))
        same, other = (np.where(there, (q - e) ** 2, 0.0).sum(axis=1) for e in (p, -p))
        clear = CLEAR * np.minimum(same, other) < np.maximum(same, other)
        turned = np.where(clear, other < same, opposite)
        if turned.any():
            found = found.copy()
            found[:, parts] *= np.where(turned, -1.0, 1.0)[:, None]
    return found


def _scalar(v: Array) -> Array:
    """Magnitude (n,) of a unit quaternion's scalar part, from its vector part (n, 3)."""
    return np.sqrt(np.maximum(0.0, 1.0 - (v**2).sum(axis=1)))

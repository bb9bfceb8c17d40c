"""Measurements that mean the same: a quaternion and its negative, an angle and itself a turn later.

A plant declares which of its outputs are such (`Plant.quaternions`, `Signal.period`). A sensor may report either at any
sample; a filter gets the one nearest its prediction. Where neither a quaternion nor its negative is clearly nearer, it is
the one with the expected sign.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, int64, void

from fdi_gym.kernels import M, bools, compiled, floats, helper
from fdi_gym.model import contiguous
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
        if found is y:
            found = y.copy()
        _turn(np.array(quaternion), contiguous(y), np.ascontiguousarray(seen), contiguous(expected), found)
    return found


@helper
def _scalar(v):
    """Magnitude of a unit quaternion's scalar part, from its vector part (3,)."""
    return np.sqrt(max(0.0, 1.0 - (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])))


@compiled(void(int64[::1], M, boolean[:, ::1], M, M))
def _turn(parts, y, seen, expected, found):
    """Turn the outputs `parts` (4,), vector and sign, of found (n, n_y) where the negative quaternion is what is meant."""
    p, q, there = floats(4), floats(4), bools(4)
    for e in range(len(y)):
        for i in range(4):
            q[i], p[i] = y[e, parts[i]], expected[e, parts[i]]
            there[i] = seen[e, parts[i]] and np.isfinite(p[i])
            if not np.isfinite(p[i]):
                p[i] = 0.0
        opposite = there[3] and q[3] * p[3] < 0.0
        p[3] *= _scalar(p)
        q[3] *= _scalar(q) if there[0] and there[1] and there[2] else abs(p[3])
        same = other = 0.0
        for i in range(4):
            if there[i]:
                same += (q[i] - p[i]) ** 2
                other += (q[i] + p[i]) ** 2
        clear = CLEAR * min(same, other) < max(same, other)
        if other < same if clear else opposite:
            for i in range(4):
                found[e, parts[i]] = -found[e, parts[i]]

"""From estimates of effectiveness to a diagnosis: a unit is faulty where it has lost more than a threshold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fdi_gym.diagnosis import Diagnosis
from fdi_gym.plant import Array, Plant

F_MIN, F_MAX = -1.0, 2.0  # estimates are kept in this range
P_THETA, Q_THETA = 1e-4, 1e-10  # variance of a healthy unit's effectiveness at the start, and what it gains per step
THRESHOLD = 0.05  # a unit that has lost more is called faulty


def threshold_rule(plant: Plant, threshold: float) -> Callable[[Array, Array, Array], Diagnosis]:
    """The rule (f (n, units), P (n, units, units), flag (n,)) -> Diagnosis: unit i is faulty where 1 - f_i > threshold.

    The alarm is up where the label says so, and before it does where the filter's own fault flag is.
    """
    units = len(plant.theta)
    modes = [mode.name for mode in plant.modes]
    label_of = np.array([
        plant.label_of(frozenset(modes[i] for i in range(units) if number >> i & 1)) for number in range(2**units)
    ])  # fmt: skip
    bits = 2 ** np.arange(units)

    def decide(f: Array, P: Array, flag: Array) -> Diagnosis:
        label = label_of[(1.0 - f > threshold) @ bits]
        return Diagnosis((label > 0) | flag, label, f, np.sqrt(np.maximum(np.einsum("nii->ni", P), 0.0)))

    return decide

"""From estimates of effectiveness to a decision: a unit is faulty where it has lost more than a threshold."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_gym.estimation.decision import Reading, Rule, Verdict, by_candidate
from fdi_gym.plant import Array, Plant

F_MIN, F_MAX = -1.0, 2.0  # estimates are kept in this range
P_THETA, Q_THETA = 1e-4, 1e-10  # variance of a healthy unit's effectiveness at the start, and what it gains per step
THRESHOLD = 0.05  # a unit that has lost more is called faulty


def threshold_rule(plant: Plant, threshold: float) -> Rule:
    """Unit i is faulty where 1 - f_i > threshold, at once.

    The alarm is up where the label says so, and before it does where the filter's own signal "flag" is.
    """
    units = len(plant.theta)
    modes = [mode.name for mode in plant.modes]
    label_of = np.array([
        plant.label_of(frozenset(modes[i] for i in range(units) if number >> i & 1)) for number in range(2**units)
    ])  # fmt: skip
    bits = 2 ** np.arange(units)

    def lost(r: Reading, label: Array) -> Array:
        assert r.z is not None
        return label_of[(-r.z > threshold) @ bits]

    by_loss = by_candidate(lost, after=1)

    def step(s: Any, k: Array, r: Reading, informed: Array) -> tuple[Any, Verdict]:
        assert r.signals is not None
        s, said = by_loss.step(s, k, r, informed)
        return s, said._replace(alarm=said.alarm | r.signals["flag"])

    return Rule(by_loss.start, step)

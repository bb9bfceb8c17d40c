"""Windowed NIS detector: is the innovation of the fault-free filter as large as it should be?

The normalised innovation squared (NIS) of the steady Kalman filter is chi-square distributed while the plant is
healthy; its sum over a window is tested against a quantile. It detects; it cannot isolate.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import gammaincinv

from baselines.filters import kalman_filter
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.calibration import Persistence
from fdi_gym.estimation.decision import Reading, Rule, Verdict, declare, undeclared
from fdi_gym.plant import Array, Plant


def chi_square_quantile(confidence: float, freedoms: int) -> float:
    """The quantile of the chi-square distribution."""
    return 2.0 * float(gammaincinv(0.5 * freedoms, confidence))


def window_rule(window: int, limit: float, alarm_after: int) -> Rule:
    """The sum of the last `window` NIS values against a limit; a sensor that is missing counts with its expectation."""
    after = Persistence(alarm_after, 1, 1)

    def start(n: int) -> Any:
        return np.zeros((n, window)), np.zeros(n, np.int64), undeclared(n)

    def step(state: Any, k: Array, r: Reading, informed: Array) -> tuple[Any, Verdict]:
        nis, count, declared = state
        assert r.cost is not None
        now = r.cost[:, 0]
        rows = np.flatnonzero(informed)
        nis = nis.copy()
        nis[rows, count[rows] % window] = now[rows]
        count = count + informed
        exceeds = (nis.sum(axis=1) > limit) & (count >= window)
        declared = declare(declared, np.ones(len(now), np.int64), exceeds, ~exceeds, after, informed)
        return (nis, count, declared), Verdict(declared.label > 0, np.zeros(len(now), np.int64))

    return Rule(start, step)


@diagnoser("windowed_nis", "Windowed chi-square test on the innovations: detection only")
def windowed_nis(plant: Plant, *, window: int = 50, confidence: float = 0.9999, alarm_after: int = 5) -> Diagnoser:
    """The detector.

    Args:
        plant: A linear plant.
        window: Samples in the sum.
        confidence: Of the chi-square quantile for one window.
        alarm_after: Consecutive exceedances that raise the alarm; it falls at the first sample without one.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    f = kalman_filter.nominal_filter(plant)
    m = len(f.R)
    limit = chi_square_quantile(confidence, window * m)

    def start(n: int) -> tuple[kalman_filter.Healthy, Array]:
        return kalman_filter.start(f, plant, n), np.zeros(n)

    def update(state: Any, at: Any, y: Array, seen: Array) -> Any:
        s = kalman_filter.correct(f, state[0], y, seen)
        nis = (s.nu[:, None, :] @ s.W @ s.nu[:, :, None])[:, 0, 0]
        return s, nis + (~seen).sum(axis=1)

    def read(state: Any) -> Reading:
        s, nis = state
        shown = {"NIS": nis, "limit of the mean": np.full(len(nis), limit / window)}
        return Reading(x=s.x, Px=s.P, nu=s.nu, cost=nis[:, None], signals=shown)

    filter = Filter(start, lambda s, at: (kalman_filter.predict(f, s[0], at), s[1]), update, read, first_sample=False)
    return diagnoser_of(plant, filter, window_rule(window, limit, alarm_after))

"""Windowed NIS detector: is the innovation of the fault-free filter as large as it should be?

The normalised innovation squared (NIS) of the steady Kalman filter is chi-square distributed while the plant is
healthy; its sum over a window is tested against a quantile. It detects; it cannot isolate.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from scipy.special import chdtri

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.kalman import times
from fdi_gym.estimation.linear import LinearModel, linear_model
from fdi_gym.plant import Array, Plant


class SteadyFilter(NamedTuple):
    """The fault-free Kalman filter in its steady state."""

    model: LinearModel
    K: Array  # gain (n_x, n_y)
    S: Array  # innovation covariance (n_y, n_y)
    W: Array  # its inverse

    def step(self, x: Array, u: Array, y: Array) -> tuple[Array, Array]:
        """(next estimate, innovation) from the estimate x_k (n, n_x), u_k (n, n_u), y_{k+1} (n, n_y)."""
        predicted = times(self.model.A, x) + times(self.model.B, u)
        nu = y - times(self.model.C, predicted)
        return predicted + times(self.K, nu), nu


def steady_filter(plant: Plant) -> SteadyFilter:
    """The steady filter of a linear plant, from the discrete algebraic Riccati equation.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    model = linear_model(plant)
    P = scipy.linalg.solve_discrete_are(model.A.T, model.C.T, plant.Q, plant.R)
    S = model.C @ P @ model.C.T + plant.R
    return SteadyFilter(model, np.linalg.solve(S, model.C @ P).T, S, np.linalg.inv(S))


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
    nominal = steady_filter(plant)
    limit = chdtri(window * len(plant.outputs), 1 - confidence)  # chi-square quantile
    trim = plant.trim_state

    def init(n: int) -> Any:
        return 0, np.tile(trim, (n, 1)), np.zeros((n, window)), np.zeros(n, np.int64)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, x, nis, over = state
        n = len(obs)
        if k > 0:
            y, u, _ = plant.split(obs)
            x, nu = nominal.step(x, u, y)
            nis = nis.copy()
            nis[:, k % window] = (nu[:, None, :] @ nominal.W @ nu[:, :, None])[:, 0, 0]
            exceeds = (nis.sum(axis=1) > limit) & (k >= window)
            over = np.where(exceeds, over + 1, 0)
        shown = {"windowed NIS": nis.sum(axis=1), "limit": np.full(n, limit)}
        return (k + 1, x, nis, over), Diagnosis(over >= alarm_after, np.zeros(n, np.int64), signals=shown)

    return Diagnoser(init, update)

"""Augmented-state central-difference Kalman filter (ASCDKF): state, fault and disturbance in one vector.

The reference that the three-stage filters decouple. Fault and disturbance are random walks; sigma points are spread
over the whole augmented vector. M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from baselines.filters.flag_thresholds import thresholds_for
from baselines.filters.three_stage_cdkf import X0_STD, initial_covariance
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.flags import with_flags
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.propagation import (
    central_difference_moments,
    central_difference_points,
    fault_inputs,
    linear_output,
)
from fdi_gym.plant import Array, Plant


class Augmented(NamedTuple):
    """State of the filter: xa = [x; b; d] and its covariance."""

    x: Array  # (n, N)
    P: Array  # (n, N, N)


@diagnoser("ascdkf", "Augmented central-difference Kalman filter (ASCDKF)")
def ascdkf(
    plant: Plant,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] = X0_STD,
    b0_std: float = 2e-3,
    d0_std: float = 0.5,
    b_step: float = 7e-4,
    d_step: float = 0.05,
    alpha: float = 0.2,
    thresholds: Sequence[float] | None = None,
    h: float = 3**0.5,
) -> Diagnoser:
    """The augmented filter with the flag logic.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        b0_std, d0_std: Of the initial fault [rad] and disturbance [m/s].
        b_step, d_step: Standard deviations of their random walks per step.
        alpha: Smoothing of the flag logic.
        thresholds: Of the flag logic, one per channel [rad]. Default: the calibrated table.
        h: Interval of the central differences, in standard deviations.

    Raises:
        NotApplicableError: The plant is not of that kind, or no thresholds are known for this configuration.
    """
    inputs, H = fault_inputs(plant, channels), linear_output(plant)
    n_x, p, q = len(plant.states), len(inputs.names), len(plant.disturbances)
    N = n_x + p + q
    P0x = initial_covariance(plant, x0_std)
    P0 = np.asarray(scipy.linalg.block_diag(P0x, b0_std**2 * np.eye(p), d0_std**2 * np.eye(q)))
    Qa = scipy.linalg.block_diag(plant.Q, b_step**2 * np.eye(p), d_step**2 * np.eye(q))
    fault, dist = slice(n_x, n_x + p), slice(n_x + p, N)
    x0 = np.concatenate([plant.trim_state, np.zeros(p + q)])

    def first(n: int) -> Augmented:
        return Augmented(np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)))

    def advance(s: Augmented, t: float, u: Array, y: Array) -> Augmented:
        points = central_difference_points(s.x, np.linalg.cholesky(s.P), h)
        theta = np.tile(plant.nominal_theta, (*points.shape[:2], 1))
        theta[..., inputs.entries] += points[..., fault]
        points[..., :n_x] = plant.propagate(t, points[..., :n_x], u, theta, points[..., dist] if q else None)
        x, Pf, _ = central_difference_moments(points, h)
        P = Pf + Qa
        PHt = P[..., :n_x] @ H.T
        C = H @ PHt[:, :n_x] + plant.R
        K = right_divide(PHt, C)
        return Augmented(x + times(K, y - times(H, x[:, :n_x])), symmetric(P - K @ T(PHt)))

    def read(s: Augmented) -> tuple[Array, Array]:
        return s.x[:, fault], s.P[:, fault, fault]

    J = thresholds_for(plant, "ascdkf", inputs, thresholds)
    return with_flags(plant, inputs, first, advance, read, alpha=alpha, thresholds=J)

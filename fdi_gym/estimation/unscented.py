"""The unscented transform on stacks of episodes: x (n, n_x), P (n, n_x, n_x), points (n, 2 n_x + 1, n_x).

Points x, x +- sqrt(n_x + lambda) times the columns of the lower Cholesky factor of P; the weights of mean and
covariance are the same (beta = 0): lambda / (n_x + lambda) at the centre, 1 / (2 (n_x + lambda)) elsewhere [1]. With
alpha = 1, lambda is the kappa of [1].

[1] S. J. Julier, J. K. Uhlmann, Proceedings of the IEEE 92(3), 2004.
"""

from __future__ import annotations

import functools

import numpy as np

from fdi_gym.estimation.kalman import T
from fdi_gym.plant import Array

JITTER, RETRIES = 1e-14, 7  # added to the diagonal where the factorisation fails, times 100 at each retry


def cholesky(P: Array) -> Array:
    """Lower factors (n, n_x, n_x). Jitter only where it fails without; NaN, a lost filter, where no jitter helps."""
    try:
        return np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        L = np.full_like(P, np.nan)
        for i, Pi in enumerate(P):  # rare: one covariance of the batch has lost its definiteness
            for jitter in (0.0, *(JITTER * 100.0**j for j in range(RETRIES))):
                try:
                    L[i] = np.linalg.cholesky(Pi + jitter * np.eye(len(Pi)))
                    break
                except np.linalg.LinAlgError:
                    continue
        return L


@functools.cache
def weights(n_x: int, spread: float = 2.0) -> Array:
    """Weights of the 2 n_x + 1 points, for lambda = spread."""
    w = np.full(2 * n_x + 1, 0.5 / (n_x + spread))
    w[0] = spread / (n_x + spread)
    return w


def sigma_points(x: Array, P: Array, spread: float = 2.0) -> Array:
    """The points (n, 2 n_x + 1, n_x), the centre first."""
    n, n_x = x.shape
    offsets = T(cholesky(P))
    offsets = np.sqrt(n_x + spread) * offsets
    points = np.empty((n, 2 * n_x + 1, n_x))
    points[:, 0] = x
    np.add(x[:, None], offsets, out=points[:, 1 : n_x + 1])
    np.subtract(x[:, None], offsets, out=points[:, n_x + 1 :])
    return points


def mean_and_deviations(points: Array, w: Array) -> tuple[Array, Array]:
    """Weighted mean (n, m) of points (n, p, m), and the points less it."""
    mean = w @ points
    return mean, points - mean[:, None]


def covariance(a: Array, b: Array, w: Array) -> Array:
    """Weighted covariance (n, m_a, m_b) of deviations a (n, p, m_a) and b (n, p, m_b)."""
    return T(a) @ (w[:, None] * b)

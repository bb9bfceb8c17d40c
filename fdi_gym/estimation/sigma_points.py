"""Points that stand for a Gaussian, on stacks of episodes: x (n, N), P (n, N, N), points (n, 2 N + 1, N).

Unscented points x, x +- sqrt(N + lambda) times the columns of the lower Cholesky factor of P; the weights of mean and
covariance are the same (beta = 0): lambda / (N + lambda) at the centre, 1 / (2 (N + lambda)) elsewhere [1]. With
alpha = 1, lambda is the kappa of [1]. Central differences (Stirling's interpolation) take x, x +- h s_i and give a mean, a
spread and a slope [2]; h^2 = 3 is the kurtosis of a Gaussian.

[1] S. J. Julier, J. K. Uhlmann, Proceedings of the IEEE 92(3), 2004.
[2] M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000.
"""

from __future__ import annotations

import functools

import numpy as np

from fdi_gym.estimation.kalman import T
from fdi_gym.plant import Array

JITTER, RETRIES = 1e-14, 7  # added to the diagonal where the factorisation fails, times 100 at each retry
INTERVAL = 3**0.5  # h of the central differences


def cholesky(P: Array) -> Array:
    """Lower factors (n, N, N). Jitter only where it fails without; NaN, a lost filter, where no jitter helps."""
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


def spread(x: Array, S: Array, width: float) -> Array:
    """x, x + width s_i, x - width s_i for the columns s_i of S: (n, 2 N + 1, N)."""
    offsets = width * T(S)
    return np.concatenate([x[:, None], x[:, None] + offsets, x[:, None] - offsets], axis=1)


@functools.cache
def weights(N: int, lambda_: float = 2.0) -> Array:
    """Weights of the 2 N + 1 unscented points."""
    w = np.full(2 * N + 1, 0.5 / (N + lambda_))
    w[0] = lambda_ / (N + lambda_)
    return w


def unscented_points(x: Array, P: Array, lambda_: float = 2.0) -> Array:
    """The points (n, 2 N + 1, N), the centre first."""
    return spread(x, cholesky(P), np.sqrt(x.shape[1] + lambda_))


def mean_and_deviations(points: Array, w: Array) -> tuple[Array, Array]:
    """Weighted mean (n, m) of points (n, p, m), and the points less it."""
    mean = w @ points
    return mean, points - mean[:, None]


def covariance(a: Array, b: Array, w: Array) -> Array:
    """Weighted covariance (n, m_a, m_b) of deviations a (n, p, m_a) and b (n, p, m_b)."""
    return T(a) @ (w[:, None] * b)


def central_difference_moments(F: Array, h: float) -> tuple[Array, Array, Array]:
    """Mean (n, m), covariance D1 D1' + D2 D2' and slope D1 (n, m, N) from the images F (n, 2 N + 1, m) of `spread`."""
    N = F.shape[1] // 2
    centre, plus, minus = F[:, :1], F[:, 1 : N + 1], F[:, N + 1 :]
    both = plus + minus
    mean = (h**2 - N) / h**2 * centre[:, 0] + both.sum(axis=1) / (2 * h**2)
    D1 = T(plus - minus) / (2 * h)
    D2 = T(both - 2 * centre) * (np.sqrt(h**2 - 1) / (2 * h**2))
    return mean, D1 @ T(D1) + D2 @ T(D2), D1

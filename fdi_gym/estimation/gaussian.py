"""How a Gaussian passes through a function, and the Kalman filter that is made of it.

Three rules, extended, unscented and central-difference: mean of g(X), covariance of g(X), covariance of X with g(X). The
rest is the Kalman filter: predict through f and add Q, measure through h and add R, correct. On a linear plant the three
give the Kalman filter's numbers.

A. H. Jazwinski, Stochastic Processes and Filtering Theory, 1970 (extended); S. J. Julier, J. K. Uhlmann, Proceedings of
the IEEE 92(3), 2004 (unscented); M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000 (central differences).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.kalman import T
from fdi_gym.estimation.sigma_points import (
    INTERVAL,
    central_difference_moments,
    cholesky,
    covariance,
    mean_and_deviations,
    spread,
    unscented_points,
    weights,
)
from fdi_gym.plant import Array

Function = Callable[[Array], Array]  # points (n, M, N) to their images (n, M, m)


class Passed(NamedTuple):
    """A Gaussian that has passed through a function."""

    mean: Array  # (n, m)
    P: Array  # (n, m, m)
    cross: Array  # (n, N, m) with what went in


Rule = Callable[[Function, Array, Array, Array], Passed]  # (g, X (n, N), P (n, N, N), step (N,) of differences)


def jacobian(g: Function, X: Array, step: Array) -> tuple[Array, Array]:
    """g at X (n, N), and its Jacobian (n, m, N) by central differences with a step (N,) per entry."""
    N = X.shape[1]
    points = np.repeat(X[:, None], 2 * N + 1, axis=1)
    points[:, 1 : N + 1] += np.diag(step)
    points[:, N + 1 :] -= np.diag(step)
    F = g(points)
    return F[:, 0], T((F[:, 1 : N + 1] - F[:, N + 1 :]) / (2 * step[:, None]))


def extended(g: Function, X: Array, P: Array, step: Array) -> Passed:
    """The mean goes through the function, the spread through its Jacobian."""
    mean, J = jacobian(g, X, step)
    cross = P @ T(J)
    return Passed(mean, J @ cross, cross)


def unscented(g: Function, X: Array, P: Array, step: Array) -> Passed:
    """2 N + 1 sigma points, lambda = 2, the same weights for mean and covariance."""
    points, w = unscented_points(X, P), weights(X.shape[1])
    mean, out = mean_and_deviations(g(points), w)
    return Passed(mean, covariance(out, out, w), covariance(points - X[:, None], out, w))


def central_difference(g: Function, X: Array, P: Array, step: Array) -> Passed:
    """Second-order Stirling interpolation with the interval sqrt(3)."""
    S = cholesky(P)
    mean, spread_of, D1 = central_difference_moments(g(spread(X, S, INTERVAL)), INTERVAL)
    return Passed(mean, spread_of, S @ T(D1))


RULES: dict[str, Rule] = {"extended": extended, "unscented": unscented, "central difference": central_difference}

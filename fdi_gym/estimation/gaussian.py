"""Gaussian filters of the augmented model: extended, unscented and central-difference Kalman filter in one form.

They differ in how a Gaussian passes through a function g: mean of g(X), covariance of g(X), covariance of X with g(X).
The rest is the Kalman filter: predict through f and add Q, look through h and add R, update. On a linear plant the
three give the Kalman filter's numbers.

A. H. Jazwinski, Stochastic Processes and Filtering Theory, 1970 (extended); S. J. Julier, J. K. Uhlmann, Proceedings of
the IEEE 92(3), 2004 (unscented); M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000 (central differences).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation.augmented import Augmented, Interval
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.propagation import central_difference_points
from fdi_gym.estimation.unscented import cholesky, covariance, mean_and_deviations, sigma_points, weights
from fdi_gym.plant import Array


class Passed(NamedTuple):
    """A Gaussian that has passed through a function."""

    mean: Array  # (n, m)
    P: Array  # (n, m, m)
    cross: Array  # (n, N, m) with what went in


Pass = Callable[[Augmented, str, Array, Array, Interval], Passed]


def extended(model: Augmented, function: str, X: Array, P: Array, at: Interval) -> Passed:
    """The mean goes through the function, the spread through its Jacobian."""
    mean, J = model.jacobian(function, X, at)
    cross = P @ T(J)
    return Passed(mean, J @ cross, cross)


def unscented(model: Augmented, function: str, X: Array, P: Array, at: Interval) -> Passed:
    """2 N + 1 sigma points, lambda = 2, the same weights for mean and covariance."""
    points, w = sigma_points(X, P), weights(X.shape[1])
    mean, out = mean_and_deviations((model.f if function == "f" else model.h)(points, at), w)
    return Passed(mean, covariance(out, out, w), covariance(points - X[:, None], out, w))


def central_difference(model: Augmented, function: str, X: Array, P: Array, at: Interval) -> Passed:
    """Second-order Stirling interpolation with the interval sqrt(3)."""
    h, N = 3**0.5, X.shape[1]
    S = cholesky(P)
    F = (model.f if function == "f" else model.h)(central_difference_points(X, S, h), at)
    plus, minus, both = F[:, 1 : N + 1], F[:, N + 1 :], F[:, 1 : N + 1] + F[:, N + 1 :]
    mean = (h**2 - N) / h**2 * F[:, 0] + both.sum(axis=1) / (2 * h**2)
    first = T(plus - minus) / (2 * h)
    second = T(both - 2 * F[:, :1]) * (np.sqrt(h**2 - 1) / (2 * h**2))
    return Passed(mean, first @ T(first) + second @ T(second), S @ T(first))


RULES: dict[str, Pass] = {"extended": extended, "unscented": unscented, "central difference": central_difference}


class Gaussian(NamedTuple):
    """State of a filter after its sample k - 1."""

    k: int  # samples seen
    X: Array  # (n, N)
    P: Array  # (n, N, N)
    nu: Array  # (n, m) last innovation
    S: Array  # (n, m, m) its covariance
    known: Array  # (n, n_known) the known signals of the last sample


def start(model: Augmented, n: int) -> Gaussian:
    """The filter before its first sample."""
    m = len(model.R)
    return Gaussian(
        0, np.tile(model.X0, (n, 1)), np.tile(model.P0, (n, 1, 1)), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
        np.zeros((n, len(model.plant.known))),
    )  # fmt: skip


def predict(model: Augmented, rule: Pass, X: Array, P: Array, at: Interval) -> tuple[Array, Array]:
    """Mean and covariance one sample later."""
    moved = rule(model, "f", X, P, at)
    return moved.mean, model.limited(symmetric(moved.P) + model.Q)


def look(model: Augmented, rule: Pass, X: Array, P: Array, at: Interval) -> tuple[Array, Array, Array, Array]:
    """Update with the measurement: mean, covariance, innovation, innovation covariance."""
    if model.H is not None:
        cross = P @ model.H.T
        nu, S = at.y - times(model.H, X), model.H @ cross + model.R
    else:
        seen = rule(model, "h", X, P, at)
        cross, nu, S = seen.cross, at.y - seen.mean, seen.P + model.R
    K = right_divide(cross, S)
    return X + times(K, nu), symmetric(P - K @ T(cross)), nu, S


def advance(model: Augmented, rule: Pass, s: Gaussian, obs: Array, first_sample: bool = True) -> Gaussian:
    """One sample: obs (n, n_obs). The first one ends no interval; it is a measurement, or nothing at all."""
    at, known = model.read(s.k, obs, s.known)
    if s.k == 0 and not first_sample:
        return s._replace(k=1, known=known)
    X, P = (s.X, s.P) if s.k == 0 else predict(model, rule, s.X, s.P, at)
    return Gaussian(s.k + 1, *look(model, rule, X, P, at), known)


def nis(s: Any) -> Array:
    """nu' S^-1 nu of the last sample (n,)."""
    return np.einsum("ni,ni->n", s.nu, right_divide(s.nu[:, None], s.S)[:, 0])

"""The Kalman filter of a healthy linear plant, from its steady state on: what residual tests and Bayes banks stand on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, solve, symmetric, times, update
from fdi_gym.estimation.linear import LinearModel, linear_model
from fdi_gym.plant import Array, Plant


class Nominal(NamedTuple):
    """The plant as it is without faults, and the filter's steady state."""

    model: LinearModel
    Q: Array  # (n_x, n_x)
    R: Array  # (n_y, n_y)
    P: Array  # covariance after an update (n_x, n_x)
    K: Array  # gain (n_x, n_y)
    S: Array  # innovation covariance (n_y, n_y)
    W: Array  # its inverse


class Healthy(NamedTuple):
    """State of the filter, and what it made of the last sample."""

    x: Array  # (n, n_x)
    P: Array  # (n, n_x, n_x)
    nu: Array  # (n, n_y) innovation, 0 where a sensor did not report
    K: Array  # (n, n_x, n_y), columns of 0 there
    W: Array  # (n, n_y, n_y) inverse of the innovation covariance, rows and columns of 0 there


def nominal_filter(plant: Plant) -> Nominal:
    """The filter in its steady state, from the discrete algebraic Riccati equation.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    model = linear_model(plant)
    P = scipy.linalg.solve_discrete_are(model.A.T, model.C.T, plant.Q, plant.R)
    S = model.C @ P @ model.C.T + plant.R
    K = np.linalg.solve(S, model.C @ P).T
    return Nominal(model, plant.Q, plant.R, symmetric(P - K @ model.C @ P), K, S, np.linalg.inv(S))


def start(f: Nominal, plant: Plant, n: int) -> Healthy:
    """At trim, as sure as in the steady state."""
    m = len(f.R)
    return Healthy(
        np.tile(plant.trim_state, (n, 1)), np.tile(f.P, (n, 1, 1)), np.zeros((n, m)), np.tile(f.K, (n, 1, 1)),
        np.tile(f.W, (n, 1, 1)),
    )  # fmt: skip


def predict(f: Nominal, s: Healthy, at: Interval) -> Healthy:
    """Over an interval."""
    A = f.model.A
    return s._replace(x=times(A, s.x) + times(f.model.B, at.u), P=A @ s.P @ A.T + at.noise(f.Q))


def correct(f: Nominal, s: Healthy, y: Array, seen: Array) -> Healthy:
    """With the sensors that reported: y, seen (n, n_y)."""
    done = update(s.x, s.P, y - times(f.model.C, s.x), f.model.C, f.R, seen)
    W = solve(done.S, np.broadcast_to(np.eye(len(f.R)), done.S.shape))
    if not seen.all():
        W = np.where(seen[:, :, None] & seen[:, None, :], W, 0.0)
    return Healthy(done.x, done.P, done.nu, done.K, W)


def sense(f: Nominal, s: Healthy, M: Array, G: Array, g: Array, E: Array) -> tuple[Array, Array, Array]:
    """How a fault shows in the innovations, one sample on: H = A M + E, then G, g and M = (I - K C) H.

    M: how far one unit of each fault entry has moved the filter's error (n, hypotheses, n_x, p); E: what it adds over the
    interval, broadcast to M, 0 once the fault is gone; G (n, hypotheses, p, p) and g (n, hypotheses, p): its information.
    """
    moved = f.model.A @ M + E
    H = f.model.C @ moved
    HtW = T(H) @ s.W[:, None]
    return moved - s.K[:, None] @ H, G + HtW @ H, g + (HtW @ s.nu[:, None, :, None])[..., 0]

"""Augmented Kalman filter: the fault parameter appended to the state.

The yardstick of every two-stage filter: the same statistics, one larger covariance. Any forgetting of the fault
parameter's covariance is process noise Pz- - Pz on it, so the augmented filter follows each rule exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters.two_stage_kf import aging, make_logic, prior
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.decision import with_logic
from fdi_gym.estimation.kalman import T, symmetric, times, update
from fdi_gym.estimation.linear import LinearModel, linear_model
from fdi_gym.plant import Array, Plant


class Augmented(NamedTuple):
    """State of the filter: X = [x; z] with its covariance."""

    X: Array  # (n, n_x + p)
    P: Array  # (n, n_x + p, n_x + p)
    z: Array  # (n, p) the part of X that is the fault parameter's deviation from healthy
    Pz: Array  # (n, p, p)
    nu: Array  # (n, n_y) innovation
    S: Array  # (n, n_y, n_y)


def start(n: int, n_y: int, P_x: Array, P_z: Array) -> Augmented:
    """The filter before its first measurement."""
    n_x, p = len(P_x), len(P_z)
    P = np.zeros((n, n_x + p, n_x + p))
    P[:, :n_x, :n_x], P[:, n_x:, n_x:] = P_x, P_z
    return Augmented(
        np.zeros((n, n_x + p)),
        P,
        np.zeros((n, p)),
        P[:, n_x:, n_x:],
        np.zeros((n, n_y)),
        np.tile(np.eye(n_y), (n, 1, 1)),
    )


def step(s: Augmented, u: Array, y: Array, model: LinearModel, Q: Array, R: Array, Pz_minus: Array) -> Augmented:
    """One step of the Kalman filter of F = [A E_k; 0 I] with the command u_k and the measurement y_{k+1}."""
    n, n_x = len(y), len(model.A)
    N = s.X.shape[1]
    F = np.tile(np.eye(N), (n, 1, 1))
    F[:, :n_x, :n_x], F[:, :n_x, n_x:] = model.A, model.E(u)
    X = times(F, s.X)
    X[:, :n_x] += times(model.B, u)
    P = F @ s.P @ T(F)
    P[:, :n_x, :n_x] += Q
    P[:, n_x:, n_x:] += Pz_minus - s.Pz
    H = np.zeros((len(model.C), N))
    H[:, :n_x] = model.C
    nu = y - times(H, X)
    done = update(X, symmetric(P), nu, H, R)
    return Augmented(done.x, done.P, done.x[:, n_x:], done.P[:, n_x:, n_x:], nu, done.S)


@diagnoser("augmented_kf", "Augmented Kalman filter, exponential forgetting", forgetting="exponential")
def augmented_kf(
    plant: Plant,
    *,
    q_bias: float = 0.0,
    forgetting: str = "none",
    factor: float = 0.99,
    a_min: float = 1e-4,
    a_max: float = 1.0,
    decision: str = "distance",
    threshold: float = 8.0,
    release_after: int = 50,
) -> Diagnoser:
    """The augmented Kalman filter with a decision logic; arguments and errors as of `two_stage_kf`."""
    aged = aging(plant, q_bias, forgetting, factor, a_min, a_max)
    model = linear_model(plant)
    P_x, P_z = prior(plant)

    def advance(s: Augmented, u: Array, y: Array) -> Augmented:
        return step(s, u, y, model, plant.Q, plant.R, aged(s.Pz))

    logic = make_logic(plant, decision, threshold, release_after)
    return with_logic(plant, lambda n: start(n, len(plant.outputs), P_x, P_z), advance, logic)

"""How a Gaussian over the state passes through a nonlinear plant, and how the unknown inputs enter on the way.

Two rules, central differences (Stirling's interpolation) and the extended Kalman filter's linearisation. Either gives
the mean and spread after one sample together with the plant's Jacobians with respect to the state, to a fault vector b
and to a disturbance d: what the three-stage filters need. Everything a rule needs of the plant is one compiled call for
the whole batch of episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation.belief import FaultInputs
from fdi_gym.estimation.kalman import T, symmetric
from fdi_gym.estimation.sigma_points import INTERVAL, central_difference_moments, cholesky, spread
from fdi_gym.plant import Array, Plant


class Propagated(NamedTuple):
    """What a rule gives. The Jacobian with respect to the state is A = D S^-1."""

    x: Array  # (n, n_x) mean after the sample
    P: Array  # (n, n_x, n_x) spread, process noise not included
    D: Array  # (n, n_x, n_x) how the spread's columns come out,
    S: Array | None  # (n, n_x, n_x) and how they went in; None: the identity
    B: Array  # (n, n_x, p) Jacobian with respect to the fault vector
    E: Array  # (n, n_x, q) and the disturbance

    def carry(self, V: Array) -> Array:
        """A V for V (n, n_x, m)."""
        return self.D @ (V if self.S is None else np.linalg.solve(self.S, V))

    @property
    def A(self) -> Array:
        """The Jacobian itself (n, n_x, n_x)."""
        return self.D if self.S is None else self.carry(np.tile(np.eye(self.D.shape[-1]), (len(self.D), 1, 1)))


Propagation = Callable[..., Propagated]  # of (t, x (n, n_x), P (n, n_x, n_x), u (n, n_u), b (n, p), d (n, q))


def _steps(plant: Plant, inputs: FaultInputs, ahead: int, step_b: float, step_d: float) -> tuple[Array, Array]:
    """Offsets of theta (m, n_theta) and d (m, q): none for the first `ahead` points, then +-step on each b and d."""
    p, q = len(inputs.entries), len(plant.disturbances)
    m = ahead + 2 * p + 2 * q
    theta, d = np.zeros((m, len(plant.theta))), np.zeros((m, q))
    for j, entry in enumerate(inputs.entries):
        theta[ahead + j, entry], theta[ahead + p + j, entry] = step_b, -step_b
    for j in range(q):
        d[ahead + 2 * p + j, j], d[ahead + 2 * p + q + j, j] = step_d, -step_d
    return theta, d


def _differences(F: Array, ahead: int, p: int, q: int, step_b: float, step_d: float) -> tuple[Array, Array]:
    """B and E from the points that `_steps` laid out."""
    b, d = F[:, ahead : ahead + 2 * p], F[:, ahead + 2 * p :]
    return T(b[:, :p] - b[:, p:]) / (2 * step_b), T(d[:, :q] - d[:, q:]) / (2 * step_d)


def central_difference_propagation(
    plant: Plant, inputs: FaultInputs, *, step_b: float = 1e-3, step_d: float = 0.1
) -> Propagation:
    """Second-order central differences of the state; A = D1 S^-1, P = S S'.

    Norgaard, Poulsen, Ravn, Automatica 36(11), 2000. B and E are plain central differences with the given steps.
    """
    n_x, p, q = len(plant.states), len(inputs.entries), len(plant.disturbances)
    ahead = 2 * n_x + 1
    step_theta, step_dist = _steps(plant, inputs, ahead, step_b, step_d)

    def propagation(t: Any, x: Array, P: Array, u: Array, b: Array, d: Array) -> Propagated:
        S = cholesky(P)
        points = np.empty((len(x), len(step_theta), n_x))
        points[:, :ahead] = spread(x, S, INTERVAL)
        points[:, ahead:] = x[:, None]
        theta = inputs.theta(plant, b)[:, None] + step_theta
        F = plant.propagate(t, points, u, theta, d[:, None] + step_dist if q else None)
        mean, Pf, D1 = central_difference_moments(F[:, :ahead], INTERVAL)
        return Propagated(mean, Pf, D1, S, *_differences(F, ahead, p, q, step_b, step_d))

    return propagation


def extended_propagation(
    plant: Plant, inputs: FaultInputs, *, step_x: float = 1e-5, step_b: float = 1e-5, step_d: float = 1e-3
) -> Propagation:
    """The mean goes through the plant, the spread through its Jacobian A P A'; central differences with these steps."""
    n_x, p, q = len(plant.states), len(inputs.entries), len(plant.disturbances)
    ahead = 2 * n_x + 1
    step_theta, step_dist = _steps(plant, inputs, ahead, step_b, step_d)
    step_state = np.zeros((len(step_theta), n_x))
    step_state[1 : n_x + 1], step_state[n_x + 1 : ahead] = step_x * np.eye(n_x), -step_x * np.eye(n_x)

    def propagation(t: Any, x: Array, P: Array, u: Array, b: Array, d: Array) -> Propagated:
        theta = inputs.theta(plant, b)[:, None] + step_theta
        F = plant.propagate(t, x[:, None] + step_state, u, theta, d[:, None] + step_dist if q else None)
        A = T(F[:, 1 : n_x + 1] - F[:, n_x + 1 : ahead]) / (2 * step_x)
        return Propagated(F[:, 0], symmetric(A @ P @ T(A)), A, None, *_differences(F, ahead, p, q, step_b, step_d))

    return propagation


PROPAGATIONS = {"central difference": central_difference_propagation, "extended": extended_propagation}


def propagation_of(rule: str, plant: Plant, inputs: FaultInputs) -> Propagation:
    """The rule by name.

    Raises:
        ValueError: Unknown name.
    """
    if rule not in PROPAGATIONS:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(PROPAGATIONS)}")
    return PROPAGATIONS[rule](plant, inputs)


def trim_model(plant: Plant, inputs: FaultInputs) -> Propagated:
    """The linearisation at trim: A (n_x, n_x), B (n_x, p), E (n_x, q), with the trim state after one sample as x."""
    n_x, zero = len(plant.states), np.zeros((1, len(inputs.entries)))
    found = extended_propagation(plant, inputs)(
        0.0, plant.trim_state[None], np.eye(n_x)[None], plant.trim_command[None], zero,
        np.zeros((1, len(plant.disturbances))),
    )  # fmt: skip
    return Propagated(found.x[0], found.P[0], found.D[0], None, found.B[0], found.E[0])

"""The matrices of a linear plant, and of linear sensors, read off the compiled model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.model import contiguous
from fdi_gym.plant import Array, NotApplicableError, Plant


class LinearModel(NamedTuple):
    """x+ = A x + B u + E(u) (theta - nominal), y = C x, of a plant that is linear in x and bilinear in (u, theta)."""

    A: Array  # (n_x, n_x)
    B: Array  # (n_x, n_u)
    C: Array  # (n_y, n_x)
    E0: Array  # (n_x, n_theta), the part of E that does not depend on u
    Eu: Array  # (n_u, n_x, n_theta), its rate of change with u

    def E(self, u: Array) -> Array:
        """dx+/dtheta under the command u (n, n_u): (n, n_x, n_theta)."""
        return self.E0 + (u @ self.Eu.reshape(len(self.Eu), -1)).reshape(-1, *self.E0.shape)

    @property
    def equations(self) -> tuple[Array, Array, Array, Array]:
        """A, B, E0 and Eu, as a kernel takes them."""
        return self.A, self.B, self.E0, self.Eu


def stacked(Q: Array) -> Array:
    """A covariance (N, N) for all episodes, or one for each (n, N, N), as a kernel takes it: (1 or n, N, N)."""
    return contiguous(Q if Q.ndim == 3 else Q[None])


def linear_model(plant: Plant) -> LinearModel:
    """The model's matrices, by unit steps: exact for a linear plant.

    Raises:
        NotApplicableError: The plant is not linear.
    """
    if not plant.linear:
        raise NotApplicableError(f"needs a linear plant; {plant.id} is nonlinear")
    n_x, n_u, n_theta = len(plant.states), len(plant.commands), len(plant.theta)
    zero_x, zero_u = np.zeros((1, n_x)), np.zeros((1, n_u))
    A = plant.propagate(0.0, np.eye(n_x), zero_u).T
    B = plant.propagate(0.0, np.zeros((n_u, n_x)), np.eye(n_u)).T
    C = plant.measure(0.0, np.eye(n_x), zero_u).T
    theta = plant.nominal_theta + np.eye(n_theta)

    def E(u: Array) -> Array:
        moved = plant.propagate(0.0, np.zeros((n_theta, n_x)), u, theta)
        return (moved - plant.propagate(0.0, zero_x, u)).T

    E0 = E(zero_u)
    Eu = np.stack([E(np.eye(n_u)[i : i + 1]) - E0 for i in range(n_u)])
    return LinearModel(*(contiguous(a) for a in (A, B, C, E0, Eu)))


def linear_output(plant: Plant, sensors: Array | None = None) -> Array:
    """H (m, n_x) of a plant with y = H x, for these of its sensors (m,); all by default.

    Raises:
        NotApplicableError: The sensors are not linear in the state, or see the command, a fault or the disturbance.
    """
    n_x, which = len(plant.states), np.arange(len(plant.outputs)) if sensors is None else sensors
    rng = np.random.default_rng(0)
    HT = plant.measure(0.0, np.eye(n_x), plant.trim_command) - plant.measure(0.0, np.zeros(n_x), plant.trim_command)
    H = HT.take(which, axis=1).T
    x = rng.standard_normal((8, n_x))
    u = plant.trim_command + rng.standard_normal((8, len(plant.commands)))
    theta = plant.nominal_theta + rng.standard_normal((8, len(plant.theta)))
    d = rng.standard_normal((8, len(plant.disturbances))) if plant.disturbances else None
    if not np.allclose(plant.measure(0.0, x, u, theta, d)[:, which], x @ H.T, rtol=1e-9, atol=1e-9):
        raise NotApplicableError(f"needs sensors y = H x; those of {plant.id} are not")
    return H

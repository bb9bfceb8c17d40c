"""The matrices of a linear plant, read off its compiled model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.plant import Array, Plant


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
    return LinearModel(A, B, C, E0, Eu)

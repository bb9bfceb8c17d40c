"""Attitude in three numbers: the quaternion's vector part, whose scalar part follows from the unit norm and a sign."""

from __future__ import annotations

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.plant import Array, Plant


def require_attitude(plant: Plant) -> None:
    """Check that the plant measures its whole state but for the quaternion's scalar part, and the sign of that.

    Raises:
        NotApplicableError: It does not.
    """
    if len(plant.states) != 11 or [s.name for s in plant.outputs[-1:]] != ["sign q4"]:
        raise NotApplicableError(f"needs a measured quaternion, rate and gimbal angles; {plant.id} has none")


def with_scalar(xi: Array, sign: Array) -> Array:
    """(q1..q4, rest) from xi = (q1..q3, rest) (n, points, m) and the sign (n,): q4 = sign sqrt(max(0, 1 - |q_v|^2))."""
    x = np.empty((*xi.shape[:-1], xi.shape[-1] + 1))
    x[..., :3], x[..., 4:] = xi[..., :3], xi[..., 3:]
    squares = xi[..., :3] ** 2
    rest = 1.0 - squares[..., 0] - squares[..., 1] - squares[..., 2]
    x[..., 3] = sign[:, None] * np.sqrt(np.maximum(rest, 0.0))
    return x


def cross(v: Array) -> Array:
    """The cross-product matrices [v x] (n, 3, 3) of v (n, 3)."""
    M = np.zeros((*v.shape, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    M[:, 1, 0], M[:, 2, 0], M[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return M


def rotated(q: Array, t: Array) -> Array:
    """q * dq(t/2) to first order, normalised: quaternions (n, 4) turned by small angles t (n, 3) in body axes."""
    v, s = q[:, :3], q[:, 3:]
    turned = np.concatenate([v + 0.5 * (s * t + np.cross(v, t)), s - 0.5 * (v * t).sum(axis=1, keepdims=True)], axis=1)
    return turned / np.sqrt((turned**2).sum(axis=1, keepdims=True))

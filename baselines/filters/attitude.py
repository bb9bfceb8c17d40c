"""What the satellite's filters share of attitudes: a quaternion in three numbers and a sign, and small rotations."""

from __future__ import annotations

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.plant import Array, Plant


def require_attitude(plant: Plant) -> None:
    """Check that the plant measures its whole state but for the quaternion's scalar part, and the sign of that.

    Raises:
        NotApplicableError: It does not.
    """
    if len(plant.states) != 11 or plant.quaternions != ((0, 1, 2, 10),):
        raise NotApplicableError(f"needs a measured quaternion, rate and gimbal angles; {plant.id} has none")


def without_scalar(x: Array) -> tuple[Array, Array]:
    """xi = (q1..q3, rest) and the sign of q4, from x = (q1..q4, rest) (..., m)."""
    return np.delete(x, 3, axis=-1), np.where(x[..., 3] < 0.0, -1.0, 1.0)


def with_scalar(xi: Array, sign: Array) -> Array:
    """(q1..q4, rest) from xi = (q1..q3, rest) (n, points, m) and the sign (n,): q4 = sign sqrt(max(0, 1 - |q_v|^2))."""
    x = np.empty((*xi.shape[:-1], xi.shape[-1] + 1))
    x[..., :3], x[..., 4:] = xi[..., :3], xi[..., 3:]
    squares = xi[..., :3] ** 2
    rest = 1.0 - squares[..., 0] - squares[..., 1] - squares[..., 2]
    x[..., 3] = sign[:, None] * np.sqrt(np.maximum(rest, 0.0))
    return x


def taken(x: Array, P: Array, y: Array, variance: Array, fresh: Array) -> tuple[Array, Array]:
    """x (n, N) and P with the entries taken as measured that report for the first time: an update without a prior.

    Args:
        x: Mean (n, N), of which the measured entries come first.
        P: Covariance (n, N, N).
        y: Measurement (n, m).
        variance: That it leaves (m,) or (n, m).
        fresh: Which report for the first time (n, m) bool.
    """
    if not fresh.any():
        return x, P
    m, N = fresh.shape[1], x.shape[1]
    x, now = x.copy(), np.zeros((len(x), N), bool)
    x[:, :m], now[:, :m] = np.where(fresh, y, x[:, :m]), fresh
    P = np.where(now[:, :, None] | now[:, None, :], 0.0, P)
    P[:, range(m), range(m)] += np.where(fresh, variance, 0.0)
    return x, P


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

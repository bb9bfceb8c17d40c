"""The Kalman filter's algebra on stacks of episodes: x (n, n_x), P (n, n_x, n_x)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation import compiled, gaussian
from fdi_gym.model import contiguous
from fdi_gym.plant import Array


def T(M: Array) -> Array:
    """Transpose of each matrix of a stack."""
    return np.swapaxes(M, -1, -2)


def times(M: Array, v: Array) -> Array:
    """M v for each episode: M (n_a, n_b) or (n, n_a, n_b), v (n, n_b)."""
    return (M @ v[..., None])[..., 0]


def symmetric(P: Array) -> Array:
    """(P + P') / 2: what rounding took away."""
    return 0.5 * (P + T(P))


def solve(S: Array, M: Array) -> Array:
    """S^-1 M for stacks of small matrices: S (..., m, m), M (..., m, r). Not finite where S is singular."""
    outer = S.shape[:-2] if S.shape[:-2] == M.shape[:-2] else np.broadcast_shapes(S.shape[:-2], M.shape[:-2])
    left, right = (contiguous(a if a.shape[:-2] == outer else np.broadcast_to(a, (*outer, *a.shape[-2:]))) for a in (S, M))
    out = np.empty(right.shape)
    if not out.size:
        return out
    compiled.solve(*(a.reshape(-1, *a.shape[-2:]) for a in (left, right, out)))
    return out


def right_divide(M: Array, S: Array) -> Array:
    """M S^-1 for symmetric S."""
    return T(solve(S, T(M)))


def quadratic(v: Array, S: Array) -> Array:
    """v' S^-1 v (...,) for each vector (..., m)."""
    return (v * solve(S, v[..., None])[..., 0]).sum(axis=-1)


def log_likelihood(nu: Array, S: Array) -> Array:
    """log N(nu; 0, S) (...,) without its constant. Sensors that were masked (see `masked`) count for nothing."""
    return -0.5 * (quadratic(nu, S) + np.linalg.slogdet(S)[1])


def masked(seen: Array, nu: Array, S: Array, *crosses: Array) -> tuple[Array, ...]:
    """Innovation, its covariance and crosses with it, so that only the sensors that reported act.

    The filter with these is the filter whose missing rows were removed: a missing sensor has innovation 0, variance 1 and
    no covariance with anything.

    Args:
        seen: (n, m) bool.
        nu: Innovation (n, m).
        S: Its covariance (n, m, m).
        crosses: (n, ..., N, m) each, covariance of something with the measurement.
    """
    if seen.all():
        return nu, S, *crosses
    both = seen[:, :, None] & seen[:, None, :]
    lone = np.eye(seen.shape[1], dtype=bool) & ~seen[:, :, None]
    return (
        np.where(seen, nu, 0.0),
        np.where(both, S, 0.0) + lone,
        *(np.where(seen.reshape(len(seen), *[1] * (C.ndim - 2), -1), C, 0.0) for C in crosses),
    )


class Corrected(NamedTuple):
    """Outcome of a measurement update."""

    x: Array  # (n, n_x)
    P: Array  # (n, n_x, n_x)
    nu: Array  # innovation (n, m)
    S: Array  # its covariance (n, m, m)
    K: Array  # gain (n, n_x, m)


def correct(x: Array, P: Array, nu: Array, cross: Array, S: Array, seen: Array) -> Corrected:
    """Measurement update from the innovation (n, m), its covariance and that of the state with the measurement (n, n_x, m).

    K = cross S^-1, x + K nu, P - K cross', with the sensors that reported.
    """
    done = gaussian.correct(x, P, np.zeros_like(nu), cross, S, nu, seen)
    return Corrected(done.X, done.P, done.nu, done.S, done.K)


def update(x: Array, P: Array, nu: Array, H: Array, R: Array, seen: Array) -> Corrected:
    """Measurement update with linear sensors: H (m, n_x) or (n, m, n_x), R (m, m)."""
    cross = P @ T(H)
    return correct(x, P, nu, cross, H @ cross + R, seen)

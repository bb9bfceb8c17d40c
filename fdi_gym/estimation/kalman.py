"""The Kalman filter's two halves, on stacks of episodes: x (n, n_x), P (n, n_x, n_x)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.plant import Array, contiguous


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
    from fdi_gym.estimation import compiled

    outer = S.shape[:-2] if S.shape[:-2] == M.shape[:-2] else np.broadcast_shapes(S.shape[:-2], M.shape[:-2])
    left, right = (contiguous(a if a.shape[:-2] == outer else np.broadcast_to(a, (*outer, *a.shape[-2:]))) for a in (S, M))
    out = np.empty(right.shape)
    compiled.solve(*(a.reshape(-1, *a.shape[-2:]) for a in (left, right, out)))
    return out


def right_divide(M: Array, S: Array) -> Array:
    """M S^-1 for symmetric S."""
    return T(solve(S, T(M)))


def quadratic(v: Array, S: Array) -> Array:
    """v' S^-1 v for each episode: (n,)."""
    return np.einsum("ni,ni->n", v, solve(S, v[..., None])[..., 0])


class Updated(NamedTuple):
    """Outcome of a measurement update."""

    x: Array  # (n, n_x)
    P: Array  # (n, n_x, n_x)
    K: Array  # gain (n, n_x, n_y)
    S: Array  # innovation covariance (n, n_y, n_y)


def update(x: Array, P: Array, innovation: Array, H: Array, R: Array) -> Updated:
    """Measurement update with the innovation (n, n_y): K = P H' S^-1, S = H P H' + R."""
    PHt = P @ T(H)
    S = H @ PHt + R
    K = right_divide(PHt, S)
    return Updated(x + times(K, innovation), symmetric(P - K @ H @ P), K, S)

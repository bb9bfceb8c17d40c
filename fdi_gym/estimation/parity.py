"""Parity relations: what the samples of a window must satisfy, whatever state it began in and whatever disturbed it.

Over a window of s + 1 samples a linearised model reads

    e = O x0 + T z + B d + noise of covariance S,

e what the sensors read less what the model expects, x0 the error of the state at the window's first sample, z a fault that
acts all through it, d unknown disturbances, free at each interval. Every row w with w [O, B] = 0 is a parity relation [1].
All of them together, whitened, are the projection of L^-1 e, S = L L', on the complement of the range of L^-1 [O, B].

[1] E. Y. Chow, A. S. Willsky, IEEE Transactions on Automatic Control 29(7), 1984.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.kalman import T
from fdi_gym.plant import Array

TOLERANCE = 1e-10  # of singular values, relative: what is below is a direction that the sensors don't show


class Stacked(NamedTuple):
    """The samples of a window in one equation; rows of sensors that did not report are 0, with variance 1."""

    O: Array  # (n, rows, n_x), rows = (s + 1) m  # noqa: E741
    T: Array  # (n, rows, p)
    B: Array  # (n, rows, s q)
    S: Array  # (n, rows, rows)


def stacked(A: Array, E: Array, D: Array, Q: Array, C: Array, H: Array, R: Array, seen: Array) -> Stacked:
    """The equation of a window.

    Args:
        A: State from sample to sample (n, s, n_x, n_x).
        E: What a unit of each fault adds on the way (n, s, n_x, p).
        D: What a unit of each disturbance adds (n, s, n_x, q).
        Q: Covariance of what noise adds (n, s, n_x, n_x).
        C: Sensors (n, s + 1, m, n_x).
        H: What a unit of each fault adds to them (n, s + 1, m, p).
        R: Covariance of their noise (m, m).
        seen: Which of them reported (n, s + 1, m) bool.
    """
    n, s, n_x, p = E.shape
    m, q = len(R), D.shape[-1]
    rows = (s + 1) * m
    found = Stacked(np.empty((n, rows, n_x)), np.empty((n, rows, p)), np.empty((n, rows, s * q)), np.zeros((n, rows, rows)))
    Phi, M = np.tile(np.eye(n_x), (n, 1, 1)), np.zeros((n, n_x, p))
    G, L, P = np.zeros((n, n_x, s * q)), np.zeros((n, n_x, rows)), np.zeros((n, n_x, n_x))
    for i in range(s + 1):
        if i:
            a = A[:, i - 1]
            Phi, M, G, L, P = a @ Phi, a @ M + E[:, i - 1], a @ G, a @ L, a @ P @ T(a) + Q[:, i - 1]
            G[..., (i - 1) * q : i * q] += D[:, i - 1]
        c, r = C[:, i], slice(i * m, (i + 1) * m)
        found.O[:, r], found.T[:, r], found.B[:, r] = c @ Phi, c @ M + H[:, i], c @ G
        cross = c @ L
        L[..., r] = P @ T(c)
        cross[..., r] = c @ L[..., r] + R
        found.S[:, r] = cross
        found.S[:, :, r] = T(cross)
    there = seen.reshape(n, rows)
    if not there.all():
        for a in found[:3]:
            a *= there[..., None]
        found.S[:] = np.where(there[:, :, None] & there[:, None, :], found.S, np.eye(rows))
    return found


def projected(w: Stacked, scale: Array, *vectors: Array) -> tuple[Array, ...]:
    """Vectors (n, rows, ...) whitened, and projected on the parity space of a window.

    Args:
        w: The window.
        scale: Typical sizes of the columns of [O, B] (n_x + s q,).
        vectors: Residuals, signatures.
    """
    known = np.concatenate([w.O, w.B], axis=2) * scale
    widths = [v.shape[2] for v in vectors]
    white = np.linalg.solve(np.linalg.cholesky(w.S), np.concatenate([known, *vectors], axis=2))
    known, rest = white[..., : len(scale)], white[..., len(scale) :]
    U, size, _ = np.linalg.svd(known, full_matrices=False)
    U = U * (size > TOLERANCE * size[:, :1])[:, None, :]
    rest = rest - U @ (T(U) @ rest)
    return tuple(np.split(rest, np.cumsum(widths)[:-1], axis=2))

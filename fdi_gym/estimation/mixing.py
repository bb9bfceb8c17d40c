"""Interacting multiple models: the mixing of L filters before a prediction, and their probabilities after an update.

H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988.
"""

from __future__ import annotations

import numpy as np
from numba import float64, void

from fdi_gym.integration import LANES
from fdi_gym.kernels import compiled
from fdi_gym.model import contiguous
from fdi_gym.plant import Array
from fdi_gym.vectors import load, store, zeros

M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]


def ahead(mu: Array, transition: Array) -> tuple[Array, Array]:
    """Predicted probabilities c (n, L), and w (n, to, from): the share of each model in what another becomes.

    mu (n, L): probabilities; transition (L, L): from row to column, per sample.
    """
    joint = mu[:, :, None] * transition  # (n, from, to)
    c = joint.sum(axis=1)
    return c, np.swapaxes(joint / c[:, None, :], 1, 2)


def mixture(w: Array, X: Array, P: Array) -> tuple[Array, Array]:
    """Mean (n, to, N) and covariance (n, to, N, N) of the mixtures of X (n, from, N), P (n, from, N, N), spread included."""
    n, _, N = X.shape
    mean, mixed = np.empty((n, w.shape[1], N)), np.empty((n, w.shape[1], N, N))
    _mixture(contiguous(w), contiguous(X), contiguous(P), mean, mixed)
    return mean, mixed


@compiled(void(M3, M3, M4, M3, M4), heap=True)  # a bank has many models
def _mixture(w, X, P, mean, mixed):
    (n, L, N), to = X.shape, w.shape[1]
    W = (N + LANES - 1) // LANES * LANES
    points, wide = np.zeros((L + 1, W)), np.zeros((L * N, W))  # rows in whole vectors; the last point is the mean
    spread, total = np.empty((L, W)), np.empty((1, W))
    for e in range(n):
        for i in range(L):
            for r in range(N):
                points[i, r] = X[e, i, r]
                for c in range(r + 1):
                    wide[i * N + r, c] = P[e, i, r, c]
        for j in range(to):
            for c in range(0, W, LANES):
                found = zeros()
                for i in range(L):
                    found += load(points, i, c) * w[e, j, i]
                store(points, L, c, found)
                for i in range(L):
                    store(spread, i, c, load(points, i, c) - found)
            for r in range(N):
                mean[e, j, r] = points[L, r]
                for c in range(0, r + 1, LANES):
                    within, between = zeros(), zeros()
                    for i in range(L):
                        within += load(wide, i * N + r, c) * w[e, j, i]
                        between += load(spread, i, c) * (w[e, j, i] * spread[i, r])
                    store(total, 0, c, within + between)
                for c in range(r + 1):
                    mixed[e, j, r, c] = mixed[e, j, c, r] = total[0, c]


def over_lines(w: Array, offset: Array, direction: Array, m: Array, M: Array) -> tuple[Array, Array]:
    """Mean (n, p) and covariance (n, p, p) of a mixture on lines: of offset + direction z, where z has mean m, covariance M.

    Args:
        w: Weights (n, L), which sum to 1.
        offset: (L, p) or (n, L, p).
        direction: (L, p, f) or (n, L, p, f).
        m: (n, L, f).
        M: (n, L, f, f).
    """
    at = offset + (direction @ m[..., None])[..., 0]
    mean = (w[..., None] * at).sum(axis=1)
    gap, p = at - mean[:, None], at.shape[2]
    within = np.swapaxes(w[..., None, None] * (direction @ M), 1, 2).reshape(len(w), p, -1)
    lines = np.swapaxes(direction, -1, -2).reshape(*direction.shape[:-3], -1, p)  # those of all L one below the other
    return mean, within @ lines + np.swapaxes(w[..., None] * gap, 1, 2) @ gap


def mix(w: Array, X: Array, P: Array, own: slice, m0: Array, M0: Array) -> tuple[Array, Array]:
    """The mixtures, where the entries `own` of X belong to each model alone.

    A model that was not in force has their prior back, mean m0 (L, f) or (n, L, f) and covariance M0 (L, f, f); their
    correlation with the rest is the model's own.
    """
    L, N = X.shape[1:]
    stays = w[:, range(L), range(L)]  # that the model was in force before
    rest = [i for i in range(N) if not own.start <= i < own.stop]
    mean, mixed = mixture(w, X, P)
    m = X[..., own]
    mean[..., own] = stays[..., None] * m + (1 - stays[..., None]) * m0
    gap, a = m - m0, stays[..., None, None]
    mixed[..., own, own] = a * P[..., own, own] + (1 - a) * (M0 + a * gap[..., :, None] * gap[..., None, :])
    cross = (a * P[..., own, :])[..., rest] + (a * gap[..., :, None]) * (X - mean)[..., None, rest]
    mixed[..., own, rest] = cross
    mixed[..., rest, own] = np.swapaxes(cross, -1, -2)
    return mean, mixed


def weigh(c: Array, log_likelihood: Array, least: float) -> Array:
    """Probabilities (n, L) after a sample whose log likelihoods (n, L) are given; none falls below `least`."""
    log = log_likelihood + np.log(np.maximum(c, least))
    mu = np.exp(log - log.max(axis=1, keepdims=True))
    return np.maximum(mu / mu.sum(axis=1, keepdims=True), least)

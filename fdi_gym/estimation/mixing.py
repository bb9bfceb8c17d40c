"""Interacting multiple models: the mixing of L filters before a prediction, and their probabilities after an update.

H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.plant import Array


def ahead(mu: Array, transition: Array) -> tuple[Array, Array]:
    """Predicted probabilities c (n, L), and w (n, to, from): the share of each model in what another becomes.

    mu (n, L): probabilities; transition (L, L): from row to column, per sample.
    """
    joint = mu[:, :, None] * transition  # (n, from, to)
    c = joint.sum(axis=1)
    return c, np.swapaxes(joint / c[:, None, :], 1, 2)


def mixture(w: Array, X: Array, P: Array) -> tuple[Array, Array]:
    """Mean (n, to, N) and covariance (n, to, N, N) of the mixtures of X (n, from, N), P (n, from, N, N), spread included."""
    n, L, N = X.shape
    mean = w @ X
    spread = X[:, None] - mean[:, :, None]  # (n, to, from, N)
    mixed = (w @ P.reshape(n, L, N * N)).reshape(n, -1, N, N)
    return mean, mixed + np.swapaxes(w[..., None] * spread, 2, 3) @ spread


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
    others, P_rest = X.copy(), P.copy()
    others[..., own] = 0.0
    P_rest[..., own, :] = P_rest[..., :, own] = 0.0
    mean, mixed = mixture(w, others, P_rest)
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

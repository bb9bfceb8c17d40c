"""Generalised likelihood ratio of a fault at an unknown time, from the innovations of a filter that knows of none.

A fault that sets in at sample tau moves the innovations of the healthy filter by a signature that the model predicts.
Per onset: M, how far one unit of each fault entry has moved the filter's error, h = H M + D its signature, information
G = sum h' S^-1 h and g = sum h' S^-1 nu. The log likelihood ratio of a fault vector z is g'z - z'Gz / 2; its maximum over
onset and magnitude, for each label, is the statistic. Onsets are tried every few samples within a window; information
fades at the window's pace, and the oldest onset stands for all before it.

A. S. Willsky, H. L. Jones, IEEE Transactions on Automatic Control 21(1), 1976. The signature of an entry is the change
that a fault of typical size makes (a secant), so that a fault which acts like a switch has one too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.augmented import STEP, Augmented, Interval
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.plant import Array, Plant


class Ratio(NamedTuple):
    """State after sample k - 1: the healthy filter, and the signatures of the onsets that are tried."""

    k: int
    X: Array  # (n, N) state and unknown disturbance
    P: Array  # (n, N, N)
    M: Array  # (n, onsets, N, p), the youngest onset first
    G: Array  # (n, onsets, p, p)
    g: Array  # (n, onsets, p)
    known: Array  # (n, n_known)
    nu: Array  # (n, m) last innovation
    S: Array  # (n, m, m)


class Signatures(NamedTuple):
    """How a function of the augmented model changes."""

    mean: Array  # (n, m)
    A: Array  # (n, m, N) with state and disturbance
    E: Array  # (n, m, p) with a unit of each fault entry


def secants(plant: Plant, size: Array) -> tuple[Array, Array]:
    """The two magnitudes (p,) between which the signature of each entry is taken.

    Between healthy and a typical fault where the modes on that entry have one sign; else symmetric about healthy.
    """
    up, down = np.zeros(len(size), bool), np.zeros(len(size), bool)
    for mode in plant.modes:
        ends = np.array(mode.offset)[:, None] + np.outer(mode.direction, mode.reach)
        up |= (ends > 0).any(axis=1)
        down |= (ends < 0).any(axis=1)
    return np.where(down | ~up, -size, 0.0), np.where(up | ~down, size, 0.0)


def linearised(model: Augmented, function: str, X: Array, at: Interval, low: Array, high: Array) -> Signatures:
    """f or h at the healthy estimate X (n, N) of state and disturbance."""
    n, p = len(X), len(low)
    x, z, d = model.x, model.z, model.d
    rest = [*range(x.start, x.stop), *range(d.start, d.stop)]
    N = len(rest)
    points = np.zeros((n, 1 + 2 * N + 2 * p, len(model.scale)))
    points[:, :, rest] = X[:, None]
    step = STEP * model.scale[rest]
    for j, i in enumerate(rest):
        points[:, 1 + j, i] += step[j]
        points[:, 1 + N + j, i] -= step[j]
    for j in range(p):
        points[:, 1 + 2 * N + j, z.start + j] = high[j]
        points[:, 1 + 2 * N + p + j, z.start + j] = low[j]
    F = (model.f if function == "f" else model.h)(points, at)
    if function == "f":
        F = F[..., rest]
    A = T((F[:, 1 : 1 + N] - F[:, 1 + N : 1 + 2 * N]) / (2 * step[:, None]))
    E = T((F[:, 1 + 2 * N : 1 + 2 * N + p] - F[:, 1 + 2 * N + p :]) / (high - low)[:, None])
    return Signatures(F[:, 0], A, E)


class Test(NamedTuple):
    """A GLR test of a plant."""

    model: Augmented
    low: Array  # (p,) and
    high: Array  # (p,) the ends of the secants
    onsets: int
    spacing: int  # samples between two onsets


def start(test: Test, n: int) -> Ratio:
    """The test before its first sample."""
    model, p = test.model, len(test.low)
    rest = [*range(model.x.start, model.x.stop), *range(model.d.start, model.d.stop)]
    N, m, T_ = len(rest), len(model.R), test.onsets
    return Ratio(
        0, np.tile(model.X0[rest], (n, 1)), np.tile(model.P0[np.ix_(rest, rest)], (n, 1, 1)),
        np.zeros((n, T_, N, p)), np.zeros((n, T_, p, p)), np.zeros((n, T_, p)), np.zeros((n, len(model.plant.known))),
        np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
    )  # fmt: skip


def advance(test: Test, s: Ratio, obs: Array) -> Ratio:
    """One sample: obs (n, n_obs)."""
    model = test.model
    rest = [*range(model.x.start, model.x.stop), *range(model.d.start, model.d.stop)]
    at, known = model.read(s.k, obs, s.known)
    X, P, M, G, g = s.X, s.P, s.M, s.G, s.g
    if s.k > 0:
        if s.k % test.spacing == 0:  # a new onset; the two oldest become one
            M, G, g = (np.concatenate([np.zeros_like(a[:, :1]), a[:, :-2], a[:, -1:]], axis=1) for a in (M, G, g))
        f = linearised(model, "f", X, at, test.low, test.high)
        X, P = f.mean, symmetric(f.A @ P @ T(f.A)) + model.Q[np.ix_(rest, rest)]
        M = f.A[:, None] @ M + f.E[:, None]
    h = linearised(model, "h", X, at, test.low, test.high)
    nu, cross = at.y - h.mean, P @ T(h.A)
    S = h.A @ cross + model.R
    K = right_divide(cross, S)
    if s.k > 0:
        signature = h.A[:, None] @ M + h.E[:, None]  # (n, onsets, m, p)
        weighed = T(signature) @ right_divide(np.eye(len(model.R)), S)[:, None]
        fade = 1.0 - 1.0 / (test.onsets * test.spacing)
        G, g = fade * G + weighed @ signature, fade * g + (weighed @ nu[:, None, :, None])[..., 0]
        M = M - K[:, None] @ signature
    return Ratio(s.k + 1, X + times(K, nu), symmetric(P - K @ T(cross)), M, G, g, known, nu, S)

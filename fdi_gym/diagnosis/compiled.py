"""What the shells do with every sample of every method, compiled: splitting an observation, and looking at a diagnosis."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.kernels import M, V, compiled

I1, B1, B2 = int64[::1], boolean[::1], boolean[:, ::1]
HELD, STALE, RUNNING = 1, 2, 4  # flags of `receive`


@compiled(int64(M, I1, B1, M, M, M, I1, M, B2, M, M, M, B1, B1))
def receive(obs, k, begun, last_u, last_known, last_stale, following, y, seen, u, known, stale, heard, held):
    """Take observations (n, n_obs) apart, with the last value of a command or known signal that did not report.

    Writes the number of the sample after (n,), y and seen (n, n_y), u and stale (n, n_u), known (n, n_known), and whether
    any sensor and whether all commands and known signals reported (n,) (`held`: not). Returns flags: HELD and STALE,
    somewhere something is held, or a command; RUNNING, all episodes have begun and are beyond their first sample.
    """
    flags = RUNNING
    (n, n_y), n_u = y.shape, u.shape[1]
    for e in range(n):
        if not begun[e] or k[e] == 0:
            flags &= ~RUNNING
        following[e], heard[e], held[e] = k[e] + 1, False, False
        for i in range(n_y):
            value = obs[e, i]
            seen[e, i] = np.isfinite(value)
            if seen[e, i]:
                y[e, i], heard[e] = value, True
            else:
                y[e, i] = 0.0
        for i in range(n_u):
            value = obs[e, n_y + i]
            if np.isfinite(value):
                u[e, i], stale[e, i] = value, 0.0
            else:
                u[e, i], stale[e, i], held[e] = last_u[e, i], last_stale[e, i] + 1.0, True
                flags |= HELD | STALE
        for i in range(known.shape[1]):
            value = obs[e, n_y + n_u + i]
            if np.isfinite(value):
                known[e, i] = value
            else:
                known[e, i], held[e] = last_known[e, i], True
                flags |= HELD
    return flags


@compiled(void(M, float64[:, :, ::1], V, M, M))
def report(z, P, healthy, estimate, std):
    """healthy + z, and the roots of the diagonals of P, 0 where they are below it; P and std may be empty."""
    for e in range(len(z)):
        for i in range(len(healthy)):
            estimate[e, i] = healthy[i] + z[e, i]
            if len(std):
                variance = P[e, i, i]
                std[e, i] = 0.0 if variance < 0.0 else np.sqrt(variance)


@compiled(int64(I1, int64, M, M, M, M, V, V, float64, B1))
def look(label, labels, estimate, std, probs, state, most, largest, slack, wrong):
    """Which episodes of a diagnosis hold what cannot be; parts that it does not have are empty.

    Returns 1 if any does, -1 if there is a label that is not below `labels`, else 0.
    """
    found = 0
    for e in range(len(wrong)):
        if not 0 <= label[e] < labels:
            return -1
        bad = False
        for i in range(estimate.shape[1]):
            bad |= not abs(estimate[e, i]) <= most[i]
        for i in range(state.shape[1]):
            bad |= not abs(state[e, i]) <= largest[i]
        for i in range(std.shape[1]):
            bad |= std[e, i] < 0.0
        if probs.shape[1]:
            total = 0.0
            for i in range(probs.shape[1]):
                bad |= not probs[e, i] >= -slack
                total += probs[e, i]
            bad |= not abs(total - 1.0) <= slack
        wrong[e] = bad
        if bad:
            found = 1
    return found

"""The linear algebra of one episode in the compiled Gaussian step: covariances through a matrix, and the correction.

Rows of matrices are whole vectors (`fdi_gym.vectors`), W numbers where N count: what is beyond N is for nobody.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.estimation.gaussian_points import factor
from fdi_gym.integration import LANES
from fdi_gym.kernels import helper
from fdi_gym.vectors import load, minus, over, plus, store, zeros

LOG_2PI = float(np.log(2 * np.pi))


@helper
def widen(P, wide):
    """The rows of P (N, N) in whole vectors (N, W)."""
    for i in range(P.shape[0]):
        for j in range(P.shape[1]):
            wide[i, j] = P[i, j]


@helper
def through_matrix(F, wide, across, cross, cov):
    """cross = F P (m, W) and cov = F P F' (m, W of m) for F (m, N or more), most of which may be 0.

    wide (N, W) has the rows of P and across (N, W of m) is room for F'.
    """
    m, N = cov.shape[0], wide.shape[0]
    for a in range(m):
        for j in range(N):
            across[j, a] = F[a, j]
        for c in range(0, wide.shape[1], LANES):
            total = zeros()
            for j in range(N):
                if F[a, j] != 0.0:
                    total = plus(total, F[a, j], load(wide, j, c))
            store(cross, a, c, total)
    for a in range(m):
        for c in range(0, a + 1, LANES):
            total = zeros()
            for j in range(N):
                total = plus(total, cross[a, j], load(across, j, c))
            store(cov, a, c, total)
        for b in range(a):
            cov[b, a] = cov[a, b]


@helper
def correct_episode(X, P, y, seen, mean, S, cross, low, U, white, X1, P1, nu, S1):
    """The Kalman correction of one episode by the sensors that reported: nu' S^-1 nu, and the log density of what they read.

    A sensor that did not report has nu = 0, no covariance with anything and S = 1. S1 = U' U; `white` becomes U'^-1 nu
    and cross (m, W) U'^-1 cross; low (N + 1, W) is room.
    """
    m, N = mean.size, X.size
    for a in range(m):
        nu[a] = y[a] - mean[a] if seen[a] else 0.0
        for b in range(a + 1):
            S1[a, b] = S1[b, a] = 0.5 * (S[a, b] + S[b, a]) if seen[a] and seen[b] else 0.0
        if not seen[a]:
            S1[a, a] = 1.0
    factor(S1, U)
    for i in range(N):
        low[N, i] = X[i]
        for j in range(i + 1):
            low[i, j] = 0.5 * (P[i, j] + P[j, i])
    distance, log = 0.0, 0.0
    for a in range(m):
        white[a] = nu[a]
        if seen[a]:
            for b in range(a):
                white[a] -= U[b, a] * white[b]
            white[a] /= U[a, a]
            distance += white[a] * white[a]
            log -= 0.5 * LOG_2PI + np.log(U[a, a])
        for c in range(0, cross.shape[1], LANES):
            total = load(cross, a, c) if seen[a] else zeros()
            for b in range(a):
                total = minus(total, U[b, a], load(cross, b, c))
            total = over(total, U[a, a])
            store(cross, a, c, total)
            store(low, N, c, plus(load(low, N, c), white[a], total))
    for i in range(N):
        X1[i] = low[N, i]
        for c in range(0, i + 1, LANES):
            total = load(low, i, c)
            for a in range(m):
                total = minus(total, cross[a, i], load(cross, a, c))
            store(low, i, c, total)
        for j in range(i + 1):
            P1[i, j] = P1[j, i] = low[i, j]
    return distance, log - 0.5 * distance

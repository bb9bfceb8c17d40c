"""The linear algebra of the compiled Gaussian step, for LANES episodes side by side.

Entry (i, j) of a matrix with N columns is a vector, row i N + j of an array (entries, LANES): lane by lane the numbers are
those of one episode alone, in an order that no batch changes. Where fewer episodes are left, the last one fills up.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.integration import LANES
from fdi_gym.kernels import helper
from fdi_gym.vectors import above, choose, filled, load, root, store, zeros

LOG_2PI = float(np.log(2 * np.pi))
JITTER, RETRIES = 1e-14, 7  # added to the diagonal where the factorisation fails, times 100 at each retry


@helper
def board_vectors(given, first, shared, into):
    """Vectors (rows, m) of the episodes from `first` on, of which `shared` in a row have the same: into (m, LANES)."""
    for lane in range(LANES):
        e = min(first + lane, given.shape[0] * shared - 1) // shared
        for i in range(given.shape[1]):
            into[i, lane] = given[e, i]


@helper
def board_matrices(given, first, into):
    """Matrices (n, r, c) of the episodes from `first` on: into (r c, LANES)."""
    for lane in range(LANES):
        e = min(first + lane, given.shape[0] - 1)
        for i in range(given.shape[1]):
            for j in range(given.shape[2]):
                into[i * given.shape[2] + j, lane] = given[e, i, j]


@helper
def board_one(given, lane, columns, into):
    """The first columns of a matrix (r, ...) of one episode, into its lane of (r columns, LANES)."""
    for i in range(given.shape[0]):
        for j in range(columns):
            into[i * columns + j, lane] = given[i, j]


@helper
def disembark(A, n, lane, into):
    """The matrix (n n) of a lane into (n, n)."""
    for i in range(n):
        for j in range(n):
            into[i, j] = A[i * n + j, lane]


@helper
def put_ashore(e, lane, P, seen, distances, U, X, nu, S, X1, P1, nu1, S1, distance, log):
    """Episode e of what `correct` has left in a lane, with the log density of what its sensors read; how many reported."""
    N, m, count, density = X.shape[0], nu.shape[0], 0, 0.0
    for i in range(N):
        X1[e, i] = X[i, lane]
        for j in range(i + 1):
            P1[e, i, j] = P1[e, j, i] = P[i * N + j, lane]
    for a in range(m):
        nu1[e, a] = nu[a, lane]
        for b in range(a + 1):
            S1[e, a, b] = S1[e, b, a] = S[a * m + b, lane]
        if seen[a, lane] > 0.0:
            count += 1
            density -= 0.5 * LOG_2PI + np.log(U[a * m + a, lane])
    distance[e] = distances[0, lane]
    log[e] = density - 0.5 * distance[e]
    return count


@helper
def factor(P, n, U):
    """P = U' U with the lower triangle of P (n n); jitter only where it fails without, NaN where no jitter helps."""
    jitter, bad = zeros(), zeros()
    for attempt in range(RETRIES + 1):
        bad = zeros()
        for i in range(n):
            for j in range(i, n):
                store(U, i * n + j, 0, load(P, j * n + i, 0))
            store(U, i * n + i, 0, load(U, i * n + i, 0) + jitter)
        for k in range(n):
            pivot = load(U, k * n + k, 0)
            bad = choose(pivot, bad, 1.0)  # also where it is no number
            pivot = root(pivot)
            store(U, k * n + k, 0, pivot)
            for j in range(k + 1, n):
                store(U, k * n + j, 0, load(U, k * n + j, 0) / pivot)
            for i in range(k + 1, n):
                over = load(U, k * n + i, 0)
                for j in range(i, n):
                    store(U, i * n + j, 0, load(U, i * n + j, 0) - over * load(U, k * n + j, 0))
        if not above(bad):
            return
        jitter = choose(bad, JITTER * 100.0**attempt, jitter)
    for i in range(n):
        for j in range(i, n):
            store(U, i * n + j, 0, choose(bad, np.nan, load(U, i * n + j, 0)))


@helper
def entries_of(F, m, N, where, many):
    """Which columns of each row of F (m N) are not 0 in any lane: the first many[a] of where (m, N)."""
    for a in range(m):
        many[a] = 0
        for j in range(N):
            if filled(load(F, a * N + j, 0)):
                where[a, many[a]] = j
                many[a] += 1


@helper
def through_matrix(F, P, m, N, where, many, cross, cov):
    """cross = F P (m N) and the lower triangle of cov = F P F' (m m) for F (m N), most of which may be 0 (`entries_of`)."""
    for a in range(m):
        for c in range(N):
            total = zeros()
            for s in range(many[a]):
                j = where[a, s]
                total += load(F, a * N + j, 0) * load(P, j * N + c, 0)
            store(cross, a * N + c, 0, total)
    for a in range(m):
        for b in range(a + 1):
            total = zeros()
            for s in range(many[b]):
                j = where[b, s]
                total += load(cross, a * N + j, 0) * load(F, b * N + j, 0)
            store(cov, a * m + b, 0, total)


@helper
def correct(X, P, y, seen, mean, S, cross, m, N, U, white, X1, nu, S1):
    """The Kalman correction by the sensors that reported (seen > 0): nu' S^-1 nu.

    A sensor that did not report has nu = 0, no covariance with anything and S = 1. X1 is the new mean, and of P (N N) the
    lower triangle the new covariance's; S1 has a lower triangle, S1 = U' U, white becomes U'^-1 nu and cross (m N)
    U'^-1 cross.
    """
    for a in range(m):
        there = load(seen, a, 0)
        store(nu, a, 0, choose(there, load(y, a, 0) - load(mean, a, 0), 0.0))
        for b in range(a + 1):
            both = choose(there, load(seen, b, 0), 0.0)
            store(S1, a * m + b, 0, choose(both, 0.5 * (load(S, a * m + b, 0) + load(S, b * m + a, 0)), 0.0))
        store(S1, a * m + a, 0, choose(there, load(S1, a * m + a, 0), 1.0))
    factor(S1, m, U)
    distance = zeros()
    for i in range(N):
        store(X1, i, 0, load(X, i, 0))
    for a in range(m):
        there, pivot, total = load(seen, a, 0), load(U, a * m + a, 0), load(nu, a, 0)
        for b in range(a):
            total -= load(U, b * m + a, 0) * load(white, b, 0)
        total = choose(there, total / pivot, 0.0)
        store(white, a, 0, total)
        distance += total * total
        for i in range(N):
            found = load(cross, a * N + i, 0)
            for b in range(a):
                found -= load(U, b * m + a, 0) * load(cross, b * N + i, 0)
            found = choose(there, found / pivot, 0.0)
            store(cross, a * N + i, 0, found)
            store(X1, i, 0, load(X1, i, 0) + total * found)
    for i in range(N):
        for j in range(i + 1):
            left = 0.5 * (load(P, i * N + j, 0) + load(P, j * N + i, 0))
            for a in range(m):
                left -= load(cross, a * N + i, 0) * load(cross, a * N + j, 0)
            store(P, i * N + j, 0, left)
    return distance

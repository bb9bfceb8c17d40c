"""The linear algebra of the compiled Gaussian step, for LANES episodes side by side.

Entry (i, j) of a matrix with N columns is a vector, row i N + j of an array (entries, LANES): lane by lane the numbers are
those of one episode alone, in an order that no batch changes. Where fewer episodes are left, the last one fills up.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.integration import LANES
from fdi_gym.kernels import helper
from fdi_gym.vectors import above, choose, filled, load, root, store, zeros

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
def take_vector(A, lane, into):
    """The vector of a lane into (n,)."""
    for i in range(into.size):
        into[i] = A[i, lane]


@helper
def take_matrix(A, lane, into):
    """The matrix of a lane into (r, c)."""
    for i in range(into.shape[0]):
        for j in range(into.shape[1]):
            into[i, j] = A[i * into.shape[1] + j, lane]


@helper
def in_turn(first, rows, whose):
    """Which of so many rows, which serve episodes in turn, are the lanes' (LANES,), the first lane being episode `first`."""
    for lane in range(LANES):
        whose[lane] = (first + lane) % rows


@helper
def entry(given, whose, at, room):
    """Entry `at` of vectors (rows, n) or matrices (rows, r, c), each lane having its own (`in_turn`); room (1, LANES)."""
    if given.shape[0] == 1:
        return zeros() + given[0][at]
    for lane in range(LANES):
        room[0, lane] = given[whose[lane]][at]
    return load(room, 0, 0)


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
def through_rows(H, P, cross, cov):
    """`through_matrix` for a matrix H (m, N) that is the same for all."""
    m, N = H.shape
    for a in range(m):
        for c in range(N):
            total = zeros()
            for j in range(N):
                if H[a, j] != 0.0:
                    total += load(P, j * N + c, 0) * H[a, j]
            store(cross, a * N + c, 0, total)
    for a in range(m):
        for b in range(a + 1):
            total = zeros()
            for j in range(N):
                if H[b, j] != 0.0:
                    total += load(cross, a * N + j, 0) * H[b, j]
            store(cov, a * m + b, 0, total)


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
def predicted(mean, cross, cov, Q, whose, limit, X, P, room):
    """X and P become those one sample later: what f moves has mean and covariance cov, and cross with the rest, which stays.

    Q (rows, N, N) comes upon it, `whose` row being a lane's; a variance beyond its limit is shrunk to it.
    """
    n_x, N = mean.shape[0], X.shape[0]
    for i in range(N):
        if i < n_x:
            store(X, i, 0, load(mean, i, 0))
        for j in range(i + 1):
            if i < n_x:
                total = load(cov, i * n_x + j, 0)
            elif j < n_x:
                total = load(cross, j * N + i, 0)
            else:
                total = (load(P, i * N + j, 0) + load(P, j * N + i, 0)) * 0.5
            total += entry(Q, whose, (i, j), room)
            store(P, i * N + j, 0, total)
            store(P, j * N + i, 0, total)
    for i in range(N):
        variance = load(P, i * N + i, 0)
        if above(variance - limit[i]):
            shrink = choose(variance - limit[i], root((zeros() + limit[i]) / variance), 1.0)
            for j in range(N):
                store(P, i * N + j, 0, load(P, i * N + j, 0) * shrink)
                store(P, j * N + i, 0, load(P, j * N + i, 0) * shrink)


@helper
def correct(X, P, y, seen, mean, S, cross, U, white, nu, S1):
    """X and P become those after the sensors that reported (seen > 0), with the moments mean, S and cross (m N).

    Returns nu' S^-1 nu. A sensor that did not report has nu = 0, no covariance with anything and S = 1. S1 = U' U,
    white becomes U'^-1 nu and cross U'^-1 cross; of U there is the upper triangle.
    """
    m, N, distance = mean.shape[0], X.shape[0], zeros()
    for a in range(m):
        there = load(seen, a, 0)
        store(nu, a, 0, choose(there, load(y, a, 0) - load(mean, a, 0), 0.0))
        for b in range(a + 1):
            both = choose(there, load(seen, b, 0), 0.0)
            total = choose(both, (load(S, a * m + b, 0) + load(S, b * m + a, 0)) * 0.5, 0.0)
            store(S1, a * m + b, 0, total)
            store(S1, b * m + a, 0, total)
        store(S1, a * m + a, 0, choose(there, load(S1, a * m + a, 0), 1.0))
    factor(S1, m, U)
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
            store(X, i, 0, load(X, i, 0) + total * found)
    for i in range(N):
        for j in range(i + 1):
            left = (load(P, i * N + j, 0) + load(P, j * N + i, 0)) * 0.5
            for a in range(m):
                left -= load(cross, a * N + i, 0) * load(cross, a * N + j, 0)
            store(P, i * N + j, 0, left)
            store(P, j * N + i, 0, left)
    return distance

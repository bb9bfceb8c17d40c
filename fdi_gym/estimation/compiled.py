"""Small linear algebra for many systems at once, compiled: what NumPy's stacked routines do too slowly or not at all."""

import numpy as np
from numba import float64, void

from fdi_gym.kernels import M, compiled


@compiled(void(float64[:, :, ::1], float64[:, :, ::1], float64[:, :, ::1]))
def solve(A, B, out):
    """out[i] = A[i]^-1 B[i]: Gaussian elimination with partial pivoting, for many small systems; not finite if singular.

    A LAPACK call per matrix costs about a microsecond before it begins, several times what a 4 x 4 system needs.
    """
    n, m, width = B.shape
    a = np.empty((m, m))
    for i in range(n):
        for r in range(m):
            for c in range(m):
                a[r, c] = A[i, r, c]
            for c in range(width):
                out[i, r, c] = B[i, r, c]
        for k in range(m):
            pivot = k
            for r in range(k + 1, m):
                if abs(a[r, k]) > abs(a[pivot, k]):
                    pivot = r
            if pivot != k:
                for c in range(k, m):
                    a[k, c], a[pivot, c] = a[pivot, c], a[k, c]
                for c in range(width):
                    out[i, k, c], out[i, pivot, c] = out[i, pivot, c], out[i, k, c]
            for r in range(k + 1, m):
                factor = a[r, k] / a[k, k]
                for c in range(k + 1, m):
                    a[r, c] -= factor * a[k, c]
                for c in range(width):
                    out[i, r, c] -= factor * out[i, k, c]
        for r in range(m - 1, -1, -1):
            for c in range(width):
                total = out[i, r, c]
                for k in range(r + 1, m):
                    total -= a[r, k] * out[i, k, c]
                out[i, r, c] = total / a[r, r]


@compiled(void(float64[:, :, :, ::1], float64[:, :, ::1], M, M, float64[:, :, ::1], M))
def box_minimum(G, g, low, high, m, value):
    """value[i, h] = min of m' G m - 2 g' m over low[h] <= m <= high[h], for positive definite G[i, h]; m is where.

    Exact: at the minimum some coordinates are free and the others at a bound. All such choices are tried.
    """
    n, sets, f = g.shape
    a, b, at, where = np.empty((f, f)), np.empty(f), np.zeros(f, np.int64), np.empty(f, np.int64)
    tried = np.empty(f)
    choices = 3**f
    for i in range(n):
        for h in range(sets):
            value[i, h] = np.inf
            for choice in range(choices):
                rest, free = choice, 0
                for j in range(f):
                    at[j], rest = rest % 3, rest // 3
                    if at[j] == 0:
                        where[free] = j
                        free += 1
                    else:
                        tried[j] = low[h, j] if at[j] == 1 else high[h, j]
                for r in range(free):
                    b[r] = g[i, h, where[r]]
                    for j in range(f):
                        if at[j] != 0:
                            b[r] -= G[i, h, where[r], j] * tried[j]
                    for c in range(free):
                        a[r, c] = G[i, h, where[r], where[c]]
                for k in range(free):  # positive definite: no pivoting
                    for r in range(k + 1, free):
                        factor = a[r, k] / a[k, k]
                        for c in range(k, free):
                            a[r, c] -= factor * a[k, c]
                        b[r] -= factor * b[k]
                inside = True
                for r in range(free - 1, -1, -1):
                    for c in range(r + 1, free):
                        b[r] -= a[r, c] * b[c]
                    b[r] /= a[r, r]
                    tried[where[r]] = b[r]
                    # what rounding puts a hair outside is inside; the rest is another choice's business
                    if b[r] < low[h, where[r]] - 1e-12 or b[r] > high[h, where[r]] + 1e-12:
                        inside = False
                if inside:
                    total = 0.0
                    for r in range(f):
                        total -= 2.0 * g[i, h, r] * tried[r]
                        for c in range(f):
                            total += tried[r] * G[i, h, r, c] * tried[c]
                    if total < value[i, h]:
                        value[i, h] = total
                        for j in range(f):
                            m[i, h, j] = tried[j]
                    if free == f:
                        break  # the minimum of all m lies inside

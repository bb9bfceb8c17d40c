"""Small linear algebra for many systems at once, compiled: what NumPy's stacked routines do too slowly or not at all."""

import numpy as np
from numba import float64, void

from fdi_gym.kernels import compiled, floats, helper


@helper
def eliminate(a, b):
    """b becomes a^-1 b: Gaussian elimination with partial pivoting; not finite if a is singular. a is used up.

    A LAPACK call per matrix costs about a microsecond before it begins, several times what a 4 x 4 system needs.
    """
    m, width = b.shape
    for k in range(m):
        pivot = k
        for r in range(k + 1, m):
            if abs(a[r, k]) > abs(a[pivot, k]):
                pivot = r
        if pivot != k:
            for c in range(k, m):
                a[k, c], a[pivot, c] = a[pivot, c], a[k, c]
            for c in range(width):
                b[k, c], b[pivot, c] = b[pivot, c], b[k, c]
        for r in range(k + 1, m):
            factor = a[r, k] / a[k, k]
            for c in range(k + 1, m):
                a[r, c] -= factor * a[k, c]
            for c in range(width):
                b[r, c] -= factor * b[k, c]
    for r in range(m - 1, -1, -1):
        for c in range(width):
            total = b[r, c]
            for k in range(r + 1, m):
                total -= a[r, k] * b[k, c]
            b[r, c] = total / a[r, r]


@compiled(void(float64[:, :, ::1], float64[:, :, ::1], float64[:, :, ::1]))
def solve(A, B, out):
    """out[i] = A[i]^-1 B[i] for many small systems."""
    n, m, width = B.shape
    a = floats((m, m))
    for i in range(n):
        for r in range(m):
            for c in range(m):
                a[r, c] = A[i, r, c]
            for c in range(width):
                out[i, r, c] = B[i, r, c]
        eliminate(a, out[i])


@helper
def stationary(G, g, low, high, at, f, a, where, m):
    """m at the minimum of m' G m - 2 g' m with the coordinates at[j] = 1 at low[j] and 2 at high[j]; the others are free."""
    free = 0
    for j in range(f):
        if at[j] == 0:
            where[free] = j
            free += 1
        else:
            m[j] = low[j] if at[j] == 1 else high[j]
    for r in range(free):
        a[r, f] = g[where[r]]
        for j in range(f):
            if at[j] != 0:
                a[r, f] -= G[where[r], j] * m[j]
        for c in range(free):
            a[r, c] = G[where[r], where[c]]
    for k in range(free):  # positive definite: no pivoting
        for r in range(k + 1, free):
            factor = a[r, k] / a[k, k]
            for c in range(k, free):
                a[r, c] -= factor * a[k, c]
            a[r, f] -= factor * a[k, f]
    for r in range(free - 1, -1, -1):
        for c in range(r + 1, free):
            a[r, f] -= a[r, c] * a[c, f]
        a[r, f] /= a[r, r]
        m[where[r]] = a[r, f]


@helper
def quadratic_form(G, g, f, m):
    """m' G m - 2 g' m."""
    total = 0.0
    for r in range(f):
        total -= 2.0 * g[r] * m[r]
        for c in range(f):
            total += m[r] * G[r, c] * m[c]
    return total


SLACK = 1e-12  # what rounding puts a hair outside is inside


@helper
def box_minimum(G, g, low, high, f, a, at, where, tried, m):
    """Minimum of m' G m - 2 g' m over low <= m <= high, for positive definite G (f, f) and f > 0; m is where.

    Exact: at the minimum some coordinates are free and the others at a bound. From the free minimum on, what lies outside
    is put to its bound and what a bound pushes inwards is freed, until nothing changes; where that does not end, all such
    choices are tried. Without bound, and m 0, where the free minimum is no number.

    a (f, f + 1), at, where (f,) int and tried (f,) are room to work in.
    """
    if f == 1:  # most labels
        m[0] = g[0] / G[0, 0]
        if m[0] < low[0] - SLACK:
            m[0] = low[0]
        elif m[0] > high[0] + SLACK:
            m[0] = high[0]
        value = quadratic_form(G, g, f, m)
        if value == value:
            return value
    for j in range(f):
        at[j] = 0
    for _ in range(2 * f + 2):
        stationary(G, g, low, high, at, f, a, where, m)
        changed = False
        for j in range(f):
            if at[j] == 0:
                if m[j] < low[j] - SLACK:
                    at[j], changed = 1, True
                elif m[j] > high[j] + SLACK:
                    at[j], changed = 2, True
            else:
                slope = -g[j]
                for c in range(f):
                    slope += G[j, c] * m[c]
                if (at[j] == 1 and slope < 0.0) or (at[j] == 2 and slope > 0.0):
                    at[j], changed = 0, True
        if not changed:
            value = quadratic_form(G, g, f, m)
            if value == value:
                return value
            break
    best = np.inf
    for j in range(f):
        m[j] = 0.0
    for choice in range(3**f):
        rest = choice
        for j in range(f):
            at[j], rest = rest % 3, rest // 3
        stationary(G, g, low, high, at, f, a, where, tried)
        inside = True
        for j in range(f):
            if tried[j] < low[j] - SLACK or tried[j] > high[j] + SLACK:
                inside = False
        if inside:
            value = quadratic_form(G, g, f, tried)
            if value < best:
                best = value
                for j in range(f):
                    m[j] = tried[j]
            if choice == 0:
                break  # the minimum of all m lies inside
    return best

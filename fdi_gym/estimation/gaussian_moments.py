"""What happens to one episode in the compiled Gaussian step: moments through f and h, and the correction.

A function g (f or h of the augmented model) meets X ~ N(X, P) at 2 N + 1 points, the mean and two for each direction j.
Half the difference of a pair over its step is first[j], its second difference second[j]; with them the three rules are

    extended             directions e_j          cross' = F P,   cov = F P F',   F = first', mean = g(X)
    unscented            columns of P = L L'     cross' = D1 L', cov = D1 D1' + a D2 D2' - c d d', mean = g(X) + d
    central difference   the same

where D1 = first', D2 = second', d the sum of the second differences over 2 h^2, and h^2 = N + 2, a = 1 / (4 h^2), c = 1
give the unscented transform with lambda = 2, h^2 = 3, a = (h^2 - 1) / (4 h^4), c = 0 Stirling's interpolation. f leaves
[m; d] alone, so that their covariance stays and their covariance with the moved x is a part of cross.

Vectors of an episode are rows in C order and inner loops run along them: that is what the compiler makes vectors of,
in an order that no batch changes. Matrices are kept transposed (`first`, `cross`, the upper factor) for that reason.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.estimation.gaussian_points import (
    DISTURBANCES,
    ENTRIES,
    EXTENDED,
    KNOWN,
    OWN,
    SIZES,
    STATES,
    SUBSTEPS,
    TANGENT,
    THETA,
    enters,
    factor,
    moments_of_points,
    pass_points,
    put_magnitudes,
    spread,
    squared_step,
)
from fdi_gym.kernels import helper
from fdi_gym.tangent import tangent_at

LOG_2PI = float(np.log(2.0 * np.pi))


@helper
def through_matrix(F, P, cross, cov):
    """cross = F P and cov = F P F' for F (m, N), most of which may be 0."""
    m, N = F.shape
    for a in range(m):
        for i in range(N):
            cross[a, i] = 0.0
        for j in range(N):
            if F[a, j] != 0.0:
                for i in range(N):
                    cross[a, i] += F[a, j] * P[j, i]
    for b in range(m):
        for a in range(b, m):
            cov[a, b] = 0.0
        for j in range(N):
            if F[b, j] != 0.0:
                for a in range(b, m):
                    cov[a, b] += cross[a, j] * F[b, j]
        for a in range(b, m):
            cov[b, a] = cov[a, b]


@helper
def through(rule, moving, integers, reals, step, offset, direction, t, X, P, u, known, mean, cross, cov):
    """N(X, P) through f (moving) or h: mean (m,), cov (m, m) and cross (m, N) with what went in."""
    N, m = X.size, mean.size
    points, values = np.empty((2 * N + 1, N)), np.empty((2 * N + 1, m))
    if rule != EXTENDED:
        U, first = np.empty((N, N)), np.empty((N, m))
        factor(P, U)
        spread(X, U, np.sqrt(squared_step(rule, N)), points)
        pass_points(moving, integers, reals, offset, direction, t, points, u, known, values)
        low = integers[STATES] if moving else 0  # of f, nobody asks for the covariance with x before
        moments_of_points(rule, U, low, values, first, mean, cross, cov)
        return
    moved = 0  # columns that are not 0
    for j in range(N):
        if enters(moving, integers, direction, j):
            for i in range(N):
                points[1 + 2 * moved, i] = points[2 + 2 * moved, i] = X[i]
            points[1 + 2 * moved, j] += step[j]
            points[2 + 2 * moved, j] -= step[j]
            moved += 1
    points[0] = X
    pass_points(moving, integers, reals, offset, direction, t, points[: 1 + 2 * moved], u, known, values)
    F, moved = np.zeros((m, N)), 0
    for j in range(N):
        if enters(moving, integers, direction, j):
            for a in range(m):
                F[a, j] = (values[1 + 2 * moved, a] - values[2 + 2 * moved, a]) * (0.5 / step[j])
            moved += 1
    for a in range(m):
        mean[a] = values[0, a]
    through_matrix(F, P, cross, cov)


@helper
def linearised(integers, offset, direction, plant, X, u, known, F, mean):
    """mean = f(X) and F (n_x, N) its Jacobian, for a plant x+ = g + A x + B u + G d + (E[0] + sum u_k E[1 + k]) dtheta.

    plant (n_x, ...) has the columns [g, A, B, G, E[0], E[1], ...].
    """
    n_x, n_u, n_D, p, n_d, n_m = F.shape[0], u.size, known.size, offset.size, integers[DISTURBANCES], direction.shape[1]
    B = 1 + n_x
    G = B + n_u
    E = G + n_D
    for a in range(n_x):
        mean[a] = plant[a, 0]
        for k in range(n_u):
            mean[a] += plant[a, B + k] * u[k]
        for j in range(n_D):
            mean[a] += plant[a, G + j] * known[j]
        for j in range(n_x):
            F[a, j] = plant[a, 1 + j]
        for j in range(n_m):
            F[a, n_x + j] = 0.0
        for e in range(p):
            gain = plant[a, E + e]
            for k in range(n_u):
                gain += u[k] * plant[a, E + (1 + k) * p + e]
            mean[a] += gain * offset[e]
            for j in range(n_m):
                F[a, n_x + j] += gain * direction[e, j]
        for j in range(n_d):
            i = integers[SIZES + p + j]
            F[a, n_x + n_m + j] = plant[a, G + i]
            mean[a] -= plant[a, G + i] * known[i]  # X has it
        for j in range(F.shape[1]):
            mean[a] += F[a, j] * X[j]


@helper
def differentiated(integers, reals, step, offset, direction, t, X, u, known, F, mean):
    """mean = f(X) and F (n_x, N) its Jacobian, of a plant that says its derivatives."""
    n, n_theta, own, n_D = integers[STATES], integers[THETA], integers[OWN], integers[KNOWN]
    p, n_d, n_m, N = integers[ENTRIES], integers[DISTURBANCES], direction.shape[1], step.size
    now, d = reals[1:].copy(), known.copy()
    put_magnitudes(integers, offset, direction, X, reals[1:], now)
    n_p = now.size - n_theta
    L, used, count = np.zeros((own + n_D + n_p, N)), np.empty(p + n_d, np.int64), 0
    for e in range(p):
        i = integers[SIZES + e]
        if i < own or i >= n_theta:  # else it is a fault of a sensor
            used[count] = i if i < own else own + n_D + i - n_theta
            for j in range(n_m):
                L[used[count], n + j] = direction[e, j]
            count += 1
    for j in range(n_d):
        i = integers[SIZES + p + j]
        d[i] = X[n + n_m + j]
        used[count] = own + i
        L[own + i, n + n_m + j] = 1.0
        count += 1
    for i in range(n):
        mean[i] = X[i]
        for j in range(N):
            F[i, j] = 1.0 if i == j else 0.0
    tangent = tangent_at(integers[TANGENT])
    J, work, k = np.empty(n * (n + own + n_D + n_p)), np.empty((3, n, N)), np.empty((5, n))
    substeps = integers[SUBSTEPS]
    tangent(t, reals[0], substeps, mean, u, now[:own], d, now[n_theta:], L, used[:count], step, F, J, work, k)


@helper
def correct_episode(X, P, y, seen, mean, S, cross, U, white, X1, P1, nu, S1):
    """The Kalman correction of one episode by the sensors that reported: nu' S^-1 nu, and the log density of what they read.

    A sensor that did not report has nu = 0, no covariance with anything and S = 1. S1 = U' U; `white` becomes U'^-1 nu
    and cross (m, N) U'^-1 cross.
    """
    m, N = cross.shape
    for a in range(m):
        nu[a] = y[a] - mean[a] if seen[a] else 0.0
        for b in range(m):
            S1[a, b] = 0.5 * (S[a, b] + S[b, a]) if seen[a] and seen[b] else 0.0
        if not seen[a]:
            S1[a, a] = 1.0
    factor(S1, U)
    for i in range(N):
        X1[i] = X[i]
        for j in range(i + 1):
            P1[i, j] = 0.5 * (P[i, j] + P[j, i])
    distance, log = 0.0, 0.0
    for a in range(m):
        white[a] = nu[a]
        if not seen[a]:
            for i in range(N):
                cross[a, i] = 0.0
            continue
        for b in range(a):
            white[a] -= U[b, a] * white[b]
            for i in range(N):
                cross[a, i] -= U[b, a] * cross[b, i]
        white[a] /= U[a, a]
        for i in range(N):
            cross[a, i] /= U[a, a]
        for i in range(N):
            X1[i] += white[a] * cross[a, i]
            for j in range(i + 1):
                P1[i, j] -= cross[a, i] * cross[a, j]
        distance += white[a] * white[a]
        log -= 0.5 * LOG_2PI + np.log(U[a, a])
    for i in range(N):
        for j in range(i):
            P1[j, i] = P1[i, j]
    return distance, log - 0.5 * distance

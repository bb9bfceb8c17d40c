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

from fdi_gym.integration import interval
from fdi_gym.kernels import helper, map_at, project_at

EXTENDED, UNSCENTED, CENTRAL_DIFFERENCE = 0, 1, 2
LOG_2PI = float(np.log(2.0 * np.pi))
JITTER, RETRIES = 1e-14, 7  # added to the diagonal where the factorisation fails, times 100 at each retry
SIZES = 13  # integers before the lists of positions


@helper
def pass_points(moving, integers, reals, offset, direction, t, points, u, known, values):
    """f (moving) or h of points (M, N) of an episode on the line (offset (p,), direction (p, n_m)).

    That is the state one sample later, or what the chosen sensors read.
    """
    dynamics, output, project = map_at(integers[0]), map_at(integers[1]), project_at(integers[2])
    substeps, n_x, n_y, n_theta = integers[3], integers[4], integers[5], integers[6]
    p, n_d, m, own = integers[8], integers[9], integers[10], integers[11]
    n_m = direction.shape[1]
    entries, rest = integers[SIZES : SIZES + p], integers[SIZES + p :]
    disturbances, sensors = rest[:n_d], rest[n_d:]
    dt, nominal = reals[0], reals[1:]
    now = nominal.copy()
    theta, physical = now[:n_theta], now[n_theta:]
    x, y, theta_now, still = np.empty(n_x), np.empty(n_y), np.empty(own), np.zeros(own)
    theta_p = theta[:own]  # the rest are faults of the sensors
    d = known.copy()
    k1, k2, k3, k4, z = np.empty(n_x), np.empty(n_x), np.empty(n_x), np.empty(n_x), np.empty(n_x)
    for i in range(points.shape[0]):
        for e in range(p):
            now[entries[e]] = nominal[entries[e]]
        for e in range(p):
            deviation = offset[e]
            for j in range(n_m):
                deviation += direction[e, j] * points[i, n_x + j]
            now[entries[e]] += deviation
        for j in range(n_d):
            d[disturbances[j]] = points[i, n_x + n_m + j]
        for j in range(n_x):
            x[j] = points[i, j]
        if moving:
            interval(
                dynamics, project, t, dt, substeps, x, u, False, theta_p, still, still, d, physical, theta_now,
                k1, k2, k3, k4, z,
            )  # fmt: skip
            for j in range(n_x):
                values[i, j] = x[j]
        else:
            output(t, x, u, theta_p, d, physical, y)
            if own < n_theta:  # gains, then biases
                for j in range(n_y):
                    y[j] += y[j] * theta[own + j] + theta[own + n_y + j]
            for j in range(m):
                values[i, j] = y[sensors[j]]


@helper
def factor(P, U):
    """P = U' U with the lower triangle of P; jitter only where it fails without, NaN where no jitter helps."""
    n = P.shape[0]
    jitter = 0.0
    for attempt in range(RETRIES + 1):
        for i in range(n):
            for j in range(i, n):
                U[i, j] = P[j, i]
            U[i, i] += jitter
        definite = True
        for k in range(n):
            if not U[k, k] > 0.0:  # also where it is no number
                definite = False
                break
            U[k, k] = np.sqrt(U[k, k])
            for j in range(k + 1, n):
                U[k, j] /= U[k, k]
            for i in range(k + 1, n):
                factor = U[k, i]
                for j in range(i, n):
                    U[i, j] -= factor * U[k, j]
        if definite:
            return
        jitter = JITTER * 100.0**attempt
    for i in range(n):
        for j in range(i, n):
            U[i, j] = np.nan


@helper
def squared_step(rule, N):
    """h^2 of the rules with points along the columns of a factor of P."""
    return N + 2.0 if rule == UNSCENTED else 3.0


@helper
def spread(X, U, h, points):
    """The points (2 N + 1, N): X, and X plus and minus h times each row of the upper triangle U."""
    N = X.size
    for i in range(N):
        points[0, i] = X[i]
    for j in range(N):
        for i in range(N):
            offset = h * U[j, i] if i >= j else 0.0
            points[1 + j, i] = X[i] + offset
            points[1 + N + j, i] = X[i] - offset


@helper
def moments_of_points(rule, U, low, values, first, mean, cross, cov):
    """Mean (m,), cov (m, m) and cross (m, N) from `low` on of the values (2 N + 1, m) at points that a factor has spread.

    Into values[1 : N + 1] go the second differences, into first (N, m) the halved first ones.
    """
    (N, m), h2 = first.shape, squared_step(rule, first.shape[0])
    half, weight = 0.5 / np.sqrt(h2), 1.0 / (4.0 * h2) if rule == UNSCENTED else (h2 - 1.0) / (4.0 * h2 * h2)
    for a in range(m):
        mean[a] = 0.0
        for i in range(N):
            cross[a, i] = 0.0
        for b in range(m):
            cov[a, b] = 0.0
    second = values[1 : N + 1]
    for j in range(N):
        for a in range(m):
            first[j, a] = (values[1 + j, a] - values[1 + N + j, a]) * half
            second[j, a] = values[1 + j, a] + values[1 + N + j, a] - 2.0 * values[0, a]
            mean[a] += second[j, a]
    for a in range(m):
        mean[a] /= 2.0 * h2
        for j in range(N):
            for i in range(max(j, low), N):
                cross[a, i] += first[j, a] * U[j, i]
            weighed = weight * second[j, a]
            for b in range(a + 1):
                cov[a, b] += first[j, a] * first[j, b] + weighed * second[j, b]
        if rule == UNSCENTED:
            for b in range(a + 1):
                cov[a, b] -= mean[a] * mean[b]
    for a in range(m):
        mean[a] += values[0, a]
        for b in range(a):
            cov[b, a] = cov[a, b]


@helper
def enters(moving, integers, direction, j):
    """Whether f (moving) or h depends on entry j of X at all: a magnitude may move the sensors alone, or nothing."""
    n_x, n_theta, p, own = integers[4], integers[6], integers[8], integers[11]
    if j < n_x or j >= n_x + direction.shape[1]:
        return True
    for e in range(p):
        sensors = own <= integers[SIZES + e] < n_theta
        if direction[e, j - n_x] != 0.0 and not (moving and sensors):
            return True
    return False


@helper
def through(rule, moving, integers, reals, step, offset, direction, t, X, P, u, known, mean, cross, cov):
    """N(X, P) through f (moving) or h: mean (m,), cov (m, m) and cross (m, N) with what went in."""
    N, m = X.size, mean.size
    points, values, first = np.empty((2 * N + 1, N)), np.empty((2 * N + 1, m)), np.empty((N, m))
    if rule != EXTENDED:
        U = np.empty((N, N))
        factor(P, U)
        spread(X, U, np.sqrt(squared_step(rule, N)), points)
        pass_points(moving, integers, reals, offset, direction, t, points, u, known, values)
        low = integers[4] if moving else 0  # of f, nobody asks for the covariance with x before
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
    for a in range(m):
        mean[a] = values[0, a]
        for i in range(N):
            cross[a, i] = 0.0
    moved = 0
    for j in range(N):
        for a in range(m):
            first[j, a] = 0.0
        if enters(moving, integers, direction, j):
            for a in range(m):
                first[j, a] = (values[1 + 2 * moved, a] - values[2 + 2 * moved, a]) * (0.5 / step[j])
                for i in range(N):
                    cross[a, i] += first[j, a] * P[j, i]
            moved += 1
    for a in range(m):
        for b in range(a + 1):
            cov[a, b] = 0.0
        for i in range(N):
            for b in range(a + 1):
                cov[a, b] += cross[a, i] * first[i, b]
        for b in range(a):
            cov[b, a] = cov[a, b]


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
def linearised(integers, offset, direction, plant, X, u, known, F, mean):
    """mean = f(X) and F (n_x, N) its Jacobian, for a plant x+ = g + A x + B u + G d + (E[0] + sum u_k E[1 + k]) dtheta.

    plant (n_x, ...) has the columns [g, A, B, G, E[0], E[1], ...].
    """
    n_x, n_u, n_D, p, n_d, n_m = F.shape[0], u.size, known.size, offset.size, integers[9], direction.shape[1]
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
        for j in range(N):
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
            for j in range(N):
                P1[i, j] -= cross[a, i] * cross[a, j]
        distance += white[a] * white[a]
        log -= 0.5 * LOG_2PI + np.log(U[a, a])
    return distance, log - 0.5 * distance

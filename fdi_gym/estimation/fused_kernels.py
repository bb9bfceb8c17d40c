"""The Gaussian step, compiled: everything of `fused` that happens per episode, for any plant, by address.

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

import numba
import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.kernels import M, V, _advance, _project_at, compiled, map_at

EXTENDED, UNSCENTED, CENTRAL_DIFFERENCE = 0, 1, 2
LOG_2PI = float(np.log(2.0 * np.pi))
JITTER, RETRIES = 1e-14, 7  # added to the diagonal where the factorisation fails, times 100 at each retry
SIZES = 12  # integers before the lists of positions

I1, B2, M3 = int64[::1], boolean[:, ::1], float64[:, :, ::1]
# integers, reals, step, offset, direction: the constants of a model that tell its f and h, as `fused.bind` packs them
MODEL = (I1, V, V, M, M3)

_helper = numba.njit(error_model="numpy")


@_helper
def _images(moving, integers, reals, offset, direction, t, points, u, known, values):
    """f (moving) or h of points (M, N) of an episode on the line (offset (p,), direction (p, n_m)).

    That is the state one sample later, or what the chosen sensors read.
    """
    dynamics, output, project = map_at(integers[0]), map_at(integers[1]), _project_at(integers[2])
    substeps, n_x, n_y, n_theta = integers[3], integers[4], integers[5], integers[6]
    p, n_d, m = integers[8], integers[9], integers[10]
    n_m = direction.shape[1]
    entries, rest = integers[SIZES : SIZES + p], integers[SIZES + p :]
    disturbances, sensors = rest[:n_d], rest[n_d:]
    dt, nominal, physical = reals[0], reals[1 : 1 + n_theta], reals[1 + n_theta :]
    x, y, theta, theta_now, still = np.empty(n_x), np.empty(n_y), np.empty(n_theta), np.empty(n_theta), np.zeros(n_theta)
    d = known.copy()
    k1, k2, k3, k4, z = np.empty(n_x), np.empty(n_x), np.empty(n_x), np.empty(n_x), np.empty(n_x)
    for i in range(points.shape[0]):
        for j in range(n_theta):
            theta[j] = nominal[j]
        for e in range(p):
            deviation = offset[e]
            for j in range(n_m):
                deviation += direction[e, j] * points[i, n_x + j]
            theta[entries[e]] += deviation
        for j in range(n_d):
            d[disturbances[j]] = points[i, n_x + n_m + j]
        for j in range(n_x):
            x[j] = points[i, j]
        if moving:
            _advance(
                dynamics, project, t, dt, substeps, x, u, theta, still, still, d, physical, theta_now, k1, k2, k3, k4, z
            )
            for j in range(n_x):
                values[i, j] = x[j]
        else:
            output(t, x, u, theta, d, physical, y)
            for j in range(m):
                values[i, j] = y[sensors[j]]


@_helper
def _factor(P, U):
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


@_helper
def _through(rule, moving, integers, reals, step, offset, direction, t, X, P, u, known, mean, cross, cov):
    """N(X, P) through f (moving) or h: mean (m,), cov (m, m) and cross (m, N) with what went in."""
    N, m, low = X.size, mean.size, 0
    points, values, first = np.empty((2 * N + 1, N)), np.empty((2 * N + 1, m)), np.empty((N, m))
    h2 = N + 2.0 if rule == UNSCENTED else 3.0
    h = np.sqrt(h2)
    if rule == EXTENDED:
        U = np.zeros((N, N))
        for j in range(N):
            U[j, j] = step[j]
        h = 1.0
    else:
        U = np.empty((N, N))
        _factor(P, U)
        low = integers[4] if moving else 0  # of f, nobody asks for the covariance with x before
    for i in range(N):
        points[0, i] = X[i]
    for j in range(N):
        for i in range(N):
            offset_i = h * U[j, i] if i >= j else 0.0
            points[1 + j, i] = X[i] + offset_i
            points[1 + N + j, i] = X[i] - offset_i
    _images(moving, integers, reals, offset, direction, t, points, u, known, values)
    for a in range(m):
        mean[a] = 0.0
        for i in range(N):
            cross[a, i] = 0.0
        for b in range(m):
            cov[a, b] = 0.0
    for j in range(N):
        half = 0.5 / step[j] if rule == EXTENDED else 0.5 / h
        for a in range(m):
            first[j, a] = (values[1 + j, a] - values[1 + N + j, a]) * half
    if rule == EXTENDED:
        for a in range(m):
            for j in range(N):
                for i in range(N):
                    cross[a, i] += first[j, a] * P[j, i]
            for i in range(N):
                for b in range(a + 1):
                    cov[a, b] += cross[a, i] * first[i, b]
    else:
        second = values[1 : N + 1]
        for j in range(N):
            for a in range(m):
                second[j, a] = values[1 + j, a] + values[1 + N + j, a] - 2.0 * values[0, a]
                mean[a] += second[j, a]
        weight = 1.0 / (4.0 * h2) if rule == UNSCENTED else (h2 - 1.0) / (4.0 * h2 * h2)
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


@_helper
def _through_linear(F, P, cross, cov):
    """cross = F P and cov = F P F' for F (m, N)."""
    m, N = F.shape
    for a in range(m):
        for i in range(N):
            cross[a, i] = 0.0
        for j in range(N):
            for i in range(N):
                cross[a, i] += F[a, j] * P[j, i]
        for b in range(a + 1):
            cov[a, b] = 0.0
            for j in range(N):
                cov[a, b] += cross[a, j] * F[b, j]
            cov[b, a] = cov[a, b]


@_helper
def _linear(integers, offset, direction, plant, X, u, known, F, mean):
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


@_helper
def _check(integers, step, X, t, u, known):
    n = X.shape[0]
    if X.shape[1] != step.size:
        raise ValueError("X needs one entry for each of the model's [x; m; d]")
    if t.size == 0 or n % t.size or u.shape[0] == 0 or n % u.shape[0] or known.shape[0] == 0 or n % known.shape[0]:
        raise ValueError("t, u and d need one row for each episode, or fewer that serve equally many episodes each")
    if u.shape[1] != integers[SIZES - 1] or known.shape[1] != integers[7]:
        raise ValueError("u needs one entry for each command of the plant, d one for each disturbance, measured or not")


@_helper
def _check_covariances(n, P, N, noise, m):
    if P.shape != (n, N, N):
        raise ValueError("P needs the shape (n, N, N) for X (n, N)")
    if noise.shape[0] == 0 or n % noise.shape[0] or noise.shape[1] != m or noise.shape[2] != m:
        raise ValueError("Q needs the shape (1, N, N) and R (1, m, m), or more that serve the episodes in turn")


@_helper
def _check_sensors(n, m, y, seen):
    if y.shape[0] == 0 or n % y.shape[0] or y.shape[1] != m or seen.shape != y.shape:
        raise ValueError("y and seen need a row for each episode, or for equally many, and one entry for each sensor")


@compiled(void(int64, *MODEL, V, M, M, M3, V, M, M, M3, M, M3))
def predict(rule, integers, reals, step, offset, direction, limit, plant, X, P, t, u, known, Q, X1, P1):
    """X1 and P1 one sample after X (n, N) and P (n, N, N)."""
    (n, N), n_x = X.shape, integers[4]
    if n == 0:
        return
    _check(integers, step, X, t, u, known)
    _check_covariances(n, P, N, Q, N)
    mean, cross, cov, F = np.empty(n_x), np.empty((n_x, N)), np.empty((n_x, n_x)), np.empty((n_x, N))
    for e in range(n):
        line = e % offset.shape[0]
        ue, de = u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        if plant.shape[0] > 0:
            _linear(integers, offset[line], direction[line], plant, X[e], ue, de, F, mean)
            _through_linear(F, P[e], cross, cov)
        else:
            te = t[e * t.size // n]
            _through(
                rule, True, integers, reals, step, offset[line], direction[line], te, X[e], P[e], ue, de, mean, cross, cov
            )
        Qe = Q[e % Q.shape[0]]
        for i in range(N):
            X1[e, i] = mean[i] if i < n_x else X[e, i]
            for j in range(i + 1):
                if i < n_x:
                    moved = cov[i, j]
                elif j < n_x:
                    moved = cross[j, i]
                else:
                    moved = 0.5 * (P[e, i, j] + P[e, j, i])
                P1[e, i, j] = moved + Qe[i, j]
                P1[e, j, i] = P1[e, i, j]
        for i in range(N):
            if P1[e, i, i] > limit[i]:
                shrink = np.sqrt(limit[i] / P1[e, i, i])
                for j in range(N):
                    P1[e, i, j] *= shrink
                    P1[e, j, i] *= shrink


@_helper
def _correct(X, P, y, seen, mean, S, cross, U, white, X1, P1, nu, S1):
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
    _factor(S1, U)
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


@compiled(void(int64, *MODEL, M, M, M3, V, M, M, M, B2, M3, M, M3, M, M3, V, V))
def update(rule, integers, reals, step, offset, direction, H, X, P, t, u, known, y, seen, R, X1, P1, nu, S, distance, log):
    """X1 and P1 after the sensors y (n, m) at t, of which `seen` reported."""
    (n, N), m = X.shape, integers[10]
    if n == 0:
        return
    _check(integers, step, X, t, u, known)
    _check_covariances(n, P, N, R, m)
    _check_sensors(n, m, y, seen)
    mean, cross, cov, U, white = np.zeros(m), np.zeros((m, N)), np.zeros((m, m)), np.empty((m, m)), np.empty(m)
    for e in range(n):
        ye, reported = y[e * y.shape[0] // n], seen[e * y.shape[0] // n]
        if not reported.any():
            pass  # and nothing of what the episode before has left enters
        elif H.shape[0] > 0:
            for a in range(m):
                mean[a] = 0.0
                for j in range(N):
                    mean[a] += H[a, j] * X[e, j]
            _through_linear(H, P[e], cross, cov)
        else:
            line = e % offset.shape[0]
            te, ue, de = t[e * t.size // n], u[e * u.shape[0] // n], known[e * known.shape[0] // n]
            _through(
                rule, False, integers, reals, step, offset[line], direction[line], te, X[e], P[e], ue, de, mean, cross, cov
            )
        Re = R[e % R.shape[0]]
        for a in range(m):
            for b in range(m):
                cov[a, b] += Re[a, b]
        distance[e], log[e] = _correct(X[e], P[e], ye, reported, mean, cov, cross, U, white, X1[e], P1[e], nu[e], S[e])


@compiled(void(M, M3, M, B2, M, M3, M3, M, M3, M, M3, M3, V, V))
def correct(X, P, y, seen, mean, cross, S, X1, P1, nu, S1, K, distance, log):
    """X1 and P1 after the sensors y (n, m), of which `seen` reported, with the moments (mean, cross (n, N, m), S)."""
    (n, N), m = X.shape, mean.shape[1]
    if n == 0:
        return
    if mean.shape[0] != n or cross.shape != (n, N, m) or S.shape != (n, m, m) or P.shape != (n, N, N):
        raise ValueError("the shapes are X (n, N), P (n, N, N), mean (n, m), cross (n, N, m) and S (n, m, m)")
    _check_sensors(n, m, y, seen)
    W, U, white = np.empty((m, N)), np.empty((m, m)), np.empty(m)
    for e in range(n):
        for a in range(m):
            for i in range(N):
                W[a, i] = cross[e, i, a]
        ye, reported = y[e * y.shape[0] // n], seen[e * y.shape[0] // n]
        distance[e], log[e] = _correct(X[e], P[e], ye, reported, mean[e], S[e], W, U, white, X1[e], P1[e], nu[e], S1[e])
        for a in range(m - 1, -1, -1):  # K' = U^-1 W
            for i in range(N):
                for b in range(a + 1, m):
                    W[a, i] -= U[a, b] * W[b, i]
                W[a, i] /= U[a, a]
                K[e, i, a] = W[a, i]


@compiled(void(boolean, *MODEL, M3, V, M, M, M3))
def images(moving, integers, reals, step, offset, direction, X, t, u, known, out):
    """f (moving) or h of the points X (n, points, N)."""
    n, points, N = X.shape
    if n == 0 or points == 0:
        return
    _check(integers, step, X[:, 0].copy(), t, u, known)
    for e in range(n):
        line = e % offset.shape[0]
        te, ue, de = t[e * t.size // n], u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        _images(moving, integers, reals, offset[line], direction[line], te, X[e], ue, de, out[e])
        if moving:
            for i in range(points):
                for j in range(integers[4], N):
                    out[e, i, j] = X[e, i, j]

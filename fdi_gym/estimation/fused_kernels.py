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

from typing import NamedTuple

import numba
import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.kernels import M, V, _advance, _project_at, compiled, map_at

EXTENDED, UNSCENTED, CENTRAL_DIFFERENCE = 0, 1, 2
LOG_2PI = float(np.log(2.0 * np.pi))
JITTER, RETRIES = 1e-14, 7  # added to the diagonal where the factorisation fails, times 100 at each retry

I1, B2, M3 = int64[::1], boolean[:, ::1], float64[:, :, ::1]
SIZES = 16  # integers before the lists

Array = np.ndarray
_helper = numba.njit(error_model="numpy")


class Layout(NamedTuple):
    """The constants of a model as the kernels see them; `fused.bind` packs them."""

    dynamics_at: int
    output_at: int
    project_at: int
    substeps: int
    n_x: int
    n_z: int
    n_d: int
    n_u: int
    n_y: int
    entries: Array  # (p,) of theta
    disturbances: Array  # (n_d,) of the plant's
    sensors: Array  # (m,) of the plant's
    dt: float
    nominal: Array  # (n_theta,)
    physical: Array  # (n_p,)
    step: Array  # (N,) of the differences along the axes
    limit: Array  # (N,)
    offset: Array  # (lines, p)
    direction: Array  # (lines, p, n_z)
    H: Array  # (m, N), or without rows where the sensors are not linear
    n_D: int  # all disturbances of the plant


class Work(NamedTuple):
    """What an episode needs on the way; every entry is written before it is read."""

    x: Array
    theta: Array
    still: Array  # zeros: theta does not move within the sample
    theta_now: Array
    d: Array
    k1: Array
    k2: Array
    k3: Array
    k4: Array
    z: Array
    y: Array  # (n_y,)
    point: Array  # (N,)
    plus: Array  # (m,): images
    minus: Array
    centre: Array
    mean: Array
    U: Array  # (N, N) the upper factor of P
    first: Array  # (N, m)
    second: Array
    cross: Array  # (m, N)
    cov: Array  # (m, m)


@_helper
def _layout(integers, reals):
    n_x, n_z, n_d, n_theta, n_p = integers[4], integers[5], integers[6], integers[9], integers[10]
    p, m, lines, rows, N = integers[12], integers[13], integers[14], integers[15], n_x + n_z + n_d
    i1 = SIZES + p
    i2 = i1 + n_d
    r1 = 1 + n_theta
    r2 = r1 + n_p
    r3 = r2 + N
    r4 = r3 + N
    r5 = r4 + lines * p
    r6 = r5 + lines * p * n_z
    return Layout(
        integers[0], integers[1], integers[2], integers[3], n_x, n_z, n_d, integers[7], integers[8],
        integers[SIZES:i1], integers[i1:i2], integers[i2 : i2 + m],
        reals[0], reals[1:r1], reals[r1:r2], reals[r2:r3], reals[r3:r4], reals[r4:r5].reshape((lines, p)),
        reals[r5:r6].reshape((lines, p, n_z)), reals[r6 : r6 + rows * N].reshape((rows, N)), integers[11],
    )  # fmt: skip


@_helper
def _work(c, m):
    n, N, n_theta = c.n_x, c.step.size, c.nominal.size
    return Work(
        np.empty(n), np.empty(n_theta), np.zeros(n_theta), np.empty(n_theta), np.empty(c.n_D), np.empty(n), np.empty(n),
        np.empty(n), np.empty(n), np.empty(n), np.empty(c.n_y), np.empty(N), np.empty(m), np.empty(m), np.empty(m),
        np.empty(m), np.empty((N, N)), np.empty((N, m)), np.empty((N, m)), np.empty((m, N)), np.empty((m, m)),
    )  # fmt: skip


@_helper
def _image(c, moving, line, t, X, u, known, w, out):
    """f (moving) or h of one point X (N,): the state one sample later (n_x,), or what the chosen sensors read (m,)."""
    for j in range(c.nominal.size):
        w.theta[j] = c.nominal[j]
    for e in range(c.entries.size):
        deviation = c.offset[line, e]
        for j in range(c.n_z):
            deviation += c.direction[line, e, j] * X[c.n_x + j]
        w.theta[c.entries[e]] += deviation
    for j in range(known.size):
        w.d[j] = known[j]
    for j in range(c.n_d):
        w.d[c.disturbances[j]] = X[c.n_x + c.n_z + j]
    for j in range(c.n_x):
        w.x[j] = X[j]
    if moving:
        _advance(
            map_at(c.dynamics_at), _project_at(c.project_at), t, c.dt, c.substeps, w.x, u, w.theta, w.still, w.still,
            w.d, c.physical, w.theta_now, w.k1, w.k2, w.k3, w.k4, w.z,
        )  # fmt: skip
        for j in range(c.n_x):
            out[j] = w.x[j]
    else:
        map_at(c.output_at)(t, w.x, u, w.theta, w.d, c.physical, w.y)
        for j in range(c.sensors.size):
            out[j] = w.y[c.sensors[j]]


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
def _differences(c, moving, line, t, X, u, known, w):
    """The image of X (w.centre) and the Jacobian's columns (rows of w.first), by central differences along the axes."""
    N, m = X.size, w.centre.size
    _image(c, moving, line, t, X, u, known, w, w.centre)
    for i in range(N):
        w.point[i] = X[i]
    for j in range(N):
        w.point[j] = X[j] + c.step[j]
        _image(c, moving, line, t, w.point, u, known, w, w.plus)
        w.point[j] = X[j] - c.step[j]
        _image(c, moving, line, t, w.point, u, known, w, w.minus)
        w.point[j] = X[j]
        for a in range(m):
            w.first[j, a] = (w.plus[a] - w.minus[a]) / (2.0 * c.step[j])


@_helper
def _through(c, rule, moving, line, t, X, P, u, known, w):
    """N(X, P) through f (moving) or h: w.mean (m,), w.cov (m, m) and w.cross (m, N) with what went in."""
    N, m = X.size, w.centre.size
    for a in range(m):
        for i in range(N):
            w.cross[a, i] = 0.0
        for b in range(m):
            w.cov[a, b] = 0.0
    if rule == EXTENDED:
        _differences(c, moving, line, t, X, u, known, w)
        for a in range(m):
            w.mean[a] = w.centre[a]
            for j in range(N):
                for i in range(N):
                    w.cross[a, i] += w.first[j, a] * P[j, i]
            for i in range(N):
                for b in range(a + 1):
                    w.cov[a, b] += w.cross[a, i] * w.first[i, b]
    else:
        h2 = N + 2.0 if rule == UNSCENTED else 3.0
        h = np.sqrt(h2)
        weight = 1.0 / (4.0 * h2) if rule == UNSCENTED else (h2 - 1.0) / (4.0 * h2 * h2)
        _factor(P, w.U)
        _image(c, moving, line, t, X, u, known, w, w.centre)
        for a in range(m):
            w.mean[a] = 0.0
        for j in range(N):
            w.point[j] = X[j]
        for j in range(N):
            for i in range(j, N):
                w.point[i] = X[i] + h * w.U[j, i]
            _image(c, moving, line, t, w.point, u, known, w, w.plus)
            for i in range(j, N):
                w.point[i] = X[i] - h * w.U[j, i]
            _image(c, moving, line, t, w.point, u, known, w, w.minus)
            w.point[j] = X[j]
            for a in range(m):
                w.first[j, a] = (w.plus[a] - w.minus[a]) / (2.0 * h)
                w.second[j, a] = w.plus[a] + w.minus[a] - 2.0 * w.centre[a]
                w.mean[a] += w.second[j, a]
        for a in range(m):
            w.mean[a] /= 2.0 * h2
            for j in range(N):
                for i in range(j, N):
                    w.cross[a, i] += w.first[j, a] * w.U[j, i]
                scaled = weight * w.second[j, a]
                for b in range(a + 1):
                    w.cov[a, b] += w.first[j, a] * w.first[j, b] + scaled * w.second[j, b]
            if rule == UNSCENTED:
                for b in range(a + 1):
                    w.cov[a, b] -= w.mean[a] * w.mean[b]
        for a in range(m):
            w.mean[a] += w.centre[a]
    for a in range(m):
        for b in range(a):
            w.cov[b, a] = w.cov[a, b]


@_helper
def _check(c, n, N, t, u, known):
    if N != c.step.size:
        raise ValueError("X needs one entry for each of the model's [x; m; d]")
    if t.size == 0 or n % t.size or u.shape[0] == 0 or n % u.shape[0] or known.shape[0] == 0 or n % known.shape[0]:
        raise ValueError("t, u and d need one row for each episode, or fewer that serve equally many episodes each")
    if u.shape[1] != c.n_u:
        raise ValueError("u needs one entry for each command of the plant")
    if known.shape[1] != c.n_D:
        raise ValueError("d needs one entry for each disturbance of the plant, measured or not")


@_helper
def _check_stack(M, n, N):
    if M.shape[0] == 0 or n % M.shape[0] or M.shape[1] != N or M.shape[2] != N:
        raise ValueError("Q needs the shape (1, N, N) and R (1, m, m), or more that serve the episodes in turn")


@_helper
def _check_covariance(P, n, N):
    if P.shape != (n, N, N):
        raise ValueError("P needs the shape (n, N, N) for X (n, N)")


@_helper
def _check_sensors(n, m, y, seen):
    if y.shape[0] == 0 or n % y.shape[0] or y.shape[1] != m or seen.shape != y.shape:
        raise ValueError("y and seen need a row for each episode, or for equally many, and one entry for each sensor")


@compiled(void(int64, I1, V, M, M3, V, M, M, M3, M, M3))
def predict(rule, integers, reals, X, P, t, u, known, Q, X1, P1):
    """X1 and P1 one sample after X (n, N) and P (n, N, N)."""
    c = _layout(integers, reals)
    n, N, n_x = X.shape[0], c.step.size, c.n_x
    if n == 0:
        return
    _check(c, n, X.shape[1], t, u, known)
    _check_covariance(P, n, N)
    _check_stack(Q, n, N)
    w = _work(c, n_x)
    every_t, every_u, every_d = n // t.size, n // u.shape[0], n // known.shape[0]
    for e in range(n):
        line = e % c.offset.shape[0]
        _through(c, rule, True, line, t[e // every_t], X[e], P[e], u[e // every_u], known[e // every_d], w)
        Qe = Q[e % Q.shape[0]]
        for i in range(n_x):
            X1[e, i] = w.mean[i]
            for j in range(n_x):
                P1[e, i, j] = w.cov[i, j] + Qe[i, j]
            for j in range(n_x, N):
                P1[e, i, j] = w.cross[i, j] + Qe[i, j]
                P1[e, j, i] = w.cross[i, j] + Qe[j, i]
        for i in range(n_x, N):
            X1[e, i] = X[e, i]
            for j in range(n_x, N):
                P1[e, i, j] = 0.5 * (P[e, i, j] + P[e, j, i]) + Qe[i, j]
        for i in range(N):
            if P1[e, i, i] > c.limit[i]:
                shrink = np.sqrt(c.limit[i] / P1[e, i, i])
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


@compiled(void(int64, I1, V, M, M3, V, M, M, M, B2, M3, M, M3, M, M3, V, V))
def update(rule, integers, reals, X, P, t, u, known, y, seen, R, X1, P1, nu, S, distance, log):
    """X1 and P1 after the sensors y (rows, m) at t, of which `seen` reported."""
    c = _layout(integers, reals)
    n, N, m = X.shape[0], c.step.size, c.sensors.size
    if n == 0:
        return
    _check(c, n, X.shape[1], t, u, known)
    _check_covariance(P, n, N)
    _check_stack(R, n, m)
    _check_sensors(n, m, y, seen)
    w = _work(c, m)
    U, white = np.empty((m, m)), np.empty(m)
    every_t, every_u, every_d, every_y = n // t.size, n // u.shape[0], n // known.shape[0], n // y.shape[0]
    for e in range(n):
        ye, reported = y[e // every_y], seen[e // every_y]
        if not reported.any():
            for a in range(m):
                w.mean[a] = 0.0
                for b in range(m):
                    w.cov[a, b] = 0.0
        elif c.H.shape[0] > 0:
            for a in range(m):
                w.mean[a] = 0.0
                for i in range(N):
                    w.cross[a, i] = 0.0
                for j in range(N):
                    w.mean[a] += c.H[a, j] * X[e, j]
                    for i in range(N):
                        w.cross[a, i] += c.H[a, j] * P[e, j, i]
                for b in range(a + 1):
                    w.cov[a, b] = 0.0
                    for j in range(N):
                        w.cov[a, b] += w.cross[a, j] * c.H[b, j]
                    w.cov[b, a] = w.cov[a, b]
        else:
            line = e % c.offset.shape[0]
            _through(c, rule, False, line, t[e // every_t], X[e], P[e], u[e // every_u], known[e // every_d], w)
        Re = R[e % R.shape[0]]
        for a in range(m):
            for b in range(m):
                w.cov[a, b] += Re[a, b]
        distance[e], log[e] = _correct(X[e], P[e], ye, reported, w.mean, w.cov, w.cross, U, white, X1[e], P1[e], nu[e], S[e])


@compiled(void(M, M3, M, B2, M, M3, M3, M, M3, M, M3, M3, V, V))
def correct(X, P, y, seen, mean, cross, S, X1, P1, nu, S1, K, distance, log):
    """X1 and P1 after the sensors y (n, m), of which `seen` reported, with the moments (mean, cross (n, N, m), S)."""
    (n, N), m = X.shape, mean.shape[1]
    if n == 0:
        return
    _check_covariance(P, n, N)
    _check_sensors(n, m, y, seen)
    if mean.shape[0] != n or cross.shape != (n, N, m) or S.shape != (n, m, m):
        raise ValueError("the moments need the shapes mean (n, m), cross (n, N, m) and S (n, m, m)")
    W, U, white = np.empty((m, N)), np.empty((m, m)), np.empty(m)
    every_y = n // y.shape[0]
    for e in range(n):
        for a in range(m):
            for i in range(N):
                W[a, i] = cross[e, i, a]
        ye, reported = y[e // every_y], seen[e // every_y]
        distance[e], log[e] = _correct(X[e], P[e], ye, reported, mean[e], S[e], W, U, white, X1[e], P1[e], nu[e], S1[e])
        for a in range(m - 1, -1, -1):  # K' = U^-1 W
            for i in range(N):
                for b in range(a + 1, m):
                    W[a, i] -= U[a, b] * W[b, i]
                W[a, i] /= U[a, a]
                K[e, i, a] = W[a, i]


@compiled(void(boolean, I1, V, M3, V, M, M, M3))
def images(moving, integers, reals, X, t, u, known, out):
    """f (moving) or h of the points X (n, points, N)."""
    c = _layout(integers, reals)
    n, points, N = X.shape
    if n == 0:
        return
    _check(c, n, N, t, u, known)
    w = _work(c, c.n_x if moving else c.sensors.size)
    every_t, every_u, every_d = n // t.size, n // u.shape[0], n // known.shape[0]
    for e in range(n):
        line = e % c.offset.shape[0]
        for i in range(points):
            _image(c, moving, line, t[e // every_t], X[e, i], u[e // every_u], known[e // every_d], w, out[e, i])
            if moving:
                for j in range(c.n_x, N):
                    out[e, i, j] = X[e, i, j]


@compiled(void(boolean, I1, V, M, V, M, M, M, M3))
def jacobian(moving, integers, reals, X, t, u, known, value, J):
    """f (moving) or h of X (n, N) and its Jacobian."""
    c = _layout(integers, reals)
    n, N, m = X.shape[0], X.shape[1], c.n_x if moving else c.sensors.size
    if n == 0:
        return
    _check(c, n, N, t, u, known)
    w = _work(c, m)
    every_t, every_u, every_d = n // t.size, n // u.shape[0], n // known.shape[0]
    for e in range(n):
        line = e % c.offset.shape[0]
        _differences(c, moving, line, t[e // every_t], X[e], u[e // every_u], known[e // every_d], w)
        for a in range(m):
            value[e, a] = w.centre[a]
            for j in range(N):
                J[e, a, j] = w.first[j, a]
        if moving:
            for a in range(m, N):
                value[e, a] = X[e, a]
                for j in range(N):
                    J[e, a, j] = 1.0 if j == a else 0.0

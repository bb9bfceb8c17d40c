"""The kernels of `gaussian`: a batch of episodes in one call, for any plant, by address; compiled once for all plants."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.gaussian_algebra import correct_episode, through_matrix, widen
from fdi_gym.estimation.gaussian_moments import (
    differenced,
    differentiated,
    heard,
    linearised,
    own_faults,
    room_of,
    sensed,
    through,
)
from fdi_gym.estimation.gaussian_points import COMMANDS, EXTENDED, KNOWN, OUTPUTS, SENSORS, STATES, TANGENT, pass_points
from fdi_gym.kernels import M, V, compiled, floats, helper
from fdi_gym.tangent import row
from fdi_gym.vectors import width

I1, B2, M3 = int64[::1], boolean[:, ::1], float64[:, :, ::1]
# integers, reals, step, offset, direction: the constants of a model that tell its f and h, as `gaussian.bind` packs them
MODEL = (I1, V, V, M, M3)


@helper
def _check(integers, step, n, N, t, u, known):
    if N != step.size:
        raise ValueError("X needs one entry for each of the model's [x; m; d]")
    if t.size == 0 or n % t.size or u.shape[0] == 0 or n % u.shape[0] or known.shape[0] == 0 or n % known.shape[0]:
        raise ValueError("t, u and d need one row for each episode, or fewer that serve equally many episodes each")
    if u.shape[1] != integers[COMMANDS] or known.shape[1] != integers[KNOWN]:
        raise ValueError("u needs one entry for each command of the plant, d one for each disturbance, measured or not")


@helper
def _check_covariances(n, P, N, noise, m):
    if P.shape != (n, N, N):
        raise ValueError("P needs the shape (n, N, N) for X (n, N)")
    if noise.shape[0] == 0 or n % noise.shape[0] or noise.shape[1] != m or noise.shape[2] != m:
        raise ValueError("Q needs the shape (1, N, N) and R (1, m, m), or more that serve the episodes in turn")


@helper
def _check_sensors(n, m, y, seen):
    if y.shape[0] == 0 or n % y.shape[0] or y.shape[1] != m or seen.shape != y.shape:
        raise ValueError("y and seen need a row for each episode, or for equally many, and one entry for each sensor")


@compiled(void(int64, *MODEL, V, M, M, M3, V, M, M, M3, M, M3))
def predict(rule, integers, reals, step, offset, direction, limit, plant, X, P, t, u, known, Q, X1, P1):
    """X1 and P1 one sample after X (n, N) and P (n, N, N)."""
    (n, N), n_x = X.shape, integers[STATES]
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    _check_covariances(n, P, N, Q, N)
    W, mean, room = width(N), floats(n_x), room_of(integers, reals, row(N))
    F, cross, cov = floats((n_x, row(N))), floats((n_x, W)), floats((n_x, width(n_x)))
    wide, across = floats((N, W)), floats((N, width(n_x)))
    wide[:], across[:] = 0.0, 0.0
    for e in range(n):
        line, te = e % offset.shape[0], t[e * t.size // n]
        Xe, ue, de = X[e], u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        if plant.shape[0] > 0:
            linearised(integers, offset[line], direction[line], plant, Xe, ue, de, F, mean)
        elif rule != EXTENDED:
            through(rule, True, integers, reals, offset[line], direction[line], te, Xe, P[e], ue, de, mean, cross, cov)
        elif integers[TANGENT] != 0:
            differentiated(integers, reals, step, offset[line], direction[line], te, Xe, ue, de, room, F, mean)
        else:
            differenced(integers, reals, step, offset[line], direction[line], te, Xe, ue, de, F, mean)
        if plant.shape[0] > 0 or rule == EXTENDED:
            widen(P[e], wide)
            through_matrix(F, wide, across, cross, cov)
        Qe = Q[e % Q.shape[0]]
        P1e = P1[e]
        for i in range(n_x):
            X1[e, i] = mean[i]
            for j in range(i + 1):
                P1e[i, j] = P1e[j, i] = cov[i, j] + Qe[i, j]
        for i in range(n_x, N):
            X1[e, i] = Xe[i]
            for j in range(n_x):
                P1e[i, j] = P1e[j, i] = cross[j, i] + Qe[i, j]
            for j in range(n_x, i + 1):
                P1e[i, j] = P1e[j, i] = 0.5 * (P[e, i, j] + P[e, j, i]) + Qe[i, j]
        for i in range(N):
            if P1e[i, i] > limit[i]:
                shrink = np.sqrt(limit[i] / P1e[i, i])
                for j in range(N):
                    P1e[i, j] *= shrink
                    P1e[j, i] *= shrink


@compiled(void(*MODEL, M, V, M, M, M, M3))
def differentiate(integers, reals, step, offset, direction, X, t, u, known, X1, F):
    """X1 (n, N) one sample after X and F (n, N, N) its Jacobian, of a plant that says its derivatives."""
    (n, N), n_x = X.shape, integers[STATES]
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    mean, moved, room = floats(n_x), floats((n_x, row(N))), room_of(integers, reals, row(N))
    for e in range(n):
        line, te = e % offset.shape[0], t[e * t.size // n]
        ue, de = u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        differentiated(integers, reals, step, offset[line], direction[line], te, X[e], ue, de, room, moved, mean)
        for i in range(N):
            X1[e, i] = mean[i] if i < n_x else X[e, i]
            for j in range(N):
                F[e, i, j] = moved[i, j] if i < n_x else (1.0 if i == j else 0.0)


@compiled(void(int64, *MODEL, M, M, B2, I1, M, M3, V, M, M, M, M3, M, M3, M, M3, V, V))
def update(
    rule, integers, reals, step, offset, direction, H, plain, seen, count, X, P, t, u, known, y, R,
    X1, P1, nu, S, distance, log,
):  # fmt: skip
    """X1 and P1 after the sensors y (n, m) at t, of which `seen` reported."""
    (n, N), m = X.shape, integers[SENSORS]
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    _check_covariances(n, P, N, R, m)
    _check_sensors(n, m, y, seen)
    W, mean, U, white = width(N), floats(m), floats((m, m)), floats(m)
    cross, cov, low = floats((m, W)), floats((m, width(m))), floats((N + 1, W))
    wide, across, F, faults = floats((N, W)), floats((N, width(m))), floats((m, W)), own_faults(integers)
    room, x, values = room_of(integers, reals, W), floats(N), floats(integers[OUTPUTS])
    mean[:], cross[:], cov[:], low[:], wide[:], across[:] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for e in range(n):
        ye, reported = y[e * y.shape[0] // n], seen[e * y.shape[0] // n]
        count[e] = 0
        for a in range(m):
            count[e] += reported[a]
        if count[e] == 0:
            pass  # and nothing of what the episode before has left enters
        elif H.shape[0] > 0 or rule == EXTENDED:
            line, te, Xe = e % offset.shape[0], t[e * t.size // n], X[e]
            widen(P[e], wide)
            if H.shape[0] > 0:
                for a in range(m):
                    mean[a] = 0.0
                    for j in range(N):
                        mean[a] += H[a, j] * Xe[j]
                through_matrix(H, wide, across, cross, cov)
            elif plain.shape[0] > 0:
                heard(integers, reals, faults, offset[line], direction[line], plain, Xe, F, mean)
                through_matrix(F, wide, across, cross, cov)
            else:
                ue, de = u[e * u.shape[0] // n], known[e * known.shape[0] // n]
                sensed(integers, reals, step, offset[line], direction[line], te, Xe, ue, de, room, x, values, F, mean)
                through_matrix(F, wide, across, cross, cov)
        else:
            line, te = e % offset.shape[0], t[e * t.size // n]
            ue, de = u[e * u.shape[0] // n], known[e * known.shape[0] // n]
            through(rule, False, integers, reals, offset[line], direction[line], te, X[e], P[e], ue, de, mean, cross, cov)
        Re = R[e % R.shape[0]]
        for a in range(m):
            for b in range(m):
                cov[a, b] += Re[a, b]
        distance[e], log[e] = correct_episode(
            X[e], P[e], ye, reported, mean, cov, cross, low, U, white, X1[e], P1[e], nu[e], S[e]
        )


@compiled(void(B2, M, M3, M, M, M3, M3, M, M3, M, M3, M3, V, V))
def correct(seen, X, P, y, mean, cross, S, X1, P1, nu, S1, K, distance, log):
    """X1 and P1 after the sensors y (n, m), of which `seen` reported, with the moments (mean, cross (n, N, m), S)."""
    (n, N), m = X.shape, mean.shape[1]
    if n == 0:
        return
    if mean.shape[0] != n or cross.shape != (n, N, m) or S.shape != (n, m, m) or P.shape != (n, N, N):
        raise ValueError("the shapes are X (n, N), P (n, N, N), mean (n, m), cross (n, N, m) and S (n, m, m)")
    _check_sensors(n, m, y, seen)
    W, low, U, white = floats((m, width(N))), floats((N + 1, width(N))), floats((m, m)), floats(m)
    W[:], low[:] = 0.0, 0.0
    for e in range(n):
        for a in range(m):
            for i in range(N):
                W[a, i] = cross[e, i, a]
        ye, reported = y[e * y.shape[0] // n], seen[e * y.shape[0] // n]
        distance[e], log[e] = correct_episode(
            X[e], P[e], ye, reported, mean[e], S[e], W, low, U, white, X1[e], P1[e], nu[e], S1[e]
        )
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
    _check(integers, step, n, N, t, u, known)
    for e in range(n):
        line = e % offset.shape[0]
        te, ue, de = t[e * t.size // n], u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        pass_points(moving, integers, reals, offset[line], direction[line], te, X[e], ue, de, out[e])
        if moving:
            for i in range(points):
                for j in range(integers[STATES], N):
                    out[e, i, j] = X[e, i, j]

"""The kernels of `gaussian`: a batch of episodes in one call, for any plant, by address; compiled once for all plants."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.gaussian_moments import correct_episode, differentiated, linearised, through, through_matrix
from fdi_gym.estimation.gaussian_points import COMMANDS, EXTENDED, KNOWN, SENSORS, STATES, TANGENT, pass_points
from fdi_gym.kernels import M, V, compiled, helper

I1, B2, M3 = int64[::1], boolean[:, ::1], float64[:, :, ::1]
# integers, reals, step, offset, direction: the constants of a model that tell its f and h, as `gaussian.bind` packs them
MODEL = (I1, V, V, M, M3)


@helper
def _check(integers, step, X, t, u, known):
    n = X.shape[0]
    if X.shape[1] != step.size:
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
    _check(integers, step, X, t, u, known)
    _check_covariances(n, P, N, Q, N)
    mean, cross, cov, F = np.empty(n_x), np.empty((n_x, N)), np.empty((n_x, n_x)), np.empty((n_x, N))
    for e in range(n):
        line = e % offset.shape[0]
        ue, de = u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        if plant.shape[0] > 0:
            linearised(integers, offset[line], direction[line], plant, X[e], ue, de, F, mean)
            through_matrix(F, P[e], cross, cov)
        elif rule == EXTENDED and integers[TANGENT] != 0:
            te = t[e * t.size // n]
            differentiated(integers, reals, step, offset[line], direction[line], te, X[e], ue, de, F, mean)
            through_matrix(F, P[e], cross, cov)
        else:
            te = t[e * t.size // n]
            through(
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


@compiled(void(*MODEL, M, V, M, M, M, M3))
def differentiate(integers, reals, step, offset, direction, X, t, u, known, X1, F):
    """X1 (n, N) one sample after X and F (n, N, N) its Jacobian, of a plant that says its derivatives."""
    (n, N), n_x = X.shape, integers[STATES]
    if n == 0:
        return
    _check(integers, step, X, t, u, known)
    mean, moved = np.empty(n_x), np.empty((n_x, N))
    for e in range(n):
        line, te = e % offset.shape[0], t[e * t.size // n]
        ue, de = u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        differentiated(integers, reals, step, offset[line], direction[line], te, X[e], ue, de, moved, mean)
        for i in range(N):
            X1[e, i] = mean[i] if i < n_x else X[e, i]
            for j in range(N):
                F[e, i, j] = moved[i, j] if i < n_x else (1.0 if i == j else 0.0)


@compiled(void(int64, *MODEL, M, B2, I1, M, M3, V, M, M, M, M3, M, M3, M, M3, V, V))
def update(
    rule, integers, reals, step, offset, direction, H, seen, count, X, P, t, u, known, y, R, X1, P1, nu, S, distance, log
):
    """X1 and P1 after the sensors y (n, m) at t, of which `seen` reported."""
    (n, N), m = X.shape, integers[SENSORS]
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
            through_matrix(H, P[e], cross, cov)
        else:
            line = e % offset.shape[0]
            te, ue, de = t[e * t.size // n], u[e * u.shape[0] // n], known[e * known.shape[0] // n]
            through(
                rule, False, integers, reals, step, offset[line], direction[line], te, X[e], P[e], ue, de, mean, cross, cov
            )
        Re, count[e] = R[e % R.shape[0]], 0
        for a in range(m):
            count[e] += reported[a]
            for b in range(m):
                cov[a, b] += Re[a, b]
        distance[e], log[e] = correct_episode(
            X[e], P[e], ye, reported, mean, cov, cross, U, white, X1[e], P1[e], nu[e], S[e]
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
    W, U, white = np.empty((m, N)), np.empty((m, m)), np.empty(m)
    for e in range(n):
        for a in range(m):
            for i in range(N):
                W[a, i] = cross[e, i, a]
        ye, reported = y[e * y.shape[0] // n], seen[e * y.shape[0] // n]
        distance[e], log[e] = correct_episode(
            X[e], P[e], ye, reported, mean[e], S[e], W, U, white, X1[e], P1[e], nu[e], S1[e]
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
    _check(integers, step, X[:, 0].copy(), t, u, known)
    for e in range(n):
        line = e % offset.shape[0]
        te, ue, de = t[e * t.size // n], u[e * u.shape[0] // n], known[e * known.shape[0] // n]
        pass_points(moving, integers, reals, offset[line], direction[line], te, X[e], ue, de, out[e])
        if moving:
            for i in range(points):
                for j in range(integers[STATES], N):
                    out[e, i, j] = X[e, i, j]

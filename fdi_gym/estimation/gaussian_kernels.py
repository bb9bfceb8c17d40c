"""The kernels of `gaussian`: a batch of episodes in one call, for any plant, by address; compiled once for all plants."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.gaussian_algebra import (
    board_matrices,
    board_one,
    board_vectors,
    disembark,
    entries_of,
    factor,
    put_ashore,
    through_matrix,
)
from fdi_gym.estimation.gaussian_algebra import correct as correct_lanes
from fdi_gym.estimation.gaussian_moments import (
    board_lines,
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
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, compiled, floats, helper, ints
from fdi_gym.tangent import row
from fdi_gym.vectors import load, store, width, zeros

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
    (n, N), n_x, lines = X.shape, integers[STATES], offset.shape[0]
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    _check_covariances(n, P, N, Q, N)
    linear, points = plant.shape[0] > 0, plant.shape[0] == 0 and rule != EXTENDED
    alike_u, alike_d = n // u.shape[0], n // known.shape[0]
    Xs, Ps, means = floats((N, LANES)), floats((N * N, LANES)), floats((n_x, LANES))
    Fs, cross, cov = floats((n_x * N, LANES)), floats((n_x * N, LANES)), floats((n_x * n_x, LANES))
    where, many = ints((n_x, N)), ints(n_x)
    us, ds = floats((u.shape[1] if linear else 0, LANES)), floats((known.shape[1] if linear else 0, LANES))
    size = direction.shape[2] if linear else 0
    offsets, directions = floats((offset.shape[1], LANES)), floats((offset.shape[1] * size, LANES))
    Us, U = floats((N * N if points else 0, LANES)), floats((N, N) if points else (0, 0))
    mean, F, room = floats(n_x), floats((n_x, row(N))), room_of(integers, reals, row(N))
    of_one, across = floats((n_x, N)), floats((n_x, n_x))
    for first in range(0, n, LANES):
        board_matrices(P, first, Ps)
        if points:
            factor(Ps, N, Us)
        if linear:
            board_vectors(X, first, 1, Xs)
            board_vectors(u, first, alike_u, us)
            board_vectors(known, first, alike_d, ds)
            if lines > 1 or first == 0:
                board_lines(offset, direction, first, offsets, directions)
            linearised(integers, offsets, directions, plant, Xs, us, ds, N, Fs, means)
        for lane in range(LANES if not linear else 0):
            e = min(first + lane, n - 1)
            line, te = e % lines, t[e * t.size // n]
            Xe, ue, de = X[e], u[e // alike_u], known[e // alike_d]
            if points:
                disembark(Us, N, lane, U)
                through(rule, True, integers, reals, offset[line], direction[line], te, Xe, U, ue, de, mean, of_one, across)
                board_one(of_one, lane, N, cross)
                board_one(across, lane, n_x, cov)
            elif integers[TANGENT] != 0:
                differentiated(integers, reals, step, offset[line], direction[line], te, Xe, ue, de, room, F, mean)
                board_one(F, lane, N, Fs)
            else:
                differenced(integers, reals, step, offset[line], direction[line], te, Xe, ue, de, F, mean)
                board_one(F, lane, N, Fs)
            for i in range(n_x):
                means[i, lane] = mean[i]
        if not points:
            if not linear or first == 0:
                entries_of(Fs, n_x, N, where, many)
            through_matrix(Fs, Ps, n_x, N, where, many, cross, cov)
        for lane in range(min(LANES, n - first)):
            e = first + lane
            Qe, Pe, P1e = Q[e % Q.shape[0]], P[e], P1[e]
            for i in range(n_x):
                X1[e, i] = means[i, lane]
                for j in range(i + 1):
                    P1e[i, j] = P1e[j, i] = cov[i * n_x + j, lane] + Qe[i, j]
            for i in range(n_x, N):
                X1[e, i] = X[e, i]
                for j in range(n_x):
                    P1e[i, j] = P1e[j, i] = cross[j * N + i, lane] + Qe[i, j]
                for j in range(n_x, i + 1):
                    P1e[i, j] = P1e[j, i] = 0.5 * (Pe[i, j] + Pe[j, i]) + Qe[i, j]
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
    (n, N), m, lines = X.shape, integers[SENSORS], offset.shape[0]
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    _check_covariances(n, P, N, R, m)
    _check_sensors(n, m, y, seen)
    fixed, points = H.shape[0] > 0, H.shape[0] == 0 and rule != EXTENDED
    alike, alike_u, alike_d = n // y.shape[0], n // u.shape[0], n // known.shape[0]
    Xs, Ps, means, ys = floats((N, LANES)), floats((N * N, LANES)), floats((m, LANES)), floats((m, LANES))
    Fs, cross, Ss = floats((m * N, LANES)), floats((m * N, LANES)), floats((m * m, LANES))
    there, white, where, many = floats((m, LANES)), floats((m, LANES)), ints((m, N)), ints(m)
    X1s, nus, S1s, Us = floats((N, LANES)), floats((m, LANES)), floats((m * m, LANES)), floats((m * m, LANES))
    factors, U = floats((N * N if points else 0, LANES)), floats((N, N) if points else (0, 0))
    mean, F, faults = floats(m), floats((m, N)), own_faults(integers)
    across, distances = floats((m, m)), floats((1, LANES))
    room, x, values = room_of(integers, reals, width(N)), floats(N), floats(integers[OUTPUTS])
    if fixed:
        for lane in range(LANES):
            board_one(H, lane, N, Fs)
        entries_of(Fs, m, N, where, many)
    for first in range(0, n, LANES):
        board_vectors(X, first, 1, Xs)
        board_matrices(P, first, Ps)
        board_vectors(y, first, alike, ys)
        board_vectors(seen, first, alike, there)
        if points:
            factor(Ps, N, factors)
        if fixed:
            for a in range(m):
                total = zeros()
                for s in range(many[a]):
                    total += load(Fs, a * N + where[a, s], 0) * load(Xs, where[a, s], 0)
                store(means, a, 0, total)
        for lane in range(LANES if not fixed else 0):
            e = min(first + lane, n - 1)
            line, te = e % lines, t[e * t.size // n]
            ue, de = u[e // alike_u], known[e // alike_d]
            if points:
                disembark(factors, N, lane, U)
                through(rule, False, integers, reals, offset[line], direction[line], te, X[e], U, ue, de, mean, F, across)
                board_one(F, lane, N, cross)
                board_one(across, lane, m, Ss)
            else:
                if plain.shape[0] > 0:
                    heard(integers, reals, faults, offset[line], direction[line], plain, X[e], F, mean)
                else:
                    sensed(integers, reals, step, offset[line], direction[line], te, X[e], ue, de, room, x, values, F, mean)
                board_one(F, lane, N, Fs)
            for a in range(m):
                means[a, lane] = mean[a]
        if not points:
            if not fixed:
                entries_of(Fs, m, N, where, many)
            through_matrix(Fs, Ps, m, N, where, many, cross, Ss)
        for a in range(m):
            for b in range(a + 1):
                for lane in range(LANES):
                    Re, total = R[min(first + lane, n - 1) % R.shape[0]], Ss[a * m + b, lane]
                    Ss[a * m + b, lane] = total + Re[a, b]
                    Ss[b * m + a, lane] = total + Re[b, a]
        store(distances, 0, 0, correct_lanes(Xs, Ps, ys, there, means, Ss, cross, m, N, Us, white, X1s, nus, S1s))
        for lane in range(min(LANES, n - first)):
            count[first + lane] = put_ashore(first + lane, lane, Ps, there, distances, Us, X1s, nus, S1s, X1, P1, nu, S, distance, log)


@compiled(void(B2, M, M3, M, M, M3, M3, M, M3, M, M3, M3, V, V))
def correct(seen, X, P, y, mean, cross, S, X1, P1, nu, S1, K, distance, log):
    """X1 and P1 after the sensors y (n, m), of which `seen` reported, with the moments (mean, cross (n, N, m), S)."""
    (n, N), m = X.shape, mean.shape[1]
    if n == 0:
        return
    if mean.shape[0] != n or cross.shape != (n, N, m) or S.shape != (n, m, m) or P.shape != (n, N, N):
        raise ValueError("the shapes are X (n, N), P (n, N, N), mean (n, m), cross (n, N, m) and S (n, m, m)")
    _check_sensors(n, m, y, seen)
    alike = n // y.shape[0]
    Xs, Ps, means, ys = floats((N, LANES)), floats((N * N, LANES)), floats((m, LANES)), floats((m, LANES))
    across, Ws, Ss = floats((N * m, LANES)), floats((m * N, LANES)), floats((m * m, LANES))
    there, white, distances = floats((m, LANES)), floats((m, LANES)), floats((1, LANES))
    X1s, nus, S1s, Us = floats((N, LANES)), floats((m, LANES)), floats((m * m, LANES)), floats((m * m, LANES))
    for first in range(0, n, LANES):
        board_vectors(X, first, 1, Xs)
        board_matrices(P, first, Ps)
        board_vectors(y, first, alike, ys)
        board_vectors(seen, first, alike, there)
        board_vectors(mean, first, 1, means)
        board_matrices(cross, first, across)
        board_matrices(S, first, Ss)
        for a in range(m):
            for i in range(N):
                store(Ws, a * N + i, 0, load(across, i * m + a, 0))
        store(distances, 0, 0, correct_lanes(Xs, Ps, ys, there, means, Ss, Ws, m, N, Us, white, X1s, nus, S1s))
        for a in range(m - 1, -1, -1):  # K' = U^-1 W
            for i in range(N):
                gain = load(Ws, a * N + i, 0)
                for b in range(a + 1, m):
                    gain -= load(Us, a * m + b, 0) * load(Ws, b * N + i, 0)
                store(Ws, a * N + i, 0, gain / load(Us, a * m + a, 0))
        for lane in range(min(LANES, n - first)):
            e = first + lane
            put_ashore(e, lane, Ps, there, distances, Us, X1s, nus, S1s, X1, P1, nu, S1, distance, log)
            for a in range(m):
                for i in range(N):
                    K[e, i, a] = Ws[a * N + i, lane]


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

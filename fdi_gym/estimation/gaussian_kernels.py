"""The kernels of `gaussian`: a batch of episodes in one call, for any plant, by address; compiled once for all plants."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.gaussian_algebra import board_matrices, board_vectors, take_matrix, take_vector
from fdi_gym.estimation.gaussian_algebra import correct as correct_lanes
from fdi_gym.estimation.gaussian_moments import differentiated, room_of
from fdi_gym.estimation.gaussian_points import COMMANDS, KNOWN, SENSORS, STATES, pass_points
from fdi_gym.estimation.gaussian_step import MODEL, predict_at, update_at
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, compiled, floats, helper, inlined
from fdi_gym.tangent import row
from fdi_gym.vectors import load, store

I1, B2, M3 = int64[::1], boolean[:, ::1], float64[:, :, ::1]
LOG_2PI = float(np.log(2 * np.pi))


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


@inlined
def room_aboard(N, integers):
    """X, P, t, u and what is known of the disturbances, in lanes."""
    P = floats((N * N, LANES))
    return floats((N, LANES)), P, floats(LANES), floats((integers[COMMANDS], LANES)), floats((integers[KNOWN], LANES))


@helper
def aboard(first, X, P, t, u, known, lanes):
    """Take the episodes from `first` on into lanes; t, u and known may have fewer rows, each for as many episodes."""
    Xs, Ps, ts, us, ds = lanes
    n = X.shape[0]
    board_vectors(X, first, 1, Xs)
    board_matrices(P, first, Ps)
    board_vectors(u, first, n // u.shape[0], us)
    board_vectors(known, first, n // known.shape[0], ds)
    for lane in range(LANES):
        ts[lane] = t[min(first + lane, n - 1) * t.size // n]


@helper
def ashore(first, Xs, Ps, X1, P1):
    """Put X and P of the lanes back, from episode `first` on."""
    for lane in range(min(LANES, X1.shape[0] - first)):
        take_vector(Xs, lane, X1[first + lane])
        take_matrix(Ps, lane, P1[first + lane])


@compiled(void(int64, int64, *MODEL, V, M, M, M3, V, M, M, M3, M, M3))
def predict(lanes_at, rule, integers, reals, step, offset, direction, limit, plant, X, P, t, u, known, Q, X1, P1):
    """X1 and P1 one sample after X (n, N) and P (n, N, N); lanes_at: the address of `predict_lanes`."""
    n, N = X.shape
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    _check_covariances(n, P, N, Q, N)
    lanes = room_aboard(N, integers)
    Xs, Ps, ts, us, ds = lanes
    predict_lanes = predict_at(lanes_at)
    for first in range(0, n, LANES):
        aboard(first, X, P, t, u, known, lanes)
        some = min(LANES, n - first)
        predict_lanes(rule, integers, reals, step, offset, direction, limit, plant, first, some, Xs, Ps, ts, us, ds, Q)
        ashore(first, Xs, Ps, X1, P1)


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


@inlined
def room_of_update(N, m):
    """What sensors read, which of them reported, nu, S, its factor and the distance, in lanes."""
    S, U = floats((m * m, LANES)), floats((m * m, LANES))
    return floats((m, LANES)), floats((m, LANES)), floats((m, LANES)), S, U, floats((1, LANES))


@helper
def updated(first, there, nus, Ss, Us, distances, nu, S, distance, log):
    """Put back what lanes found of the sensors, with the log density of what they read, from episode `first` on."""
    m = nu.shape[1]
    for lane in range(min(LANES, nu.shape[0] - first)):
        e, density = first + lane, 0.0
        take_vector(nus, lane, nu[e])
        take_matrix(Ss, lane, S[e])
        for a in range(m):
            if there[a, lane] > 0.0:
                density -= 0.5 * LOG_2PI + np.log(Us[a * m + a, lane])
        distance[e] = distances[0, lane]
        log[e] = density - 0.5 * distance[e]


@compiled(void(int64, int64, *MODEL, M, M, B2, I1, M, M3, V, M, M, M, M3, M, M3, M, M3, V, V))
def update(
    lanes_at, rule, integers, reals, step, offset, direction, H, plain, seen, count, X, P, t, u, known, y, R,
    X1, P1, nu, S, distance, log,
):  # fmt: skip
    """X1 and P1 after the sensors y (n, m) at t, of which `seen` reported; lanes_at: the address of `update_lanes`."""
    (n, N), m = X.shape, integers[SENSORS]
    if n == 0:
        return
    _check(integers, step, n, N, t, u, known)
    _check_covariances(n, P, N, R, m)
    _check_sensors(n, m, y, seen)
    lanes = room_aboard(N, integers)
    Xs, Ps, ts, us, ds = lanes
    update_lanes = update_at(lanes_at)
    ys, there, nus, Ss, Us, distances = room_of_update(N, m)
    for e in range(n):
        count[e] = 0
        for a in range(m):
            count[e] += seen[e * y.shape[0] // n, a]
    for first in range(0, n, LANES):
        aboard(first, X, P, t, u, known, lanes)
        board_vectors(y, first, n // y.shape[0], ys)
        board_vectors(seen, first, n // y.shape[0], there)
        some = min(LANES, n - first)
        update_lanes(
            rule, integers, reals, step, offset, direction, H, plain, first, some, Xs, Ps, ts, us, ds, ys, there, R,
            nus, Ss, Us, distances,
        )  # fmt: skip
        ashore(first, Xs, Ps, X1, P1)
        updated(first, there, nus, Ss, Us, distances, nu, S, distance, log)


@compiled(void(B2, M, M3, M, M, M3, M3, M, M3, M, M3, M3, V, V))
def correct(seen, X, P, y, mean, cross, S, X1, P1, nu, S1, K, distance, log):
    """X1 and P1 after the sensors y (n, m), of which `seen` reported, with the moments (mean, cross (n, N, m), S)."""
    (n, N), m = X.shape, mean.shape[1]
    if n == 0:
        return
    if mean.shape[0] != n or cross.shape != (n, N, m) or S.shape != (n, m, m) or P.shape != (n, N, N):
        raise ValueError("the shapes are X (n, N), P (n, N, N), mean (n, m), cross (n, N, m) and S (n, m, m)")
    _check_sensors(n, m, y, seen)
    Xs, Ps, means, Ws = floats((N, LANES)), floats((N * N, LANES)), floats((m, LANES)), floats((N * m, LANES))
    cov, across, white = floats((m * m, LANES)), floats((m * N, LANES)), floats((m, LANES))
    ys, there, nus, Ss, Us, distances = room_of_update(N, m)
    for first in range(0, n, LANES):
        board_vectors(X, first, 1, Xs)
        board_matrices(P, first, Ps)
        board_vectors(y, first, n // y.shape[0], ys)
        board_vectors(seen, first, n // y.shape[0], there)
        board_vectors(mean, first, 1, means)
        board_matrices(cross, first, Ws)
        board_matrices(S, first, cov)
        for a in range(m):
            for i in range(N):
                store(across, a * N + i, 0, load(Ws, i * m + a, 0))
        store(distances, 0, 0, correct_lanes(Xs, Ps, ys, there, means, cov, across, Us, white, nus, Ss))
        ashore(first, Xs, Ps, X1, P1)
        updated(first, there, nus, Ss, Us, distances, nu, S1, distance, log)
        for a in range(m - 1, -1, -1):  # K' = U^-1 W
            for i in range(N):
                gain = load(across, a * N + i, 0)
                for b in range(a + 1, m):
                    gain -= load(Us, a * m + b, 0) * load(across, b * N + i, 0)
                store(across, a * N + i, 0, gain / load(Us, a * m + a, 0))
        for lane in range(min(LANES, n - first)):
            for a in range(m):
                for i in range(N):
                    K[first + lane, i, a] = across[a * N + i, lane]


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

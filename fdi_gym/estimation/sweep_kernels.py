"""Many samples of an augmented filter and its decision in one compiled call: what `sweep` stands on."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int16, int64, void

from fdi_gym.estimation.gaussian_algebra import board_matrices, board_vectors, take_matrix, take_vector
from fdi_gym.estimation.gaussian_points import COMMANDS, DISTURBANCES, ENTRIES, KNOWN, OUTPUTS, SENSORS, SIZES, STATES
from fdi_gym.estimation.gaussian_step import MODEL, predict_at, predict_lanes, update_at, update_lanes
from fdi_gym.estimation.label_kernels import SETS, decide_at, decide_lanes, fit_lanes
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, bools, compiled, floats, function_at, helper, ints
from fdi_gym.vectors import load, store

I1, I2, M3 = int64[::1], int64[:, ::1], float64[:, :, ::1]
AGE = void(V, int64, M)


@compiled(AGE)
def no_age(constants, n_x, P):
    """Nothing becomes of a prediction's covariance P (N N) in lanes; x are its first n_x entries."""


STEPS = predict_lanes, update_lanes, fit_lanes, decide_lanes
age_at = function_at(AGE)


@helper
def hear_of(integers, obs, d, first, k, y, seen, u, known):
    """What sensors in use, commands and measured disturbances read at sample k of flights obs (n, K, n_obs), into lanes."""
    n_y, sensors = integers[OUTPUTS], SIZES + integers[ENTRIES] + integers[DISTURBANCES]
    for lane in range(LANES):
        e = min(first + lane, obs.shape[0] - 1)
        for a in range(y.shape[0]):
            value = obs[e, k, integers[sensors + a]]
            seen[a, lane] = np.isfinite(value)
            y[a, lane] = value if np.isfinite(value) else 0.0
        for i in range(u.shape[0]):
            u[i, lane] = obs[e, k, n_y + i]
        for i in range(known.shape[0]):
            known[i, lane] = d[e, k, i]


@helper
def tell(x, z, P, healthy, lane, estimate, std, state):
    """Put down what the filter of a lane knows: estimate and std (p,), state (n_x,)."""
    p = healthy.size
    for i in range(p):
        estimate[i] = healthy[i] + z[i, lane]
        variance = P[i * (p + 1), lane]
        std[i] = 0.0 if variance < 0.0 else np.sqrt(variance)
    for i in range(state.size):
        state[i] = x[i, lane]


@compiled(
    void(
        I1, V, int64, *MODEL, V, M, M, M, M3, M3, M, boolean, I1, *SETS, V, float64, I1, V,
        M3, M3, I1, M, M3, M, M3, I1, I2, M, boolean[:, ::1], int16[:, ::1], M3, M3, M3,
    )
)  # fmt: skip
def sweep(
    steps, ages, rule, integers, reals, step, offset, direction, limit, plant, H, plain, Q, R,
    excess, fixed, labels, faults, at, along, low, high, penalty, rise, after, healthy,
    obs, d, following, X, P, nu, S, count, declared, waiting, alarm, label, estimate, std, state,
):  # fmt: skip
    """Samples `following` (n,) and on, obs (n, K, n_obs), of which all commands and known signals reported.

    X, P, nu, S, count, declared and waiting are brought up to the last of them. What is said of each sample comes last.
    steps: the addresses of STEPS and of what becomes of a prediction's covariance, `no_age` or one like it with `ages`.
    """
    (n, N), K, n_x, m, p = X.shape, obs.shape[1], integers[STATES], integers[SENSORS], healthy.size
    predict = predict_at(steps[0])
    update = update_at(steps[1])
    decide = decide_at(steps[3])
    age = age_at(steps[4])
    Xs, Ps, ts, us, ds = (
        floats((N, LANES)), floats((N * N, LANES)), floats(LANES), floats((integers[COMMANDS], LANES)),
        floats((integers[KNOWN], LANES)),
    )  # fmt: skip
    ys, there, nus, Ss = floats((m, LANES)), floats((m, LANES)), floats((m, LANES)), floats((m * m, LANES))
    Us, distance = floats((m * m, LANES)), floats((1, LANES))
    Pz, ks, informed = floats((p * p, LANES)), ints(LANES), bools(LANES)
    stands, waits = ints((LANES, 5)), floats((LANES, 2 + p))
    zs = Xs[n_x : n_x + p]
    for first in range(0, n, LANES):
        some = min(LANES, n - first)
        board_vectors(X, first, 1, Xs)
        board_matrices(P, first, Ps)
        for lane in range(LANES):
            e = min(first + lane, n - 1)
            ks[lane] = following[e] - 1
            for i in range(5):
                stands[lane, i] = declared[e, i]
            for i in range(2 + p):
                waits[lane, i] = waiting[e, i]
        for k in range(K):
            hear_of(integers, obs, d, first, k, ys, there, us, ds)
            for lane in range(LANES):
                ts[lane] = ks[lane] * reals[0]
                ks[lane] += 1
            predict(rule, integers, reals, step, offset, direction, limit, plant, first, some, Xs, Ps, ts, us, ds, Q)
            age(ages, n_x, Ps)
            for lane in range(LANES):
                ts[lane] = ks[lane] * reals[0]
                informed[lane] = False
                for a in range(m):
                    informed[lane] = informed[lane] or there[a, lane] > 0.0
            update(
                rule, integers, reals, step, offset, direction, H, plain, first, some, Xs, Ps, ts, us, ds, ys, there, R, nus,
                Ss, Us, distance,
            )  # fmt: skip
            for i in range(p):
                for j in range(p):
                    store(Pz, i * p + j, 0, load(Ps, (n_x + i) * N + n_x + j, 0))
            decide(
                steps[2], zs, Pz, excess, fixed, labels, faults, at, along, low, high, penalty, rise, after, ks, informed,
                stands, waits,
            )  # fmt: skip
            for lane in range(some):
                e = first + lane
                alarm[e, k], label[e, k] = stands[lane, 0] > 0, stands[lane, 0]
                tell(Xs, zs, Pz, healthy, lane, estimate[e, k], std[e, k], state[e, k])
        for lane in range(some):
            e = first + lane
            take_vector(Xs, lane, X[e])
            take_matrix(Ps, lane, P[e])
            take_vector(nus, lane, nu[e])
            take_matrix(Ss, lane, S[e])
            count[e] = 0
            for a in range(m):
                count[e] += there[a, lane] > 0.0
            for i in range(5):
                declared[e, i] = stands[lane, i]
            for i in range(2 + p):
                waiting[e, i] = waits[lane, i]

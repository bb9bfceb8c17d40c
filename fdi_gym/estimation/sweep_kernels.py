"""Many samples of an augmented filter and its decision in one compiled call: what `sweep` stands on."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int16, int64, void

from fdi_gym.estimation import gaussian_kernels, label_kernels
from fdi_gym.estimation.gaussian_kernels import MODEL
from fdi_gym.estimation.gaussian_points import COMMANDS, DISTURBANCES, ENTRIES, OUTPUTS, SENSORS, SIZES, STATES
from fdi_gym.estimation.label_kernels import SETS
from fdi_gym.kernels import M, V, address, bools, compiled, floats, function_at, helper, ints, signature_of

I1, I2, M3, M4 = int64[::1], int64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]
STEPS = gaussian_kernels.predict, gaussian_kernels.update, label_kernels.wait, label_kernels.judge
predict_at, update_at, wait_at, judge_at = (function_at(signature_of(kernel)) for kernel in STEPS)
BLOCK = 64  # flights that go side by side: what they are at stays in the nearest cache


@helper
def take(integers, obs, d, k, y, seen, u, known):
    """What the sensors in use, the commands and the measured disturbances read at a sample of flights obs (n, K, n_obs)."""
    n_y, p, n_d = integers[OUTPUTS], integers[ENTRIES], integers[DISTURBANCES]
    for e in range(y.shape[0]):
        for a in range(y.shape[1]):
            value = obs[e, k, integers[SIZES + p + n_d + a]]
            seen[e, a] = np.isfinite(value)
            y[e, a] = value if seen[e, a] else 0.0
        for i in range(u.shape[1]):
            u[e, i] = obs[e, k, n_y + i]
        for i in range(d.shape[2]):
            known[e, i] = d[e, k, i]


@helper
def tell(x, z, P, healthy, k, estimate, std, state):
    """Put down of sample k what the filter knows: estimate and std (n, K, p), state (n, K, n_x)."""
    for e in range(x.shape[0]):
        for i in range(healthy.size):
            estimate[e, k, i] = healthy[i] + z[e, i]
            variance = P[e, i, i]
            std[e, k, i] = 0.0 if variance < 0.0 else np.sqrt(variance)
        for i in range(state.shape[2]):
            state[e, k, i] = x[e, i]


def addresses() -> tuple[int, ...]:
    """Of the compiled steps that a sweep takes in turn."""
    return tuple(address(kernel) for kernel in STEPS)


@compiled(
    void(
        I1, int64, *MODEL, V, M, M, M, M3, M3, M, M3, I1, *SETS, V, float64, I1, V, M3, M3, I1, M, M4, M, M3, I1, I2, M,
        boolean[:, ::1], int16[:, ::1], M3, M3, M3,
    )
)  # fmt: skip
def sweep(
    steps, rule, integers, reals, step, offset, direction, limit, plant, H, plain, Q, R,
    excess, metric, labels, faults, at, along, low, high, penalty, rise, after, healthy,
    obs, d, following, X, P, nu, S, count, declared, waiting, alarm, label, estimate, std, state,
):  # fmt: skip
    """Samples `following` (n,) and on, obs (n, K, n_obs), of which all commands and known signals reported.

    X, nu, count, declared and waiting are brought up to the last of them, as P (2, n, N, N), whose second half is room.
    metric (1, p, p), or (0, p, p) for the estimate's own covariance. What is said of each sample comes last.
    """
    n_all, K, n_x, m, p, n_u = X.shape[0], obs.shape[1], integers[STATES], integers[SENSORS], healthy.size, integers[COMMANDS]
    N, sets, f = X.shape[1], along.shape[0], along.shape[2]
    some = min(BLOCK, n_all)
    y, u, known, t, z, Pz = floats((some, m)), floats((some, n_u)), floats((some, d.shape[2])), floats(some), floats((some, p)), floats((some, p, p))
    moved, cost, magnitudes, waited = floats((some, N)), floats((some, penalty.size)), floats((some, sets, f)), floats((some, 2 + p))
    stood, said, number = ints((some, 5)), ints(some), ints(some)
    seen, informed, counts, raised = bools((some, m)), bools(some), bools(some), bools(some)
    distance, log, nothing = floats(some), floats(some), floats(0)
    predict = predict_at(steps[0])
    update = update_at(steps[1])
    wait = wait_at(steps[2])
    judge = judge_at(steps[3])
    for first in range(0, n_all, BLOCK):
        n = min(BLOCK, n_all - first)
        own = slice(first, first + n)
        Xb, Pa, Pb, nub, Sb, countb = X[own], P[0][own], P[1][own], nu[own], S[own], count[own]
        obsb, db, declaredb, waitingb = obs[own], d[own], declared[own], waiting[own]
        alarmb, labelb, estimateb, stdb, stateb = alarm[own], label[own], estimate[own], std[own], state[own]
        yb, seenb, ub, knownb, tb, zb, Pzb = y[:n], seen[:n], u[:n], known[:n], t[:n], z[:n], Pz[:n]
        for k in range(K):
            take(integers, obsb, db, k, yb, seenb, ub, knownb)
            for e in range(n):
                number[e] = following[first + e] + k
                tb[e] = (number[e] - 1) * reals[0]
            predict(rule, integers, reals, step, offset, direction, limit, plant, Xb, Pa, tb, ub, knownb, Q, moved[:n], Pb)
            for e in range(n):
                tb[e] = number[e] * reals[0]
            update(
                rule, integers, reals, step, offset, direction, H, plain, seenb, countb, moved[:n], Pb, tb, ub, knownb, yb, R,
                Xb, Pa, nub, Sb, distance, log,
            )  # fmt: skip
            for e in range(n):
                informed[e] = countb[e] > 0
                for i in range(p):
                    zb[e, i] = Xb[e, n_x + i]
                    for j in range(p):
                        Pzb[e, i, j] = Pa[e, n_x + i, n_x + j]
            wait(Pzb, informed[:n], waitingb, waited[:n], counts[:n])
            judge(
                zb, metric if metric.shape[0] > 0 else Pzb, excess, labels, faults, at, along, low, high,
                penalty, nothing, rise, after, number[:n], counts[:n], declaredb, stood[:n], said[:n], raised[:n], cost[:n],
                magnitudes[:n],
            )  # fmt: skip
            for e in range(n):
                for i in range(5):
                    declaredb[e, i] = stood[e, i]
                for i in range(2 + p):
                    waitingb[e, i] = waited[e, i]
                alarmb[e, k], labelb[e, k] = raised[e], said[e]
            tell(Xb, zb, Pzb, healthy, k, estimateb, stdb, stateb)

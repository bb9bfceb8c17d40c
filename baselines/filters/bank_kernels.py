"""The filters of a bank over events, one sample on: of each episode those that run go side by side, wherever they stand.

Rows are those of `hypothesis_kernels`. Each is on a line of its own, as the events are that act in it; what the steps of
`fdi_gym.estimation.gaussian_step` know of the model comes first, the address of the step before it. A bank is (offset,
direction, steady, steady_direction, mean, spread): what the events do (r, p), (r, p, f), (r, p), (r, p, f), and the physical
parameters, (e,) and (e, c).
"""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, types, void

from baselines.filters.hypothesis_kernels import NEVER, likeliest
from fdi_gym.estimation.gaussian_algebra import take_matrix, take_vector
from fdi_gym.estimation.gaussian_kernels import room_aboard, room_of_update, updated
from fdi_gym.estimation.gaussian_points import EXTENDED, SENSORS
from fdi_gym.estimation.gaussian_step import predict_at, update_at
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, compiled, floats, helper, inlined, ints

I1, I3, B2 = int64[::1], int64[:, :, ::1], boolean[:, ::1]
M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]
BANK = types.Tuple((M, M3, M, M3, V, M))


@helper
def running(log, rows):
    """Which rows of an episode have a filter that runs, the first of `rows`: the healthy one, and all with a weight."""
    count = 0
    for i in range(log.size):
        if i == 0 or log[i] > NEVER:
            rows[count] = i
            count += 1
    return count


@inlined
def room_of_lines(bank, E):
    """Offsets (LANES, p + e) and directions (LANES, p + e, E f + c), with what all filters have of the parameters."""
    _, direction, _, _, mean, spread = bank
    (_, p, f), (e, c) = direction.shape, spread.shape
    offsets, directions = floats((LANES, p + e)), floats((LANES, p + e, E * f + c))
    offsets[:], directions[:] = 0.0, 0.0
    for lane in range(LANES):
        for a in range(e):
            offsets[lane, p + a] = mean[a]
            for b in range(c):
                directions[lane, p + a, E * f + b] = spread[a, b]
    return offsets, directions


@helper
def line_of(kind, length, held, bank, offsets, directions):
    """The line (p + e), (p + e, E f + c) on which these events are; length (E,) of their courses."""
    offset, direction, steady, steady_direction, _, _ = bank
    (_, p, f) = direction.shape
    for a in range(p):
        offsets[a] = 0.0
        for j in range(kind.size):
            q, share = max(kind[j], 0), length[j]
            acts = 1.0 if kind[j] >= 0 else 0.0
            offsets[a] += acts * (share * offset[q, a] + (held[j, a] + steady[q, a]))
            for b in range(f):
                directions[a, j * f + b] = acts * (share * direction[q, a, b] + steady_direction[q, a, b])


@helper
def come_aboard(rows, first, some, X, P, kind, length, held, bank, lanes, lines):
    """Take so many rows of an episode, from number `first` of `rows` on, into lanes; further lanes are as the last."""
    offsets, directions = lines
    N = X.shape[1]
    for lane in range(LANES):
        i = rows[first + min(lane, some - 1)]
        for x in range(N):
            lanes[0][x, lane] = X[i, x]
            for y in range(N):
                lanes[1][x * N + y, lane] = P[i, x, y]
        line_of(kind[i], length[i], held[i], bank, offsets[lane], directions[lane])


@helper
def go_ashore(rows, first, some, lanes, X1, P1):
    """Put the lanes' filters back into their rows."""
    for lane in range(some):
        take_vector(lanes[0], lane, X1[rows[first + lane]])
        take_matrix(lanes[1], lane, P1[rows[first + lane]])


@helper
def hear(e, t, u, known, lanes):
    """All lanes are of episode e."""
    for lane in range(LANES):
        lanes[2][lane] = t[e]
        for i in range(u.shape[1]):
            lanes[3][i, lane] = u[e, i]
        for i in range(known.shape[1]):
            lanes[4][i, lane] = known[e % known.shape[0], i]


@helper
def silence(rows, first, some, kind, frozen, again, there, likelihood):
    """Of sensors that are frozen in a lane nothing is heard, and `again` (m + 1) adds to the row's log likelihood."""
    for lane in range(LANES):
        i = rows[first + min(lane, some - 1)]
        for j in range(kind.shape[1]):
            a = frozen[kind[i, j]] if kind[i, j] >= 0 else there.shape[0]
            if a < there.shape[0]:
                there[a, lane] = 0.0
                if lane < some:
                    likelihood[i] += again[a]


@helper
def clear(log, X1, P1):
    """Nothing is where no filter runs."""
    for i in range(1, log.size):
        if log[i] <= NEVER:
            for x in range(X1.shape[1]):
                X1[i, x] = 0.0
                for y in range(X1.shape[1]):
                    P1[i, x, y] = 0.0


@helper
def wander(kind, rates, m, f, X, P):
    """Magnitudes of kinds that wander, one sample on: X (N,), P (N, N) of a row; rates (r,), 1 for kinds that do not."""
    N = X.size
    for j in range(kind.size):
        rate = rates[max(kind[j], 0)]
        for x in range(m + j * f, m + (j + 1) * f if kind[j] >= 0 and rate < 1.0 else 0):
            X[x] *= rate
            for y in range(N):
                P[x, y] *= rate
                P[y, x] *= rate
            P[x, x] += 1.0 - rate**2


@compiled(void(int64, I1, V, V, V, M, BANK, V, int64, M3, V, M, M, M3, M4, M, I3, M3, M4, M3, M4))
def move(
    predict_lanes_at, integers, reals, step, limit, plant, bank, rates, m, Q, t, u, known, X, P, log, kind, length, held,
    X1, P1,
):  # fmt: skip
    """X1 (n, count, N) and P1 (n, count, N, N), which may be X and P, one sample after t; Q (1 or n, N, N)."""
    (n, count, N), E, f = X.shape, kind.shape[2], bank[1].shape[2]
    lanes, lines, rows = room_aboard(N, integers), room_of_lines(bank, E), ints(count)
    predict_lanes = predict_at(predict_lanes_at)
    Xs, Ps, ts, us, ds = lanes
    for e in range(n):
        many, Qe = running(log[e], rows), Q[e % Q.shape[0] : e % Q.shape[0] + 1]
        hear(e, t, u, known, lanes)
        for first in range(0, many, LANES):
            some = min(LANES, many - first)
            come_aboard(rows, first, some, X[e], P[e], kind[e], length[e], held[e], bank, lanes, lines)
            predict_lanes(
                EXTENDED, integers, reals, step, lines[0], lines[1], limit, plant, 0, some, Xs, Ps, ts, us, ds, Qe
            )  # fmt: skip
            go_ashore(rows, first, some, lanes, X1[e], P1[e])
            for a in range(first, first + some):
                wander(kind[e, rows[a]], rates, m, f, X1[e, rows[a]], P1[e, rows[a]])
        clear(log[e], X1[e], P1[e])


@helper
def weighed(log, likelihood, given_up):
    """The log weights of an episode times its rows' likelihoods, of the likeliest 1 together; what is left is given up."""
    for i in range(log.size):
        value = log[i] + likelihood[i]
        log[i] = NEVER if value < NEVER else value  # what is no number remains so
    top, total = likeliest(log), 0.0
    for i in range(log.size):
        total += np.exp(log[i] - top)
    total = top + np.log(total)
    for i in range(log.size):
        if log[i] > NEVER:
            log[i] -= total
        if i > 0 and log[i] < given_up:
            log[i] = NEVER


@compiled(
    void(int64, I1, V, V, M, M, BANK, float64, M3, V, M, M, M, B2, I1, M, M3, M4, I3, M3, M4, M3, M4, M, M, M3)
)  # fmt: skip
def weigh(
    update_lanes_at, integers, reals, step, H, plain, bank, given_up, R, t, u, known, y, seen, frozen, again, X, P, kind,
    length, held, X1, P1, log, nu, S,
):  # fmt: skip
    """X1 and P1 after the sensors y (n, m) that reported, and `log` (n, count) then; nu and S are the healthy filter's.

    frozen (r,): the sensor that each kind freezes, m: none; again (n, m + 1): log density of the reading if it is frozen.
    """
    (n, count, N), E, sensors = X.shape, kind.shape[2], integers[SENSORS]
    lanes, lines, rows, likelihood = room_aboard(N, integers), room_of_lines(bank, E), ints(count), floats(count)
    ys, there, nus, Ss, Us, distances = room_of_update(N, sensors)
    nu1, S1, distance, density = floats((LANES, sensors)), floats((LANES, sensors, sensors)), floats(LANES), floats(LANES)
    update_lanes = update_at(update_lanes_at)
    Xs, Ps, ts, us, ds = lanes
    for e in range(n):
        many = running(log[e], rows)
        hear(e, t, u, known, lanes)
        likelihood[:] = 0.0
        for first in range(0, many, LANES):
            some = min(LANES, many - first)
            for a in range(sensors):
                for lane in range(LANES):
                    ys[a, lane], there[a, lane] = y[e, a], seen[e, a]
            silence(rows, first, some, kind[e], frozen, again[e], there, likelihood)
            come_aboard(rows, first, some, X[e], P[e], kind[e], length[e], held[e], bank, lanes, lines)
            update_lanes(
                EXTENDED, integers, reals, step, lines[0], lines[1], H, plain, 0, some, Xs, Ps, ts, us, ds, ys, there, R,
                nus, Ss, Us, distances,
            )  # fmt: skip
            go_ashore(rows, first, some, lanes, X1[e], P1[e])
            updated(0, there, nus, Ss, Us, distances, nu1, S1, distance, density)
            for lane in range(some):
                likelihood[rows[first + lane]] += density[lane]
            if first == 0:
                for a in range(sensors):
                    nu[e, a] = nu1[0, a]
                    for b in range(sensors):
                        S[e, a, b] = S1[0, a, b]
        clear(log[e], X1[e], P1[e])
        weighed(log[e], likelihood, given_up)


@compiled(void(M, I3, M3, M4, M3, int64, BANK, I1, I1, I1, I1, I1, M, M, M))
def tell(log, kind, length, held, X, m, bank, modes, sets, labels, entry, at, probs, z, x):
    """Probabilities of the labels (n, labels), the mean of theta's entries (n, p) and of the state (n, n_x).

    modes (r,): the kinds' modes as bits, sets: those that each of `labels` says. Entry `entry` of theta is number `at` of
    those that events move.
    """
    offset, direction, steady, steady_direction, _, _ = bank
    f = direction.shape[2]
    for e in range(log.shape[0]):
        for i in range(log.shape[1]):
            w, acts = np.exp(log[e, i]), 0
            if i > 0 and log[e, i] <= NEVER:
                continue
            for j in range(kind.shape[2]):
                q = kind[e, i, j]
                if q < 0:
                    continue
                acts |= modes[q]
                for a in range(entry.size):
                    b = at[a]
                    along, beside = offset[q, b], steady[q, b] + held[e, i, j, b]
                    for c in range(f):
                        magnitude = X[e, i, m + j * f + c]
                        along += direction[q, b, c] * magnitude
                        beside += steady_direction[q, b, c] * magnitude
                    z[e, entry[a]] += w * (length[e, i, j] * along + beside)
            label = 0
            for a in range(sets.size):
                if sets[a] == acts:
                    label = a
            probs[e, labels[label]] += w
            for a in range(x.shape[1]):
                x[e, a] += w * X[e, i, a]
        total = 0.0
        for a in range(probs.shape[1]):
            total += probs[e, a]
        for a in range(probs.shape[1]):
            probs[e, a] /= total

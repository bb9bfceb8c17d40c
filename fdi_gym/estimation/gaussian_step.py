"""The Gaussian step of LANES episodes side by side: predict and update, of any plant, by any rule.

X (N, LANES) and P (N N, LANES) and all that is so named are in lanes, as in `gaussian_algebra`. What a plant's equations are
tried at is one episode's, and goes in and out of its lane; a linear plant and linear sensors stay in lanes throughout.

The two kernels are called by address, from `gaussian_kernels` and `sweep_kernels`: compiling them takes longest of all.
"""

from __future__ import annotations

from numba import float64, int64, void

from fdi_gym.estimation.gaussian_algebra import (
    board_one,
    correct,
    entries_of,
    entry,
    factor,
    in_turn,
    predicted,
    take_matrix,
    take_vector,
    through_matrix,
    through_rows,
)
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
from fdi_gym.estimation.gaussian_points import COMMANDS, EXTENDED, KNOWN, OUTPUTS, SENSORS, STATES, TANGENT
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, compiled, floats, function_at, helper, ints, signature_of
from fdi_gym.tangent import row
from fdi_gym.vectors import load, store, zeros

I1, M3 = int64[::1], float64[:, :, ::1]
# integers, reals, step, offset, direction: the constants of a model that tell its f and h, as `gaussian.bind` packs them
MODEL = (I1, V, V, M, M3)


@helper
def take_episode(lane, X, u, known, x, ue, de):
    """Take an episode out of its lane: what a plant's equations need of it."""
    take_vector(X, lane, x)
    take_vector(u, lane, ue)
    take_vector(known, lane, de)


@helper
def board_moments(lane, points, read, table, across, mean, F, cross, cov):
    """Put what its equations gave into the lane: mean, and of points cross and cov, else the Jacobian F (m N)."""
    m, N = read.size, cross.shape[0] // read.size
    for a in range(m):
        mean[a, lane] = read[a]
    if points:
        board_one(table, lane, N, cross)
        board_one(across, lane, m, cov)
    else:
        board_one(table, lane, N, F)


@compiled(void(int64, *MODEL, V, M, int64, int64, M, M, V, M, M, M3))
def predict_lanes(rule, integers, reals, step, offset, direction, limit, plant, first, count, X, P, t, u, known, Q):
    """X and P one sample after t (LANES,), of `count` episodes from number `first` on; further lanes are as the last."""
    n_x, N = integers[STATES], X.shape[0]
    linear, points = plant.shape[0] > 0, plant.shape[0] == 0 and rule != EXTENDED
    mean, cross, cov = floats((n_x, LANES)), floats((n_x * N, LANES)), floats((n_x * n_x, LANES))
    F, where, many, Us = floats((n_x * N, LANES)), ints((n_x, N)), ints(n_x), floats((N * N if points else 0, LANES))
    x, ue, de, moved = floats(N), floats(integers[COMMANDS]), floats(integers[KNOWN]), floats(n_x)
    U, line, whose, spare = floats((N, N) if points else (0, 0)), ints(LANES), ints(LANES), floats((1, LANES))
    table, across, room = floats((n_x, row(N))), floats((n_x, n_x)), room_of(integers, reals, 0 if linear else row(N))
    in_turn(first, offset.shape[0], line)
    in_turn(first, Q.shape[0], whose)
    if linear:
        linearised(integers, offset, direction, plant, line, X, u, known, F, mean, spare)
    elif points:
        factor(P, N, Us)
    for lane in range(0 if linear else LANES):
        if lane < count:
            take_episode(lane, X, u, known, x, ue, de)
            o, e = offset[line[lane]], direction[line[lane]]
            if points:
                take_matrix(Us, lane, U)
                through(rule, True, integers, reals, o, e, t[lane], x, U, ue, de, moved, table, across)
            elif integers[TANGENT] != 0:
                differentiated(integers, reals, step, o, e, t[lane], x, ue, de, room, table, moved)
            else:
                differenced(integers, reals, step, o, e, t[lane], x, ue, de, table, moved)
        board_moments(lane, points, moved, table, across, mean, F, cross, cov)
    if not points:
        entries_of(F, n_x, N, where, many)
        through_matrix(F, P, n_x, N, where, many, cross, cov)
    predicted(mean, cross, cov, Q, whose, limit, X, P, spare)


@compiled(void(int64, *MODEL, M, M, int64, int64, M, M, V, M, M, M, M, M3, M, M, M, M))
def update_lanes(
    rule, integers, reals, step, offset, direction, H, plain, first, count, X, P, t, u, known, y, seen, R, nu, S, U, distance
):  # fmt: skip
    """X and P after the sensors y (m) at t (LANES,) that reported (seen > 0); `first` and `count` as in `predict_lanes`.

    distance (1) becomes nu' S^-1 nu; S = U' U.
    """
    m, N = integers[SENSORS], X.shape[0]
    fixed, points = H.shape[0] > 0, H.shape[0] == 0 and rule != EXTENDED
    mean, cross, F, cov = floats((m, LANES)), floats((m * N, LANES)), floats((m * N, LANES)), floats((m * m, LANES))
    white, where, many, Us = floats((m, LANES)), ints((m, N)), ints(m), floats((N * N if points else 0, LANES))
    x, ue, de, read = floats(N), floats(integers[COMMANDS]), floats(integers[KNOWN]), floats(m)
    Ue, line, whose, spare = floats((N, N) if points else (0, 0)), ints(LANES), ints(LANES), floats((1, LANES))
    table, across, room = floats((m, N)), floats((m, m)), room_of(integers, reals, 0)
    faults, tried, values = own_faults(integers), floats(N), floats(integers[OUTPUTS])
    in_turn(first, offset.shape[0], line)
    in_turn(first, R.shape[0], whose)
    if fixed:
        for a in range(m):
            total = zeros()
            for j in range(N):
                if H[a, j] != 0.0:
                    total += load(X, j, 0) * H[a, j]
            store(mean, a, 0, total)
        through_rows(H, P, cross, cov)
    elif points:
        factor(P, N, Us)
    for lane in range(0 if fixed else LANES):
        if lane < count:
            take_episode(lane, X, u, known, x, ue, de)
            o, e = offset[line[lane]], direction[line[lane]]
            if points:
                take_matrix(Us, lane, Ue)
                through(rule, False, integers, reals, o, e, t[lane], x, Ue, ue, de, read, table, across)
            elif plain.shape[0] > 0:
                heard(integers, reals, faults, o, e, plain, x, table, read)
            else:
                sensed(integers, reals, step, o, e, t[lane], x, ue, de, room, tried, values, table, read)
        board_moments(lane, points, read, table, across, mean, F, cross, cov)
    if not (fixed or points):
        entries_of(F, m, N, where, many)
        through_matrix(F, P, m, N, where, many, cross, cov)
    for a in range(m):
        for b in range(a + 1):
            total = load(cov, a * m + b, 0)
            store(cov, a * m + b, 0, total + entry(R, whose, (a, b), spare))
            store(cov, b * m + a, 0, total + entry(R, whose, (b, a), spare))
    store(distance, 0, 0, correct(X, P, y, seen, mean, cov, cross, U, white, nu, S))


predict_at, update_at = function_at(signature_of(predict_lanes)), function_at(signature_of(update_lanes))

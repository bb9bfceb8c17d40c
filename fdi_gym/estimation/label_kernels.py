"""The kernels of `labels`: how far each estimate of a batch is from each label's set, and which label fits best."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.automaton import advance
from fdi_gym.estimation.gaussian_algebra import board_matrices, board_vectors
from fdi_gym.estimation.label_algebra import informative, invert, nearest_points, room
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, compiled, floats, function_at, helper, inlined, signature_of
from fdi_gym.vectors import load, store, zeros

I1, I2, B1, M3 = int64[::1], int64[:, ::1], boolean[::1], float64[:, :, ::1]
SURE_AGAIN = 1.2  # times the variance before a gap
PATIENCE, PER_GAP = 20.0, 2.0  # it waits for so many samples at most, and so many more for each without a report
SETS = (I1, M, M3, M, M)  # faults, offset, direction, low, high: of the sets, as in `labels.Manifolds`


@compiled(void(M3, M, *SETS, M, M3))
def nearest(I, Iz, faults, offset, direction, low, high, value, m):  # noqa: E741
    """value (n, sets) and m (n, sets, f) of `nearest_points` for I (n or 1, p, p) and Iz (n, p)."""
    n, (sets, p, f) = len(Iz), direction.shape
    Is, Izs, work = floats((p * p, LANES)), floats((p, LANES)), room(p, f)
    values, at = floats((sets, LANES)), floats((sets * f, LANES))
    for first in range(0, n, LANES):
        if len(I) > 1 or first == 0:
            board_matrices(I, first, Is)
        board_vectors(Iz, first, 1, Izs)
        nearest_points(Is, Izs, faults, offset, direction, low, high, values, at, work)
        for lane in range(min(LANES, n - first)):
            for s in range(sets):
                value[first + lane, s] = values[s, lane]
                for r in range(f):
                    m[first + lane, s, r] = at[s * f + r, lane]


@compiled(void(M, M, M, *SETS, boolean, M, M, M, M))
def fit_lanes(z, P, excess, faults, offset, direction, low, high, known, I, healthy, values, m):  # noqa: E741
    """Squared distances of estimates z (p) to healthy (1) and the sets, values (sets) with their magnitudes m (sets f).

    The metric is that of P (p p) + excess, all in lanes; known: I (p p), the inverse of that, is the last call's.
    """
    p, (sets, _, f) = z.shape[0], direction.shape
    Iz, work, inner = floats((p, LANES)), floats((p * p, LANES)), room(p, f)
    if not known:
        invert(P, excess, p, work, I)
    store(healthy, 0, 0, informative(I, z, p, Iz))
    nearest_points(I, Iz, faults, offset, direction, low, high, values, m, inner)
    for s in range(sets):
        store(values, s, 0, load(values, s, 0) + load(healthy, 0, 0))


fit_at = function_at(signature_of(fit_lanes))


@inlined
def room_to_fit(direction):
    """What `fit_lanes` leaves."""
    sets, p, f = direction.shape
    return floats((p * p, LANES)), floats((1, LANES)), floats((sets, LANES)), floats((sets * f, LANES))


@compiled(void(int64, M, M3, M, I1, *SETS, M, M3))
def distances(lanes_at, z, P, excess, labels, faults, offset, direction, low, high, cost, m):
    """Squared distances of z (n, p) to healthy, cost[:, 0], and to set s, cost[:, labels[s]], with magnitudes m (n, sets, f)

    The metric is that of P (n or 1, p, p) + excess; lanes_at: the address of `fit_lanes`.
    """
    (n, p), f, found = z.shape, direction.shape[2], room_to_fit(direction)
    zs, Ps, (I, healthy, values, at) = floats((p, LANES)), floats((p * p, LANES)), found  # noqa: E741
    fit = fit_at(lanes_at)
    for first in range(0, n, LANES):
        board_vectors(z, first, 1, zs)
        board_matrices(P, first, Ps)
        fit(zs, Ps, excess, faults, offset, direction, low, high, first > 0 and len(P) == 1, I, healthy, values, at)
        for lane in range(min(LANES, n - first)):
            cost[first + lane, 0] = healthy[0, lane]
            for s in range(len(faults)):
                cost[first + lane, labels[s]] = values[s, lane]
                for r in range(f):
                    m[first + lane, s, r] = at[s * f + r, lane]


@helper
def lowest(values, penalty, first):
    """Position of the first least values + penalty from `first` on; that of one that is no number, where there is one."""
    best = first
    for i in range(first, len(values)):
        value, least = values[i] + penalty[i], values[best] + penalty[best]
        if value != value:
            return i
        if value < least:
            best = i
    return best


@helper
def gain(cost, penalty):
    """The gain in fit over healthy of the best faulty label, as a share of what it must be; no number if one is none."""
    share = -np.inf
    for i in range(1, len(cost)):
        value = (cost[0] - cost[i]) / penalty[i]
        if value != value:
            return value
        share = max(share, value)
    return share


@helper
def declared(cost, penalty, statistic, limit, after, k, informed, state, state1):
    """An automaton, the five integers of `automaton.advance`, one sample later, as of `declare`; statistic (1,) or (0,)."""
    label, over, other, under, last = state[0], state[1], state[2], state[3], state[4]
    if informed and k > after[4]:
        rise, switch, release, same = after[0], after[1], after[2], after[3] > 0
        if same:  # health is a label like the others
            best = lowest(cost, penalty, 0)
            above, below = best > 0, False
        else:
            best, share = lowest(cost, penalty, 1), gain(cost, penalty)
            above, below = statistic[0] > limit if statistic.size else share > 1.0, share < 0.5
        label, over, other, under, last = advance(
            label, over, other, under, last, best, above, below, rise, switch, release, same
        )
    state1[0], state1[1], state1[2], state1[3], state1[4] = label, over, other, under, last


@helper
def sure_again(informed, variances, state, state1):
    """Whether a sample counts, as of `wait`; variances (p,)."""
    still, patience, unsure = state[0] > 0.0, state[1], False
    for i in range(variances.size):
        unsure = unsure or variances[i] > SURE_AGAIN * state[2 + i]
    still = not informed or (still and unsure and patience > 0.0)
    state1[0] = still
    state1[1] = patience + (-1.0 if informed else PER_GAP) if still else PATIENCE
    for i in range(variances.size):
        state1[2 + i] = state[2 + i] if still else variances[i]
    return not still


@compiled(void(M3, B1, M, M, B1))
def wait(P, informed, state, state1, counts):
    """Whether samples count (n,): none after a gap does until the estimate is about as sure again, or does not become so.

    `informed` (n,): some sensor reported. The state (n, 2 + p): whether it is waited, for how many samples with reports at
    most, and the variances of the estimate when a sample last counted; P (n, p, p) has those of now.
    """
    variances = floats(P.shape[1])
    for e in range(len(counts)):
        for i in range(variances.size):
            variances[i] = P[e, i, i]
        counts[e] = sure_again(informed[e], variances, state[e], state1[e])


@compiled(void(M, V, V, float64, I1, I1, B1, I2, I2, I1, B1))
def declare(cost, penalty, statistic, limit, after, k, informed, state, state1, label, alarm):
    """The automata (n, 5) one sample later, and what they declare, from the costs (n, labels) and what each label must gain.

    The statistic (n,), where there is one (else (0,)), takes the place of the costs in raising an alarm. after: rise,
    switch, release, same and warmup of a persistence.
    """
    for e in range(len(cost)):
        declared(cost[e], penalty, statistic[e : e + 1], limit, after, k[e], informed[e], state[e], state1[e])
        label[e], alarm[e] = state1[e, 0], state1[e, 0] > 0


@compiled(void(int64, M, M, M, boolean, I1, *SETS, V, float64, I1, I1, B1, I2, M))
def decide_lanes(
    lanes_at, z, P, excess, fixed, labels, faults, offset, direction, low, high, penalty, limit, after, k, informed, state,
    waiting,
):  # fmt: skip
    """`wait`, `distances` and `declare` for whoever has its estimates in lanes: state (LANES, 5) and waiting move on.

    z (p, LANES) and P (p p, LANES), or where `fixed`, excess alone is the metric.
    """
    p, (I, healthy, values, at) = z.shape[0], room_to_fit(direction)  # noqa: E741
    cost, variances, nothing, metric = floats(penalty.size), floats(p), floats(0), floats(P.shape)
    fit = fit_at(lanes_at)
    for i in range(p * p):
        store(metric, i, 0, zeros() if fixed else load(P, i, 0))
    fit(z, metric, excess, faults, offset, direction, low, high, False, I, healthy, values, at)
    for lane in range(LANES):
        for i in range(p):
            variances[i] = P[i * (p + 1), lane]
        cost[0] = healthy[0, lane]
        for s in range(len(faults)):
            cost[labels[s]] = values[s, lane]
        counts = sure_again(informed[lane], variances, waiting[lane], waiting[lane])
        declared(cost, penalty, nothing, limit, after, k[lane], counts, state[lane], state[lane])


decide_at = function_at(signature_of(decide_lanes))

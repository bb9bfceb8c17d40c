"""The kernels of `labels`: how far each estimate of a batch is from each label's set, and which label fits best."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.automaton import advance
from fdi_gym.estimation.compiled import box_minimum, eliminate
from fdi_gym.kernels import M, V, compiled, floats, helper, inlined, ints

I1, I2, B1, M3 = int64[::1], int64[:, ::1], boolean[::1], float64[:, :, ::1]
SURE_AGAIN = 1.2  # times the variance before a gap
PATIENCE, PER_GAP = 20.0, 2.0  # it waits for so many samples at most, and so many more for each without a report
SETS = (I1, M, M3, M, M)  # faults, offset, direction, low, high: of the sets, as in `labels.Manifolds`


@inlined
def room(p, most):
    """What `nearest_points` works in, for sets of up to `most` faults in p dimensions."""
    G, g, ID, Io = floats((most, most)), floats(most), floats((most, p)), floats(p)
    a, at, where, tried = floats((most, most + 1)), ints(most), ints(most), floats(most)
    return G, g, ID, Io, a, at, where, tried


@helper
def nearest_points(I, Iz, faults, offset, direction, low, high, value, m, room):  # noqa: E741 (the information)
    """value[s] = min of q' I q - 2 q' Iz over q = offset[s] + direction[s] m[s] with m[s] in its box, for all sets s."""
    sets, p, most = direction.shape
    G, g, ID, Io, a, at, where, tried = room
    for s in range(sets):
        f = faults[s]
        base = 0.0
        for i in range(p):
            Io[i] = 0.0
            for j in range(p):
                Io[i] += I[i, j] * offset[s, j]
            base += offset[s, i] * (Io[i] - 2.0 * Iz[i])
        for r in range(f):
            g[r] = 0.0
            for i in range(p):
                g[r] += direction[s, i, r] * (Iz[i] - Io[i])
                ID[r, i] = 0.0
                for j in range(p):
                    ID[r, i] += I[i, j] * direction[s, j, r]
            for c in range(r + 1):
                G[r, c] = 0.0
                for i in range(p):
                    G[r, c] += ID[r, i] * direction[s, i, c]
                G[c, r] = G[r, c]
        for r in range(f, most):
            m[s, r] = 0.0
        value[s] = base + box_minimum(G, g, low[s], high[s], f, a, at, where, tried, m[s])


@compiled(void(M3, M, *SETS, M, M3))
def nearest(I, Iz, faults, offset, direction, low, high, value, m):  # noqa: E741
    """value (n, sets) and m (n, sets, f) of `nearest_points` for I (n or 1, p, p) and Iz (n, p)."""
    work = room(direction.shape[1], direction.shape[2])
    for e in range(len(Iz)):
        nearest_points(I[e % len(I)], Iz[e], faults, offset, direction, low, high, value[e], m[e], work)


@helper
def invert(P, excess, a, I):  # noqa: E741
    """I = (P + excess)^-1; a is room to work in."""
    for i in range(len(P)):
        for j in range(len(P)):
            a[i, j] = P[i, j] + excess[i, j]
            I[i, j] = 1.0 if i == j else 0.0
    eliminate(a, I)


@helper
def informative(I, z, Iz):  # noqa: E741
    """Iz = I z, and z' I z."""
    healthy = 0.0
    for i in range(len(z)):
        Iz[i] = 0.0
        for j in range(len(z)):
            Iz[i] += I[i, j] * z[j]
        healthy += z[i] * Iz[i]
    return healthy


@compiled(void(M, M3, M, *SETS, M, M3))
def distances(z, P, excess, faults, offset, direction, low, high, J, m):
    """J (n, 1 + sets): squared distances of z (n, p) to healthy and each set in the metric of P (n or 1, p, p) + excess."""
    n, p = z.shape
    a, I, Iz, work = floats((p, p)), floats((p, p)), floats(p), room(p, direction.shape[2])  # noqa: E741
    for e in range(n):
        if e < len(P):
            invert(P[e], excess, a, I)
        J[e, 0] = informative(I, z[e], Iz)
        nearest_points(I, Iz, faults, offset, direction, low, high, J[e, 1:], m[e], work)
        for s in range(len(faults)):
            J[e, 1 + s] += J[e, 0]


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
def declared(cost, penalty, statistic, limit, after, state, state1):
    """An automaton, the five integers of `automaton.advance`, one sample later, as of `declare`; statistic (1,) or (0,)."""
    rise, switch, release, same = after[0], after[1], after[2], after[3] > 0
    if same:  # health is a label like the others
        best = lowest(cost, penalty, 0)
        above, below = best > 0, False
    else:
        best, share = lowest(cost, penalty, 1), gain(cost, penalty)
        above, below = statistic[0] > limit if statistic.size else share > 1.0, share < 0.5
    label, over, other, under, last = state[0], state[1], state[2], state[3], state[4]
    new = advance(label, over, other, under, last, best, above, below, rise, switch, release, same)
    state1[0], state1[1], state1[2], state1[3], state1[4] = new


@compiled(void(M3, B1, M, M, B1))
def wait(P, informed, state, state1, counts):
    """Whether samples count (n,): none after a gap does until the estimate is about as sure again, or does not become so.

    `informed` (n,): some sensor reported. The state (n, 2 + p): whether it is waited, for how many samples with reports at
    most, and the variances of the estimate when a sample last counted; P (n, p, p) has those of now.
    """
    p = P.shape[1]
    for e in range(len(counts)):
        still, patience = state[e, 0] > 0.0, state[e, 1]
        unsure = False
        for i in range(p):
            unsure = unsure or P[e, i, i] > SURE_AGAIN * state[e, 2 + i]
        still = not informed[e] or (still and unsure and patience > 0.0)
        counts[e], state1[e, 0] = not still, still
        state1[e, 1] = patience + (-1.0 if informed[e] else PER_GAP) if still else PATIENCE
        for i in range(p):
            state1[e, 2 + i] = state[e, 2 + i] if still else P[e, i, i]


@compiled(void(M, V, V, float64, I1, I1, B1, I2, I2, I1, B1))
def declare(cost, penalty, statistic, limit, after, k, informed, state, state1, label, alarm):
    """The automata (n, 5) one sample later, and what they declare, from the costs (n, labels) and what each label must gain.

    The statistic (n,), where there is one (else (0,)), takes the place of the costs in raising an alarm. after: rise,
    switch, release, same and warmup of a persistence.
    """
    for e in range(len(cost)):
        if informed[e] and k[e] > after[4]:
            declared(cost[e], penalty, statistic[e : e + 1], limit, after, state[e], state1[e])
        else:
            for i in range(5):
                state1[e, i] = state[e, i]
        label[e], alarm[e] = state1[e, 0], state1[e, 0] > 0


@compiled(void(M, M3, M, I1, *SETS, V, V, float64, I1, I1, B1, I2, I2, I1, B1, M, M3))
def judge(
    z, P, excess, labels, faults, offset, direction, low, high,
    penalty, statistic, limit, after, k, informed, state, state1, label, alarm, cost, m,
):  # fmt: skip
    """`distances` as the costs of `declare`: of health, and of set s at labels[s]."""
    n, p = z.shape
    a, I, Iz, work = floats((p, p)), floats((p, p)), floats(p), room(p, direction.shape[2])  # noqa: E741
    J = floats(len(faults))
    for e in range(n):
        if e < len(P):
            invert(P[e], excess, a, I)
        cost[e, 0] = informative(I, z[e], Iz)
        nearest_points(I, Iz, faults, offset, direction, low, high, J, m[e], work)
        for s in range(len(faults)):
            cost[e, labels[s]] = J[s] + cost[e, 0]
        if informed[e] and k[e] > after[4]:
            declared(cost[e], penalty, statistic[e : e + 1], limit, after, state[e], state1[e])
        else:
            for i in range(5):
                state1[e, i] = state[e, i]
        label[e], alarm[e] = state1[e, 0], state1[e, 0] > 0

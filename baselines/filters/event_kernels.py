"""What a bank over events does with its hypotheses: events end and begin, and hypotheses that are alike become one.

Rows, nodes and rooms are those of `hypothesis_kernels`; a node keeps so many hypotheses.
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, void

from baselines.filters.hypothesis_kernels import (
    AS_IT_IS,
    LESS,
    MORE,
    NEVER,
    acting,
    allowed,
    derive,
    hold,
    least_likely,
    likeliest,
    merge,
    node_of,
    of_node,
    squeezed,
)
from fdi_gym.kernels import M, V, bools, compiled, floats, helper, ints

I1, I3 = int64[::1], int64[:, :, ::1]
M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]
NEGLIGIBLE = 40.0  # below the log weight of what it goes to, or of the likeliest: nothing begins or ends there


@helper
def end(X, P, log, kind, onset, held, step, stays, every, m, f, kinds, code, room, rows, leave):
    """Events may have ended in the period before this step: their hypotheses' weight goes to those without them."""
    E, last, top = kind.shape[1], stays.size - 1, likeliest(log)
    for count in range(1, E + 1):
        for i in range(1, log.size):
            if log[i] <= NEVER or acting(kind, i) != count:
                continue
            before, stay = log[i], 0.0
            for j in range(count):
                age = max(int(step - onset[i, j]), 0)
                leave[j] = -30.0 if age > last else stays[age] - stays[max(age - every, 0)]
                stay += leave[j]
            log[i] += stay
            for j in range(count):
                weight = before + stay - leave[j] + (np.log(-np.expm1(leave[j])) if leave[j] < 0.0 else -np.inf)
                if not weight > (log[0] if count == 1 else top) - NEGLIGIBLE:
                    continue
                t = 0
                if count > 1:
                    node, t = node_of(kind, i, j, LESS, 0, kinds), -1
                    for a in range(of_node(code, log, node, rows)):
                        if t < 0 or log[rows[a]] > log[t]:
                            t = rows[a]
                    if t < 0:
                        t = least_likely(log)
                        if log[t] < weight:
                            derive(kind, onset, held, i, m, f, j, LESS, room)
                            hold(X, P, kind, onset, held, t, i, room)
                            log[t], code[t] = weight, node
                        continue
                derive(kind, onset, held, i, m, f, j, LESS, room)
                merge(X, P, log, onset, held, t, weight, i, room)


@helper
def likely(log, kind, chance, top, code, rows, parents, weights):
    """Rows beside which another event may begin, the first of `parents`, and log weights of their nodes; how many there are.

    Those of most events first: what begins changes rows of more only. What stays as it is loses what begins.
    """
    E, found = kind.shape[1], 0
    for count in range(E - 1, -1, -1):
        for i in range(log.size):
            if log[i] <= NEVER or acting(kind, i) != count or (count > 0) != (i > 0):
                continue
            if count > 0 and log[i] < top - NEGLIGIBLE:
                continue
            total, first = log[i], True
            if count > 0:  # the likeliest of its node stands for all of it
                for a in range(of_node(code, log, code[i], rows)):
                    if rows[a] != i:
                        total = np.logaddexp(total, log[rows[a]])
                        first = first and (log[rows[a]] < log[i] or (log[rows[a]] == log[i] and i < rows[a]))
            if first:
                parents[found], weights[found] = i, total
                found += 1
    for i in range(log.size):
        if log[i] > NEVER and acting(kind, i) < E:
            log[i] += np.log1p(-chance[acting(kind, i)])
    return found


@helper
def may_begin(kind, i, masks, sets, prior, may):
    """Which kinds may begin beside those of row i, and the log of how likely all of them are."""
    modes, total = 0, 0.0
    for j in range(acting(kind, i)):
        modes |= masks[kind[i, j]]
    for q in range(masks.size):
        may[q] = modes & masks[q] == 0 and allowed(sets, modes | masks[q])
        if may[q]:
            total += np.exp(prior[q])
    return np.log(total)


@helper
def beside(kind, log, i, number):
    """How many rows have the events of row i and one more, by the kind of that."""
    count = acting(kind, i)
    number[:] = 0
    for other in range(1, log.size):
        if log[other] > NEVER and acting(kind, other) == count + 1:
            both, more = 0, -1
            for a in range(count + 1):
                if both < count and kind[other, a] == kind[i, both]:
                    both += 1
                else:
                    more = kind[other, a]
            if both == count:
                number[more] += 1


@helper
def begin(
    X, P, log, kind, onset, held, step, chance, every, m, f, keep, masks, sets, prior, M0, fresh, code, room, rows, of
):
    """Another event may begin with this step, of each kind that may act beside those that do: the newest hypotheses."""
    key, onset1, held1, _ = room
    parents, weights, may, number = of
    kinds, top, worst = masks.size, likeliest(log), least_likely(log)
    for a in range(likely(log, kind, chance, top, code, rows, parents, weights)):
        i = parents[a]
        count, all_of = acting(kind, i), may_begin(kind, i, masks, sets, prior, may)
        before = weights[a] + np.log(chance[count])
        beside(kind, log, i, number)  # or fewer by now: what has begun since may have taken their places
        for q in range(kinds):
            weight = before + prior[q] - all_of
            if not may[q] or (count > 0 and weight < top - NEGLIGIBLE) or (number[q] < keep and not log[worst] < weight):
                continue
            slot = 0
            while slot < count and kind[i, slot] < q:
                slot += 1
            node, t = node_of(kind, i, slot, MORE, q, kinds), worst
            some = of_node(code, log, node, rows)
            if some >= keep:
                t = squeezed(X, P, log, kind, onset, held, m, f, rows, some, step, every, room)
            elif t == i or not log[t] < weight:
                continue
            derive(kind, onset, held, i, m, f, slot, MORE, room)
            key[slot], onset1[slot] = q, step
            for b in range(held1.shape[1]):
                held1[slot, b] = fresh[q, b]
            hold(X, P, kind, onset, held, t, i, room)
            for b in range(m + slot * f, m + (slot + 1) * f):
                P[t, b, b] = M0[q, b - m - slot * f]
            log[t], code[t] = weight, node
            worst = least_likely(log)


@compiled(void(I1, M3, M4, M, I3, M3, M4, V, M, V, int64, int64, int64, int64, I1, I1, V, M, M3, V))
def renew(
    turn, X, P, log, kind, onset, held, step, chance, stays, every, m, f, keep, masks, sets, prior, M0, fresh, healed
):  # fmt: skip
    """The hypotheses of some episodes, in place: events end, then begin; the rest has a row for each of those in `turn`.

    step; chance (E): that another event begins, by how many act; stays (ages,): log of the share that outlasts an age;
    fresh (r, p): what each kind that begins now is held at; masks (r,): the kinds' modes as bits; sets: those that labels
    say; healed: the healthy log weight when events have ended.
    """
    (_, count, N), E, p, kinds = X.shape, kind.shape[2], held.shape[3], masks.size
    room = ints(E), floats(E), floats((E, p)), ints(N)
    rows, code, leave, of = ints(count), ints(count), floats(E), (ints(count), floats(count), bools(kinds), ints(kinds))
    for a in range(turn.size):
        e = turn[a]
        for i in range(count):
            code[i] = node_of(kind[e], i, 0, AS_IT_IS, 0, kinds)
        if stays.size:
            end(
                X[e], P[e], log[e], kind[e], onset[e], held[e], step[a], stays, every, m, f, kinds, code, room, rows, leave
            )  # fmt: skip
        healed[a] = log[e, 0]
        begin(
            X[e], P[e], log[e], kind[e], onset[e], held[e], step[a], chance[a], every, m, f, keep, masks, sets, prior, M0,
            fresh[a], code, room, rows, of,
        )  # fmt: skip

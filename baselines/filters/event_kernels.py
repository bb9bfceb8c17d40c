"""What a bank over events does with its hypotheses: events end and begin, and hypotheses that are alike become one.

Rows, nodes and rooms are those of `hypothesis_kernels`; a node keeps so many hypotheses.
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, void

from baselines.filters.hypothesis_kernels import (
    NEVER,
    acting,
    allowed,
    changed,
    hold,
    likeliest,
    merge,
    of_node,
    place_for,
    squeezed,
)
from fdi_gym.kernels import M, V, compiled, helper

I1, I3 = int64[::1], int64[:, :, ::1]
M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]
NEGLIGIBLE = 40.0  # below the log weight of what it goes to, or of the likeliest: nothing begins or ends there


@helper
def end(X, P, log, kind, onset, held, step, stays, every, m, f, room, rows, leave):
    """Events may have ended in the period before this step: their hypotheses' weight goes to those without them."""
    mean, cov, key, onset1, held1 = room
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
                changed(X, P, kind, onset, held, i, m, f, j, -1, room)
                t = 0
                if count > 1:
                    some, t = of_node(kind, log, key, rows), -1
                    for a in range(some):
                        if t < 0 or log[rows[a]] > log[t]:
                            t = rows[a]
                    if t < 0:
                        t = place_for(log, weight)
                        if t < 0:
                            continue
                        hold(X, P, kind, onset, held, t, room)
                        log[t] = weight
                        continue
                merge(X, P, log, onset, held, t, weight, mean, cov, onset1, held1)


@helper
def likely(log, kind, chance, top, rows, parents, weights):
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
                for a in range(of_node(kind, log, kind[i], rows)):
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
def begin(X, P, log, kind, onset, held, step, chance, every, m, f, keep, masks, sets, prior, M0, fresh, room, rows, of):
    """Another event may begin with this step, of each kind that may act beside those that do: the newest hypotheses."""
    _, cov, key, onset1, held1 = room
    parents, weights = of
    r, top = masks.size, likeliest(log)
    for a in range(likely(log, kind, chance, top, rows, parents, weights)):
        i = parents[a]
        count, modes, all_of = acting(kind, i), 0, 0.0
        for j in range(count):
            modes |= masks[kind[i, j]]
        for q in range(r):
            if modes & masks[q] == 0 and allowed(sets, modes | masks[q]):
                all_of += np.exp(prior[q])
        for q in range(r):
            if modes & masks[q] != 0 or not allowed(sets, modes | masks[q]):
                continue
            weight = weights[a] + np.log(chance[count]) + prior[q] - np.log(all_of)
            if count > 0 and weight < top - NEGLIGIBLE:
                continue
            slot = 0
            while slot < count and kind[i, slot] < q:
                slot += 1
            changed(X, P, kind, onset, held, i, m, f, slot, 1, room)
            key[slot], onset1[slot] = q, step
            for b in range(held1.shape[1]):
                held1[slot, b] = fresh[q, b]
            for b in range(f):
                cov[m + slot * f + b, m + slot * f + b] = M0[q, b]
            some = of_node(kind, log, key, rows)
            full = some >= keep
            t = squeezed(X, P, log, kind, onset, held, rows, some, step, every) if full else place_for(log, weight)
            if t >= 0:
                hold(X, P, kind, onset, held, t, room)
                log[t] = weight


@compiled(void(M3, M4, M, I3, M3, M4, V, M, V, int64, int64, int64, int64, I1, I1, V, M, M3, V), heap=True)
def renew(X, P, log, kind, onset, held, step, chance, stays, every, m, f, keep, masks, sets, prior, M0, fresh, healed):
    """All episodes' hypotheses, in place, at the steps (n,): events end, then begin; healed (n,): the healthy log between.

    chance (n, E): that another event begins, by how many act; stays (ages,): log of the share that outlasts an age; fresh
    (n, r, p): what each kind that begins now is held at; masks (r,): the kinds' modes as bits; sets: those that labels say.
    """
    (n, count, N), E = X.shape, kind.shape[2]
    room = np.zeros(N), np.zeros((N, N)), np.zeros(E, np.int64), np.zeros(E), np.zeros((E, held.shape[3]))
    rows, leave, of = np.zeros(count, np.int64), np.zeros(E), (np.zeros(count, np.int64), np.zeros(count))
    for e in range(n):
        if stays.size:
            end(X[e], P[e], log[e], kind[e], onset[e], held[e], step[e], stays, every, m, f, room, rows, leave)
        healed[e] = log[e, 0]
        begin(
            X[e], P[e], log[e], kind[e], onset[e], held[e], step[e], chance[e], every, m, f, keep, masks, sets, prior, M0,
            fresh[e], room, rows, of,
        )  # fmt: skip


@compiled(void(I1, I3, M3, M4, M, M3, M, M3, M, M3))
def lines(rows, kind, length, held, offset, direction, steady, steady_direction, offsets, directions):
    """Adds the events to offsets (rows, p + e) and directions (rows, p + e, E f + c) of the filters in these rows.

    length (n, count, E) of the courses; offset, steady (r, p) and their directions (r, p, f) are the events'.
    """
    count, E = kind.shape[1], kind.shape[2]
    (_, p, f) = direction.shape
    for i in range(rows.size):
        of, place = rows[i] // count, rows[i] % count
        for j in range(E):
            q = kind[of, place, j]
            if q >= 0:
                share = length[of, place, j]
                for a in range(p):
                    offsets[i, a] += share * offset[q, a] + (held[of, place, j, a] + steady[q, a])
                    for b in range(f):
                        directions[i, a, j * f + b] = share * direction[q, a, b] + steady_direction[q, a, b]


@compiled(void(I1, I3, V, int64, int64, M, M3))
def wander(rows, kind, rates, m, f, X, P):
    """Magnitudes of kinds that wander, one sample on: X (rows, N), P (rows, N, N); rates (r,), 1 for kinds that do not."""
    count, E, N = kind.shape[1], kind.shape[2], X.shape[1]
    for i in range(rows.size):
        of, place = rows[i] // count, rows[i] % count
        for j in range(E):
            q = kind[of, place, j]
            if q >= 0 and rates[q] < 1.0:
                for b in range(f):
                    x = m + j * f + b
                    X[i, x] *= rates[q]
                    for y in range(N):
                        P[i, x, y] *= rates[q]
                        P[i, y, x] *= rates[q]
                    P[i, x, x] += 1.0 - rates[q] ** 2

"""What the overlap bank does with its hypotheses: events end and begin, and hypotheses that are alike become one.

A hypothesis is a row of an episode: kind (E,) of the events that act, in rising order and then -1, onset (E,), held (E, p),
and a filter X (N,), P (N, N) with its log weight, NEVER where nothing is. Row 0 flies healthy. Magnitudes of event j are the
f entries of X from m + j f on. Hypotheses of the same kinds are of one node, and a node keeps so many.
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, void

from baselines.filters.hypotheses import NEVER
from fdi_gym.kernels import M, V, compiled, helper

I1, I3 = int64[::1], int64[:, :, ::1]
M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]
NEGLIGIBLE = (
    40.0  # log of a share of an episode's likeliest hypothesis below which nothing begins from others than the healthy
)
WITHOUT = 1e-17  # share that changes nothing


@helper
def acting(kind, i):
    """How many events act in a row."""
    count = 0
    for j in range(kind.shape[1]):
        count += kind[i, j] >= 0
    return count


@helper
def likeliest(log):
    """The largest log weight."""
    found = log[0]
    for i in range(log.size):
        found = max(found, log[i])
    return found


@helper
def latest(onset, kind, i):
    """The last onset of a row."""
    found = -1.0
    for j in range(kind.shape[1]):
        if kind[i, j] >= 0:
            found = max(found, onset[i, j])
    return found


@helper
def same(kind, i, key):
    """Whether a row is of the node with these kinds."""
    differ = 0
    for j in range(key.size):
        differ += kind[i, j] != key[j]
    return differ == 0


@helper
def source(place, m, f, slot, width):
    """Which entry of X without the event in a slot is the entry `place` of X with it; -1: one of that event's own.

    width: f times the number of slots.
    """
    if place < m or place >= m + width:
        return place
    if place < m + slot * f:
        return place
    if place < m + (slot + 1) * f:
        return -1
    return place - f


@helper
def merge(X, P, log, onset, held, t, weight, mean, cov, onset1, held1):
    """Row t becomes the mixture of itself and a hypothesis of its node with this log weight."""
    total = np.logaddexp(log[t], weight)
    w = np.exp(weight - total)
    log[t] = total
    if w < WITHOUT:
        return
    N = mean.size
    for i in range(N):
        gap = mean[i] - X[t, i]
        for j in range(i + 1):
            between = w * (1.0 - w) * gap * (mean[j] - X[t, j])
            P[t, i, j] = P[t, j, i] = (1.0 - w) * P[t, i, j] + w * cov[i, j] + between
    for i in range(N):
        X[t, i] += w * (mean[i] - X[t, i])
    for j in range(onset1.size):
        onset[t, j] += w * (onset1[j] - onset[t, j])
        if w > 0.5:
            for a in range(held.shape[2]):
                held[t, j, a] = held1[j, a]


@helper
def of_node(kind, log, key, into):
    """How many rows a node has, their numbers in the first of `into`."""
    count = 0
    for i in range(1, log.size):
        if log[i] > NEVER and same(kind, i, key):
            into[count] = i
            count += 1
    return count


@helper
def place_for(log, weight):
    """A row where nothing is, or what is has less weight than this; -1: there is none."""
    worst = 1
    for i in range(1, log.size):
        if log[i] <= NEVER:
            return i
        if log[i] < log[worst]:
            worst = i
    return worst if log[worst] < weight else -1


@helper
def squeezed(X, P, log, kind, onset, held, rows, count, step, every):
    """Of a node's rows those two become one that are least likely for how close their onsets are; the free row."""
    for a in range(1, count):  # in the order of their onsets
        b = a
        while b > 0 and latest(onset, kind, rows[b - 1]) > latest(onset, kind, rows[b]):
            rows[b - 1], rows[b] = rows[b], rows[b - 1]
            b -= 1
    best, least = 0, np.inf
    for a in range(count - 1):
        young, old = latest(onset, kind, rows[a + 1]), latest(onset, kind, rows[a])
        gap = (young - old) / (step - young + every)
        cost = np.logaddexp(log[rows[a]], log[rows[a + 1]]) + 2.0 * np.log(max(gap, 1e-9))
        if cost < least:
            best, least = a, cost
    a, b = rows[best], rows[best + 1]
    merge(X, P, log, onset, held, a, log[b], X[b], P[b], onset[b], held[b])
    log[b] = NEVER
    return b


@helper
def end(X, P, log, kind, onset, held, step, stays, every, m, f, room):
    """Events may have ended in the period before this step: their hypotheses' weight goes to those without them."""
    mean, cov, onset1, held1, key, rows, leave = room
    E, N, last, top = kind.shape[1], X.shape[1], stays.size - 1, likeliest(log)
    for count in range(1, E + 1):
        for i in range(1, log.size):
            if log[i] <= NEVER or acting(kind, i) != count:
                continue
            before, stay = log[i], 0.0
            for j in range(count):
                age = max(int(step - onset[i, j]), 0)
                one = -30.0 if age > last else stays[age] - stays[max(age - every, 0)]
                leave[j] = one
                stay += one
            log[i] += stay
            for j in range(count):
                weight = before + stay - leave[j] + (np.log(-np.expm1(leave[j])) if leave[j] < 0.0 else -np.inf)
                if not weight > top - NEGLIGIBLE:
                    continue
                for a in range(E):
                    key[a] = -1
                    onset1[a] = 0.0
                    for b in range(held.shape[2]):
                        held1[a, b] = 0.0
                for a in range(count):
                    if a != j:
                        to = a - (a > j)
                        key[to], onset1[to] = kind[i, a], onset[i, a]
                        for b in range(held.shape[2]):
                            held1[to, b] = held[i, a, b]
                for a in range(N):
                    mean[a] = 0.0
                    for b in range(N):
                        cov[a, b] = 0.0
                for a in range(N):
                    to = source(a, m, f, j, E * f)
                    if to >= 0:
                        mean[to] = X[i, a]
                        for b in range(N):
                            other = source(b, m, f, j, E * f)
                            if other >= 0:
                                cov[to, other] = P[i, a, b]
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
                        log[t] = NEVER
                        for a in range(E):
                            kind[t, a] = key[a]
                merge(X, P, log, onset, held, t, weight, mean, cov, onset1, held1)


@helper
def begin(X, P, log, kind, onset, held, step, chance, every, m, f, keep, masks, labels, prior, M0, fresh, room):
    """Another event may begin with this step, of each kind that may act beside those that do: the newest hypotheses."""
    key, rows, parents, weights = room
    E, N, r, top, found = kind.shape[1], X.shape[1], masks.size, likeliest(log), 0
    for count in range(E - 1, -1, -1):  # those of most events first: what begins changes rows of more only
        for i in range(log.size):
            if log[i] <= NEVER or acting(kind, i) != count or (count > 0) != (i > 0):
                continue
            if count > 0 and log[i] < top - NEGLIGIBLE:
                continue
            total = log[i]
            if count > 0:  # the likeliest of its node stands for all of it
                some, first = of_node(kind, log, kind[i], rows), True
                for a in range(some):
                    if rows[a] != i:
                        total = np.logaddexp(total, log[rows[a]])
                        first = first and (log[rows[a]] < log[i] or (log[rows[a]] == log[i] and i < rows[a]))
                if not first:
                    continue
            parents[found], weights[found] = i, total
            found += 1
    for i in range(log.size):
        if log[i] > NEVER:
            count = acting(kind, i)
            if count < E:
                log[i] += np.log1p(-chance[count])
    for a in range(found):
        i = parents[a]
        count, mask, all_of = acting(kind, i), 0, 0.0
        for j in range(count):
            mask |= masks[kind[i, j]]
        for q in range(r):
            if mask & masks[q] == 0 and labels[mask | masks[q]] >= 0:
                all_of += np.exp(prior[q])
        for q in range(r):
            if mask & masks[q] != 0 or labels[mask | masks[q]] < 0:
                continue
            weight = weights[a] + np.log(chance[count]) + prior[q] - np.log(all_of)
            if count > 0 and weight < top - NEGLIGIBLE:
                continue
            slot = 0
            while slot < count and kind[i, slot] < q:
                slot += 1
            for j in range(E):
                key[j] = -1
            for j in range(count):
                key[j + (j >= slot)] = kind[i, j]
            key[slot] = q
            some = of_node(kind, log, key, rows)
            full = some >= keep
            t = squeezed(X, P, log, kind, onset, held, rows, some, step, every) if full else place_for(log, weight)
            if t < 0:
                continue
            log[t] = weight
            for j in range(E):
                kind[t, j] = key[j]
                onset[t, j] = 0.0
                for b in range(held.shape[2]):
                    held[t, j, b] = 0.0
            for j in range(count):
                to = j + (j >= slot)
                onset[t, to] = onset[i, j]
                for b in range(held.shape[2]):
                    held[t, to, b] = held[i, j, b]
            onset[t, slot] = step
            for b in range(held.shape[2]):
                held[t, slot, b] = fresh[q, b]
            for x in range(N):
                of = source(x, m, f, slot, E * f)
                X[t, x] = X[i, of] if of >= 0 else 0.0
                for y in range(N):
                    other = source(y, m, f, slot, E * f)
                    P[t, x, y] = P[i, of, other] if of >= 0 and other >= 0 else 0.0
            for b in range(f):
                P[t, m + slot * f + b, m + slot * f + b] = M0[q, b]


@compiled(
    void(M3, M4, M, I3, M3, M4, V, M, V, int64, int64, int64, int64, I1, I1, V, M, M3, V), heap=True
)  # fmt: skip
def renew(X, P, log, kind, onset, held, step, chance, stays, every, m, f, keep, masks, labels, prior, M0, fresh, healed):
    """All episodes' hypotheses, in place, at the steps (n,): events end, then begin; healed (n,): the healthy log between.

    chance (n, E): that another event begins, by how many act; stays (ages,): log of the share that outlasts an age; fresh
    (n, r, p): what each kind that begins now is held at; masks (r,) of the kinds' modes; labels (masks,), -1 for none.
    """
    (n, rows, N), E = X.shape, kind.shape[2]
    key, of = np.zeros(E, np.int64), np.zeros(rows, np.int64)
    to_end = np.zeros(N), np.zeros((N, N)), np.zeros(E), np.zeros((E, held.shape[3])), key, of, np.zeros(E)
    to_begin = key, of, np.zeros(rows, np.int64), np.zeros(rows)
    for e in range(n):
        if stays.size:
            end(X[e], P[e], log[e], kind[e], onset[e], held[e], step[e], stays, every, m, f, to_end)
        healed[e] = log[e, 0]
        begin(
            X[e], P[e], log[e], kind[e], onset[e], held[e], step[e], chance[e], every, m, f, keep, masks, labels, prior, M0,
            fresh[e], to_begin,
        )  # fmt: skip


@compiled(void(I1, I3, M3, M4, M, M3, M, M3, M, M3))
def lines(rows, kind, length, held, offset, direction, steady, steady_direction, offsets, directions):
    """Offsets (rows, p) and directions (rows, p, E f) of the filters in these rows, numbered through; they come zeroed.

    length (n, count, E) of the courses.
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

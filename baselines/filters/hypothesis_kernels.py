"""Hypotheses of an episode in rows of tables: their nodes, places, mixtures, and how one becomes another.

A hypothesis is a row: kind (E,) of the events that act, in rising order and then -1, onset (E,), held (E, p), and a filter
X (N,), P (N, N) with its log weight, NEVER where nothing is. Row 0 flies healthy. Magnitudes of event j are the f entries of
X from m + j f on. Hypotheses of the same kinds are of one node. A room (mean, cov, key, onset1, held1) has place for one.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.kernels import helper

NEVER = -1e300  # log weight of a place where nothing is
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
def allowed(sets, modes):
    """Whether a label says these modes."""
    count = 0
    for i in range(sets.size):
        count += sets[i] == modes
    return count > 0


@helper
def place_in(x, m, f, width, slot, by):
    """Where entry x of X is once an event is taken out of a slot (by -1) or put into one (by 1); -1: nowhere.

    width: f times the number of slots.
    """
    if x < m or x >= m + width:
        return x
    block = (x - m) // f
    if block < slot:
        return x
    if (by < 0 and block == slot) or (by > 0 and x + f >= m + width):
        return -1
    return x + by * f


@helper
def changed(X, P, kind, onset, held, i, m, f, slot, by, room):
    """Into the room the hypothesis of row i without the event in a slot (by -1), or with that slot free (by 1)."""
    mean, cov, key, onset1, held1 = room
    E, N, width = key.size, mean.size, key.size * f
    for a in range(E):
        key[a], onset1[a] = -1, 0.0
        for b in range(held1.shape[1]):
            held1[a, b] = 0.0
    for a in range(E):
        to = a + by if a >= slot else a
        if kind[i, a] >= 0 and (by > 0 or a != slot):
            key[to], onset1[to] = kind[i, a], onset[i, a]
            for b in range(held1.shape[1]):
                held1[to, b] = held[i, a, b]
    for x in range(N):
        mean[x] = 0.0
        for y in range(N):
            cov[x, y] = 0.0
    for x in range(N):
        to = place_in(x, m, f, width, slot, by)
        if to >= 0:
            mean[to] = X[i, x]
            for y in range(N):
                other = place_in(y, m, f, width, slot, by)
                if other >= 0:
                    cov[to, other] = P[i, x, y]


@helper
def hold(X, P, kind, onset, held, t, room):
    """Row t becomes the hypothesis in the room."""
    mean, cov, key, onset1, held1 = room
    for a in range(key.size):
        kind[t, a], onset[t, a] = key[a], onset1[a]
        for b in range(held1.shape[1]):
            held[t, a, b] = held1[a, b]
    for x in range(mean.size):
        X[t, x] = mean[x]
        for y in range(mean.size):
            P[t, x, y] = cov[x, y]


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

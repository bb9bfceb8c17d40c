"""Hypotheses of an episode in rows of tables: their nodes, places, mixtures, and how one becomes another.

A hypothesis is a row: kind (E,) of the events that act, in rising order and then -1, onset (E,), held (E, p), and a filter
X (N,), P (N, N) with its log weight, NEVER where nothing is. Row 0 flies healthy. Magnitudes of event j are the f entries of
X from m + j f on. Hypotheses of the same kinds are of one node, whose number is in code. What becomes of a row is first in a
room (key, onset1, held1, origin): its kinds and their onsets, and where its filter's entries come from.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.kernels import helper

NEVER = -1e300  # log weight of a place where nothing is
WITHOUT = 1e-17  # share that changes nothing
LESS, AS_IT_IS, MORE = -1, 0, 1  # a row without the event in a slot, itself, or with that slot free for another


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
def allowed(sets, modes):
    """Whether a label says these modes."""
    count = 0
    for i in range(sets.size):
        count += sets[i] == modes
    return count > 0


@helper
def node_of(kind, i, slot, by, q, kinds):
    """The number of the node of row i, of it without the event in a slot, or of it with kind q there; of so many kinds."""
    code, place = 0, 1
    for a in range(kind.shape[1]):
        if by == MORE and a == slot:
            code += (q + 1) * place
            place *= kinds + 1
        if kind[i, a] >= 0 and not (by == LESS and a == slot):
            code += (kind[i, a] + 1) * place
            place *= kinds + 1
    return code


@helper
def of_node(code, log, node, into):
    """How many rows a node has, their numbers in the first of `into`."""
    count = 0
    for i in range(1, log.size):
        if code[i] == node and log[i] > NEVER:
            into[count] = i
            count += 1
    return count


@helper
def derive(kind, onset, held, i, m, f, slot, by, room):
    """Into the room what becomes of row i."""
    key, onset1, held1, origin = room
    E = key.size
    for a in range(E):
        key[a], onset1[a] = -1, 0.0
        for b in range(held1.shape[1]):
            held1[a, b] = 0.0
    for a in range(E):
        to = a + by if a >= slot else a
        if kind[i, a] >= 0 and not (by == LESS and a == slot):
            key[to], onset1[to] = kind[i, a], onset[i, a]
            for b in range(held1.shape[1]):
                held1[to, b] = held[i, a, b]
    for x in range(origin.size):
        origin[x] = x
    for x in range(m + slot * f, m + E * f):
        origin[x] = x - by * f
        if (by == MORE and x < m + (slot + 1) * f) or origin[x] >= m + E * f:
            origin[x] = -1


@helper
def hold(X, P, kind, onset, held, t, i, room):
    """Row t becomes what the room says of row i."""
    key, onset1, held1, origin = room
    for a in range(key.size):
        kind[t, a], onset[t, a] = key[a], onset1[a]
        for b in range(held1.shape[1]):
            held[t, a, b] = held1[a, b]
    for x in range(origin.size):
        a = origin[x]
        X[t, x] = X[i, a] if a >= 0 else 0.0
        for y in range(origin.size):
            b = origin[y]
            P[t, x, y] = P[i, a, b] if a >= 0 and b >= 0 else 0.0


@helper
def merge(X, P, log, onset, held, t, weight, i, room):
    """Row t becomes the mixture of itself and, with this log weight, what the room says of row i, which is of its node."""
    _, onset1, held1, origin = room
    total = np.logaddexp(log[t], weight)
    w = np.exp(weight - total)
    log[t] = total
    if w < WITHOUT:
        return
    for x in range(origin.size):
        a = origin[x]
        gap = (X[i, a] if a >= 0 else 0.0) - X[t, x]
        for y in range(x + 1):
            b = origin[y]
            between = w * (1.0 - w) * gap * ((X[i, b] if b >= 0 else 0.0) - X[t, y])
            other = P[i, a, b] if a >= 0 and b >= 0 else 0.0
            P[t, x, y] = P[t, y, x] = (1.0 - w) * P[t, x, y] + w * other + between
    for x in range(origin.size):
        a = origin[x]
        X[t, x] += w * ((X[i, a] if a >= 0 else 0.0) - X[t, x])
    for j in range(onset1.size):
        onset[t, j] += w * (onset1[j] - onset[t, j])
        if w > 0.5:
            for a in range(held.shape[2]):
                held[t, j, a] = held1[j, a]


@helper
def least_likely(log):
    """A row where nothing is, or else the least likely one beside the healthy."""
    worst = 1
    for i in range(1, log.size):
        if log[i] <= NEVER:
            return i
        if log[i] < log[worst]:
            worst = i
    return worst


@helper
def squeezed(X, P, log, kind, onset, held, m, f, rows, count, step, every, room):
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
    derive(kind, onset, held, b, m, f, 0, AS_IT_IS, room)
    merge(X, P, log, onset, held, a, log[b], b, room)
    log[b] = NEVER
    return b

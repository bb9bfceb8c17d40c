"""How far estimates are from the labels' sets, for LANES estimates side by side, as in `gaussian_algebra`."""

from __future__ import annotations

from fdi_gym.estimation.compiled import SLACK, box_minimum
from fdi_gym.integration import LANES
from fdi_gym.kernels import floats, helper, inlined, ints
from fdi_gym.vectors import choose, filled, load, store, zeros


@inlined
def room(p, most):
    """What `nearest_points` works in, for sets of up to `most` faults in p dimensions."""
    Gs, gs, ID, Io = floats((most * most, LANES)), floats((most, LANES)), floats((most * p, LANES)), floats((p, LANES))
    G, g, m = floats((most, most)), floats(most), floats(most)
    a, at, where, tried = floats((most, most + 1)), ints(most), ints(most), floats(most)
    return Gs, gs, ID, Io, G, g, m, a, at, where, tried


@helper
def nearest_points(I, Iz, faults, offset, direction, low, high, value, m, room):  # noqa: E741 (the information)
    """value[s] = min of q' I q - 2 q' Iz over q = offset[s] + direction[s] m[s] with m[s] in its box, for all sets s.

    I (p p), Iz (p), value (sets) and m (sets most) are in lanes, the sets are the same for all.
    """
    sets, p, most = direction.shape
    Gs, gs, ID, Io, G, g, one, a, at, where, tried = room
    for s in range(sets):
        f = faults[s]
        base = zeros()
        for i in range(p):
            total = zeros()
            for j in range(p):
                if offset[s, j] != 0.0:
                    total += load(I, i * p + j, 0) * offset[s, j]
            store(Io, i, 0, total)
            if offset[s, i] != 0.0:
                base += (total - load(Iz, i, 0) * 2.0) * offset[s, i]
        for r in range(f):
            slope = zeros()
            for i in range(p):
                if direction[s, i, r] != 0.0:
                    slope += (load(Iz, i, 0) - load(Io, i, 0)) * direction[s, i, r]
                total = zeros()
                for j in range(p):
                    if direction[s, j, r] != 0.0:
                        total += load(I, i * p + j, 0) * direction[s, j, r]
                store(ID, r * p + i, 0, total)
            store(gs, r, 0, slope)
            for c in range(r + 1):
                total = zeros()
                for i in range(p):
                    if direction[s, i, c] != 0.0:
                        total += load(ID, r * p + i, 0) * direction[s, i, c]
                store(Gs, r * most + c, 0, total)
                store(Gs, c * most + r, 0, total)
        for r in range(f, most):
            store(m, s * most + r, 0, zeros())
        done = False
        if f == 1:  # most labels
            slope, curve = load(gs, 0, 0), load(Gs, 0, 0)
            to = slope / curve
            to = choose((low[s, 0] - SLACK) - to, low[s, 0], choose(to - (high[s, 0] + SLACK), high[s, 0], to))
            found = zeros() - slope * 2.0 * to + to * curve * to
            store(m, s * most, 0, to)
            store(value, s, 0, base + found)
            done = not filled(found - found)  # numbers in all lanes
        if not done:
            store(value, s, 0, base)
            for lane in range(LANES):
                for r in range(f):
                    g[r] = gs[r, lane]
                    for c in range(f):
                        G[r, c] = Gs[r * most + c, lane]
                value[s, lane] += box_minimum(G, g, low[s], high[s], f, a, at, where, tried, one)
                for r in range(f):
                    m[s * most + r, lane] = one[r]


@helper
def invert(P, excess, p, a, I):  # noqa: E741
    """I = (P + excess)^-1 of covariances P (p p) in lanes; a (p p) is room to work in."""
    for i in range(p):
        for j in range(p):
            store(a, i * p + j, 0, load(P, i * p + j, 0) + excess[i, j])
            store(I, i * p + j, 0, zeros() + (1.0 if i == j else 0.0))
    for k in range(p):  # positive definite: no pivoting
        pivot = load(a, k * p + k, 0)
        for r in range(k + 1, p):
            factor = load(a, r * p + k, 0) / pivot
            for c in range(k + 1, p):
                store(a, r * p + c, 0, load(a, r * p + c, 0) - factor * load(a, k * p + c, 0))
            for c in range(k + 1):
                store(I, r * p + c, 0, load(I, r * p + c, 0) - factor * load(I, k * p + c, 0))
    for r in range(p - 1, -1, -1):
        pivot = load(a, r * p + r, 0)
        for c in range(p):
            total = load(I, r * p + c, 0)
            for k in range(r + 1, p):
                total -= load(a, r * p + k, 0) * load(I, k * p + c, 0)
            store(I, r * p + c, 0, total / pivot)


@helper
def informative(I, z, p, Iz):  # noqa: E741
    """Iz = I z, and z' I z, in lanes."""
    healthy = zeros()
    for i in range(p):
        total = zeros()
        for j in range(p):
            total += load(I, i * p + j, 0) * load(z, j, 0)
        store(Iz, i, 0, total)
        healthy += load(z, i, 0) * total
    return healthy

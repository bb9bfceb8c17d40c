"""What the onset bank does with all its filters at once: their lines, mixtures of them, and the rows of those that run."""

from __future__ import annotations

import numpy as np
from numba import float64, int64, void
from scipy.special import logsumexp

from fdi_gym.estimation.mixing import mixture
from fdi_gym.kernels import M, compiled
from fdi_gym.plant import Array

M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]


def merged(log: Array, X: Array, P: Array) -> tuple[Array, Array, Array]:
    """Log weight (a,), mean (a, N) and covariance (a, N, N) of the mixtures of log (a, b), X (a, b, N), P (a, b, N, N)."""
    total = np.asarray(logsumexp(log, axis=1))
    w = np.exp(log - total[:, None])[:, None]
    mean, covariance = mixture(w, X, P)
    return total, mean[:, 0], covariance[:, 0]


def taken(table: Array, rows: Array) -> Array:
    """Some rows of a table (n, count, ...), numbered through; the table itself where those are all."""
    flat = table.reshape(-1, *table.shape[2:])
    return flat if len(rows) == len(flat) else flat[rows]


def put(table: Array, rows: Array, values: Array) -> Array:
    """The table (n, count, ...) with other values in these rows."""
    if len(rows) == table.shape[0] * table.shape[1]:
        return values.reshape(table.shape)
    found = table.copy()
    found.reshape(-1, *table.shape[2:])[rows] = values
    return found


@compiled(void(int64[::1], int64, M3, M4, M, M3, M, M3, M, M, M3))
def lines(rows, slots, length, held, offset, direction, steady, steady_direction, spread, offsets, directions):
    """Offsets (rows, p + e) and directions (rows, p + e, f + c) of the filters in these rows; they come zeroed.

    length (n, r, slots), held (n, r, slots, p), offset, steady (r, p) and their directions (r, p, f) are the events', spread
    (e, c) the parameters'. In an episode's rows the healthy filter is the first.
    """
    (kinds, p, f), (e, c) = direction.shape, spread.shape
    count = 1 + kinds * slots
    for i in range(rows.size):
        of, place = rows[i] // count, rows[i] % count
        if place > 0:
            kind, slot = (place - 1) // slots, (place - 1) % slots
            share = length[of, kind, slot]
            for a in range(p):
                offsets[i, a] = share * offset[kind, a] + (held[of, kind, slot, a] + steady[kind, a])
                for b in range(f):
                    directions[i, a, b] = share * direction[kind, a, b] + steady_direction[kind, a, b]
        for a in range(e):
            for b in range(c):
                directions[i, p + a, f + b] = spread[a, b]

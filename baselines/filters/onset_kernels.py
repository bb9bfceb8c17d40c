"""The lines of the onset bank's filters."""

from __future__ import annotations

from numba import float64, int64, void

from fdi_gym.kernels import M, compiled

M3, M4 = float64[:, :, ::1], float64[:, :, :, ::1]


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

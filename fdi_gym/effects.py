"""What faults do at a sample, to theta and to the sensors, compiled for the closed loop; the columns of their tables."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import float64, int64, types
from numba.core import cgutils
from numba.extending import intrinsic

from fdi_gym.noise import uniform

# Columns of a flight's table of effects: entry of theta, first and end step, kind, and what the kind needs
ENTRY, ONSET, END, KIND, VALUE, FIRST, SECOND, COLUMNS = range(8)
ABRUPT, INCIPIENT, INTERMITTENT, SQUARE, HOLD, SAMPLES, RAMP = range(7)

# Columns of a sensor's faults at a sample; all 0: none
GAIN, BIAS, NOISE, FROZEN, LAG, MISSING, FAULTS = range(7)

# Columns of how a sensor reports: probability that a missing sample begins, and that another follows; samples from one
# reading to the next; samples by which all of them lag; 1 where the last reading is shown again
BEGIN, STAY, PERIOD, DELAY, AGAIN, REPORTING = range(6)


def _pointer_at(typing_context, where):
    def codegen(context, builder, _, arguments):
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(int64), codegen


pointer: Any = intrinsic(_pointer_at)  # a pointer from an address
at: Any = numba.carray  # type: ignore[attr-defined]  # the array there


@numba.njit(inline="always")
def row_of(table, i):
    """Row i of a table, without counting who refers to it (which costs more than to read it): the table outlives it."""
    n = table.shape[-1]
    return at(pointer(table.ctypes.data + 8 * i * n), (n,), float64)


@numba.njit(inline="always")
def page_of(tables, i):
    """Table i of so many, in the same way."""
    rows, n = tables.shape[-2], tables.shape[-1]
    return at(pointer(tables.ctypes.data + 8 * i * rows * n), (rows, n), float64)


@numba.njit
def theta_over(k, seen, dt, slot, effects, counts, values, held, nominal, i, courses):
    """theta over step k, tau after sample k, from the effects on flight `slot` that act then; of two, the later listed.

    It is a + b exp(-g tau), or a + b tau where g < 0, of courses[i] = (a, b, g).

    `seen`: as the sensors meet it at sample k, before the command of step k is known.
    Returns whether any entry drifts.
    """
    table, course = page_of(effects, slot), page_of(courses, i)
    a, b, g = row_of(course, 0), row_of(course, 1), row_of(course, 2)
    for j in range(a.size):
        a[j], b[j], g[j] = nominal[j], 0.0, 0.0
    drifts = False
    for e in range(counts[slot]):
        onset = np.int64(table[e, ONSET])
        if not onset <= k < table[e, END]:
            continue
        j, kind, value = np.int64(table[e, ENTRY]), np.int64(table[e, KIND]), table[e, VALUE]
        since = (k - onset) * dt
        b[j] = g[j] = 0.0
        if kind == ABRUPT:
            a[j] = value
        elif kind == INCIPIENT:
            a[j], g[j] = value, table[e, FIRST]
            b[j] = (nominal[j] - value) * np.exp(-g[j] * since)
            drifts = True
        elif kind == RAMP:
            share, then = min(since / table[e, FIRST], 1.0), min((since + dt) / table[e, FIRST], 1.0)
            a[j] = nominal[j] + (value - nominal[j]) * share
            if then > share:
                b[j], g[j] = (value - nominal[j]) * (then - share) / dt, -1.0
                drifts = True
        elif kind == INTERMITTENT:
            a[j] = value if (since / table[e, FIRST] + 1e-9) % 1.0 < table[e, SECOND] else nominal[j]
        elif kind == SQUARE:
            half = np.floor(since / (0.5 * table[e, FIRST]) + 1e-9)
            a[j] = value if half % 2.0 == 0.0 else table[e, SECOND]
        elif kind == SAMPLES:
            last = np.int64(table[e, FIRST]) - 1
            a[j] = at(pointer(values[slot, e]), (last + 1,), float64)[min(k - onset, last)]
        elif seen and k == onset:
            a[j] = nominal[j]
        else:
            a[j] = held[slot, e]
    return drifts


@numba.njit
def caught(k, slot, effects, counts, u, i, held):
    """Hold faults of flight `slot` that begin at step k catch the command u[i]. Returns whether it has any."""
    holds = False
    for e in range(counts[slot]):
        if effects[slot, e, KIND] == HOLD:
            holds = True
            if k == effects[slot, e, ONSET] - effects[slot, e, SECOND]:
                held[slot, e] = u[i, np.int64(effects[slot, e, FIRST])]
    return holds


@numba.njit
def wrong_sensors(k, s, slot, sensors, theta, own, tables, seed, drops, f):
    """f (n_y, FAULTS): what is wrong with each sensor of flight `slot` at sample k, from all who have a say."""
    n_y, reporting, dropped = f.shape[0], page_of(tables, slot), row_of(drops, slot)
    tabled, layered, reports = sensors.shape[0] > 0, own < theta.size, tables.shape[0] > 0
    for i in range(n_y):
        for c in range(FAULTS):
            f[i, c] = sensors[s, slot, i, c] if tabled else 0.0
            if layered:
                f[i, c] += theta[own + c * n_y + i]
        if reports:
            f[i, LAG] += reporting[i, DELAY]
            if reporting[i, PERIOD] > 1.0 and k % np.int64(reporting[i, PERIOD]):
                f[i, MISSING] = 1.0
            if reporting[i, BEGIN] > 0.0:
                chance = reporting[i, STAY] if dropped[i] else reporting[i, BEGIN]
                if k == 0:  # as long after a start
                    chance = reporting[i, BEGIN] / (1.0 + reporting[i, BEGIN] - reporting[i, STAY])
                dropped[i] = 1.0 if uniform(seed[slot], k, i) < chance else 0.0
                f[i, MISSING] += dropped[i]


@numba.njit(inline="always")
def sense(k, y, z, row, sigma, limit, injected, v, faulty, f, again, true_feedback, healthy, box, history, last, shown, fed):
    """What the sensors say: `shown` (NaN where one does not report), and `fed`, what the controller gets.

    `last` has the last reading of each, and what it last fed; `again`: it is shown in place of NaN. `true_feedback`: the
    controller gets no noise. `healthy`: no faults.
    """
    for i in range(y.size):
        true = y[i]
        if history.shape[0]:
            history[k % history.shape[0], i] = true
        noise = v[k, i] if injected else sigma[i] * min(max(z[row, i], -limit), limit) if sigma[i] else 0.0
        clean = true if true_feedback else min(max(true + noise, box[0, i]), box[1, i])
        missing = frozen = False
        if faulty:
            lag = min(np.int64(f[i, LAG]), history.shape[0] - 1)
            if lag > 0:
                true = history[max(k - lag, 0) % history.shape[0], i]
            if f[i, NOISE]:
                noise += f[i, NOISE] * noise
            if f[i, GAIN]:
                true += f[i, GAIN] * true
                noise += f[i, GAIN] * noise
            if f[i, BIAS]:
                true += f[i, BIAS]
            frozen, missing = f[i, FROZEN] != 0.0, f[i, MISSING] != 0.0
        says = min(max(true + noise, box[0, i]), box[1, i])
        feeds = true if true_feedback else says
        if (frozen or missing) and k:
            says, feeds = last[0, i], last[1, i]
        last[0, i], last[1, i] = says, feeds
        shown[i] = np.nan if missing and not again else says
        fed[i] = clean if healthy else feeds

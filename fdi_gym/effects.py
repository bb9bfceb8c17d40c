"""What faults do at a sample, to theta and to the sensors, compiled for the closed loop; the columns of their tables."""

from __future__ import annotations

import numpy as np

from fdi_gym.kernels import floats_at, helper
from fdi_gym.noise import uniform

# Columns of a flight's table of effects: entry of theta, first and end step, kind, and what the kind needs
ENTRY, ONSET, END, KIND, VALUE, FIRST, SECOND, COLUMNS = range(8)
ABRUPT, INCIPIENT, INTERMITTENT, SQUARE, HOLD, SAMPLES, RAMP = range(7)

# Columns of a sensor's faults at a sample; all 0: none
GAIN, BIAS, NOISE, FROZEN, LAG, MISSING, FAULTS = range(7)

# Columns of how a sensor reports: probability that a missing sample begins, and that another follows; samples from one
# reading to the next; samples by which all of them lag; 1 where the last reading is shown again
BEGIN, STAY, PERIOD, DELAY, AGAIN, REPORTING = range(6)

NEVER = 2**62  # a sample that does not come


@helper
def theta_over(k, seen, dt, slot, effects, counts, values, held, nominal, i, courses, drifts, theta):
    """theta over step k, tau after sample k, from the effects on flight `slot` that act then; of two, the later listed.

    It is a + b exp(-g tau), or a + b tau where g < 0, of courses[i] = (a, b, g); theta[i] is what it is at first, and
    drifts[i] whether it changes within the step.

    `seen`: as the sensors meet it at sample k, before the command of step k is known.
    Returns the next step at which to ask again.
    """
    table, a, b, g = effects[slot], courses[i, 0], courses[i, 1], courses[i, 2]
    for j in range(a.size):
        a[j], b[j], g[j] = nominal[j], 0.0, 0.0
    drifts[i], until = False, NEVER
    for e in range(counts[slot]):
        onset, end = np.int64(table[e, ONSET]), np.int64(table[e, END])
        if k < onset:
            until = min(until, onset)
        if not onset <= k < end:
            continue
        until = min(until, end)
        j, kind, value = np.int64(table[e, ENTRY]), np.int64(table[e, KIND]), table[e, VALUE]
        since = (k - onset) * dt
        b[j] = g[j] = 0.0
        if kind == ABRUPT:
            a[j] = value
        elif kind == INCIPIENT:
            a[j], g[j] = value, table[e, FIRST]
            b[j] = (nominal[j] - value) * np.exp(-g[j] * since)
            drifts[i] = True
        elif kind == RAMP:
            share, then = min(since / table[e, FIRST], 1.0), min((since + dt) / table[e, FIRST], 1.0)
            a[j] = nominal[j] + (value - nominal[j]) * share
            if then > share:
                b[j], g[j] = (value - nominal[j]) * (then - share) / dt, -1.0
                drifts[i] = True
        elif kind == INTERMITTENT:
            a[j] = value if (since / table[e, FIRST] + 1e-9) % 1.0 < table[e, SECOND] else nominal[j]
        elif kind == SQUARE:
            half = np.floor(since / (0.5 * table[e, FIRST]) + 1e-9)
            a[j] = value if half % 2.0 == 0.0 else table[e, SECOND]
        elif kind == SAMPLES:
            last = np.int64(table[e, FIRST]) - 1
            a[j] = floats_at(values[slot, e], last + 1)[min(k - onset, last)]
        elif seen and k == onset:
            a[j] = nominal[j]
        else:
            a[j] = held[slot, e]
        if kind != ABRUPT:
            until = k + 1
    for j in range(a.size):
        theta[i, j] = a[j] if g[j] < 0.0 else a[j] + b[j]
    return until


@helper
def caught(k, slot, effects, counts, u, i, held):
    """Hold faults of flight `slot` that begin at step k catch the command u[i]. Returns whether it has any."""
    holds = False
    for e in range(counts[slot]):
        if effects[slot, e, KIND] == HOLD:
            holds = True
            if k == effects[slot, e, ONSET] - effects[slot, e, SECOND]:
                held[slot, e] = u[i, np.int64(effects[slot, e, FIRST])]
    return holds


@helper
def wrong_sensors(k, s, slot, sensors, theta, own, tables, seed, drops, f):
    """f (n_y, FAULTS): what is wrong with each sensor of flight `slot` at sample k, from all who have a say."""
    n_y, reporting, dropped = f.shape[0], tables[slot], drops[slot]
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


@helper
def sense(k, y, noise, faulty, f, again, true_feedback, healthy, box, history, last, shown, fed):
    """What the sensors say: `shown` (NaN where one does not report), and `fed`, what the controller gets.
    `last` has the last reading of each, and what it last fed; `again`: it is shown in place of NaN. `true_feedback`: the
    controller gets no noise. `healthy`: no faults.
    """
    for i in range(y.size if history.shape[0] else 0):
        history[k % history.shape[0], i] = y[i]
    if not faulty:
        for i in range(y.size):
            shown[i] = last[0, i] = min(max(y[i] + noise[i], box[0, i]), box[1, i])
        for i in range(y.size):
            fed[i] = last[1, i] = y[i] if true_feedback else shown[i]
        return
    for i in range(y.size):
        true, error = y[i], noise[i]
        clean = true if true_feedback else min(max(true + error, box[0, i]), box[1, i])
        lag = min(np.int64(f[i, LAG]), history.shape[0] - 1)
        if lag > 0:
            true = history[max(k - lag, 0) % history.shape[0], i]
        if f[i, NOISE]:
            error += f[i, NOISE] * error
        if f[i, GAIN]:
            true += f[i, GAIN] * true
            error += f[i, GAIN] * error
        if f[i, BIAS]:
            true += f[i, BIAS]
        frozen, missing = f[i, FROZEN] != 0.0, f[i, MISSING] != 0.0
        says = min(max(true + error, box[0, i]), box[1, i])
        feeds = true if true_feedback else says
        if (frozen or missing) and k:
            says, feeds = last[0, i], last[1, i]
        last[0, i], last[1, i] = says, feeds
        shown[i] = np.nan if missing and not again else says
        fed[i] = clean if healthy else feeds

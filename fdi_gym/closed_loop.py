"""The closed loop, sample by sample: THE order of operations in a step is written here and nowhere else.

At sample k: the sensors give y_k, right or wrong; what else is known gives n_k; the controller computes u_k, held until
k + 1; entries of theta that a hold fault owns take their value; the plant advances to x_{k+1} under the fault parameter
that acts over [k, k + 1); process noise is added. The observation is [y_k, u_{k-1}, n_k]. u_{-1} is the trim command and
theta at sample 0 the nominal one: no interval has ended before sample 0.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import float64, int64, types, uint64, void
from numba.core import cgutils
from numba.extending import intrinsic

from fdi_gym.integration import interval_at
from fdi_gym.kernels import M, V, compiled, control_at, known_at, map_at, outside_at
from fdi_gym.noise import fill, uniform

TILE = 32  # samples of one flight flown before the next one's turn

# Columns of a flight's table of effects: entry of theta, first and end step, kind, and what the kind needs
ENTRY, ONSET, END, KIND, VALUE, FIRST, SECOND, COLUMNS = range(8)
ABRUPT, INCIPIENT, INTERMITTENT, SQUARE, HOLD, SAMPLES, RAMP = range(7)

# Columns of a sensor's faults at a sample; all 0: none
GAIN, BIAS, NOISE, FROZEN, LAG, MISSING, FAULTS = range(7)

# Columns of how a sensor reports: probability that a missing sample begins, and that another follows; samples from one
# reading to the next; samples by which all of them lag; 1 where the last reading is shown again
BEGIN, STAY, PERIOD, DELAY, AGAIN, REPORTING = range(6)

# Where a flight is
FLYING, ENDED, OVER, TERMINATED = range(4)  # ENDED: its last sample is still to be shown; TERMINATED: over, before its time


def _pointer_at(typing_context, where):
    def codegen(context, builder, _, arguments):
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(int64), codegen


_pointer: Any = intrinsic(_pointer_at)  # a pointer from an address
_at: Any = numba.carray  # type: ignore[attr-defined]  # the array there


@numba.njit
def _effects(k, seen, dt, table, count, values, held, nominal, a, b, g):
    """theta over step k, tau after sample k, from the effects that act then; of two, the later listed.

    It is a + b exp(-g tau), or a + b tau where g < 0.

    `seen`: as the sensors meet it at sample k, before the command of step k is known.
    Returns whether any entry drifts.
    """
    for j in range(a.size):
        a[j], b[j], g[j] = nominal[j], 0.0, 0.0
    drifts = False
    for e in range(count):
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
            a[j] = _at(_pointer(values[e]), (last + 1,), float64)[min(k - onset, last)]
        elif seen and k == onset:
            a[j] = nominal[j]
        else:
            a[j] = held[e]
    return drifts


@numba.njit
def _wrong(k, tabled, sensors, s, slot, layered, theta, own, reports, reporting, seed, dropped, f):
    """f (n_y, FAULTS): what is wrong with each sensor at sample k, from all who have a say."""
    n_y = f.shape[0]
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
                dropped[i] = 1.0 if uniform(seed, k, i) < chance else 0.0
                f[i, MISSING] += dropped[i]


@numba.njit(inline="always")
def _sense(
    k, y, z, row, sigma, limit, injected, v, faulty, f, again, true_feedback, healthy, box, history, last, shown, fed
):
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


_I, _D3 = int64[::1], float64[:, :, ::1]


@compiled(
    void(
        int64, int64, int64, int64, int64,
        float64, int64, int64, V, M, M, V, float64, _I,
        uint64[::1], _I, _I, _I, _I, _I, _I, _I, M, M, _D3, _I, int64[:, ::1], int64[:, :, ::1],
        _D3, _I, _I, M, M, M, M, M, _D3, _D3, M,
        _I, int64, int64, _D3, _D3, float64[:, :, :, ::1], _D3, _D3, _D3, int64[:, ::1],
    )
)  # fmt: skip
def fly(
    interval_address, output_address, control_address, known_address, outside_address,
    dt, substeps, true_feedback, nominal, sensor_box, command_box, sigma, limit, widths,
    seed, steps, reference_at, disturbance_at, process_noise, sensor_noise, reference_step, disturbance_step,
    p, parameters, effects, counts, values, labels,
    reporting, at, status, X, C, U, THETA, held, readings, histories, dropped,
    slots, first, samples, inputs, references_added, sensors, obs, state, theta, label,
):  # fmt: skip
    """Fly the flights in `slots` on by so many samples, into the rows from `first` on of obs, state, theta and label.

    The second line of arguments is the plant's, the next two the flights' (one row each; tables by address, with a step of
    0 where one row serves all samples; a noise address of 0: by counter), then how their sensors report (nothing: at every
    sample) and where they are, changed in place. `inputs` (samples, flights, n_u) is added to the command within its range,
    `references_added` (samples, flights, n_r) to what it follows,
    `sensors` (samples, flights, n_y, FAULTS) is what is wrong with the sensors; either may be empty. Of theta the plant's
    equations get the first `widths[2]` entries; where there are more, they are the faults of its sensors, column by column.
    """
    interval, output, control = interval_at(interval_address), map_at(output_address), control_at(control_address)
    known, outside = known_at(known_address), outside_at(outside_address)
    n, n_u, n_c, n_y, n_theta = X.shape[1], U.shape[1], C.shape[1], sensor_box.shape[1], nominal.size
    n_k = obs.shape[2] - n_y - n_u
    n_r, n_d, own, healthy = widths[0], widths[1], widths[2], widths[3] != 0
    layered, tabled, reports = own < n_theta, sensors.shape[0] > 0, reporting.shape[0] > 0
    x, u, c, p_i, acts = np.empty(n), np.empty(n_u), np.empty(n_c), np.empty(p.shape[1]), np.empty(n_theta)
    y, shown, fed, out, wrong = np.empty(n_y), np.empty(n_y), np.empty(n_y), np.empty(n_k), np.zeros((n_y, FAULTS))
    course, theta_k = np.empty((3, n_theta)), np.empty(n_theta)
    a, b, g, theta_p, acts_p = course[0], course[1], course[2], theta_k[:own], acts[:own]  # the last two: the plant's own
    r, d = np.empty(n_r), np.empty(n_d)
    before = np.empty(n)
    used, words, normals = sigma > 0.0, np.empty((2, TILE), np.uint64), np.zeros((TILE, sigma.size))
    steady = not used.any()
    for tile in range(0, samples, TILE):
        for slot in slots:
            if status[slot] >= OVER:
                continue
            k, last = at[slot], steps[slot]
            for i in range(n):
                x[i] = X[slot, i]
            for i in range(n_u):
                u[i] = U[slot, i]
            for i in range(n_c):
                c[i] = C[slot, i]
            for i in range(p_i.size):
                p_i[i] = p[slot, i]
            for j in range(n_theta):
                acts[j] = THETA[slot, j]
            injected = process_noise[slot] != 0
            if not (injected or steady):
                fill(seed[slot], k, min(TILE, samples - tile), used, words, normals)
            step_r, step_d = reference_step[slot], disturbance_step[slot]
            references = _at(_pointer(reference_at[slot]), (last + 1, n_r), float64)
            disturbances = _at(_pointer(disturbance_at[slot]), (last + 1, n_d), float64)
            w = _at(_pointer(process_noise[slot]), (last, n), float64)
            v = _at(_pointer(sensor_noise[slot]), (last + 1, n_y), float64)
            q, acting, count, values_i, held_i = parameters[slot], effects[slot], counts[slot], values[slot], held[slot]
            readings_i, history, segment = readings[slot], histories[slot], 0
            again = reports and reporting[slot, 0, AGAIN] != 0.0
            faulty = tabled or reports or (layered and count > 0)
            holds = False
            for e in range(count):
                holds = holds or acting[e, KIND] == HOLD
            drifts = _effects(k, True, dt, acting, count, values_i, held_i, nominal, a, b, g)
            for s in range(tile, min(tile + TILE, samples)):
                row, t = first + s, k * dt
                # sample k: what acts, what is measured, what is known
                for i in range(n_r):
                    r[i] = references[k * step_r, i]
                if references_added.shape[0]:
                    for i in range(n_r):
                        r[i] += references_added[s, slot, i]
                for i in range(n_d):
                    d[i] = disturbances[min(k, last - 1) * step_d, i]
                if count:
                    drifts = _effects(k, True, dt, acting, count, values_i, held_i, nominal, a, b, g)
                for j in range(n_theta):
                    theta_k[j] = a[j] if g[j] < 0.0 else a[j] + b[j]
                output(t, x, u, theta_p, d, p_i, y)
                if faulty:
                    _wrong(
                        k, tabled, sensors, s, slot, layered, theta_k, own, reports, reporting[slot] if reports else wrong,
                        seed[slot], dropped[slot] if reports else y, wrong,
                    )  # fmt: skip
                _sense(
                    k, y, normals, s - tile, sigma, limit, injected, v, faulty, wrong, again, true_feedback != 0, healthy,
                    sensor_box, history, readings_i, shown, fed,
                )  # fmt: skip
                known(t, r, c, out)
                while labels[slot, segment + 1, 0] <= k:
                    segment += 1
                label[row, slot] = labels[slot, segment, 1]
                for i in range(n):
                    state[row, slot, i] = x[i]
                for j in range(n_theta):
                    theta[row, slot, j] = acts[j]
                for i in range(n_y):
                    obs[row, slot, i] = shown[i]
                for i in range(n_u):
                    obs[row, slot, n_y + i] = u[i]
                for i in range(n_k):
                    obs[row, slot, n_y + n_u + i] = out[i]
                if k == last or status[slot] == ENDED:
                    status[slot] = TERMINATED if status[slot] == ENDED else OVER
                    steps[slot] = k
                    break
                # step k: the command, the interval to sample k + 1
                control(t, fed, r, q, c, u)
                if inputs.shape[0]:
                    for i in range(n_u):
                        if inputs[s, slot, i]:
                            u[i] = min(max(u[i] + inputs[s, slot, i], command_box[0, i]), command_box[1, i])
                if holds:  # other faults do in the step what the sensors met
                    for e in range(count):
                        if acting[e, KIND] == HOLD and k == acting[e, ONSET] - acting[e, SECOND]:
                            held_i[e] = u[np.int64(acting[e, FIRST])]
                    drifts = _effects(k, False, dt, acting, count, values_i, held_i, nominal, a, b, g)
                for i in range(n):
                    before[i] = x[i]
                interval(t, dt, substeps, drifts, x, u, course, d, p_i, acts_p)
                for j in range(own, n_theta):
                    acts[j] = a[j] + (b[j] * (dt if g[j] < 0.0 else np.exp(-g[j] * dt)) if b[j] else 0.0)
                lost = False
                for i in range(n):
                    if injected:
                        x[i] += w[k, i]
                    elif used[n_y + i]:
                        x[i] += sigma[n_y + i] * min(max(normals[s - tile, n_y + i], -limit), limit)
                    lost = lost or not np.isfinite(x[i])
                if lost:  # the state has left the numbers: the last finite one is what is shown
                    for i in range(n):
                        x[i] = before[i]
                k += 1
                for i in range(n_r):
                    r[i] = references[k * step_r, i]
                if lost or outside(t + dt, x, r):
                    status[slot] = ENDED
            at[slot] = k
            for i in range(n):
                X[slot, i] = x[i]
            for i in range(n_u):
                U[slot, i] = u[i]
            for i in range(n_c):
                C[slot, i] = c[i]
            for j in range(n_theta):
                THETA[slot, j] = acts[j]

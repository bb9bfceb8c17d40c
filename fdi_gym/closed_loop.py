"""The closed loop, sample by sample: THE order of operations in a step is written here and nowhere else.

At sample k: the sensors give y_k, right or wrong; what else is known gives n_k; the controller computes u_k, held until
k + 1; entries of theta that a hold fault owns take their value; the plant advances to x_{k+1} under the fault parameter
that acts over [k, k + 1); process noise is added. The observation is [y_k, u_{k-1}, n_k]. u_{-1} is the trim command and
theta at sample 0 the nominal one: no interval has ended before sample 0.

Flights go side by side, some at a time: what the plant does over an interval is then a vector's work (`integration`).
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, uint64, void

from fdi_gym.effects import AGAIN, FAULTS, caught, sense, theta_over, wrong_sensors
from fdi_gym.integration import FEW, LANES, interval_at, lanes_at
from fdi_gym.kernels import (
    M,
    V,
    bools,
    compiled,
    control_at,
    floats,
    floats_at,
    helper,
    ints,
    known_at,
    map_at,
    outside_at,
    put,
    words,
)
from fdi_gym.noise import white

TILE = 32  # samples that flights fly before the turn of the next ones

# Where a flight is
FLYING, ENDED, OVER, TERMINATED = range(4)  # ENDED: its last sample is still to be shown; TERMINATED: over, before its time


@helper
def _boarded(slots, position, status, beside):
    """The next flights that are not over, as many as go side by side. Returns how many, and the position after them.

    What is left of `beside` is the last of them again: a lane that nobody flies computes something harmless.
    """
    width = 0
    while position < slots.size and width < LANES:
        if status[slots[position]] < OVER:
            beside[width] = slots[position]
            width += 1
        position += 1
    for i in range(width, LANES if width else 0):
        beside[i] = beside[width - 1]
    return width, position


@helper
def _move(interval, lanes, dt, substeps, t, x, u, theta, d, p, courses, drifts, moving, beside, after, THETA):
    """after[i] = the state one sample after x[i], for those that move, and theta as it is then; where it drifts, alone."""
    together = 0
    for i in range(LANES):
        together += moving[i] and not drifts[i]
    if together >= FEW:
        lanes(t, dt, substeps, x, u, theta, d, p, after)
    for i in range(LANES):
        if not moving[i]:
            continue
        now = THETA[beside[i]]
        if together < FEW or drifts[i]:
            for j in range(x.shape[1]):
                after[i, j] = x[i, j]
            interval(t[i], dt, substeps, drifts[i], after[i], u[i], courses[i], d[i], p[i], now)
        else:
            for j in range(now.size):
                now[j] = theta[i, j]


@helper
def _injected(k, last, samples, process_noise, sensor_noise, n_y, noise):
    """The noise of samples from k on, from a flight's own tables."""
    n = noise.shape[1] - n_y
    w, v = floats_at(process_noise, (last, n)), floats_at(sensor_noise, (last + 1, n_y))
    for s in range(min(samples, last + 1 - k)):
        for j in range(n_y):
            noise[s, j] = v[k + s, j]
        for j in range(n if k + s < last else 0):
            noise[s, n_y + j] = w[k + s, j]


_I, _D3 = int64[::1], float64[:, :, ::1]


@compiled(
    void(
        int64, int64, int64, int64, int64, int64,
        float64, int64, int64, V, M, M, V, float64, _I,
        uint64[::1], _I, _I, _I, _I, _I, _I, _I, M, M, _D3, _I, int64[:, ::1], int64[:, :, ::1],
        _D3, _I, _I, M, M, M, M, M, _D3, _D3, M,
        _I, int64, int64, _D3, _D3, float64[:, :, :, ::1], _D3, _D3, _D3, int64[:, ::1],
    )
)  # fmt: skip
def fly(
    interval_address, lanes_address, output_address, control_address, known_address, outside_address,
    dt, substeps, true_feedback, nominal, sensor_box, command_box, sigma, limit, widths,
    seed, steps, reference_at, disturbance_at, process_noise, sensor_noise, reference_step, disturbance_step,
    P, parameters, effects, counts, values, labels,
    reporting, sample, status, X, C, U, THETA, held, readings, histories, dropped,
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
    interval, lanes, output = interval_at(interval_address), lanes_at(lanes_address), map_at(output_address)
    control, known, outside = control_at(control_address), known_at(known_address), outside_at(outside_address)
    n, n_u, n_y, n_theta, n_p = X.shape[1], U.shape[1], sensor_box.shape[1], nominal.size, P.shape[1]
    n_r, n_d, own, healthy = widths[0], widths[1], widths[2], widths[3] != 0
    layered, tabled, reports = own < n_theta, sensors.shape[0] > 0, reporting.shape[0] > 0
    # of the flights side by side: what the plant's equations get, the course of theta, which they are
    t, x, u, d = floats(LANES), floats((LANES, n)), floats((LANES, n_u)), floats((LANES, n_d))
    p, theta_k, after = floats((LANES, n_p)), floats((LANES, n_theta)), floats((LANES, n))
    courses, beside, segment, until = floats((LANES, 3, n_theta)), ints(LANES), ints(LANES), ints(LANES)
    moving, drifts = bools(LANES), bools(LANES)
    y, fed, r, wrong = floats(n_y), floats(n_y), floats(n_r), floats((n_y, FAULTS))
    used, pairs, noise = bools(sigma.size), words((2, TILE)), floats((LANES, TILE, sigma.size))
    t[:], d[:], noise[:] = 0.0, 0.0, 0.0
    for j in range(sigma.size):
        used[j] = sigma[j] > 0.0
    for tile in range(0, samples, TILE):
        position, end = 0, min(tile + TILE, samples)
        while position < slots.size:
            width, position = _boarded(slots, position, status, beside)
            if width == 0:
                break
            for i in range(LANES):
                slot = beside[i]
                k, moving[i], segment[i] = sample[slot], i < width, 0
                put(X[slot], x[i])
                put(U[slot], u[i])
                put(P[slot], p[i])
                until[i] = theta_over(k, True, dt, slot, effects, counts, values, held, nominal, i, courses, drifts, theta_k)
                if process_noise[slot]:
                    _injected(k, steps[slot], end - tile, process_noise[slot], sensor_noise[slot], n_y, noise[i])
                elif moving[i]:
                    white(seed[slot], k, end - tile, sigma, limit, used, pairs, noise[i])
            for s in range(tile, end):
                row = first + s
                for i in range(width):
                    if not moving[i]:
                        continue
                    # sample k: what acts, what is measured, what is known
                    slot = beside[i]
                    k, last = sample[slot], steps[slot]
                    t[i] = k * dt
                    references = floats_at(reference_at[slot], (last + 1, n_r))
                    disturbances = floats_at(disturbance_at[slot], (last + 1, n_d))
                    for j in range(n_r):
                        r[j] = references[k * reference_step[slot], j]
                    if references_added.shape[0]:
                        for j in range(n_r):
                            r[j] += references_added[s, slot, j]
                    for j in range(n_d):
                        d[i, j] = disturbances[min(k, last - 1) * disturbance_step[slot], j]
                    if k >= until[i]:
                        until[i] = theta_over(
                            k, True, dt, slot, effects, counts, values, held, nominal, i, courses, drifts, theta_k
                        )
                    acts, faulty = theta_k[i], tabled or reports or (layered and counts[slot] > 0)
                    output(t[i], x[i], u[i], acts[:own], d[i], p[i], y)
                    if faulty:
                        wrong_sensors(k, s, slot, sensors, acts, own, reporting, seed, dropped, wrong)
                    seen = obs[row, slot]
                    again, errors = reports and reporting[slot, 0, AGAIN] != 0.0, noise[i, s - tile]
                    sense(
                        k, y, errors, faulty, wrong, again, true_feedback != 0, healthy, sensor_box,
                        histories[slot], readings[slot], seen, fed,
                    )  # fmt: skip
                    for j in range(n_u):
                        seen[n_y + j] = u[i, j]
                    known(t[i], r, C[slot], seen[n_y + n_u :])
                    while labels[slot, segment[i] + 1, 0] <= k:
                        segment[i] += 1
                    label[row, slot] = labels[slot, segment[i], 1]
                    put(x[i], state[row, slot])
                    put(THETA[slot], theta[row, slot])
                    if k == last or status[slot] == ENDED:
                        status[slot] = TERMINATED if status[slot] == ENDED else OVER
                        steps[slot], moving[i] = k, False
                        continue
                    # step k: the command
                    control(t[i], fed, r, parameters[slot], C[slot], u[i])
                    if inputs.shape[0]:
                        for j in range(n_u):
                            if inputs[s, slot, j]:
                                u[i, j] = min(max(u[i, j] + inputs[s, slot, j], command_box[0, j]), command_box[1, j])
                    if caught(k, slot, effects, counts, u, i, held):  # other faults do in the step what the sensors met
                        theta_over(k, False, dt, slot, effects, counts, values, held, nominal, i, courses, drifts, theta_k)
                # the interval to sample k + 1
                _move(interval, lanes, dt, substeps, t, x, u, theta_k, d, p, courses, drifts, moving, beside, after, THETA)
                for i in range(width):
                    if not moving[i]:
                        continue
                    slot = beside[i]
                    k, finite = sample[slot], True
                    for j in range(own, n_theta):
                        a, b, g = courses[i, 0, j], courses[i, 1, j], courses[i, 2, j]
                        THETA[slot, j] = a + (b * (dt if g < 0.0 else np.exp(-g * dt)) if b else 0.0)
                    for j in range(n):
                        after[i, j] += noise[i, s - tile, n_y + j]
                        finite &= abs(after[i, j]) < np.inf
                    if finite:  # else the state has left the numbers: the last finite one is what is shown
                        put(after[i], x[i])
                    sample[slot] = k + 1
                    references = floats_at(reference_at[slot], (steps[slot] + 1, n_r))
                    for j in range(n_r):
                        r[j] = references[(k + 1) * reference_step[slot], j]
                    if not finite or outside(t[i] + dt, x[i], r):
                        status[slot] = ENDED
            for i in range(width):
                put(x[i], X[beside[i]])
                put(u[i], U[beside[i]])

"""What happens to one episode in the compiled Gaussian step: moments through f and h.

A function g (f or h of the augmented model) meets X ~ N(X, P) at 2 N + 1 points, the mean and two for each direction j.
Half the difference of a pair over its step is first[j], its second difference second[j]; with them the three rules are

    extended             directions e_j          cross' = F P,   cov = F P F',   F = first', mean = g(X)
    unscented            columns of P = L L'     cross' = D1 L', cov = D1 D1' + a D2 D2' - c d d', mean = g(X) + d
    central difference   the same

where D1 = first', D2 = second', d the sum of the second differences over 2 h^2, and h^2 = N + 2, a = 1 / (4 h^2), c = 1
give the unscented transform with lambda = 2, h^2 = 3, a = (h^2 - 1) / (4 h^4), c = 0 Stirling's interpolation. f leaves
[m; d] alone, so that their covariance stays and their covariance with the moved x is a part of cross.

Vectors of an episode are rows in C order and inner loops run along them: that is what the compiler makes vectors of,
in an order that no batch changes. Matrices are kept transposed (`first`, `cross`, the upper factor) for that reason; W is
what rows of N are as whole vectors.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.estimation.gaussian_algebra import entry
from fdi_gym.estimation.gaussian_points import (
    DISTURBANCES,
    ENTRIES,
    KNOWN,
    OUTPUT,
    OUTPUTS,
    OWN,
    SENSORS,
    SIZES,
    STATES,
    SUBSTEPS,
    TANGENT,
    THETA,
    change_magnitude,
    enters,
    moments_of_points,
    pass_points,
    put_magnitudes,
    spread,
    squared_step,
)
from fdi_gym.kernels import floats, helper, inlined, ints, map_at, put
from fdi_gym.tangent import tangent_at
from fdi_gym.vectors import load, store, zeros


@helper
def through(rule, moving, integers, reals, offset, direction, t, X, U, u, known, mean, cross, cov):
    """N(X, U' U) through f (moving) or h at points: mean (m,), cov (m, m) and cross (m, N) with what went in."""
    N, m = X.size, mean.size
    points, values, first = floats((2 * N + 1, N)), floats((2 * N + 1, m)), floats((N, m))
    spread(X, U, np.sqrt(squared_step(rule, N)), points)
    pass_points(moving, integers, reals, offset, direction, t, points, u, known, values)
    low = integers[STATES] if moving else 0  # of f, nobody asks for the covariance with x before
    moments_of_points(rule, U, low, values, first, mean, cross, cov)


@helper
def differenced(integers, reals, step, offset, direction, t, X, u, known, F, mean):
    """mean = f(X) and F (n_x, W) its Jacobian, by central differences."""
    N, m, moved = X.size, mean.size, 0  # so many columns are not 0
    points, values = floats((2 * N + 1, N)), floats((2 * N + 1, m))
    for j in range(N):
        if enters(True, integers, direction, j):
            for i in range(N):
                points[1 + 2 * moved, i] = points[2 + 2 * moved, i] = X[i]
            points[1 + 2 * moved, j] += step[j]
            points[2 + 2 * moved, j] -= step[j]
            moved += 1
    put(X, points[0])
    pass_points(True, integers, reals, offset, direction, t, points[: 1 + 2 * moved], u, known, values)
    moved = 0
    for j in range(N):
        for a in range(m):
            F[a, j] = 0.0
        if enters(True, integers, direction, j):
            for a in range(m):
                F[a, j] = (values[1 + 2 * moved, a] - values[2 + 2 * moved, a]) * (0.5 / step[j])
            moved += 1
    for a in range(m):
        mean[a] = values[0, a]


@helper
def sensed(integers, reals, step, offset, direction, t, X, u, known, room, x, y, F, mean):
    """mean = h(X) and F (m, W) its Jacobian, by central differences, one column after the other.

    room: as of `room_of`; x (N,) and y (n_y,) are room too.
    """
    now, theta, physical, d = room[:4]
    state = x[: integers[STATES]]
    output = map_at(integers[OUTPUT])
    n_x, n_m, m, N = integers[STATES], direction.shape[1], mean.size, X.size
    p, own, n_y, n_d = integers[ENTRIES], integers[OWN], integers[OUTPUTS], integers[DISTURBANCES]
    for i in range(N):
        x[i] = X[i]
    for i in range(d.size):
        d[i] = known[i]
    put_magnitudes(integers, offset, direction, X, reals[1:], now)
    middle = floats(now.size)
    put(now, middle)
    for j in range(-1, N):  # first the mean
        if j >= n_x and not enters(False, integers, direction, j):
            for a in range(m):
                F[a, j] = 0.0
            continue
        for side in range(2 if j >= 0 else 1):
            if j >= 0:
                x[j] = X[j] + step[j] if side == 0 else X[j] - step[j]
            if n_x <= j < n_x + n_m:
                change_magnitude(integers, direction, j - n_x, x[j] - X[j], middle, now)
            for i in range(n_d):
                d[integers[SIZES + p + i]] = x[n_x + n_m + i]
            output(t, state, u, theta, d, physical, y)
            for a in range(m):
                i = integers[SIZES + p + n_d + a]
                value = y[i]
                if own < integers[THETA]:  # gains, then biases
                    value += y[i] * now[own + i] + now[own + n_y + i]
                if j < 0:
                    mean[a] = value
                elif side == 0:
                    F[a, j] = value
                else:
                    F[a, j] = (F[a, j] - value) * (0.5 / step[j])
        if j >= 0:
            x[j] = X[j]
        if n_x <= j < n_x + n_m:
            change_magnitude(integers, direction, j - n_x, 0.0, middle, now)


@inlined
def own_faults(integers):
    """Which entries are the gain and the bias of each sensor (2, m); -1 where none is."""
    p, m, own, n_y = integers[ENTRIES], integers[SENSORS], integers[OWN], integers[OUTPUTS]
    found = ints((2, m))
    found[:] = -1
    for a in range(m):
        i = own + integers[SIZES + p + integers[DISTURBANCES] + a]
        for e in range(p):
            if own < integers[THETA] and integers[SIZES + e] == i:
                found[0, a] = e
            elif own < integers[THETA] and integers[SIZES + e] == i + n_y:
                found[1, a] = e
    return found


@helper
def heard(integers, reals, faults, offset, direction, plain, X, F, mean):
    """mean = h(X) and F (m, W) its Jacobian, of sensors that read plain x, times their gain, and their bias.

    faults: as of `own_faults`.
    """
    n_x, n_m = integers[STATES], direction.shape[1]
    for a in range(mean.size):
        y = 0.0
        for j in range(n_x):
            y += plain[a, j] * X[j]
        for j in range(n_x, X.size):
            F[a, j] = 0.0
        gain = bias = 0.0
        for of in range(2):
            e = faults[of, a]
            if e >= 0:
                deviation = reals[1 + integers[SIZES + e]] + offset[e]
                for j in range(n_m):
                    deviation += direction[e, j] * X[n_x + j]
                    F[a, n_x + j] += direction[e, j] * (y if of == 0 else 1.0)
                if of == 0:
                    gain = deviation
                else:
                    bias = deviation
        for j in range(n_x):
            F[a, j] = plain[a, j] * (1.0 + gain)
        mean[a] = y + (y * gain + bias)


@helper
def linearised(integers, offset, direction, plant, line, X, u, known, F, mean, room):
    """mean = f(X) and F (n_x N) its Jacobian, for a plant x+ = g + A x + B u + G d + (E[0] + sum u_k E[1 + k]) dtheta.

    plant (n_x, ...) has the columns [g, A, B, G, E[0], E[1], ...]. X, u, known, F and mean are in lanes, as in
    `gaussian_algebra`, each of which is on its `line` (LANES,); room (1, LANES).
    """
    n_x, n_u, n_D, p, n_d = mean.shape[0], u.shape[0], known.shape[0], direction.shape[1], integers[DISTURBANCES]
    B, N, n_m = 1 + n_x, X.shape[0], direction.shape[2]
    G = B + n_u
    E = G + n_D
    for a in range(n_x):
        total = zeros() + plant[a, 0]
        for k in range(n_u):
            total += load(u, k, 0) * plant[a, B + k]
        for j in range(n_D):
            total += load(known, j, 0) * plant[a, G + j]
        for j in range(n_x):
            store(F, a * N + j, 0, zeros() + plant[a, 1 + j])
        for j in range(n_m):
            store(F, a * N + n_x + j, 0, zeros())
        for e in range(p):
            gain = zeros() + plant[a, E + e]
            for k in range(n_u):
                gain += load(u, k, 0) * plant[a, E + (1 + k) * p + e]
            total += gain * entry(offset, line, e, room)
            for j in range(n_m):
                if direction.shape[0] > 1 or direction[0, e, j] != 0.0:
                    at = a * N + n_x + j
                    store(F, at, 0, load(F, at, 0) + gain * entry(direction, line, (e, j), room))
        for j in range(n_d):
            i = integers[SIZES + p + j]
            store(F, a * N + n_x + n_m + j, 0, zeros() + plant[a, G + i])
            total -= load(known, i, 0) * plant[a, G + i]  # X has it
        for j in range(N):
            total += load(F, a * N + j, 0) * load(X, j, 0)
        store(mean, a, 0, total)


@helper
def differentiated(integers, reals, step, offset, direction, t, X, u, known, room, F, mean):
    """mean = f(X) and F (n_x, W) its Jacobian, of a plant that says its derivatives.

    room: as of `room_of`.
    """
    now, theta, physical, d, L, used = room
    n, own, n_D = integers[STATES], integers[OWN], integers[KNOWN]
    n_theta, p, n_d, n_m, count = integers[THETA], integers[ENTRIES], integers[DISTURBANCES], direction.shape[1], 0
    put_magnitudes(integers, offset, direction, X, reals[1:], now)
    for e in range(p):
        i = integers[SIZES + e]
        if i < own or i >= n_theta:  # else it is a fault of a sensor
            at, moves = i if i < own else own + n_D + i - n_theta, False
            for j in range(n_m):
                L[at, n + j] = direction[e, j]
                moves = moves or direction[e, j] != 0.0
            if moves:
                used[count] = at
                count += 1
    for j in range(n_D):
        d[j] = known[j]
    for j in range(n_d):
        i = integers[SIZES + p + j]
        d[i] = X[n + n_m + j]
        used[count] = own + i
        L[own + i, n + n_m + j] = 1.0
        count += 1
    for i in range(n):
        mean[i] = X[i]
        for j in range(F.shape[1]):
            F[i, j] = 0.0
        F[i, i] = 1.0
    tangent_at(integers[TANGENT])(t, reals[0], integers[SUBSTEPS], mean, u, theta, d, physical, L, used[:count], step, F)


@inlined
def room_of(integers, reals, W):
    """Room for theta and p, in one and apart, d, and deviations of all of them (-1, W) with which of those count."""
    n_theta, own, n_D = integers[THETA], integers[OWN], integers[KNOWN]
    now, d, used = floats(reals.size - 1), floats(n_D), ints(integers[ENTRIES] + integers[DISTURBANCES])
    L = floats((own + n_D + now.size - n_theta if W else 0, W))
    put(reals[1:], now)
    L[:] = 0.0
    return now, now[:own], now[n_theta:], d, L, used

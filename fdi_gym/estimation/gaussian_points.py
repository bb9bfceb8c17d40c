"""The points at which the compiled Gaussian step tries a model, and the moments of a Gaussian that passes through them.

f and h are those of the augmented model; `gaussian_moments` says which points the rules take, and what they make of them.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.integration import LANES, lanes_at
from fdi_gym.kernels import floats, helper, map_at, put

EXTENDED, UNSCENTED, CENTRAL_DIFFERENCE = 0, 1, 2
# The integers of a model: three addresses (the last may be 0), sizes, then the lists (entries, disturbances, sensors)
OF_LANES, OUTPUT, TANGENT, ADDRESSES = range(4)
SUBSTEPS, STATES, OUTPUTS, THETA, KNOWN, ENTRIES, DISTURBANCES, SENSORS, OWN, COMMANDS, SIZES = range(ADDRESSES, 14)


@helper
def put_magnitudes(integers, offset, direction, X, nominal, now):
    """Into theta and the physical parameters, what the magnitudes in X make of the entries on the line."""
    n_x = integers[STATES]
    for e in range(integers[ENTRIES]):
        i, deviation = integers[SIZES + e], offset[e]
        for j in range(direction.shape[1]):
            deviation += direction[e, j] * X[n_x + j]
        now[i] = nominal[i] + deviation


@helper
def change_magnitude(integers, direction, j, by, middle, now):
    """The entries that magnitude j moves, from their values in the middle, where it is larger by so much."""
    for e in range(integers[ENTRIES]):
        if direction[e, j] != 0.0:
            i = integers[SIZES + e]
            now[i] = middle[i] + direction[e, j] * by


@helper
def other_magnitudes(integers, direction, points, i):
    """Whether point i has other magnitudes than the one before, or there is none before."""
    n_x, other = integers[STATES], i == 0
    for j in range(n_x, n_x + direction.shape[1]):
        other = other or points[i, j] != points[i - 1, j]
    return other


@helper
def pass_points(moving, integers, reals, offset, direction, t, points, u, known, values):
    """f (moving) or h of points (M, N) of an episode on the line (offset (p,), direction (p, n_m)).

    That is the state one sample later, or what the chosen sensors read.
    """
    if not moving:
        read_points(integers, reals, offset, direction, t, points, u, known, values)
    else:
        move_points(integers, reals, offset, direction, t, points, u, known, values)


@helper
def read_points(integers, reals, offset, direction, t, points, u, known, values):
    """What the chosen sensors read at the points."""
    output = map_at(integers[OUTPUT])
    n_x, n_y, n_theta, p = integers[STATES], integers[OUTPUTS], integers[THETA], integers[ENTRIES]
    n_d, m, own, n_m = integers[DISTURBANCES], integers[SENSORS], integers[OWN], direction.shape[1]
    disturbances, sensors = integers[SIZES + p : SIZES + p + n_d], integers[SIZES + p + n_d :]
    nominal = reals[1:]
    now, d, x, y = floats(nominal.size), floats(known.size), floats(n_x), floats(n_y)
    put(nominal, now)
    put(known, d)
    theta, theta_p, physical = now[:n_theta], now[:own], now[n_theta:]  # beyond the plant's own are faults of the sensors
    for i in range(points.shape[0]):
        if other_magnitudes(integers, direction, points, i):
            put_magnitudes(integers, offset, direction, points[i], nominal, now)
        for j in range(n_d):
            d[disturbances[j]] = points[i, n_x + n_m + j]
        for j in range(n_x):
            x[j] = points[i, j]
        output(t, x, u, theta_p, d, physical, y)
        if own < n_theta:  # gains, then biases
            for j in range(n_y):
                y[j] += y[j] * theta[own + j] + theta[own + n_y + j]
        for j in range(m):
            values[i, j] = y[sensors[j]]


@helper
def move_points(integers, reals, offset, direction, t, points, u, known, values):
    """The states one sample after the points, so many at a time."""
    lanes = lanes_at(integers[OF_LANES])
    n_x, n_theta, p, n_d = integers[STATES], integers[THETA], integers[ENTRIES], integers[DISTURBANCES]
    n_m, M, nominal = direction.shape[1], points.shape[0], reals[1:]
    disturbances, now = integers[SIZES + p : SIZES + p + n_d], floats(nominal.size)
    T, X, U, D = floats(LANES), floats((LANES, n_x)), floats((LANES, u.size)), floats((LANES, known.size))
    acts, P = floats((LANES, n_theta)), floats((LANES, now.size - n_theta))
    put(nominal, now)
    T[:] = t
    for lane in range(LANES):
        put(u, U[lane])
        put(known, D[lane])
    for first in range(0, M, LANES):
        for lane in range(LANES):
            i = min(first + lane, M - 1)
            if other_magnitudes(integers, direction, points, i):
                put_magnitudes(integers, offset, direction, points[i], nominal, now)
            for j in range(n_d):
                D[lane, disturbances[j]] = points[i, n_x + n_m + j]
            for j in range(n_x):
                X[lane, j] = points[i, j]
            for j in range(n_theta):
                acts[lane, j] = now[j]
            for j in range(n_theta, now.size):
                P[lane, j - n_theta] = now[j]
        lanes(T, reals[0], integers[SUBSTEPS], X, U, acts, D, P, X)
        for lane in range(min(LANES, M - first)):
            for j in range(n_x):
                values[first + lane, j] = X[lane, j]


@helper
def squared_step(rule, N):
    """h^2 of the rules with points along the columns of a factor of P."""
    return N + 2.0 if rule == UNSCENTED else 3.0


@helper
def spread(X, U, h, points):
    """The points (2 N + 1, N): X, and X plus and minus h times each row of the upper triangle U."""
    N = X.size
    for i in range(N):
        points[0, i] = X[i]
    for j in range(N):
        for i in range(N):
            offset = h * U[j, i] if i >= j else 0.0
            points[1 + j, i] = X[i] + offset
            points[1 + N + j, i] = X[i] - offset


@helper
def moments_of_points(rule, U, low, values, first, mean, cross, cov):
    """Mean (m,), cov (m, m) and cross (m, N) from `low` on of the values (2 N + 1, m) at points that a factor has spread.

    Into values[1 : N + 1] go the second differences, into first (N, m) the halved first ones.
    """
    (N, m), h2 = first.shape, squared_step(rule, first.shape[0])
    half, weight = 0.5 / np.sqrt(h2), 1.0 / (4.0 * h2) if rule == UNSCENTED else (h2 - 1.0) / (4.0 * h2 * h2)
    for a in range(m):
        mean[a] = 0.0
        for i in range(N):
            cross[a, i] = 0.0
        for b in range(m):
            cov[a, b] = 0.0
    second = values[1 : N + 1]
    for j in range(N):
        for a in range(m):
            first[j, a] = (values[1 + j, a] - values[1 + N + j, a]) * half
            second[j, a] = values[1 + j, a] + values[1 + N + j, a] - 2.0 * values[0, a]
            mean[a] += second[j, a]
    for a in range(m):
        mean[a] /= 2.0 * h2
        for j in range(N):
            for i in range(max(j, low), N):
                cross[a, i] += first[j, a] * U[j, i]
            weighed = weight * second[j, a]
            for b in range(a + 1):
                cov[a, b] += first[j, a] * first[j, b] + weighed * second[j, b]
        if rule == UNSCENTED:
            for b in range(a + 1):
                cov[a, b] -= mean[a] * mean[b]
    for a in range(m):
        mean[a] += values[0, a]
        for b in range(a):
            cov[b, a] = cov[a, b]


@helper
def enters(moving, integers, direction, j):
    """Whether f (moving) or h depends on entry j of X at all: a magnitude may move the sensors alone, or nothing."""
    n_x, n_theta, p, own = integers[STATES], integers[THETA], integers[ENTRIES], integers[OWN]
    if j < n_x or j >= n_x + direction.shape[1]:
        return True
    for e in range(p):
        sensors = own <= integers[SIZES + e] < n_theta
        if direction[e, j - n_x] != 0.0 and not (moving and sensors):
            return True
    return False

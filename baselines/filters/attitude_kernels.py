"""The satellite's unscented prediction, compiled: a quaternion without its scalar part goes through the plant and back."""

import numpy as np
from numba import float64, int64, void

from fdi_gym.estimation.gaussian_algebra import board_matrices, factor, take_matrix
from fdi_gym.estimation.gaussian_points import UNSCENTED, moments_of_points, spread, squared_step
from fdi_gym.integration import LANES, lanes_at
from fdi_gym.kernels import M, V, compiled, floats, helper

M3 = float64[:, :, ::1]


@helper
def put_back(xi, sign, x):
    """x = (q1..q4, rest) of xi = (q1..q3, rest) and the sign of q4."""
    x[3] = sign * np.sqrt(max(0.0, 1.0 - xi[0] ** 2 - xi[1] ** 2 - xi[2] ** 2))
    for i in range(x.size - 1):
        x[i if i < 3 else i + 1] = xi[i]


@compiled(void(int64, float64, int64, V, M, M3, V, M, M, M, M3, V))
def predict(lanes_address, dt, substeps, physical, X, P, sign, u, Q, X1, P1, sign1):
    """X1, P1 and the signs one sample after X = (q1..q3, rest, theta) (n, N), P (n, N, N) and sign (n,) under u (n, n_u).

    Q (N, N) is what a sample adds; theta stays.
    """
    lanes = lanes_at(lanes_address)
    (n, N), n_theta = X.shape, u.shape[1]
    n_x, count = N - n_theta + 1, 2 * N + 1
    T, x, us, theta = floats(LANES), floats((LANES, n_x)), floats((LANES, n_theta)), floats((LANES, n_theta))
    d, p = floats((LANES, 0)), floats((LANES, physical.size))
    Ps, Us = floats((N * N, LANES)), floats((N * N, LANES))
    U, points, values, first = floats((N, N)), floats((count, N)), floats((count, N)), floats((N, N))
    mean, cross, cov = floats(N), floats((N, N)), floats((N, N))
    T[:] = 0.0
    for lane in range(LANES):
        for j in range(physical.size):
            p[lane, j] = physical[j]
    for e in range(n):
        if e % LANES == 0:
            board_matrices(P, e, Ps)
            factor(Ps, N, Us)
        take_matrix(Us, e % LANES, U)
        spread(X[e], U, np.sqrt(squared_step(UNSCENTED, N)), points)
        for lane in range(LANES):
            for j in range(n_theta):
                us[lane, j] = u[e, j]
        for start in range(0, count, LANES):
            for lane in range(LANES):
                i = min(start + lane, count - 1)
                put_back(points[i, : n_x - 1], sign[e], x[lane])
                for j in range(n_theta):
                    theta[lane, j] = points[i, n_x - 1 + j]
            lanes(T, dt, substeps, x, us, theta, d, p, x)
            for lane in range(min(LANES, count - start)):
                for j in range(n_x - 1):
                    values[start + lane, j] = x[lane, j if j < 3 else j + 1]
                for j in range(n_x - 1, N):
                    values[start + lane, j] = points[start + lane, j]
            if start == 0:
                sign1[e] = -1.0 if x[0, 3] < 0.0 else 1.0
        moments_of_points(UNSCENTED, U, N, values, first, mean, cross, cov)
        for i in range(N):
            X1[e, i] = mean[i]
            for j in range(N):
                P1[e, i, j] = cov[i, j] + Q[i, j]

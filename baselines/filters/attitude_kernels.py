"""The satellite's unscented prediction, compiled: a quaternion without its scalar part goes through the plant and back."""

import numpy as np
from numba import float64, int64, void

from fdi_gym.estimation.gaussian_points import UNSCENTED, factor, moments_of_points, spread, squared_step
from fdi_gym.integration import interval_at
from fdi_gym.kernels import M, V, compiled, helper

M3 = float64[:, :, ::1]


@helper
def put_back(xi, sign, x):
    """x = (q1..q4, rest) of xi = (q1..q3, rest) and the sign of q4."""
    x[3] = sign * np.sqrt(max(0.0, 1.0 - xi[0] ** 2 - xi[1] ** 2 - xi[2] ** 2))
    for i in range(x.size - 1):
        x[i if i < 3 else i + 1] = xi[i]


@compiled(void(int64, float64, int64, V, M, M3, V, M, M, M, M3, V))
def predict(interval_address, dt, substeps, physical, X, P, sign, u, Q, X1, P1, sign1):
    """X1, P1 and the signs one sample after X = (q1..q3, rest, theta) (n, N), P (n, N, N) and sign (n,) under u (n, n_u).

    Q (N, N) is what a sample adds; theta stays.
    """
    interval = interval_at(interval_address)
    (n, N), n_theta = X.shape, u.shape[1]
    n_x = N - n_theta + 1
    x, course, theta_now, d = np.empty(n_x), np.zeros((3, n_theta)), np.empty(n_theta), np.zeros(0)
    U, points, values, first = np.empty((N, N)), np.empty((2 * N + 1, N)), np.empty((2 * N + 1, N)), np.empty((N, N))
    mean, cross, cov = np.empty(N), np.empty((N, N)), np.empty((N, N))
    for e in range(n):
        factor(P[e], U)
        spread(X[e], U, np.sqrt(squared_step(UNSCENTED, N)), points)
        for i in range(2 * N + 1):
            put_back(points[i, : n_x - 1], sign[e], x)
            for j in range(n_theta):
                course[0, j] = values[i, n_x - 1 + j] = points[i, n_x - 1 + j]
            interval(0.0, dt, substeps, False, x, u[e], course, d, physical, theta_now)
            if i == 0:
                sign1[e] = -1.0 if x[3] < 0.0 else 1.0
            for j in range(n_x - 1):
                values[i, j] = x[j if j < 3 else j + 1]
        moments_of_points(UNSCENTED, U, N, values, first, mean, cross, cov)
        for i in range(N):
            X1[e, i] = mean[i]
            for j in range(N):
                P1[e, i, j] = cov[i, j] + Q[i, j]

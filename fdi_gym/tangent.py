"""How small deviations grow over one sample interval: the exact Jacobian of what `integration` computes, in one pass.

A plant whose kernels say the partial derivatives of its dynamics (`jacobian`) is differentiated along the Runge-Kutta steps
themselves: dV/dt = J_x V + J_in L, where the columns of V are deviations of the state, and of L those of [theta; d; p] that
go with them and are held. Differences of whole intervals take two for each column; this is one, with N columns beside it.
"""

from __future__ import annotations

from typing import Any

from numba import float64, int64, void

from fdi_gym.kernels import M, V, around, function_at, helper

FINE = 1e-2  # of a step of the differences along the axes: that along which the projection is tried
I1, M3 = int64[::1], float64[:, :, ::1]
_TANGENT = void(float64, float64, int64, V, V, V, V, V, M, I1, V, M, V, M3, M)
tangent_at = function_at(_TANGENT)


@helper
def _slope(J_x, J_theta, J_d, J_p, Z, L, used, K):
    """K = J_x Z + [J_theta J_d J_p] L, of whose rows only the used ones are not 0."""
    n, N = Z.shape
    n_theta, n_d = J_theta.shape[1], J_d.shape[1]
    K[:] = 0.0
    for a in range(n):
        for b in range(n):
            gain = J_x[a, b]
            if gain != 0.0:
                for j in range(N):
                    K[a, j] += gain * Z[b, j]
    for i in used:
        if i < n_theta:
            gains = J_theta[:, i]
        elif i < n_theta + n_d:
            gains = J_d[:, i - n_theta]
        else:
            gains = J_p[:, i - n_theta - n_d]
        for a in range(n):
            if gains[a] != 0.0:
                for j in range(n, N):  # none is a deviation of the state
                    K[a, j] += gains[a] * L[i, j]


@helper
def _add(factor, K, total):
    """total += factor K, all in one loop."""
    into, other = total.reshape(total.size), K.reshape(K.size)
    for i in range(into.size):
        into[i] += factor * other[i]


def _around(dynamics: Any, jacobian: Any, *manifold: Any) -> Any:
    curved, project = bool(manifold), manifold[0] if manifold else dynamics  # never called then

    def tangent(t, dt, substeps, x, u, theta, d, p, L, used, step, V, J, work, k):
        (n, N), h, stages = V.shape, dt / max(substeps, 1), 4 if substeps else 1
        z, K, Z, total = k[4], work[0], work[1], work[2]
        by_theta, by_d = n * n, n * (n + theta.size)
        by_p = by_d + n * d.size
        J_x, J_theta = J[:by_theta].reshape(n, n), J[by_theta:by_d].reshape(n, theta.size)
        J_d, J_p = J[by_d:by_p].reshape(n, d.size), J[by_p:].reshape(n, p.size)
        for s in range(max(substeps, 1)):
            z[:] = x
            Z[:], total[:] = V, 0.0
            for stage in range(stages):  # Runge-Kutta's
                ahead = h * (0.0 if stage == 0 else (1.0 if stage == 3 else 0.5))
                if stage:
                    Z[:] = V
                    _add(ahead, K, Z)
                    for i in range(n):
                        z[i] = x[i] + ahead * k[stage - 1, i]
                J[:] = 0.0
                dynamics(t + s * h + ahead, z, u, theta, d, p, k[stage])
                jacobian(t + s * h + ahead, z, u, theta, d, p, J_x, J_theta, J_d, J_p)
                _slope(J_x, J_theta, J_d, J_p, Z, L, used, K)
                _add(2.0 if 0 < stage < 3 else 1.0, K, total)
            if substeps:
                _add(h / 6.0, total, V)
                for i in range(n):
                    x[i] += h / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])
            else:
                V[:], x[:] = total, k[0]
        if curved:
            for j in range(N):  # the projection, by differences along each column
                small = FINE * step[j]
                for i in range(n):
                    z[i], k[0, i] = x[i] + small * V[i, j], x[i] - small * V[i, j]
                project(z, theta)
                project(k[0], theta)
                for i in range(n):
                    V[i, j] = (z[i] - k[0, i]) / (2.0 * small)
            project(x, theta)

    return tangent


def tangent(dynamics: Any, jacobian: Any, project: Any = None) -> Any:
    """The kernel that moves a state and small deviations over an interval, compiled around a plant's own; see `tangent_at`.

    Its arguments: t, dt, substeps, x, u, theta, d, p as of `integration.interval`, theta held; L (n_theta + n_d + n_p, N),
    which of its rows are not 0, the steps (N,) of differences along the columns, and V (n_x, N).
    It moves x and V on to t + dt. The rest is for it to use: J (n_x (n_x + n_theta + n_d + n_p),), work (3, n_x, N) and
    k (5, n_x).
    """
    return around(_around, _TANGENT, dynamics, jacobian, *(() if project is None else (project,)))

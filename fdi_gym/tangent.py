"""How small deviations grow over one sample interval: the exact Jacobian of what `integration` computes, in one pass.

A plant whose kernels say the partial derivatives of its dynamics (`jacobian`) is differentiated along the Runge-Kutta steps
themselves: dV/dt = J_x V + J_in L, where the columns of V are deviations of the state, and of L those of [theta; d; p] that
go with them and are held. Differences of whole intervals take two for each column; this is one, with N columns beside it.

Rows of V and L are as long as `row` says, whole vectors (`fdi_gym.vectors`); what is beyond N is for nobody.
"""

from __future__ import annotations

from typing import Any

from numba import float64, int64, void

from fdi_gym.integration import LANES
from fdi_gym.kernels import M, V, around, function_at, helper, stack
from fdi_gym.vectors import vectors

WIDEST = 2 * LANES  # numbers that are moved at a time: two vectors of the widest processors
FINE = 1e-2  # of a step of the differences along the axes: that along which the projection is tried
I1 = int64[::1]
_TANGENT = void(float64, float64, int64, V, V, V, V, V, M, I1, V, M)
tangent_at = function_at(_TANGENT)


@helper
def row(columns):
    """What rows of so many columns are, in numbers that are moved at a time."""
    return LANES if columns <= LANES else (columns + WIDEST - 1) // WIDEST * WIDEST


def _around(sizes: tuple[int, ...], dynamics: Any, jacobian: Any, *manifold: Any) -> Any:
    n, n_theta, n_d, n_p, W = sizes
    curved, project = bool(manifold), manifold[0] if manifold else dynamics  # never called then
    of_state, table = stack(n), stack(n, W)  # known sizes: LLVM unrolls the loops
    by_x, by_theta, by_d, by_p = stack(n, n), stack(n, n_theta), stack(n, n_d), stack(n, n_p)
    count = min(W, WIDEST)
    zeros, load, store = vectors(count)

    def tangent(t, dt, substeps, x, u, theta, d, p, L, used, step, V):
        h, stages = dt / max(substeps, 1), 4 if substeps else 1
        now, z, k, first, middle = of_state(), of_state(), of_state(), of_state(), of_state()
        K, Z, total = table(), table(), table()
        J_x, J_theta, J_d, J_p = by_x(), by_theta(), by_d(), by_p()
        for a in range(n):
            now[a] = x[a]
        for s in range(max(substeps, 1)):
            for a in range(n):
                z[a], middle[a] = now[a], 0.0
                for c in range(0, W, count):
                    store(Z, a, c, load(V, a, c))
                    store(total, a, c, zeros())
            for stage in range(stages):  # Runge-Kutta's
                ahead = h * (0.0 if stage == 0 else (1.0 if stage == 3 else 0.5))
                if stage:
                    for a in range(n):
                        z[a] = now[a] + ahead * k[a]
                        for c in range(0, W, count):
                            store(Z, a, c, load(V, a, c) + load(K, a, c) * ahead)
                J_x[:], J_theta[:], J_d[:], J_p[:] = 0.0, 0.0, 0.0, 0.0
                dynamics(t + s * h + ahead, z, u, theta, d, p, k)
                jacobian(t + s * h + ahead, z, u, theta, d, p, J_x, J_theta, J_d, J_p)
                for a in range(n):
                    if stage == 0:
                        first[a] = k[a]
                    elif stage < 3:
                        middle[a] += k[a]
                    for c in range(0, W, count):
                        rate = zeros()
                        for b in range(n):
                            if J_x[a, b] != 0.0:
                                rate += load(Z, b, c) * J_x[a, b]
                        store(K, a, c, rate)
                for i in used:
                    for a in range(n):
                        if i < n_theta:
                            gain = J_theta[a, i]
                        elif i < n_theta + n_d:
                            gain = J_d[a, i - n_theta]
                        else:
                            gain = J_p[a, i - n_theta - n_d]
                        if gain != 0.0:
                            for c in range(0, W, count):
                                store(K, a, c, load(K, a, c) + load(L, i, c) * gain)
                weight = 2.0 if 0 < stage < 3 else 1.0
                for a in range(n):
                    for c in range(0, W, count):
                        store(total, a, c, load(total, a, c) + load(K, a, c) * weight)
            for a in range(n):
                now[a] = now[a] + h / 6.0 * (first[a] + 2.0 * middle[a] + k[a]) if substeps else k[a]
                for c in range(0, W, count):
                    store(V, a, c, load(V, a, c) + load(total, a, c) * (h / 6.0) if substeps else load(total, a, c))
        if curved:
            for j in range(step.size):  # the projection, by differences along each column
                small = FINE * step[j]
                for a in range(n):
                    z[a], k[a] = now[a] + small * V[a, j], now[a] - small * V[a, j]
                project(z, theta)
                project(k, theta)
                for a in range(n):
                    V[a, j] = (z[a] - k[a]) / (2.0 * small)
            project(now, theta)
        for a in range(n):
            x[a] = now[a]

    return tangent


def tangent(sizes: tuple[int, ...], dynamics: Any, jacobian: Any, project: Any = None) -> Any:
    """The kernel that moves a state and small deviations over an interval, compiled around a plant's own; see `tangent_at`.

    It is for so many entries of x, theta, d and p and columns N. Its arguments: t, dt, substeps, x, u, theta, d, p as of
    `integration.interval`, theta held; L (n_theta + n_d + n_p, row(N)), which of its rows are not 0, the steps (N,) of
    differences along the columns, and V (n_x, row(N)). It moves x and V on to t + dt.
    """
    sizes = *sizes[:-1], row.py_func(sizes[-1])
    return around(_around, _TANGENT, dynamics, jacobian, *(() if project is None else (project,)), sizes=sizes)

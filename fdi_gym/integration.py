"""One sample interval of any plant, the model's prediction and output for many points at once, and lags of first order."""

from typing import Any

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.kernels import M, V, around, compiled, floats, function_at, inside, map_at, put, stack


@inside
def _theta_at(tau, a, b, g, theta):
    for j in range(theta.size):
        if b[j] == 0.0:
            theta[j] = a[j]
        else:
            theta[j] = a[j] + b[j] * (tau if g[j] < 0.0 else np.exp(-g[j] * tau))


def _around(sizes: tuple[int, ...], dynamics: Any, project: Any) -> Any:
    n, n_theta = sizes
    of_state, of_theta = stack(n), stack(n_theta)  # known sizes: LLVM unrolls the loops and keeps all in registers

    def interval(t, dt, substeps, drifts, x, u, course, d, p, theta):
        a, b, g = course[0], course[1], course[2]
        k1, k2, k3, k4, z, now, acts = of_state(), of_state(), of_state(), of_state(), of_state(), of_state(), of_theta()
        for i in range(n):
            now[i] = x[i]
        _theta_at(0.0, a, b, g, acts)
        if substeps == 0:
            dynamics(t, now, u, acts, d, p, k1)
            for i in range(n):
                now[i] = k1[i]
        else:
            h = dt / substeps
            for s in range(substeps):
                tau = s * h
                dynamics(t + tau, now, u, acts, d, p, k1)
                for i in range(n):
                    z[i] = now[i] + 0.5 * h * k1[i]
                if drifts:
                    _theta_at(tau + 0.5 * h, a, b, g, acts)
                dynamics(t + tau + 0.5 * h, z, u, acts, d, p, k2)
                for i in range(n):
                    z[i] = now[i] + 0.5 * h * k2[i]
                dynamics(t + tau + 0.5 * h, z, u, acts, d, p, k3)
                for i in range(n):
                    z[i] = now[i] + h * k3[i]
                if drifts:
                    _theta_at(tau + h, a, b, g, acts)
                dynamics(t + tau + h, z, u, acts, d, p, k4)
                for i in range(n):
                    now[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
        if drifts:
            _theta_at(dt, a, b, g, acts)
        project(now, acts)
        for i in range(n):
            x[i] = now[i]
        for j in range(n_theta):
            theta[j] = acts[j]

    return interval


_INTERVAL = void(float64, float64, int64, boolean, V, V, M, V, V, V)
interval_at = function_at(_INTERVAL)


def interval(states: int, entries: int, dynamics: Any, project: Any) -> Any:
    """The kernel of one sample interval of a plant, compiled around its own; call it by address, with `interval_at`.

    It is for so many states and entries of theta. Its arguments: t, dt, substeps, drifts, x, u, course, d, p, theta. It
    moves x on to t + dt with theta(t + tau) = a + b exp(-g tau), or a + b tau where g < 0, of the course (a, b, g), and
    gives theta as it is then; u and d are held. Classical Runge-Kutta with `substeps` steps; for 0 the plant is discrete
    and maps x itself. `drifts` says whether any b is not 0.
    """
    return around(_around, _INTERVAL, dynamics, project, sizes=(states, entries))


LANES = 8  # points that are moved side by side: what a vector of the widest processors holds
FEW = 3  # points from which that is worth it


def _lanes_around(sizes: tuple[int, ...], dynamics: Any, project: Any) -> Any:
    continuous, (n, n_u, n_theta, n_d, n_p) = sizes[0], sizes[1:]
    of_state, of_command, of_theta, of_disturbance, of_p = (stack(size) for size in sizes[1:])
    states, commands, thetas, disturbances, ps, times = (stack(size * LANES) for size in (*sizes[1:], 1))

    def lanes(t, dt, substeps, x, u, theta, d, p, out):
        # all on the stack: LLVM then sees that no store of one lane is a load of another, and makes vectors of the loops
        k1, k2, k3, k4, z, now = of_state(), of_state(), of_state(), of_state(), of_state(), of_state()
        u_j, theta_j, d_j, p_j = of_command(), of_theta(), of_disturbance(), of_p()
        X, U, THETA, D, P, T = states(), commands(), thetas(), disturbances(), ps(), times()  # entry by entry
        for j in range(LANES):
            T[j] = t[j]
            for i in range(n):
                X[i * LANES + j] = x[j, i]
            for i in range(n_u):
                U[i * LANES + j] = u[j, i]
            for i in range(n_theta):
                THETA[i * LANES + j] = theta[j, i]
            for i in range(n_d):
                D[i * LANES + j] = d[j, i]
            for i in range(n_p):
                P[i * LANES + j] = p[j, i]
        h = dt / max(substeps, 1)
        for s in range(max(substeps, 1)):
            tau = s * h
            for j in range(LANES):
                for i in range(n):
                    now[i] = X[i * LANES + j]
                for i in range(n_u):
                    u_j[i] = U[i * LANES + j]
                for i in range(n_theta):
                    theta_j[i] = THETA[i * LANES + j]
                for i in range(n_d):
                    d_j[i] = D[i * LANES + j]
                for i in range(n_p):
                    p_j[i] = P[i * LANES + j]
                dynamics(T[j] + tau, now, u_j, theta_j, d_j, p_j, k1)
                if not continuous:
                    for i in range(n):
                        X[i * LANES + j] = k1[i]
                    continue
                for i in range(n):
                    z[i] = now[i] + 0.5 * h * k1[i]
                dynamics(T[j] + tau + 0.5 * h, z, u_j, theta_j, d_j, p_j, k2)
                for i in range(n):
                    z[i] = now[i] + 0.5 * h * k2[i]
                dynamics(T[j] + tau + 0.5 * h, z, u_j, theta_j, d_j, p_j, k3)
                for i in range(n):
                    z[i] = now[i] + h * k3[i]
                dynamics(T[j] + tau + h, z, u_j, theta_j, d_j, p_j, k4)
                for i in range(n):
                    X[i * LANES + j] = now[i] + h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
        for j in range(LANES):
            for i in range(n):
                now[i] = X[i * LANES + j]
            for i in range(n_theta):
                theta_j[i] = THETA[i * LANES + j]
            project(now, theta_j)
            for i in range(n):
                out[j, i] = now[i]

    return lanes


_LANES = void(V, float64, int64, M, M, M, M, M, M)
lanes_at = function_at(_LANES)


def lanes(continuous: bool, sizes: tuple[int, ...], dynamics: Any, project: Any) -> Any:
    """The kernel that moves LANES points over an interval side by side, to the bits of `interval`; see `lanes_at`.

    It is for so many entries of x, u, theta, d and p. Its arguments: t (LANES,), dt, substeps, then x, u, theta, d and p,
    a row for each point (of more columns the first count), and `out`, where the states one sample later go. theta is held.
    """
    return around(_lanes_around, _LANES, dynamics, project, sizes=(int(continuous), *sizes))


@compiled(void(int64, int64, float64, int64, V, M, M, M, M, M, M))
def propagate(interval_address, lanes_address, dt, substeps, t, x, u, theta, d, p, out):
    """out[i] = the state one sample after x[i]; t, u, theta, d, p have m rows that serve M/m consecutive points each."""
    interval, lanes = interval_at(interval_address), lanes_at(lanes_address)
    points, n = x.shape
    T, X, U, THETA = floats(LANES), floats((LANES, n)), floats((LANES, u.shape[1])), floats((LANES, theta.shape[1]))
    D, P = floats((LANES, d.shape[1])), floats((LANES, p.shape[1]))
    course, theta_now = floats((3, theta.shape[1])), floats(theta.shape[1])
    every_t, every_u, every_theta = points // t.size, points // u.shape[0], points // theta.shape[0]
    every_d, every_p = points // d.shape[0], points // p.shape[0]
    course[1:] = 0.0
    for first in range(0, points, LANES):
        count = min(LANES, points - first)
        for lane in range(LANES):
            i = min(first + lane, points - 1)
            T[lane] = t[i // every_t]
            put(x[i], X[lane])
            put(u[i // every_u], U[lane])
            put(theta[i // every_theta], THETA[lane])
            put(d[i // every_d], D[lane])
            put(p[i // every_p], P[lane])
        if count >= FEW:
            lanes(T, dt, substeps, X, U, THETA, D, P, X)
        else:
            for lane in range(count):
                put(THETA[lane], course[0])
                interval(T[lane], dt, substeps, False, X[lane], U[lane], course, D[lane], P[lane], theta_now)
        for lane in range(count):
            put(X[lane], out[first + lane])


@compiled(void(int64, V, M, M, M, M, M, M))
def evaluate(function_address, t, x, u, theta, d, p, out):
    """out[i] = function(t, x[i], ...): the sensors' values or the state's rate of change, rows served as in `propagate`."""
    function = map_at(function_address)
    points = x.shape[0]
    xi, ui, ti = floats(x.shape[1]), floats(u.shape[1]), floats(theta.shape[1])
    di, pi, oi = floats(d.shape[1]), floats(p.shape[1]), floats(out.shape[1])
    every_t, every_u, every_theta = points // t.size, points // u.shape[0], points // theta.shape[0]
    every_d, every_p = points // d.shape[0], points // p.shape[0]
    for i in range(points):
        for j in range(xi.size):
            xi[j] = x[i, j]
        for j in range(ui.size):
            ui[j] = u[i // every_u, j]
        for j in range(ti.size):
            ti[j] = theta[i // every_theta, j]
        for j in range(di.size):
            di[j] = d[i // every_d, j]
        for j in range(pi.size):
            pi[j] = p[i // every_p, j]
        function(t[i // every_t], xi, ui, ti, di, pi, oi)
        for j in range(oi.size):
            out[i, j] = oi[j]


@compiled(void(float64, V))
def _first_order(a, course):
    for k in range(1, course.size):
        course[k] += a * course[k - 1]


def first_order(a: float, inputs: np.ndarray) -> np.ndarray:
    """The course s (K,) of a discrete first-order lag: s_0 = e_0, s_k = a s_{k-1} + e_k, of its inputs e (K,)."""
    course = np.array(inputs, float)
    _first_order(a, course)
    return course

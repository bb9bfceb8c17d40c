"""Compiled generic kernels: what every plant shares, written once for any plant's equations.

A plant file writes its equations as plain functions and marks them with `kernel`. The parameter names say which
role a function has, and the role fixes its compiled signature:

    dynamics(t, x, u, theta, d, p, dx)   xdot, or for a discrete plant (`substeps=0`) the next state
    output(t, x, u, theta, d, p, y)      noise-free sensor values; u is the command held up to t
    control(t, y, r, q, c, u)            the command u from the measurement y; updates the controller state c
    known(t, r, c, out)                  what else the flight computer knows at t, before it computes the command
    project(x, theta)                    puts the state back on its manifold after a step (unit quaternion, jammed fin)
    outside(t, x, r)                     True where the flight ends: validity of the model or loss of control

with t the time [s], x the state, theta the fault parameter, d the disturbance, p the physical parameters, r the row
of exogenous references, q the controller's parameters. A function with any other parameters is a helper that the
file's kernels may call. A kernel must not call a kernel of another file, which is what keeps numba's disk cache valid:
the generic kernels below get the addresses of the plant's compiled functions (`address`) and call through them. So
they are compiled once for all plants, nothing is compiled to bring the two together, and a call costs a microsecond.

The cache lies in the user's cache folder (or `FDI_GYM_CACHE_DIR`) under a hash of the file that defines the kernel and
of the files of the package that it imports, so that no edit is ever answered by old code.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import platformdirs
from numba import boolean, float64, int64, types, void
from numba.core import cgutils, config
from numba.extending import intrinsic

V, M = float64[::1], float64[:, ::1]

_MAP = void(float64, V, V, V, V, V, V)
_CONTROL = void(float64, V, V, V, V, V)
_KNOWN = void(float64, V, V, V)
_PROJECT = void(V, V)
_OUTSIDE = boolean(float64, V, V)
_ROLES = {
    ("t", "x", "u", "theta", "d", "p", "dx"): _MAP,
    ("t", "x", "u", "theta", "d", "p", "y"): _MAP,
    ("t", "y", "r", "q", "c", "u"): _CONTROL,
    ("t", "r", "c", "out"): _KNOWN,
    ("x", "theta"): _PROJECT,
    ("t", "x", "r"): _OUTSIDE,
}


@functools.cache
def sources(path: Path) -> tuple[Path, ...]:
    """A source file and those of the package that it imports, directly or not: what its kernels can depend on."""
    found, todo = set(), [path.resolve()]
    root = Path(__file__).resolve().parent
    while todo:
        here = todo.pop()
        if here in found:
            continue
        found.add(here)
        for node in ast.walk(ast.parse(here.read_bytes())):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                package, *rest = name.split(".")
                if package == root.name and (file := root.joinpath(*rest).with_suffix(".py")).is_file():
                    todo.append(file)
    return tuple(sorted(found))


_signatures: dict[Any, Any] = {}  # of the kernels, compiled when they are first needed
_announced: set[str] = set()  # source files whose cold compilation has been announced


@functools.cache
def cache_folder(source: str) -> Path | None:
    """The cache folder that belongs to these sources; None where there can be none."""
    if not Path(source).is_file():
        return None
    digest = hashlib.sha256()
    for path in sources(Path(source)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    base = Path(os.environ.get("FDI_GYM_CACHE_DIR") or platformdirs.user_cache_path("fdi_gym"))
    folder = base / f"{Path(source).stem}-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def _lazily(function: Callable[..., Any], signature: Any) -> Any:
    """The function as numba's dispatcher, cached in the folder of its sources; nothing is compiled yet."""
    folder = cache_folder(function.__code__.co_filename)
    settings: Any = config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before if folder is None else str(folder)
    try:
        dispatcher = numba.njit(cache=folder is not None, error_model="numpy")(function)
    finally:
        settings.CACHE_DIR = before
    _signatures[dispatcher] = signature
    return dispatcher


def _load(dispatcher: Any) -> Any:
    """The dispatcher, compiled for its role's signature or loaded from the cache."""
    if not dispatcher.overloads:
        source = dispatcher.py_func.__code__.co_filename
        folder = cache_folder(source)
        if source not in _announced and not (folder and any(folder.rglob("*.nbi"))):
            print(f"fdi_gym: compiling {Path(source).stem} (once; kept in {folder})", file=sys.stderr, flush=True)
        _announced.add(source)
        dispatcher.compile(_signatures[dispatcher])
        dispatcher.disable_compile()  # other types are an error, not another compilation
    return dispatcher


def kernel(function: Callable[..., Any]) -> Any:
    """Make a plant's function a kernel of the role that its parameter names declare (see the module's docstring)."""
    role = _ROLES.get(tuple(inspect.signature(function).parameters))
    if role is None:
        return numba.njit(error_model="numpy")(function)
    return _lazily(function, role)


# ---------------------------------------------------------------------------------------------------------------
# Plant functions as numbers


def address(dispatcher: Any) -> int:
    """The address of a kernel, compiled if need be, by which the generic kernels call it. Valid as long as it lives."""
    (result,) = _load(dispatcher).overloads.values()
    return result.library.get_pointer_to_function(result.fndesc.llvm_func_name)


def _function_at(signature: Any) -> Any:
    """An intrinsic that makes numba's first-class function of this signature from an address."""
    function_type = types.FunctionType(signature)

    @intrinsic
    def function_at(typing_context, where):
        def codegen(context, builder, _, arguments):
            function = cgutils.create_struct_proxy(function_type)(context, builder)
            function.jit_addr = builder.inttoptr(arguments[0], cgutils.voidptr_t)
            function.c_addr = function.py_addr = cgutils.get_null_value(cgutils.voidptr_t)
            return function._getvalue()

        return function_type(int64), codegen

    return function_at


map_at, _control_at, _known_at = _function_at(_MAP), _function_at(_CONTROL), _function_at(_KNOWN)
_project_at, _outside_at = _function_at(_PROJECT), _function_at(_OUTSIDE)


# ---------------------------------------------------------------------------------------------------------------
# What a plant need not write


@kernel
def known(t, r, c, out):
    """Nothing else is known: the default of a plant without known signals."""


@kernel
def project(x, theta):
    """The state space is flat: the default of a plant without a manifold."""


@kernel
def outside(t, x, r):
    """The model holds everywhere: the default of a plant without a termination rule."""
    return False


# ---------------------------------------------------------------------------------------------------------------
# Generic kernels


def compiled(signature: Any) -> Callable[[Any], Any]:
    """Make a generic kernel of this file: compiled for this signature at its first call, cached."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = _lazily(function, signature)

        @functools.wraps(function)
        def call(*arguments: Any) -> Any:
            return _load(dispatcher)(*arguments)

        return call

    return decorate


@numba.njit
def _theta_at(tau, a, b, g, theta):
    for j in range(theta.size):
        theta[j] = a[j] if b[j] == 0.0 else a[j] + b[j] * np.exp(-g[j] * tau)


@numba.njit
def _advance(dynamics, project, t, dt, substeps, x, u, a, b, g, d, p, theta, k1, k2, k3, k4, z):
    """One sample interval: x(t) -> x(t + dt) in place, theta(t + tau) = a + b exp(-g tau), u and d held.

    Classical Runge-Kutta with `substeps` steps; for `substeps` = 0 the plant is discrete and maps x itself.
    """
    n = x.size
    if substeps == 0:
        _theta_at(0.0, a, b, g, theta)
        dynamics(t, x, u, theta, d, p, k1)
        for i in range(n):
            x[i] = k1[i]
    else:
        h = dt / substeps
        for s in range(substeps):
            tau = s * h
            _theta_at(tau, a, b, g, theta)
            dynamics(t + tau, x, u, theta, d, p, k1)
            for i in range(n):
                z[i] = x[i] + 0.5 * h * k1[i]
            _theta_at(tau + 0.5 * h, a, b, g, theta)
            dynamics(t + tau + 0.5 * h, z, u, theta, d, p, k2)
            for i in range(n):
                z[i] = x[i] + 0.5 * h * k2[i]
            dynamics(t + tau + 0.5 * h, z, u, theta, d, p, k3)
            for i in range(n):
                z[i] = x[i] + h * k3[i]
            _theta_at(tau + h, a, b, g, theta)
            dynamics(t + tau + h, z, u, theta, d, p, k4)
            for i in range(n):
                x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
    _theta_at(dt, a, b, g, theta)
    project(x, theta)


@compiled(void(int64, int64, float64, int64, V, M, M, M, M, M, M))
def propagate(dynamics_at, project_at, dt, substeps, t, x, u, theta, d, p, out):
    """out[i] = the state one sample after x[i]; t, u, theta, d, p have m rows that serve M/m consecutive points each."""
    dynamics, project = map_at(dynamics_at), _project_at(project_at)
    points, n = x.shape
    xi, ui, ti, di, pi = (
        np.empty(n),
        np.empty(u.shape[1]),
        np.empty(theta.shape[1]),
        np.empty(d.shape[1]),
        np.empty(p.shape[1]),
    )
    b, g, work = np.zeros(ti.size), np.zeros(ti.size), np.empty(ti.size)
    k1, k2, k3, k4, z = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    every_t, every_u, every_theta = points // t.size, points // u.shape[0], points // theta.shape[0]
    every_d, every_p = points // d.shape[0], points // p.shape[0]
    for i in range(points):
        for j in range(n):
            xi[j] = x[i, j]
        for j in range(ui.size):
            ui[j] = u[i // every_u, j]
        for j in range(ti.size):
            ti[j] = theta[i // every_theta, j]
        for j in range(di.size):
            di[j] = d[i // every_d, j]
        for j in range(pi.size):
            pi[j] = p[i // every_p, j]
        _advance(dynamics, project, t[i // every_t], dt, substeps, xi, ui, ti, b, g, di, pi, work, k1, k2, k3, k4, z)
        for j in range(n):
            out[i, j] = xi[j]


@compiled(void(int64, V, M, M, M, M, M, M))
def evaluate(function_at, t, x, u, theta, d, p, out):
    """out[i] = function(t, x[i], ...): the sensors' values or the state's rate of change, rows served as in `propagate`."""
    function = map_at(function_at)
    points = x.shape[0]
    xi, ui, ti = np.empty(x.shape[1]), np.empty(u.shape[1]), np.empty(theta.shape[1])
    di, pi, oi = np.empty(d.shape[1]), np.empty(p.shape[1]), np.empty(out.shape[1])
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


@compiled(void(float64[:, :, ::1], float64[:, :, ::1], float64[:, :, ::1]))
def solve(A, B, out):
    """out[i] = A[i]^-1 B[i]: Gaussian elimination with partial pivoting, for many small systems; not finite if singular.

    A LAPACK call per matrix costs about a microsecond before it begins, several times what a 4 x 4 system needs.
    """
    n, m, width = B.shape
    a = np.empty((m, m))
    for i in range(n):
        for r in range(m):
            for c in range(m):
                a[r, c] = A[i, r, c]
            for c in range(width):
                out[i, r, c] = B[i, r, c]
        for k in range(m):
            pivot = k
            for r in range(k + 1, m):
                if abs(a[r, k]) > abs(a[pivot, k]):
                    pivot = r
            if pivot != k:
                for c in range(k, m):
                    a[k, c], a[pivot, c] = a[pivot, c], a[k, c]
                for c in range(width):
                    out[i, k, c], out[i, pivot, c] = out[i, pivot, c], out[i, k, c]
            for r in range(k + 1, m):
                factor = a[r, k] / a[k, k]
                for c in range(k + 1, m):
                    a[r, c] -= factor * a[k, c]
                for c in range(width):
                    out[i, r, c] -= factor * out[i, k, c]
        for r in range(m - 1, -1, -1):
            for c in range(width):
                total = out[i, r, c]
                for k in range(r + 1, m):
                    total -= a[r, k] * out[i, k, c]
                out[i, r, c] = total / a[r, r]


@compiled(void(float64[:, :, :, ::1], float64[:, :, ::1], M, M, float64[:, :, ::1], M))
def box_minimum(G, g, low, high, m, value):
    """value[i, h] = min of m' G m - 2 g' m over low[h] <= m <= high[h], for positive definite G[i, h]; m is where.

    Exact: at the minimum some coordinates are free and the others at a bound. All such choices are tried.
    """
    n, sets, f = g.shape
    a, b, at, where = np.empty((f, f)), np.empty(f), np.zeros(f, np.int64), np.empty(f, np.int64)
    tried = np.empty(f)
    choices = 3**f
    for i in range(n):
        for h in range(sets):
            value[i, h] = np.inf
            for choice in range(choices):
                rest, free = choice, 0
                for j in range(f):
                    at[j], rest = rest % 3, rest // 3
                    if at[j] == 0:
                        where[free] = j
                        free += 1
                    else:
                        tried[j] = low[h, j] if at[j] == 1 else high[h, j]
                for r in range(free):
                    b[r] = g[i, h, where[r]]
                    for j in range(f):
                        if at[j] != 0:
                            b[r] -= G[i, h, where[r], j] * tried[j]
                    for c in range(free):
                        a[r, c] = G[i, h, where[r], where[c]]
                for k in range(free):  # positive definite: no pivoting
                    for r in range(k + 1, free):
                        factor = a[r, k] / a[k, k]
                        for c in range(k, free):
                            a[r, c] -= factor * a[k, c]
                        b[r] -= factor * b[k]
                inside = True
                for r in range(free - 1, -1, -1):
                    for c in range(r + 1, free):
                        b[r] -= a[r, c] * b[c]
                    b[r] /= a[r, r]
                    tried[where[r]] = b[r]
                    # what rounding puts a hair outside is inside; the rest is another choice's business
                    if b[r] < low[h, where[r]] - 1e-12 or b[r] > high[h, where[r]] + 1e-12:
                        inside = False
                if inside:
                    total = 0.0
                    for r in range(f):
                        total -= 2.0 * g[i, h, r] * tried[r]
                        for c in range(f):
                            total += tried[r] * G[i, h, r, c] * tried[c]
                    if total < value[i, h]:
                        value[i, h] = total
                        for j in range(f):
                            m[i, h, j] = tried[j]
                    if free == f:
                        break  # the minimum of all m lies inside


@compiled(
    int64(
        int64,
        int64,
        int64,
        int64,
        int64,
        int64,
        float64,
        int64,
        V,
        V,
        V,
        V,
        M,
        M,
        M,
        M,
        M,
        int64[:, ::1],
        M,
        M,
        M,
        V,
        V,
        int64,
        M,
        M,
        M,
    )
)
def simulate(
    dynamics_at,
    output_at,
    control_at,
    known_at,
    project_at,
    outside_at,
    dt,
    substeps,
    x0,
    u0,
    c0,
    q,
    r,
    d,
    a,
    b,
    g,
    holds,
    w,
    v,
    sensor_range,
    p,
    nominal,
    true_feedback,
    X,
    OBS,
    TH,
):
    """One closed-loop flight of K = len(w) samples. THE order of operations in a step is written here and nowhere else.

    At sample k: the sensors give y_k; what else is known gives n_k; the controller computes u_k, held until k + 1;
    entries of theta that a hold fault owns take their value; the plant advances to X[k+1] under TH[k+1], the fault
    parameter that acts over [k, k+1) (its value at the interval's end); process noise is added.
    The observation is OBS[k] = [y_k, u_{k-1}, n_k]. u_{-1} is the trim command and TH[0] the nominal parameter: no
    interval has ended before sample 0.

    `holds` has the rows (theta entry, first step, end step, command index, lag): from the first step on the entry holds
    the command of `lag` steps before. Returns the number of steps flown, negative where the flight ended early.
    """
    dynamics, output, control = map_at(dynamics_at), map_at(output_at), _control_at(control_at)
    known, project, outside = _known_at(known_at), _project_at(project_at), _outside_at(outside_at)
    steps, n = w.shape
    p_theta, n_y, n_u = TH.shape[1], v.shape[1], u0.size
    n_n = OBS.shape[1] - n_y - n_u
    x, u, c, out = x0.copy(), u0.copy(), c0.copy(), np.empty(n_n)
    y, fed = np.empty(n_y), np.empty(n_y)
    ak, bk, gk, theta = np.empty(p_theta), np.empty(p_theta), np.empty(p_theta), np.empty(p_theta)
    rk, dk, held = np.empty(r.shape[1]), np.empty(d.shape[1]), np.zeros(holds.shape[0])
    k1, k2, k3, k4, z, last = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for j in range(p_theta):
        TH[0, j] = nominal[j]
    for i in range(n_u):
        OBS[0, n_y + i] = u[i]
    for i in range(n):
        X[0, i] = x[i]
    ended = False
    for k in range(steps + 1):
        t = k * dt
        for j in range(rk.size):
            rk[j] = r[k, j]
        for j in range(dk.size):
            dk[j] = d[min(k, steps - 1), j]
        for j in range(p_theta):
            ak[j], bk[j], gk[j] = a[k, j], b[k, j], g[k, j]
        for h in range(holds.shape[0]):
            if holds[h, 1] < k < holds[h, 2]:
                ak[holds[h, 0]] = held[h]
        for j in range(p_theta):
            theta[j] = ak[j] + bk[j]
        output(t, x, u, theta, dk, p, y)
        for i in range(n_y):
            fed[i] = y[i]
            y[i] = min(max(y[i] + v[k, i], sensor_range[0, i]), sensor_range[1, i])
            OBS[k, i] = y[i]
            fed[i] = fed[i] if true_feedback else y[i]
        known(t, rk, c, out)
        for i in range(n_n):
            OBS[k, n_y + n_u + i] = out[i]
        if k == steps or ended:
            return -k if ended else k
        control(t, fed, rk, q, c, u)
        for i in range(n_u):
            OBS[k + 1, n_y + i] = u[i]
        for h in range(holds.shape[0]):
            if holds[h, 1] == k:
                held[h] = OBS[max(k + 1 - holds[h, 4], 0), n_y + holds[h, 3]]
                ak[holds[h, 0]] = held[h]
        for i in range(n):
            last[i] = x[i]
        _advance(dynamics, project, t, dt, substeps, x, u, ak, bk, gk, dk, p, theta, k1, k2, k3, k4, z)
        for j in range(p_theta):
            TH[k + 1, j] = theta[j]
        for i in range(n):
            x[i] += w[k, i]
            ended = ended or not np.isfinite(x[i])
        if ended:  # the state has left the numbers: the last finite one is what is shown
            for i in range(n):
                x[i] = last[i]
        for i in range(n):
            X[k + 1, i] = x[i]
        for j in range(rk.size):
            rk[j] = r[k + 1, j]
        ended = ended or outside(t + dt, x, rk)
    return steps

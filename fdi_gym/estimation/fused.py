"""The Gaussian step in one compiled call: predict, update and their parts, for a batch of episodes and any plant.

The model is the augmented one, X = [x; m; d]: the plant's state, magnitudes of its faults and disturbances that nothing
measures. theta is nominal but for theta[entries], to which offset + direction m is added: an ordinary filter has the one
line "offset 0, direction I", a bank one line for each of its models, and row i of a stack lies on line i % lines. f moves
x by one sample (theta, d and the command held) and leaves m and d; h gives the chosen sensors. A Gaussian passes through
f and h by one of three rules:

    "extended"            A. H. Jazwinski, Stochastic Processes and Filtering Theory, 1970; Jacobians by differences
    "unscented"           S. J. Julier, J. K. Uhlmann, Proceedings of the IEEE 92(3), 2004; lambda = 2, equal weights
    "central difference"  M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000; interval sqrt(3)

On a linear plant each is the Kalman filter. A sensor that did not report leaves no trace: the result is that of the
filter without its row, whatever stands in y there. An episode's numbers do not depend on its neighbours, to the bit.

Arrays are stacks with the episodes first. t (n,), u (n, n_u), d (n, n_D), y and seen (n, m) may have fewer rows, each of
which then serves equally many consecutive episodes; Q and R may have fewer, which serve the episodes in turn (line by
line). d is what is known of all the plant's disturbances, None where nothing is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation import fused_kernels as kernels
from fdi_gym.estimation.fused_moments import CENTRAL_DIFFERENCE, EXTENDED, UNSCENTED
from fdi_gym.plant import Array, Plant, contiguous

STEP = 1e-3  # of the central differences along the axes, in units of the entries' scales
RULES = {"extended": EXTENDED, "unscented": UNSCENTED, "central difference": CENTRAL_DIFFERENCE}


class Model(NamedTuple):
    """A plant's augmented model with its constants packed for the kernels; made by `bind`."""

    plant: Plant  # keeps its compiled equations alive
    m: int  # sensors
    constants: tuple[Array, Array, Array, Array, Array]  # what tells f and h, in the kernels' order
    step: Array  # (N,) of the differences along the axes
    limit: Array  # (N,)
    linear: Array  # (n_x, ...), or (0, 0) where the plant is not linear
    H: Array  # (m, N), or (0, N) where the sensors are not
    unmeasured: Array  # (1, n_D) zeros


class Updated(NamedTuple):
    """Outcome of an update. What was not seen has nu = 0 and the identity's row and column in S."""

    X: Array  # (n, N)
    P: Array  # (n, N, N)
    nu: Array  # (n, m) innovation
    S: Array  # (n, m, m) its covariance
    nis: Array  # (n,) nu' S^-1 nu, chi-square with as many degrees of freedom as sensors were seen
    log_likelihood: Array  # (n,) log density of what was seen, its 2 pi terms included; 0 where nothing was


class Corrected(NamedTuple):
    """Outcome of a correction: as `Updated`, with the gain."""

    X: Array  # (n, N)
    P: Array  # (n, N, N)
    nu: Array  # (n, m)
    S: Array  # (n, m, m)
    nis: Array  # (n,)
    log_likelihood: Array  # (n,)
    K: Array  # (n, N, m), 0 for what was not seen


def bind(
    plant: Plant,
    *,
    scale: Sequence[float] | Array,
    entries: Sequence[int] | Array,
    disturbances: Sequence[int] | Array = (),
    sensors: Sequence[int] | Array | None = None,
    limit: Sequence[float] | Array | None = None,
    lines: tuple[Array, Array] | None = None,
    H: Array | None = None,
) -> Model:
    """The model of [x; m; d] of a plant.

    Args:
        plant: The plant.
        scale: Typical size of each entry of X (N,); the differences along the axes take a thousandth of it.
        entries: Positions (p,) in theta that the faults move.
        disturbances: Positions (n_d,) in the plant's disturbances of those in X.
        sensors: Positions (m,) in the plant's outputs of those that the filter hears. Default: all.
        limit: Largest variance (N,) that a prediction leaves an entry; where it is passed the entry's row and column
            shrink, so that correlations stay. Default: none.
        lines: Offsets (lines, p) and directions (lines, p, n_m). Default: m is the deviation of theta[entries] itself.
        H: (m, N) where the sensors are H X whatever u, t and d are: they are then not evaluated. Default: they are.

    Raises:
        ValueError: A position does not exist, or an array has the wrong shape or values that are no numbers.
    """
    n_x, n_theta, n_D = len(plant.states), len(plant.theta), len(plant.disturbances)
    where = {
        "entries": _positions("entries", entries, n_theta),
        "disturbances": _positions("disturbances", disturbances, n_D),
        "sensors": _positions("sensors", range(len(plant.outputs)) if sensors is None else sensors, len(plant.outputs)),
    }
    p, n_d, m = (len(a) for a in where.values())
    offset, direction = (np.zeros((1, p)), np.eye(p)[None]) if lines is None else (np.array(a, float) for a in lines)
    if offset.ndim != 2 or direction.ndim != 3 or direction.shape[:2] != offset.shape or offset.shape[1] != p:
        raise ValueError(
            f"lines are offsets (lines, {p}) and directions (lines, {p}, n_m); not {offset.shape}, {direction.shape}"
        )
    N = n_x + direction.shape[2] + n_d
    size, widest = np.array(scale, float), np.full(N, np.inf) if limit is None else np.array(limit, float)
    observed = np.zeros((0, N)) if H is None else np.array(H, float)
    if size.shape != (N,) or not (np.isfinite(size) & (size > 0)).all():
        raise ValueError(f"scale needs {N} positive numbers, not {scale}")
    if widest.shape != (N,) or not (widest >= 0).all():
        raise ValueError(f"limit needs {N} numbers that are not negative, not {limit}")
    if H is not None and (observed.shape != (m, N) or not np.isfinite(observed).all()):
        raise ValueError(f"H needs the shape ({m}, {N}) and finite numbers, not {observed.shape}")
    dynamics, output, *_, project, _ = plant.addresses
    sizes = (plant.substeps, n_x, len(plant.outputs), n_theta, n_D, p, n_d, m, len(plant.commands))
    integers = np.concatenate([[dynamics, output, project, *sizes], *where.values()]).astype(np.int64)
    reals = np.concatenate([[plant.dt], plant.nominal_theta, plant.nominal_p])
    constants = (integers, reals, STEP * size, contiguous(offset), contiguous(direction))
    linear = _linear(plant, where["entries"])
    return Model(plant, m, constants, STEP * size, widest, linear, contiguous(observed), np.zeros((1, n_D)))


def _positions(name: str, given: Any, count: int) -> Array:
    positions = np.array(given, dtype=np.int64).reshape(-1)
    if len(set(positions.tolist())) < len(positions) or not all(0 <= i < count for i in positions):
        raise ValueError(f"{name} are different positions from 0 to {count - 1}, not {positions.tolist()}")
    return positions


def _linear(plant: Plant, entries: Array) -> Array:
    """[g, A, B, G, E[0], E[1], ...] of x+ = g + A x + B u + G d + (E[0] + sum u_k E[1 + k]) dtheta; (0, 0) if not so.

    Read off by unit steps, and compared with the plant at random points, since a declaration may be wrong.
    """
    if not plant.linear:
        return np.zeros((0, 0))
    n_x, n_u, n_D, p = len(plant.states), len(plant.commands), len(plant.disturbances), len(entries)
    x, u, d = np.zeros((1, n_x)), np.zeros((1, n_u)), np.zeros((1, n_D))
    theta = np.tile(plant.nominal_theta, (p, 1))
    theta[np.arange(p), entries] += 1.0
    g = plant.propagate(0.0, x, u, None, d)[0]
    A = (plant.propagate(0.0, np.eye(n_x), u, None, d) - g).T
    B = (plant.propagate(0.0, np.zeros((n_u, n_x)), np.eye(n_u), None, d) - g).T
    G = (plant.propagate(0.0, np.zeros((n_D, n_x)), u, None, np.eye(n_D)) - g).T
    commands = np.concatenate([u, np.eye(n_u)])
    E = np.stack([(plant.propagate(0.0, np.zeros((p, n_x)), c[None], theta, d) - g - B @ c).T for c in commands])
    E[1:] -= E[0]

    rng = np.random.default_rng(0)
    x, u, d, z = (rng.standard_normal((16, n)) for n in (n_x, n_u, n_D, p))
    x *= [s.scale for s in plant.states]
    theta = np.tile(plant.nominal_theta, (16, 1))
    theta[:, entries] += z
    gain = E[0] + np.einsum("nk,kap->nap", u, E[1:])
    expected = g + x @ A.T + u @ B.T + np.einsum("nap,np->na", gain, z) + d @ G.T
    found = plant.propagate(rng.uniform(0, 100, 16), x, u, theta, d)
    if not np.allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(found).max()):
        return np.zeros((0, 0))
    return contiguous(np.concatenate([g[:, None], A, B, G, *E], axis=1))


def _rule(name: str) -> int:
    if name not in RULES:
        raise ValueError(f"unknown rule {name!r}; there are {', '.join(RULES)}")
    return RULES[name]


def _call(kernel: Any, head: tuple[Any, ...], *arrays: Any) -> None:
    """Call a kernel with the arrays in the order and type that it takes; a copy only of what is not so, or read-only."""
    plain = [np.ascontiguousarray(a, float) for a in arrays]
    try:
        kernel(*head, *plain)
    except TypeError:
        plain = [a if a.flags.writeable else a.copy() for a in plain]
        head = tuple(a.copy() if isinstance(a, np.ndarray) and not a.flags.writeable else a for a in head)
        try:
            kernel(*head, *plain)
        except TypeError:
            shapes = ", ".join(str(a.shape) for a in plain)
            raise TypeError(f"the arrays need the documented dimensions, not {shapes}, and `seen` bool") from None


def f(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> Array:
    """The points X (n, points, N) one sample after t (n,) [s], without noise: (n, points, N)."""
    moved = np.empty(X.shape)
    _call(kernels.images, (True, *model.constants), X, t, u, model.unmeasured if d is None else d, moved)
    return moved


def h(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> Array:
    """What the sensors read at the points X (n, points, N) at t (n,) [s], without noise: (n, points, m)."""
    y = np.empty((*X.shape[:2], model.m))
    _call(kernels.images, (False, *model.constants), X, t, u, model.unmeasured if d is None else d, y)
    return y


def jacobian_f(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> tuple[Array, Array]:
    """X (n, N) one sample after t (n,) [s], and the Jacobian of that (n, N, N) by central differences."""
    return _differences(model, f(model, _along_axes(model, X), t, u, d))


def jacobian_h(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> tuple[Array, Array]:
    """What the sensors read at X (n, N) at t (n,) [s]: (n, m), and its Jacobian (n, m, N) by central differences."""
    return _differences(model, h(model, _along_axes(model, X), t, u, d))


def _along_axes(model: Model, X: Array) -> Array:
    """X (n, N), and X plus and minus the step of each entry: (n, 2 N + 1, N)."""
    if X.ndim != 2 or X.shape[1] != len(model.step):
        raise ValueError(f"X needs the shape (n, {len(model.step)}), not {X.shape}")
    step = np.diag(model.step)
    return X[:, None] + np.concatenate([np.zeros_like(step[:1]), step, -step])


def _differences(model: Model, values: Array) -> tuple[Array, Array]:
    N = len(model.step)
    columns = (values[:, 1 : N + 1] - values[:, N + 1 :]) / (2 * model.step[:, None])
    return values[:, 0], np.ascontiguousarray(np.swapaxes(columns, 1, 2))


def predict(
    model: Model, rule: str, X: Array, P: Array, t: Array, u: Array, d: Array | None, Q: Array
) -> tuple[Array, Array]:
    """Mean (n, N) and covariance (n, N, N) one sample after t (n,) [s].

    Args:
        model: The model.
        rule: One of `RULES`.
        X: Mean (n, N) at t.
        P: Its covariance (n, N, N). Where it has lost its definiteness, as little as helps is added to its diagonal.
        t: Start of the interval (n,) [s].
        u: Command (n, n_u) held over it.
        d: Measured disturbance (n, n_D) held over it.
        Q: Covariance (1, N, N) that a sample adds, or one for each line or episode.

    Raises:
        ValueError: Unknown rule, or shapes that do not fit.
    """
    X1, P1 = np.empty(X.shape), np.empty(P.shape)
    known = model.unmeasured if d is None else d
    _call(kernels.predict, (_rule(rule), *model.constants, model.limit, model.linear), X, P, t, u, known, Q, X1, P1)
    return X1, P1


def update(
    model: Model, rule: str, X: Array, P: Array, t: Array, u: Array, d: Array | None, y: Array, seen: Array, R: Array
) -> Updated:
    """Update with the sensors at t.

    Args:
        model: The model.
        rule: One of `RULES`; without effect where the model has H.
        X: Predicted mean (n, N).
        P: Its covariance (n, N, N).
        t: Time of the sample (n,) [s].
        u: Command (n, n_u) held up to it.
        d: Measured disturbance (n, n_D).
        y: What the sensors read (n, m).
        seen: Which of them reported (n, m), bool.
        R: Covariance of their noise (1, m, m), or one for each line or episode.

    Raises:
        ValueError: Unknown rule, or shapes that do not fit.
    """
    n, m = len(X), model.m
    X1, P1, nu, S = np.empty(X.shape), np.empty(P.shape), np.empty((n, m)), np.empty((n, m, m))
    nis, log = np.empty(n), np.empty(n)
    known = model.unmeasured if d is None else d
    _call(
        kernels.update, (_rule(rule), *model.constants, model.H, np.ascontiguousarray(seen)), X, P, t, u, known, y, R,
        X1, P1, nu, S, nis, log,
    )  # fmt: skip
    return Updated(X1, P1, nu, S, nis, log)


def correct(X: Array, P: Array, mean: Array, cross: Array, S: Array, y: Array, seen: Array) -> Corrected:
    """The Kalman correction alone, for a method that brings its own moments.

    Args:
        X: Predicted mean (n, N).
        P: Its covariance (n, N, N).
        mean: Mean of what the sensors read (n, m).
        cross: Covariance of X with it (n, N, m).
        S: Its own covariance, noise included (n, m, m).
        y: What they read (n, m).
        seen: Which of them reported (n, m), bool.

    Raises:
        ValueError: Shapes that do not fit.
    """
    n, m = mean.shape
    X1, P1, K = np.empty(X.shape), np.empty(P.shape), np.empty((n, X.shape[1], m))
    nu, S1, nis, log = np.empty((n, m)), np.empty((n, m, m)), np.empty(n), np.empty(n)
    _call(kernels.correct, (np.ascontiguousarray(seen),), X, P, y, mean, cross, S, X1, P1, nu, S1, K, nis, log)
    return Corrected(X1, P1, nu, S1, nis, log, K)

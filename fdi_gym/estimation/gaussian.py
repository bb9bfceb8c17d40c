"""The Gaussian step in one compiled call: predict, update and their parts, for a batch of episodes and any plant.

The model is the augmented one, X = [x; m; d]: the plant's state, magnitudes of its faults and disturbances that nothing
measures. theta is nominal but for theta[entries], to which offset + direction m is added: an ordinary filter has the one
line "offset 0, direction I", a bank one line for each of its models, and row i of a stack lies on line i % lines. f moves
x by one sample (theta, d and the command held) and leaves m and d; an entry beyond theta is one of the plant's physical
parameters; h gives the chosen sensors. A Gaussian passes through
f and h by one of three rules:

    "extended"            A. H. Jazwinski, Stochastic Processes and Filtering Theory, 1970; f's Jacobian is exact where the
                          plant says its derivatives (`fdi_gym.tangent`), others by central differences
    "unscented"           S. J. Julier, J. K. Uhlmann, Proceedings of the IEEE 92(3), 2004; lambda = 2, equal weights
    "central difference"  M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000; interval sqrt(3)

On a linear plant each is the Kalman filter. A sensor that did not report leaves no trace: the result is that of the
filter without its row, whatever stands in y there. An episode's numbers do not depend on its neighbours, to the bit.

Arrays are stacks with the episodes first. t (n,), u (n, n_u), d (n, n_D), y and seen (n, m) may have fewer rows, each of
which then serves equally many consecutive episodes; Q and R may have fewer, which serve the episodes in turn (line by
line). d is what is known of all the plant's disturbances, None where nothing is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation import gaussian_kernels as kernels
from fdi_gym.estimation.gaussian_model import Model, bind
from fdi_gym.estimation.gaussian_points import CENTRAL_DIFFERENCE, EXTENDED, TANGENT, UNSCENTED
from fdi_gym.estimation.gaussian_step import predict_lanes, update_lanes
from fdi_gym.kernels import address
from fdi_gym.model import contiguous
from fdi_gym.plant import Array

__all__ = [
    "RULES", "Corrected", "Model", "Updated", "bind", "correct", "f", "h", "jacobian_f", "jacobian_h", "predict", "update",
]  # fmt: skip

RULES = {"extended": EXTENDED, "unscented": UNSCENTED, "central difference": CENTRAL_DIFFERENCE}


class Updated(NamedTuple):
    """Outcome of an update. What was not seen has nu = 0 and the identity's row and column in S."""

    X: Array  # (n, N)
    P: Array  # (n, N, N)
    nu: Array  # (n, m) innovation
    S: Array  # (n, m, m) its covariance
    nis: Array  # (n,) nu' S^-1 nu, chi-square with as many degrees of freedom as sensors were seen
    log_likelihood: Array  # (n,) log density of what was seen, its 2 pi terms included; 0 where nothing was
    count: Array  # (n,) int: sensors that were seen


class Corrected(NamedTuple):
    """Outcome of a correction: as `Updated`, with the gain."""

    X: Array  # (n, N)
    P: Array  # (n, N, N)
    nu: Array  # (n, m)
    S: Array  # (n, m, m)
    nis: Array  # (n,)
    log_likelihood: Array  # (n,)
    K: Array  # (n, N, m), 0 for what was not seen


def _rule(name: str) -> int:
    rule = RULES.get(name)
    if rule is None:
        raise ValueError(f"unknown rule {name!r}; there are {', '.join(RULES)}")
    return rule


def _call(kernel: Any, head: tuple[Any, ...], *arrays: Any) -> None:
    """Call a kernel with the arrays in the order and type that it takes; a copy only of what is not so, or read-only.

    Slow where it has to copy: numba takes long to refuse. A caller whose arrays are parts of others makes them contiguous.
    """
    try:
        kernel(*head, *arrays)
    except TypeError:
        plain = [contiguous(a) for a in arrays]
        head = tuple(np.require(a, requirements=["C", "W"]) if isinstance(a, np.ndarray) else a for a in head)
        try:
            kernel(*head, *plain)
        except TypeError:
            shapes = ", ".join(str(a.shape) for a in plain)
            raise TypeError(f"the arrays need the documented dimensions, not {shapes}, and `seen` bool") from None


def f(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> Array:
    """The points X (n, points, N) one sample after t (n,) [s], without noise: (n, points, N)."""
    moved = np.empty(X.shape)
    _call(kernels.images, (True, *model.constants), X, t, u, model.known(d), moved)
    return moved


def h(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> Array:
    """What the sensors read at the points X (n, points, N) at t (n,) [s], without noise: (n, points, m)."""
    y = np.empty((*X.shape[:2], model.m))
    _call(kernels.images, (False, *model.constants), X, t, u, model.known(d), y)
    return y


def jacobian_f(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> tuple[Array, Array]:
    """X (n, N) one sample after t (n,) [s], and the Jacobian of that (n, N, N).

    It is exact where the plant says its derivatives; elsewhere central differences take its place.
    """
    _check_width(model, X)
    if model.constants[0][TANGENT]:
        X1, F = np.empty(X.shape), np.empty((*X.shape, X.shape[1]))
        _call(kernels.differentiate, model.constants, X, t, u, model.known(d), X1, F)
        return X1, F
    return _differences(model, f(model, _along_axes(model, X), t, u, d))


def jacobian_h(model: Model, X: Array, t: Array, u: Array, d: Array | None = None) -> tuple[Array, Array]:
    """What the sensors read at X (n, N) at t (n,) [s]: (n, m), and its Jacobian (n, m, N) by central differences."""
    _check_width(model, X)
    return _differences(model, h(model, _along_axes(model, X), t, u, d))


def _check_width(model: Model, X: Array) -> None:
    if X.ndim != 2 or X.shape[1] != len(model.step):
        raise ValueError(f"X needs the shape (n, {len(model.step)}), not {X.shape}")


def _along_axes(model: Model, X: Array) -> Array:
    """X (n, N), and X plus and minus the step of each entry: (n, 2 N + 1, N)."""
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
    constants = (address(predict_lanes), _rule(rule), *model.constants, model.limit, model.linear)
    _call(kernels.predict, constants, X, P, t, u, model.known(d), Q, X1, P1)
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
    nis, log, count = np.empty(n), np.empty(n), np.empty(n, np.int64)
    _call(
        kernels.update, (address(update_lanes), _rule(rule), *model.constants, model.H, model.plain, seen, count),
        X, P, t, u, model.known(d), y, R, X1, P1, nu, S, nis, log,
    )  # fmt: skip
    return Updated(X1, P1, nu, S, nis, log, count)


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
    # parts of larger arrays, most often: numba takes 300 us to say that it does not take them
    X, P, y, mean, cross, S = (contiguous(a) for a in (X, P, y, mean, cross, S))
    X1, P1, K = np.empty(X.shape), np.empty(P.shape), np.empty((n, X.shape[1], m))
    nu, S1, nis, log = np.empty((n, m)), np.empty((n, m, m)), np.empty(n), np.empty(n)
    _call(kernels.correct, (np.ascontiguousarray(seen),), X, P, y, mean, cross, S, X1, P1, nu, S1, K, nis, log)
    return Corrected(X1, P1, nu, S1, nis, log, K)

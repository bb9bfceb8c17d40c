"""A plant's augmented model with its constants packed for the compiled steps of `gaussian`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation.gaussian_points import ADDRESSES
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, NotApplicableError, Plant

LARGEST = 100  # entries of an augmented state: matrices of several episodes lie on the stack
STEP = 1e-3  # of the central differences along the axes, in units of the entries' scales


class Model(NamedTuple):
    """A plant's augmented model with its constants packed for the kernels; made by `bind`."""

    plant: Plant  # keeps its compiled equations alive
    m: int  # sensors
    constants: tuple[Array, ...]  # integers, reals, step, offset, direction: what tells f and h
    step: Array  # (N,) of the differences along the axes
    limit: Array  # (N,)
    linear: Array  # (n_x, ...), or (0, 0) where the plant is not linear
    H: Array  # (m, N), or (0, N) where the sensors are not
    plain: Array  # (m, n_x) what sensors read of x where that is all but their own faults, or (0, n_x) where it is not
    unmeasured: Array  # (1, n_D) zeros

    def known(self, d: Array | None) -> Array:
        """The disturbances that are measured (n, n_D), or zeros (1, n_D) where none is."""
        return self.unmeasured if d is None else d

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled without the addresses of compiled code, which hold in this process only."""
        integers, *rest = self.constants
        blank = np.concatenate([np.zeros(ADDRESSES, np.int64), integers[ADDRESSES:]])
        return _with_addresses, (self.plant, self.m, (blank, *rest), *self[3:])


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
        entries: Positions (p,) in theta that the faults move; beyond its end, in the physical parameters p.
        disturbances: Positions (n_d,) in the plant's disturbances of those in X.
        sensors: Positions (m,) in the plant's outputs of those that the filter hears. Default: all.
        limit: Largest variance (N,) that a prediction leaves an entry; where it is passed the entry's row and column
            shrink, so that correlations stay. Default: none.
        lines: Offsets (lines, p) and directions (lines, p, n_m). Default: m is the deviation of theta[entries] itself.
        H: (m, N) where the sensors are H X whatever u, t and d are: they are then not evaluated. Default: they are.

    Raises:
        ValueError: A position does not exist, or an array has the wrong shape or values that are no numbers.
        NotApplicableError: It would have more than LARGEST entries.
    """
    n_x, n_theta, n_D = len(plant.states), len(plant.theta), len(plant.disturbances)
    where = {
        "entries": _positions("entries", entries, n_theta + len(plant.nominal_p)),
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
    if N > LARGEST:
        raise NotApplicableError(f"estimates at most {LARGEST} numbers at once, not {N}")
    size, widest = np.array(scale, float), np.full(N, np.inf) if limit is None else np.array(limit, float)
    observed = np.zeros((0, N)) if H is None else np.array(H, float)
    if size.shape != (N,) or not (np.isfinite(size) & (size > 0)).all():
        raise ValueError(f"scale needs {N} positive numbers, not {scale}")
    if widest.shape != (N,) or not (widest >= 0).all():
        raise ValueError(f"limit needs {N} numbers that are not negative, not {limit}")
    if H is not None and (observed.shape != (m, N) or not np.isfinite(observed).all()):
        raise ValueError(f"H needs the shape ({m}, {N}) and finite numbers, not {observed.shape}")
    sizes = (plant.substeps, n_x, len(plant.outputs), n_theta, n_D, p, n_d, m, plant.own_theta, len(plant.commands))
    integers = np.concatenate([np.zeros(ADDRESSES), sizes, *where.values()]).astype(np.int64)
    reals = np.concatenate([[plant.dt], plant.nominal_theta, plant.nominal_p])
    constants = (integers, reals, STEP * size, contiguous(offset), contiguous(direction))
    linear = _linear(plant, where["entries"])
    plain = np.zeros((0, n_x)) if H is not None else _plain(plant, where["sensors"])
    return _with_addresses(
        plant, m, constants, STEP * size, widest, linear, contiguous(observed), plain, np.zeros((1, n_D))
    )  # fmt: skip


def _with_addresses(plant: Plant, m: int, constants: tuple[Array, ...], *others: Any) -> Model:
    integers, *rest = constants
    addresses = plant.addresses.lanes, plant.addresses.output, plant.tangent(len(others[0]))
    integers = np.concatenate([addresses, integers[ADDRESSES:]])
    return Model(plant, m, (integers, *rest), *others)


def _positions(name: str, given: Any, count: int) -> Array:
    found = np.asarray(given)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
        raise ValueError(f"{name} are a list of integers, not {given!r}")
    positions = found.astype(np.int64)
    if len(set(positions.tolist())) < len(positions) or not all(0 <= i < count for i in positions):
        raise ValueError(f"{name} are different positions from 0 to {count - 1}, not {positions.tolist()}")
    return positions


def _plain(plant: Plant, sensors: Array) -> Array:
    """C (m, n_x) if y = C x whatever the command, the plant's own faults, disturbance, time and parameters; else (0, n_x).

    Read off by unit steps, and compared with the plant at random points.
    """
    rng, n_x = np.random.default_rng(0), len(plant.states)
    C = contiguous(plant.measure(0.0, np.eye(n_x), plant.trim_command)[:, sensors].T)
    x = rng.standard_normal((16, n_x)) * [s.scale for s in plant.states]
    u = plant.trim_command + rng.standard_normal((16, len(plant.commands)))
    theta = np.tile(plant.nominal_theta, (16, 1))
    theta[:, : plant.own_theta] += rng.standard_normal((16, plant.own_theta))
    d, p = rng.standard_normal((16, len(plant.disturbances))), plant.nominal_p * rng.uniform(0.5, 2.0, (16, 1))
    found = plant.measure(rng.uniform(0, 100, 16), x, u, theta, d, p)[:, sensors]
    return C if np.allclose(found, x @ C.T, rtol=1e-9, atol=1e-9 * np.abs(found).max()) else C[:0]


def _linear(plant: Plant, entries: Array) -> Array:
    """[g, A, B, G, E[0], E[1], ...] of x+ = g + A x + B u + G d + (E[0] + sum u_k E[1 + k]) dtheta; (0, 0) if not so.

    Read off by unit steps, and compared with the plant at random points, since a declaration may be wrong.
    """
    if not plant.linear or (entries >= len(plant.theta)).any():
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

"""Any plant as a filter sees it: state, fault and unknown disturbance in one vector X = [x; z; d].

z is the fault vector's deviation from healthy and d the disturbances that nothing measures; both are random walks. The
model is the plant's compiled one, so whatever is a plant can be filtered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.estimation.kalman import T
from fdi_gym.estimation.prior import Prior, prior
from fdi_gym.plant import Array, Plant

STEP = 1e-3  # of the central differences, in units of the signals' scales
WIDEST = 2.0  # the walk never makes a fault's standard deviation larger than this, in units of its typical size


class Interval(NamedTuple):
    """What is known of the interval that ends at a sample, for n episodes."""

    k: int  # the sample at its end
    y: Array  # (n, m) the noisy sensors
    u: Array  # (n, n_u) the command held over it
    d: Array | None  # (n, n_d) the measured disturbance; None where none is


class Augmented(NamedTuple):
    """The model of [x; z; d] and what is believed of it at first."""

    plant: Plant
    prior: Prior
    x: slice
    z: slice
    d: slice
    scale: Array  # (N,) typical size of each entry
    X0: Array  # (N,)
    P0: Array  # (N, N)
    Q: Array  # (N, N)
    R: Array  # (m, m)
    limit: Array  # (N,) largest variance that a walk may reach
    H: Array | None  # (m, N) where the sensors are linear in X and see nothing else
    lines: tuple[Array, Array] | None = None  # offsets (r, p) and directions (r, p, f): z are then magnitudes along them

    def deviation(self, z: Array) -> Array:
        """The fault vector's deviation from healthy (n, ..., p) that z (n, ..., f) stands for; row i lies on line i % r."""
        if self.lines is None:
            return z
        offset, direction = self.lines
        grouped = z.reshape(-1, len(offset), int(np.prod(z.shape[1:-1])), z.shape[-1])
        return (offset[:, None] + grouped @ T(direction)).reshape(*z.shape[:-1], offset.shape[-1])

    def _inputs(self, X: Array, known: Array | None) -> tuple[Array, Array]:
        """theta and d of points X (..., N)."""
        theta = np.empty((*X.shape[:-1], len(self.plant.theta)))
        theta[...] = self.plant.nominal_theta
        theta[..., self.prior.inputs.entries] += self.deviation(X[..., self.z])
        d = np.zeros((*X.shape[:-1], len(self.plant.disturbances)))
        if known is not None:
            d += known.reshape(len(known), *[1] * (X.ndim - 2), -1)
        d[..., self.prior.disturbances] = X[..., self.d]
        return theta, d

    def f(self, X: Array, at: Interval) -> Array:
        """The points X (n, M, N) one sample later, without noise."""
        theta, d = self._inputs(X, at.d)
        moved = X.copy()
        moved[..., self.x] = self.plant.propagate((at.k - 1) * self.plant.dt, X[..., self.x], at.u, theta, d)
        return moved

    def h(self, X: Array, at: Interval) -> Array:
        """What the noisy sensors read at the points X (n, M, N): (n, M, m)."""
        if self.H is not None:
            return X @ self.H.T
        theta, d = self._inputs(X, at.d)
        y = self.plant.measure(at.k * self.plant.dt, X[..., self.x], at.u, theta, d)
        return y[..., self.prior.sensors]

    def jacobian(self, function: str, X: Array, at: Interval) -> tuple[Array, Array]:
        """f or h at X (n, N), and its Jacobian (n, m, N) by central differences."""
        N = X.shape[1]
        step = STEP * self.scale
        points = np.repeat(X[:, None], 2 * N + 1, axis=1)
        points[:, 1 : N + 1] += np.diag(step)
        points[:, N + 1 :] -= np.diag(step)
        F = (self.f if function == "f" else self.h)(points, at)
        return F[:, 0], T((F[:, 1 : N + 1] - F[:, N + 1 :]) / (2 * step[:, None]))

    def read(self, k: int, obs: Array, before: Array) -> tuple[Interval, Array]:
        """The interval that ends with the observations (n, n_obs) at sample k, and the known signals at its end.

        before (n, n_known): those at its start.
        """
        y, u, known = self.plant.split(obs)
        measured = self.plant.measured_disturbance
        d = measured((k - 1) * self.plant.dt, before if k else known, known) if measured is not None else None
        return Interval(k, y[:, self.prior.sensors], u, d), known

    def limited(self, P: Array) -> Array:
        """P (n, N, N) with the variances of z back at their limit, correlations kept."""
        variance = np.einsum("nii->ni", P)
        if (variance <= self.limit).all():
            return P
        s = np.sqrt(np.minimum(1.0, self.limit / np.maximum(variance, 1e-300)))
        return s[:, :, None] * P * s[:, None, :]


def _linear_sensors(model: Augmented) -> Array | None:
    """H (m, N) if y = H X whatever the command, the time and the measured disturbance are."""
    plant, N = model.plant, len(model.scale)
    rng = np.random.default_rng(0)
    n_d = len(plant.disturbances)

    def at(n: int) -> Interval:
        d = rng.standard_normal((n, n_d)) if plant.measured_disturbance is not None else None
        return Interval(
            int(rng.integers(1, 100)), np.empty(0), plant.trim_command + rng.standard_normal((n, len(plant.commands))), d
        )

    points = np.concatenate([np.zeros((1, N)), np.diag(model.scale)])
    values = model.h(points[None], at(1))[0]
    H = T((values[1:] - values[0]) / model.scale[:, None])
    X = model.scale * rng.standard_normal((16, 1, N))
    found = model.h(X, at(16))
    tolerance = 1e-9 * np.abs(found).max()
    return H if np.allclose(found, X @ H.T, rtol=1e-9, atol=tolerance) else None


def augmented(
    plant: Plant,
    process: str = "standard",
    *,
    walk: float = 1.0,
    x0_std: Sequence[float] | None = None,
    z0_std: Sequence[float] | None = None,
    z_walk: Sequence[float] | None = None,
    faults: bool = True,
) -> Augmented:
    """The augmented model of a plant, with what one of its fault processes lets one believe.

    Args:
        plant: The plant.
        process: The fault process that will be met.
        walk: Factor on the standard deviation of the faults' random walk.
        x0_std: Initial standard deviations of the state (n_x,), in place of the process's.
        z0_std: Those of the fault vector (p,). Default: a tenth of the typical fault, since flights begin healthy.
        z_walk: Standard deviations of its random walk per step (p,). Default: what follows the process's faults.
        faults: With the fault vector; without it X = [x; d] is the model of a healthy plant.

    Raises:
        NotApplicableError: No sensor has noise, or the fault vector does not enter additively.
        ValueError: A list has the wrong length.
    """
    p = prior(plant, process)
    n_x, n_z, n_d = len(plant.states), len(p.z_size), len(p.disturbances)
    for name, given, n in (("x0_std", x0_std, n_x), ("z0_std", z0_std, n_z), ("z_walk", z_walk, n_z)):
        if given is not None and len(given) != n:
            raise ValueError(f"{name} needs {n} entries for {plant.id}, not {len(given)}")
    z0 = 0.1 * p.z_size if z0_std is None else np.array(z0_std, float)
    steps = walk * (p.z_walk if z_walk is None else np.array(z_walk, float))
    if not faults:
        p = p._replace(inputs=p.inputs._replace(entries=p.inputs.entries[:0], estimated=p.inputs.estimated[:0]))
        z0, steps, n_z = z0[:0], steps[:0], 0
    N = n_x + n_z + n_d
    x, z, d = slice(0, n_x), slice(n_x, n_x + n_z), slice(n_x + n_z, N)
    scale = np.concatenate([
        [s.scale for s in plant.states], p.z_size[:n_z], [plant.disturbances[i].scale for i in p.disturbances]
    ])  # fmt: skip
    P0_x = p.P0 if x0_std is None else np.diag(np.square(x0_std))
    P0 = np.asarray(scipy.linalg.block_diag(P0_x, np.diag(z0**2), np.diag(p.d0**2)))
    Q = np.asarray(scipy.linalg.block_diag(p.Q, np.diag(steps**2), np.diag(p.d_walk**2)))
    limit = np.full(N, np.inf)
    limit[z] = np.maximum(WIDEST * p.z_size[:n_z], z0) ** 2
    X0 = np.concatenate([p.x0, np.zeros(n_z + n_d)])
    model = Augmented(plant, p, x, z, d, scale, X0, P0, Q, p.R, limit, None)
    return model._replace(H=_linear_sensors(model))

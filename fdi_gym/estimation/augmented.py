"""Any plant as a filter sees it: state, fault and unknown disturbance in one vector X = [x; z; d].

z is the fault vector's deviation from healthy and d the disturbances that nothing measures; both are random walks. The
model is the plant's compiled one, so whatever is a plant can be filtered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.estimation.belief import Belief, FaultInputs, fault_inputs
from fdi_gym.estimation.gaussian import Rule
from fdi_gym.estimation.kalman import Corrected, T, correct, symmetric, times
from fdi_gym.plant import Array, Plant

STEP = 1e-3  # of the central differences, in units of the signals' scales
WIDEST = 2.0  # the walk never makes a fault's standard deviation larger than this, in units of its typical size


class Interval(NamedTuple):
    """What is known of the interval that ends at a sample, for n episodes."""

    k: Array  # (n,) the sample at its end
    u: Array  # (n, n_u) the command held over it
    d: Array | None  # (n, n_d) the measured disturbance; None where none is
    known: Array  # (n, n_known) what else is known at its end
    held: Array | None = None  # (n,) bool: a command or known signal did not report, its last value stands; None: all did

    def of(self, rows: Array) -> Interval:
        """Of some episodes, each as often as its row is named."""
        d, held = (None if a is None else a[rows] for a in (self.d, self.held))
        return Interval(self.k[rows], self.u[rows], d, self.known[rows], held)


class AugmentedModel(NamedTuple):
    """The model of [x; z; d] and what is believed of it at first."""

    plant: Plant
    inputs: FaultInputs
    sensors: Array  # (m,) which are used
    disturbances: Array  # (q,) which are in d
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

    @property
    def step(self) -> Array:
        """Steps of the central differences (N,)."""
        return STEP * self.scale

    @property
    def rest(self) -> list[int]:
        """The entries of X that are not the fault vector."""
        return [*range(self.x.start, self.x.stop), *range(self.d.start, self.d.stop)]

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
        theta[..., self.inputs.entries] += self.deviation(X[..., self.z])
        d = np.zeros((*X.shape[:-1], len(self.plant.disturbances)))
        if known is not None:
            d += known.reshape(len(known), *[1] * (X.ndim - 2), -1)
        d[..., self.disturbances] = X[..., self.d]
        return theta, d

    def f(self, X: Array, at: Interval) -> Array:
        """The points X (n, M, N) one sample later, without noise."""
        theta, d = self._inputs(X, at.d)
        moved = X.copy()
        moved[..., self.x] = self.plant.propagate((at.k - 1) * self.plant.dt, X[..., self.x], at.u, theta, d)
        return moved

    def h(self, X: Array, at: Interval) -> Array:
        """What the sensors read at the points X (n, M, N): (n, M, m)."""
        if self.H is not None:
            return X @ self.H.T
        theta, d = self._inputs(X, at.d)
        y = self.plant.measure(at.k * self.plant.dt, X[..., self.x], at.u, theta, d)
        return y[..., self.sensors]

    def expect(self, x: Array, at: Interval) -> Array:
        """What all sensors of the healthy plant read in the states x (n, n_x): (n, n_y)."""
        return self.plant.measure(at.k * self.plant.dt, x, at.u, None, at.d)

    def limited(self, P: Array) -> Array:
        """P (n, N, N) with the variances of z back at their limit, correlations kept."""
        variance = np.einsum("nii->ni", P)
        if (variance <= self.limit).all():
            return P
        s = np.sqrt(np.minimum(1.0, self.limit / np.maximum(variance, 1e-300)))
        return s[:, :, None] * P * s[:, None, :]

    def predict(self, rule: Rule, X: Array, P: Array, at: Interval, Q: Array | None = None) -> tuple[Array, Array]:
        """Mean and covariance one sample later."""
        moved = rule(lambda points: self.f(points, at), X, P, self.step)
        return moved.mean, self.limited(symmetric(moved.P) + (self.Q if Q is None else Q))

    def update(self, rule: Rule, X: Array, P: Array, at: Interval, y: Array, seen: Array) -> Corrected:
        """Update with the measurement y (n, n_y) of the sensors that reported, seen (n, n_y)."""
        y, seen = y[:, self.sensors], seen[:, self.sensors]
        if self.H is not None:
            cross = P @ self.H.T
            return correct(X, P, y - times(self.H, X), cross, self.H @ cross + self.R, seen)
        moved = rule(lambda points: self.h(points, at), X, P, self.step)
        return correct(X, P, y - moved.mean, moved.cross, moved.P + self.R, seen)


def _linear_sensors(model: AugmentedModel) -> Array | None:
    """H (m, N) if y = H X whatever the command, the time and the measured disturbance are."""
    plant, N = model.plant, len(model.scale)
    rng = np.random.default_rng(0)
    n_d = len(plant.disturbances)

    def at(n: int) -> Interval:
        d = rng.standard_normal((n, n_d)) if plant.measured_disturbance is not None else None
        u = plant.trim_command + rng.standard_normal((n, len(plant.commands)))
        return Interval(rng.integers(1, 100, n), u, d, np.zeros((n, len(plant.known))))

    points = np.concatenate([np.zeros((1, N)), np.diag(model.scale)])
    values = model.h(points[None], at(1))[0]
    H = T((values[1:] - values[0]) / model.scale[:, None])
    X = model.scale * rng.standard_normal((16, 1, N))
    found = model.h(X, at(16))
    tolerance = 1e-9 * np.abs(found).max()
    return H if np.allclose(found, X @ H.T, rtol=1e-9, atol=tolerance) else None


def augmented(
    plant: Plant,
    belief: Belief,
    *,
    walk: float = 1.0,
    x0_std: Sequence[float] | None = None,
    z0_std: Sequence[float] | None = None,
    z_walk: Sequence[float] | None = None,
    faults: bool = True,
) -> AugmentedModel:
    """The augmented model of a plant.

    Args:
        plant: The plant.
        belief: What is believed of it.
        walk: Factor on the standard deviation of the faults' random walk.
        x0_std: Standard deviations of the initial state (n_x,). Default: the belief's.
        z0_std: Those of the fault vector (p,). Default: a tenth of the typical fault, since flights begin healthy.
        z_walk: Standard deviations of its random walk per step (p,). Default: the belief's.
        faults: With the fault vector; without it X = [x; d] is the model of a healthy plant.

    Raises:
        NotApplicableError: The fault vector does not enter additively.
        ValueError: A list has the wrong length, or the belief is another plant's.
    """
    inputs = fault_inputs(plant)
    n_x, n_z, n_d = len(plant.states), len(belief.z_size), len(belief.disturbances)
    if len(belief.x0) != n_x or n_z != len(inputs.names) or len(belief.m_mean) != len(plant.modes):
        raise ValueError(f"the belief is not one of {plant.id}: its states, faults or modes are others")
    for name, given, n in (("x0_std", x0_std, n_x), ("z0_std", z0_std, n_z), ("z_walk", z_walk, n_z)):
        if given is not None and len(given) != n:
            raise ValueError(f"{name} needs {n} entries for {plant.id}, not {len(given)}")
    z0 = 0.1 * belief.z_size if z0_std is None else np.array(z0_std, float)
    steps = walk * (belief.z_walk if z_walk is None else np.array(z_walk, float))
    if not faults:
        inputs = inputs._replace(entries=inputs.entries[:0], estimated=inputs.estimated[:0])
        z0, steps, n_z = z0[:0], steps[:0], 0
    N = n_x + n_z + n_d
    x, z, d = slice(0, n_x), slice(n_x, n_x + n_z), slice(n_x + n_z, N)
    scale = np.concatenate([
        [s.scale for s in plant.states], belief.z_size[:n_z], [plant.disturbances[i].scale for i in belief.disturbances]
    ])  # fmt: skip
    P0_x = belief.P0 if x0_std is None else np.diag(np.square(x0_std))
    P0 = np.asarray(scipy.linalg.block_diag(P0_x, np.diag(z0**2), np.diag(belief.d0**2)))
    Q = np.asarray(scipy.linalg.block_diag(belief.Q, np.diag(steps**2), np.diag(belief.d_walk**2)))
    limit = np.full(N, np.inf)
    limit[z] = np.maximum(WIDEST * belief.z_size[:n_z], z0) ** 2
    X0 = np.concatenate([belief.x0, np.zeros(n_z + n_d)])
    model = AugmentedModel(
        plant, inputs, belief.sensors, belief.disturbances, x, z, d, scale, X0, P0, Q, belief.R, limit, None
    )
    return model._replace(H=_linear_sensors(model))

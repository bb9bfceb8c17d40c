"""Any plant as a filter sees it: state, fault and unknown disturbance in one vector X = [x; z; d].

z is the fault vector's deviation from healthy and d the disturbances that nothing measures; both are random walks. The
model is the plant's compiled one, so whatever is a plant can be filtered.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.estimation import gaussian
from fdi_gym.estimation.belief import Belief, FaultInputs, fault_inputs
from fdi_gym.estimation.gaussian_model import STEP
from fdi_gym.estimation.kalman import T
from fdi_gym.plant import Array, Plant

HELD = 10  # samples within which a command that is held goes wrong by its typical size
WIDEST = 2.0  # the walk never makes a fault's standard deviation larger than this, in units of its typical size


class Interval(NamedTuple):
    """What is known of the interval that ends at a sample, for n episodes."""

    k: Array  # (n,) the sample at its end
    u: Array  # (n, n_u) the command held over it
    d: Array | None  # (n, n_d) the measured disturbance; None where none is
    known: Array  # (n, n_known) what else is known at its end
    held: Array | None = None  # (n,) bool: a command or known signal did not report, its last value stands; None: all did
    stale: Array | None = None  # (n, n_u) for how many samples in a row each command has been missing; None: none is

    def of(self, rows: Array) -> Interval:
        """Of some episodes, each as often as its row is named."""
        d, held, stale = (None if a is None else a[rows] for a in (self.d, self.held, self.stale))
        return Interval(self.k[rows], self.u[rows], d, self.known[rows], held, stale)


def plus_held_commands(plant: Plant, P: Array, x: Array, at: Interval) -> Array:
    """A predicted covariance P (n, N, N) whose first entries are the state's, with what a command that was held adds."""
    more = held_command_covariance(plant, x, at)
    if more is None:
        return P
    P, n_x = P.copy(), x.shape[1]
    P[:, :n_x, :n_x] += more
    return P


def held_command_covariance(plant: Plant, x: Array, at: Interval) -> Array | None:
    """What a command that was not reported adds to the covariance of the state (n, n_x, n_x); None where all were.

    The error of a command that is held grows to its typical size within HELD samples, and it is one error, not white noise:
    over j samples its effects add up, so that the j-th adds 2 j - 1 times its square.

    Args:
        plant: The plant.
        x: The state at the interval's start (n, n_x).
        at: The interval.
    """
    if at.stale is None:
        return None
    scale = np.array([s.scale for s in plant.commands])
    points = at.u[:, None] + STEP * np.concatenate([np.diag(scale), -np.diag(scale)])  # (n, 2 n_u, n_u)
    n, n_u = at.u.shape
    t = np.repeat((at.k - 1) * plant.dt, 2 * n_u)
    d = None if at.d is None else np.repeat(at.d, 2 * n_u, axis=0)
    moved = plant.propagate(t, np.repeat(x, 2 * n_u, axis=0), points.reshape(-1, n_u), None, d).reshape(n, 2 * n_u, -1)
    B = (moved[:, :n_u] - moved[:, n_u:]) / (2 * STEP)  # (n, n_u, n_x): by a command's typical size
    weight = np.sqrt(np.maximum(2.0 * at.stale - 1.0, 0.0)) * np.minimum(at.stale / HELD, 1.0)
    B = weight[..., None] * B
    return T(B) @ B


@dataclass(frozen=True, kw_only=True, eq=False)
class AugmentedModel:
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
    Q: Array  # (N, N), or one for each line
    R: Array  # (m, m)
    limit: Array  # (N,) largest variance that a walk may reach
    H: Array | None = None  # (m, N) where the sensors are linear in X and see nothing else
    lines: tuple[Array, Array] | None = None  # offsets (r, p) and directions (r, p, f): z are then magnitudes along them

    def replace(self, **changes: Any) -> AugmentedModel:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    @property
    def rest(self) -> list[int]:
        """The entries of X that are not the fault vector."""
        return [*range(self.x.start, self.x.stop), *range(self.d.start, self.d.stop)]

    @functools.cached_property
    def compiled(self) -> gaussian.Model:
        """The model as the compiled steps take it."""
        return gaussian.bind(
            self.plant, scale=self.scale, entries=self.inputs.entries, disturbances=self.disturbances, sensors=self.sensors,
            limit=self.limit, lines=self.lines, H=self.H,
        )  # fmt: skip

    def f(self, X: Array, at: Interval) -> Array:
        """The points X (n, M, N) one sample later, without noise."""
        return gaussian.f(self.compiled, X, (at.k - 1) * self.plant.dt, at.u, at.d)

    def h(self, X: Array, at: Interval) -> Array:
        """What the sensors read at the points X (n, M, N): (n, M, m)."""
        return gaussian.h(self.compiled, X, at.k * self.plant.dt, at.u, at.d)

    def jacobian_f(self, X: Array, at: Interval) -> tuple[Array, Array]:
        """X (n, N) one sample later, and the Jacobian of that (n, N, N)."""
        return gaussian.jacobian_f(self.compiled, X, (at.k - 1) * self.plant.dt, at.u, at.d)

    def jacobian_h(self, X: Array, at: Interval) -> tuple[Array, Array]:
        """What the sensors read at X (n, N): (n, m), and its Jacobian (n, m, N)."""
        return gaussian.jacobian_h(self.compiled, X, at.k * self.plant.dt, at.u, at.d)

    def expect(self, x: Array, at: Interval) -> Array:
        """What all sensors of the healthy plant read in the states x (n, n_x): (n, n_y)."""
        return self.plant.measure(at.k * self.plant.dt, x, at.u, None, at.d)

    def predict(self, rule: str, X: Array, P: Array, at: Interval) -> tuple[Array, Array]:
        """Mean (n, N) and covariance (n, N, N) one sample later; rule is one of `gaussian.RULES`.

        The interval and the measurement may have fewer rows than X, each for equally many consecutive ones.
        """
        after, P = gaussian.predict(
            self.compiled, rule, X, P, (at.k - 1) * self.plant.dt, at.u, at.d, self.Q if self.Q.ndim == 3 else self.Q[None]
        )
        if at.stale is None:
            return after, P
        at = at.of(np.repeat(np.arange(len(at.k)), len(X) // len(at.k)))
        return after, plus_held_commands(self.plant, P, X[:, self.x], at)

    def update(self, rule: str, X: Array, P: Array, at: Interval, y: Array, seen: Array) -> gaussian.Updated:
        """Update with the measurement y (n, n_y) of the sensors that reported, seen (n, n_y)."""
        return gaussian.update(
            self.compiled, rule, X, P, at.k * self.plant.dt, at.u, at.d, y[:, self.sensors], seen[:, self.sensors],
            self.R[None],
        )  # fmt: skip


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
    H = np.ascontiguousarray(T((values[1:] - values[0]) / model.scale[:, None]))
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
        plant=plant, inputs=inputs, sensors=belief.sensors, disturbances=belief.disturbances, x=x, z=z, d=d, scale=scale,
        X0=X0, P0=P0, Q=Q, R=belief.R, limit=limit,
    )  # fmt: skip
    return model.replace(H=_linear_sensors(model))

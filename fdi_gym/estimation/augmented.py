"""Any plant as a filter sees it: state, fault and unknown disturbance in one vector X = [x; z; d].

z is the fault vector's deviation from healthy and d the disturbances that nothing measures; both are random walks. The
model is the plant's compiled one, so whatever is a plant can be filtered.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from fdi_gym.estimation import gaussian
from fdi_gym.estimation.belief import Belief, FaultInputs, fault_inputs
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

NO_TIME = np.zeros(1)  # of what is a matrix: it is the same at all times
WIDEST = 2.0  # the walk never makes a fault's standard deviation larger than this, in units of its typical size


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

    def on(self, offset: Array, direction: Array, Q: Array | None = None) -> AugmentedModel:
        """The model of other lines: offsets (r, p) and directions (r, p, f) of as many magnitudes, and Q (r, N, N)."""
        found = self.replace(lines=(offset, direction), Q=self.Q if Q is None else Q)
        bound = self.compiled
        constants = (*bound.constants[:3], contiguous(offset), contiguous(direction))
        found.__dict__["compiled"] = bound._replace(constants=constants)
        return found

    @property
    def rest(self) -> list[int]:
        """The entries of X that are not the fault vector."""
        return [*range(self.x.start, self.x.stop), *range(self.d.start, self.d.stop)]

    @functools.cached_property
    def hears_all(self) -> bool:
        """Whether it uses all sensors of the plant, in their order."""
        return self.sensors.tolist() == list(range(len(self.plant.outputs)))

    @functools.cached_property
    def compiled(self) -> gaussian.Model:
        """The model as the compiled steps take it."""
        return gaussian.bind(
            self.plant, scale=self.scale, entries=self.inputs.entries, disturbances=self.disturbances, sensors=self.sensors,
            limit=self.limit, lines=self.lines, H=self.H,
        )  # fmt: skip

    @functools.cached_property
    def noises(self) -> tuple[Array, Array]:
        """Q (1 or lines, N, N) and R (1, m, m) as the compiled steps take them."""
        return self.Q if self.Q.ndim == 3 else self.Q[None], self.R[None]

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
        model, (Q, _) = self.compiled, self.noises
        if at.Q_held is not None:  # each episode has its own, as often as it has rows
            Q = at.noise(Q, len(X))
        t = NO_TIME if model.linear.size else (at.k - 1) * self.plant.dt
        return gaussian.predict(model, rule, X, P, t, at.u, at.d, Q)

    def update(
        self, rule: str, X: Array, P: Array, at: Interval, y: Array, seen: Array, R: Array | None = None
    ) -> gaussian.Updated:
        """Update with the measurement y (n, n_y) of the sensors that reported, seen (n, n_y).

        R (r, m, m) serves the rows of X in turn. Default: the model's, for all.
        """
        if not self.hears_all:
            y, seen = y.take(self.sensors, axis=1), seen.take(self.sensors, axis=1)
        model, R = self.compiled, self.noises[1] if R is None else R
        t = NO_TIME if model.H.size else at.k * self.plant.dt
        return gaussian.update(model, rule, X, P, t, at.u, at.d, y, seen, R)


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
    if len(belief.x0) != n_x or n_z != len(inputs.names) or len(belief.m_mean) != plant.n_magnitudes:
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


def on_lines(
    base: AugmentedModel, offset: Array, direction: Array, walk: Array, size: float, entries: Array | None = None
) -> AugmentedModel:
    """The model of [x; m; d] on r lines, or planes: the fault vector is offset + direction m.

    Args:
        base: The augmented model of the plant.
        offset: (r, p) deviations from healthy.
        direction: (r, p, f).
        walk: Variance (r, f) that a sample adds to the magnitudes.
        size: Typical magnitude.
        entries: Positions of the p entries in theta. Default: those of the fault vector.

    Returns:
        The model; X0 and P0 are those of healthy flight, zero for the magnitudes.
    """
    r, _, f = direction.shape
    n_x, rest = base.x.stop, base.rest
    N = len(rest) + f
    z, d = slice(n_x, n_x + f), slice(n_x + f, N)
    keep = [*range(n_x), *range(d.start, N)]
    Q = np.zeros((r, N, N))
    Q[np.ix_(range(r), keep, keep)] = base.Q[np.ix_(rest, rest)]
    Q[:, range(z.start, z.stop), range(z.start, z.stop)] = walk
    P0 = np.zeros((N, N))
    P0[np.ix_(keep, keep)] = base.P0[np.ix_(rest, rest)]
    X0, scale = np.zeros(N), np.full(N, size)
    X0[keep], scale[keep] = base.X0[rest], base.scale[rest]
    H = None
    if entries is None and base.H is not None and not base.H[:, base.z].any():
        H = np.zeros((len(base.R), N))
        H[:, keep] = base.H[:, rest]
    inputs = base.inputs if entries is None else base.inputs._replace(entries=entries)
    model = base.replace(
        inputs=inputs, z=z, d=d, scale=scale, X0=X0, P0=P0, Q=Q, limit=np.full(N, np.inf), H=H, lines=(offset, direction)
    )
    if entries is None:
        return model
    H = _linear_sensors(model.replace(lines=(np.zeros_like(offset), np.ones_like(direction))))
    return model if H is None or H[:, z].any() else model.replace(H=H)  # on whatever line

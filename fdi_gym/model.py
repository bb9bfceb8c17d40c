"""A plant's compiled equations for many points at once: the model as filters use it, with its nominal parameters."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
FLOAT = np.dtype(float)

SENSOR_FAULTS = ("gain", "bias", "noise", "frozen", "lag", "missing")  # columns of `fdi_gym.sensors`, in order


class NotApplicableError(ValueError):
    """A method's word that it cannot run on a plant, with the reason (no unknown input, rank condition)."""


def contiguous(a: Any) -> Array:
    """As the compiled kernels take an array: float64, in C order and writable; a copy only of one that is not."""
    if type(a) is Array and a.dtype is FLOAT and a.flags.carray:
        return a
    a = np.ascontiguousarray(a, float)
    return a if a.flags.writeable else a.copy()


class Addresses(NamedTuple):
    """Where the compiled equations of a plant lie, as the closed loop calls them."""

    interval: int  # dynamics and project over a sample: `integration.interval`
    lanes: int  # the same for points side by side: `integration.lanes`
    output: int
    control: int
    known: int
    outside: int


class Model:
    """What the equations of a plant's declaration say, without noise."""

    dt: float
    substeps: int
    kernels: Any
    states: tuple[Any, ...]
    outputs: tuple[Any, ...]
    commands: tuple[Any, ...]
    theta: tuple[Any, ...]
    bare: Any
    disturbances: tuple[Any, ...]
    physical: Callable[[Mapping[str, Any]], Array]

    @functools.cached_property
    def nominal_theta(self) -> Array:
        """The healthy fault parameter (n_theta,)."""
        return np.array([s.nominal for s in self.theta])

    @functools.cached_property
    def own_theta(self) -> int:
        """How many entries of theta the equations get; the others are faults of the sensors."""
        return len(self.theta if self.bare is None else self.bare.theta)

    @functools.cached_property
    def lags(self) -> range:
        """The positions in theta of the sensors' lags; none where sensors don't fail."""
        column, n_y = SENSOR_FAULTS.index("lag"), len(self.outputs)
        first = self.own_theta + column * n_y
        return range(0) if self.bare is None else range(first, first + n_y)

    @functools.cached_property
    def nominal_p(self) -> Array:
        """The physical parameters of the model that diagnosers get."""
        return contiguous(self.physical({}))

    @functools.cached_property
    def trim_command(self) -> Array:
        """The command before the first sample (n_u,)."""
        return np.array([s.nominal for s in self.commands])

    @functools.cached_property
    def trim_state(self) -> Array:
        """The initial state where a scenario gives none (n_x,)."""
        return np.array([s.nominal for s in self.states])

    @functools.cached_property
    def addresses(self) -> Addresses:
        """Addresses of the compiled kernels, with the defaults where the plant has none.

        Raises:
            NotApplicableError: The plant declares channels, and no equations.
        """
        from fdi_gym import integration, kernels

        own = self.kernels
        if own is None:
            raise NotApplicableError("needs equations; this plant declares channels only")
        moving, (n_x, n_u, _, n_d, n_p) = (own.dynamics, own.project or kernels.project), self._widths
        interval = integration.interval(n_x, self.own_theta, *moving)
        lanes = integration.lanes(self.substeps > 0, (n_x, n_u, self.own_theta, n_d, n_p), *moving)
        others = (getattr(own, role) or getattr(kernels, role) for role in Addresses._fields[2:])
        return Addresses(*map(kernels.address, (interval, lanes, *others)))

    def tangent(self, columns: int) -> int:
        """Address of `tangent.tangent` around its kernels, for so many deviations; 0 where it says no derivatives."""
        from fdi_gym import kernels
        from fdi_gym.tangent import tangent

        own, (n_x, _, _, n_d, n_p) = self.kernels, self._widths
        if own is None or own.jacobian is None:
            return 0
        sizes = n_x, self.own_theta, n_d, n_p, columns
        return kernels.address(tangent(sizes, own.dynamics, own.jacobian, own.project))

    def _rows(self, value: Array | None, default: Array) -> Array:
        rows = default if value is None else np.asarray(value, float)
        return contiguous(rows.reshape(math.prod(rows.shape[:-1]), rows.shape[-1]))  # also of zero width

    def _rows_of(self, t: Any, x: Array, u: Array, theta: Any, d: Any, p: Any, width: int) -> tuple[Array, ...]:
        """The arguments of a generic kernel from those of `propagate`, and an array for its output."""
        points = contiguous(x.reshape(math.prod(x.shape[:-1]), x.shape[-1] if x.ndim else 1))
        rows = (
            points,
            self._rows(u, self.trim_command),
            self._rows(theta, self.nominal_theta),
            self._rows(d, np.zeros(len(self.disturbances))),
            self._rows(p, self.nominal_p),
        )
        times = contiguous(np.ravel(t))
        for name, a, n in zip(("x", "u", "theta", "d", "p"), rows, self._widths, strict=True):
            if a.shape[1] != n or (len(points) % len(a) if len(a) else len(points)):
                raise ValueError(f"{name} has {n} columns and rows that serve the {len(points)} points alike, not {a.shape}")
        if len(points) % times.size if times.size else len(points):
            raise ValueError(f"t is one number, or serves the {len(points)} points alike, not {times.size} numbers")
        own = contiguous(rows[2][:, : self.own_theta])
        return times, *rows[:2], own, *rows[3:], np.empty((len(points), width))

    @functools.cached_property
    def _widths(self) -> tuple[int, ...]:
        """Of x, u, theta, d and p."""
        vectors = (self.states, self.commands, self.theta, self.disturbances, self.nominal_p)
        return tuple(len(vector) for vector in vectors)

    def propagate(
        self, t: Any, x: Array, u: Array, theta: Array | None = None, d: Array | None = None, p: Array | None = None
    ) -> Array:
        """The state one sample after x (..., n_x), without noise, u, theta and d held: the model's prediction.

        u, theta, d and p may have fewer rows than x: row i of m then serves M/m consecutive points (sigma points of one
        episode share their command). t [s] is a number or one per such group. theta, d and the physical parameters p
        default to nominal, none and the model's.
        """
        from fdi_gym import integration

        x = np.asarray(x, float)
        rows = self._rows_of(t, x, u, theta, d, p, len(self.states))
        integration.propagate(*self.addresses[:2], self.dt, self.substeps, *rows)
        return rows[-1].reshape(x.shape)

    def measure(
        self, t: Any, x: Array, u: Array, theta: Array | None = None, d: Array | None = None, p: Array | None = None
    ) -> Array:
        """The noise-free sensor values at x (..., n_x); arguments as in `propagate`, u held up to t."""
        from fdi_gym import integration

        x = np.asarray(x, float)
        rows = self._rows_of(t, x, u, theta, d, p, len(self.outputs))
        integration.evaluate(self.addresses.output, *rows)
        y, own, n_y = rows[-1], self.own_theta, len(self.outputs)
        if theta is not None and own < len(self.theta):  # gains and biases of the sensors
            wrong = self._rows(theta, self.nominal_theta)[:, own : own + 2 * n_y]
            wrong = np.repeat(wrong, len(y) // max(len(wrong), 1), axis=0)
            y += y * wrong[:, :n_y] + wrong[:, n_y:]
        return y.reshape(*x.shape[:-1], n_y)

    def derivative(self, t: Any, x: Array, u: Array, theta: Array | None = None, d: Array | None = None) -> Array:
        """xdot at x (..., n_x); arguments as in `propagate`. For a discrete plant it is the next state."""
        from fdi_gym import integration, kernels

        x = np.asarray(x, float)
        rows = self._rows_of(t, x, u, theta, d, None, len(self.states))
        integration.evaluate(kernels.address(self.kernels.dynamics), *rows)
        return rows[-1].reshape(x.shape)

    @functools.cached_property
    def Q(self) -> Array:
        """Covariance of the process noise per step (n_x, n_x)."""
        return np.diag([s.sigma**2 for s in self.states])

    @functools.cached_property
    def R(self) -> Array:
        """Covariance of the sensor noise (n_y, n_y)."""
        return np.diag([s.sigma**2 for s in self.outputs])

"""The entries of a plant's data sheet: signals, fault modes, the labels made of them, and its compiled equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.model import Array


class Signal(NamedTuple):
    """One entry of a vector: its name, unit and range.

    Args:
        name: What it is, in the field's words.
        unit: SI or the source's unit; "" where it has none.
        low: Lower end of its range; a sensor saturates there.
        high: Upper end.
        scale: Typical size, by which learners divide.
        sigma: Standard deviation of its white noise: per sample of a sensor, per step of a state. 0 for others.
        nominal: Trim value of a command or state, healthy value of a fault parameter.
        period: Of an angle that is known up to whole turns: a turn in its unit. 0 for others.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: float = 1.0
    sigma: float = 0.0
    nominal: float = 0.0
    period: float = 0.0


class FaultMode(NamedTuple):
    """A discrete class of fault, of which the labels are made.

    Args:
        name: For example "aileron LOE".
        description: What it does to theta.
        size: Maps theta (..., n_theta) to the fault's size (...), for accuracy by severity.
        bands: Sizes below the first are "small", below the second "medium", else "large".
        offset, direction, reach: The line that the fault spans in the estimated space, as a deviation from healthy:
            offset + m direction with m in reach. A stuck surface has offset -1 in its effectiveness, direction its
            position. A fault with several magnitudes that move each for itself, such as a gain and a bias, has as many
            directions, independent ones, and ranges: ((1, 0), (0, 1)) and ((-0.5, 0.5), (-2, 2)) are a plane. Two faults
            add their deviations. A fault that is building up is on its way from healthy to there; processes other than
            "standard" may draw one that stays short of the reach, none beyond it.
    """

    name: str
    description: str
    size: Callable[[Array], Array]
    bands: tuple[float, float]
    offset: tuple[float, ...]
    direction: tuple[float, ...] | tuple[tuple[float, ...], ...]
    reach: tuple[float, float] | tuple[tuple[float, float], ...]

    @property
    def directions(self) -> Array:
        """The direction of each of its magnitudes (f, n)."""
        return np.atleast_2d(np.array(self.direction, float))

    @property
    def reaches(self) -> Array:
        """The ends of each of its magnitudes (f, 2)."""
        return np.atleast_2d(np.array(self.reach, float))

    @property
    def moves(self) -> Array:
        """Which entries of the estimated space it moves (n,) bool."""
        return np.abs(self.offset) + np.abs(self.directions).sum(axis=0) > 0


class Label(NamedTuple):
    """One answer of the isolation task: the set of fault modes that are active."""

    name: str
    modes: frozenset[str]


class Kernels(NamedTuple):
    """A plant's compiled equations; the roles and signatures are those of `fdi_gym.kernels`."""

    dynamics: Any
    output: Any
    control: Any
    known: Any = None
    project: Any = None
    outside: Any = None
    jacobian: Any = None  # without it filters take differences of the interval, several times as slow


def squared_error(scale: Sequence[float]) -> Callable[[Array], Array]:
    """The usual identification reward: minus the sum of squared errors (..., n), each divided by its scale."""
    weight = 1.0 / np.asarray(scale, float) ** 2

    def reward(error: Array) -> Array:
        return -(error**2 * weight).sum(axis=-1)  # not a matrix product: the same bits for one as for many

    return reward

"""What a filter believes of a plant before its first sample: plain data.

`fdi_gym.diagnosis.fitting` makes a belief from a plant's declaration and flights of a fault process; an author may write one
by hand. Nothing here flies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from fdi_gym.plant import Array, NotApplicableError, Plant


class Belief(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Means and covariances; all standard deviations in the units of the data sheet, walks per step.

    Args:
        x0, P0: Initial state (n_x,) and its covariance (n_x, n_x).
        Q: Process noise per step (n_x, n_x), model errors included.
        R: Noise (m, m) of the sensors that have any, model errors included.
        sensors: Which those are (m,).
        z_size: Median size of a fault while it acts, per entry of the fault vector (p,).
        z_walk: Standard deviation of the random walk that follows it (p,).
        m_mean, m_std, m_walk: The magnitudes of the fault modes along their directions while they act: mean, spread, walk
            (n_magnitudes,).
        changes: Changes of the label per sample.
        disturbances: The disturbances that occur and are not measured (q,).
        d0, d_walk: Their initial standard deviations and walks (q,).
    """

    x0: np.ndarray
    P0: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    sensors: np.ndarray
    z_size: np.ndarray
    z_walk: np.ndarray
    m_mean: np.ndarray
    m_std: np.ndarray
    m_walk: np.ndarray
    changes: float
    disturbances: np.ndarray
    d0: np.ndarray
    d_walk: np.ndarray

    def __post_init__(self) -> None:
        n, m, p, q = len(self.x0), len(self.sensors), len(self.z_size), len(self.disturbances)
        magnitudes = len(self.m_mean)
        shapes = {"P0": (n, n), "Q": (n, n), "R": (m, m), "z_walk": (p,), "m_std": (magnitudes,), "m_walk": (magnitudes,),
                  "d0": (q,), "d_walk": (q,)}  # fmt: skip
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"a belief's {name} has the shape {shape}, not {np.shape(getattr(self, name))}")
        for name in self.__struct_fields__:
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"a belief's {name} is not finite")
        for name in ("sensors", "disturbances"):  # JSON does not tell an empty list's type
            msgspec.structs.force_setattr(self, name, np.asarray(getattr(self, name), np.int64))


class FaultInputs(NamedTuple):
    """Where the fault vector z (n, p) that a filter estimates enters the plant: theta = nominal + z on `entries`."""

    names: tuple[str, ...]
    estimated: Array  # (p,) positions in plant.estimated
    entries: Array  # (p,) positions in plant.theta

    def theta(self, plant: Plant, z: Array) -> Array:
        """The fault parameter (n, n_theta) that z (n, p) stands for."""
        theta = np.tile(plant.nominal_theta, (len(z), 1))
        theta[:, self.entries] += z
        return theta


def fault_inputs(plant: Plant, channels: Sequence[str] | None = None) -> FaultInputs:
    """The fault vector of a plant: the named entries of `plant.estimated`, all of them by default.

    An estimated quantity is a theta entry of the same name, or it is the error of a command, which enters additively
    through the theta entry "offset_<name>".

    Raises:
        NotApplicableError: An unknown name, or a quantity that is neither.
    """
    asked, entries = [s.name for s in plant.estimated], [s.name for s in plant.theta]
    names = tuple(asked if channels is None else channels)
    if not names or set(names) - set(asked) or len(set(names)) < len(names):
        raise NotApplicableError(f"channels are different ones of {', '.join(asked)}, not {', '.join(names) or 'none'}")
    found = []
    for name in names:
        entry = name if name in entries else f"offset_{name}"
        if entry not in entries:
            raise NotApplicableError(f"{plant.id} has no theta entry through which {name!r} enters additively")
        found.append(entries.index(entry))
    return FaultInputs(names, np.array([asked.index(n) for n in names]), np.array(found))


def noisy_sensors(plant: Plant) -> Array:
    """The sensors that have noise (m,).

    Raises:
        NotApplicableError: None has.
    """
    sensors = np.flatnonzero([s.sigma > 0 for s in plant.outputs])
    if not sensors.size:
        raise NotApplicableError(f"needs sensor noise; {plant.id} has none with {dict(plant.options)}")
    return sensors

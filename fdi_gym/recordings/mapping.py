"""Which column of a recording is what: plain data, read strictly from a small JSON file.

    {"time": {"column": "stamp", "unit": "ms"},
     "channels": {"beta": "sideslip", "p": {"column": "roll rate", "unit": "rad/s"}, "r": {"column": "yaw", "factor": -1}},
     "commands": "u_k",
     "not_recorded": ["phi"],
     "label": {"column": "state", "names": {"0": "none", "7": "rudder stuck"}}}

A channel that is not named is looked for under its own name. A value is factor * what is recorded + offset; where a unit is
named in its place, the factor follows.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from fdi_gym.files import RefusedError, read_json

LARGEST = 2**20  # bytes of a mapping's file

Name = Annotated[str, Meta(min_length=1, max_length=200)]
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]

_UNITS = {  # of a quantity, in one of its units; temperatures also have an offset and are left to their owner
    "angle": {"rad": 1.0, "deg": math.pi / 180, "mrad": 1e-3, "rev": 2 * math.pi},
    "rate": {"rad/s": 1.0, "deg/s": math.pi / 180, "mrad/s": 1e-3, "rpm": math.pi / 30, "Hz": 2 * math.pi},
    "length": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "in": 0.0254},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "kn": 0.514444, "kt": 0.514444, "ft/s": 0.3048, "cm/s": 1e-2},
    "acceleration": {"m/s^2": 1.0, "m/s2": 1.0, "g": 9.80665, "ft/s^2": 0.3048},
    "share": {"": 1.0, "1": 1.0, "-": 1.0, "%": 0.01},
    "current": {"A": 1.0, "mA": 1e-3}, "voltage": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "bar": 1e5, "psi": 6894.757}, "area": {"m^2": 1.0, "cm^2": 1e-4},
    "flow": {"m^3/s": 1.0, "l/s": 1e-3, "l/min": 1e-3 / 60, "m^3/h": 1 / 3600},
}  # fmt: skip
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}


def factor_between(unit: str, wanted: str) -> float | None:
    """By what a value in a unit is multiplied to be one in another; None where they measure different things."""
    if unit == wanted:
        return 1.0
    for units in _UNITS.values():
        if unit in units and wanted in units:
            return units[unit] / units[wanted]
    return None


def units_beside(wanted: str) -> dict[str, float]:
    """The other units in which the same is measured, with the factor from there."""
    return {
        unit: size / units[wanted]
        for units in _UNITS.values() if wanted in units for unit, size in units.items() if size != units[wanted]
    }  # fmt: skip


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a channel's values are, and what makes them the plant's: factor * value + offset."""

    column: Name
    unit: str = ""  # in which they are recorded; instead of a factor
    factor: Number | None = None
    offset: Number = 0.0


class Time(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The column with the time: numbers in a unit, or dates with times ("2026-03-09 10:14:33")."""

    column: Name
    unit: Literal["s", "ms", "us", "ns", "min", "h"] | None = None


class Labels(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The column with the true label of the interval that ends at each row: names or indices of the plant's labels."""

    column: Name
    names: dict[str, str] = {}  # the plant's label for what stands there, where that is something else


class Onset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Columns that say of a flight when its fault began and ended, in the terms of the time column, and which it was."""

    column: Name
    end: Name | None = None
    fault: Name | None = None  # may be left out where the plant has one faulty label
    names: dict[str, str] = {}


class Mapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which column is what; see the module's docstring.

    `commands` says what a row holds: "u_k-1", the command held over the interval that has just ended, or "u_k", the one
    that was computed at that row and acts from then on.
    """

    time: Name | Time | None = None
    channels: dict[str, Name | Column] = {}
    commands: Literal["u_k-1", "u_k"] = "u_k-1"
    not_recorded: list[Name] = []
    label: Name | Labels | None = None
    onset: Name | Onset | None = None


def read_mapping(path: Path) -> Mapping:
    """A mapping from its file.

    Raises:
        RefusedError: It is no such file; the message says what is wrong where.
    """
    found = read_json(path, Mapping, "mapping", LARGEST)
    if found.label is not None and found.onset is not None:
        raise RefusedError(f"{path}: faults are given by 'label' or by 'onset', not by both")
    return found

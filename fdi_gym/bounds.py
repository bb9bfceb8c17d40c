"""Whether a plant's kernels stay within their arrays: compiled, they would read and write whatever lies beyond.

They are run as the Python that they were written as, which says where an index is out of range.
"""

from __future__ import annotations

import contextlib
import types
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from fdi_gym.model import Array
from fdi_gym.plant import Plant

_passed: weakref.WeakSet[Plant] = weakref.WeakSet()


def check_bounds(plant: Plant) -> None:
    """Run each kernel once, at rest and with arrays of the declared widths; a plant that has passed is not asked again.

    Raises:
        ValueError: A kernel reads or writes beyond an array; the message names the kernel and the widths there are.
    """
    if plant not in _passed:
        check_bounds_at(plant, 0.0, plant.trim_state, plant.trim_command, plant.nominal_theta)
        _passed.add(plant)


def check_bounds_at(plant: Plant, t: float, x: Array, u: Array, theta: Array) -> None:
    """The same at any sample: time [s], state (n_x,), command (n_u,), theta (n_theta,)."""
    widths = {
        "x": len(plant.states), "u": len(plant.commands), "theta": plant.own_theta, "d": len(plant.disturbances),
        "p": len(plant.nominal_p), "y": len(plant.outputs), "r": plant.reference_width, "q": len(plant.q),
        "c": len(plant.c0), "out": len(plant.known), "dx": len(plant.states),
    }  # fmt: skip
    values = {name: np.zeros(width) for name, width in widths.items()}
    values |= {f"J_{name}": np.zeros((widths["dx"], widths[name])) for name in ("x", "theta", "d", "p")}
    values |= {
        "x": x,
        "u": u,
        "theta": theta[: plant.own_theta],
        "p": plant.nominal_p,
        "q": np.asarray(plant.q, float),
        "c": plant.c0,
    }
    made: dict[Any, Callable[..., Any]] = {}
    # the sensors first: the controller reads what they say
    for role in ("output", "known", "control", "dynamics", "project", "outside", "jacobian"):
        kernel = getattr(plant.kernels, role)
        if kernel is None:
            continue
        names = kernel.py_func.__code__.co_varnames[: kernel.py_func.__code__.co_argcount]
        arrays = {name: np.array(values[name], float) for name in names if name != "t"}
        try:
            # anything else that Python minds and machine code does not, is none of this
            with np.errstate(all="ignore"), contextlib.suppress(ArithmeticError, ValueError, TypeError, AttributeError):
                _in_python(kernel, made)(*(np.float64(t) if name == "t" else arrays[name] for name in names))
        except IndexError as error:
            have = ", ".join(f"{name} {' by '.join(map(str, values[name].shape))}" for name in names if name != "t")
            raise ValueError(
                f"{plant.id}: the kernel {role!r} reaches beyond its arrays: {error}; it gets so many numbers in {have}"
            ) from error
        if role == "output":
            values["y"] = np.nan_to_num(arrays["y"])


def _in_python(kernel: Any, made: dict[Any, Callable[..., Any]]) -> Callable[..., Any]:
    """A kernel as plain Python, and the helpers that it calls."""
    function = kernel.py_func
    if function not in made:
        scope = dict(function.__globals__)
        cells = tuple(types.CellType(_plain(cell.cell_contents, made)) for cell in function.__closure__ or ())
        made[function] = types.FunctionType(function.__code__, scope, function.__name__, function.__defaults__, cells)
        for name in function.__code__.co_names:
            if name in scope:
                scope[name] = _plain(scope[name], made)
    return made[function]


def _plain(value: Any, made: dict[Any, Callable[..., Any]]) -> Any:
    return _in_python(value, made) if hasattr(value, "py_func") else value

"""Plain data: what JSON can say, and what it may be made of."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

MAX_DEPTH = 16  # of lists and dicts within each other

_NUMBER = Annotated[int, Meta(ge=1 - 2**63, le=2**63 - 1)] | Annotated[float, Meta(ge=-1e300, le=1e300)]
_LEAF = str | bool | None | _NUMBER
_INNER = _LEAF | list[_LEAF] | dict[str, _LEAF]

# What the usual dict holds, for msgspec to copy: no deeper than this, no numbers at the edge of what there are
UsualDict = dict[str, _LEAF | list[_INNER] | dict[str, _INNER]]


class _NotPlain(ValueError):
    """Something else; `path` leads there from where the search began."""

    path = ""

    def __init__(self, problem: str):
        super().__init__(problem)
        self.problem = problem


def plain(value: Any, where: str) -> Any:
    """A copy of what JSON can say: strings, finite numbers, booleans, None, lists and dicts of them; also from NumPy's.

    Raises:
        ValueError: Anything else; the message says where.
    """
    if type(value) is dict:
        try:
            copy = msgspec.convert(value, UsualDict)
            if copy == value:  # msgspec also makes lists of sets
                return copy
        except Exception:  # something else, which the search below names, or takes
            pass
    try:
        return _copied(value, 0)
    except _NotPlain as error:
        raise ValueError(f"{where}{error.path}: {error.problem}") from None


def _copied(value: Any, depth: int) -> Any:
    kind = type(value)
    entries: Any = value
    if kind is str or kind is bool or value is None:
        return value
    if kind is float or (kind is int and abs(value) < 2**63):
        if math.isfinite(value):
            return value
    elif kind is list and depth < MAX_DEPTH and set(map(type, value)) == {float} and math.isfinite(sum(value)):
        return value.copy()  # the usual list, quickly
    elif kind is not dict and isinstance(value, (np.generic, np.ndarray)) and value.dtype.kind in "biufU":
        return _copied(value.tolist(), depth)
    elif depth >= MAX_DEPTH:
        raise _NotPlain(f"lists and dicts within each other {MAX_DEPTH} deep at most are allowed")
    elif kind is not dict and isinstance(value, (list, tuple)):
        return [_entry(v, depth, "[{}]", i) for i, v in enumerate(value)]
    elif (kind is dict or isinstance(value, Mapping)) and all(isinstance(key, str) for key in entries):
        return {str(key): _entry(v, depth, ".{}", key) for key, v in entries.items()}
    raise _NotPlain(f"strings, finite numbers, lists and dicts of them are allowed, not {reprlib.repr(value)}")


def _entry(value: Any, depth: int, step: str, name: Any) -> Any:
    try:
        return _copied(value, depth + 1)
    except _NotPlain as error:
        error.path = step.format(name) + error.path
        raise


def of_numpy(value: Any) -> Any:
    """NumPy's numbers, strings and arrays as Python's."""
    if isinstance(value, (np.generic, np.ndarray)) and value.dtype.kind in "biufU":
        return value.tolist()
    raise TypeError(f"a scenario holds numbers, strings, lists and dicts, not {type(value).__name__}")


def value_at(message: str, data: Any) -> str:
    """What stands where a message of msgspec points, as an appendix to it."""
    path = re.search(r"at `\$(\S+)`$", message)
    try:
        for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path[1] if path else ""):
            data = data[name or int(index)]
    except (KeyError, IndexError, TypeError):
        return ""
    return f", where there is {reprlib.repr(data)}" if path else ""

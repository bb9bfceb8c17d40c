"""Plain data with arrays in it: JSON and back to an equal object, and a digest."""

from __future__ import annotations

import hashlib
from typing import Any, TypeVar

import msgspec
import numpy as np

S = TypeVar("S")
DIGITS = 9  # that are kept: another machine's last bits don't matter


def rounded(a: Any) -> Any:
    """An array, or a number, to nine significant digits."""
    a = np.asarray(a, float)
    found = np.array([float(f"{v:.{DIGITS}g}") for v in a.ravel()]).reshape(a.shape)
    return found if found.ndim else float(found)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no plain data")


def _array(kind: type, value: Any) -> Any:
    if kind is np.ndarray:
        found = np.array(value)
        if found.size and found.dtype.kind not in "if":
            raise ValueError("an array of numbers is needed")
        return found
    raise TypeError(f"{kind} is no plain data")


def to_json(value: Any) -> bytes:
    """JSON text of a msgspec Struct whose fields may be arrays."""
    return msgspec.json.encode(value, enc_hook=_plain, order="sorted")


def from_json(text: bytes | str, kind: type[S]) -> S:
    """The object that `to_json` wrote.

    Raises:
        ValueError: The text is not one; the message says where.
    """
    try:
        return msgspec.json.decode(text, type=kind, dec_hook=_array)
    except msgspec.DecodeError as error:
        raise ValueError(f"not a {kind.__name__}: {error}") from error


def digest(value: Any) -> str:
    """SHA-256 of the object's JSON."""
    return hashlib.sha256(to_json(value)).hexdigest()


def alike(one: Any, other: Any) -> bool:
    """Whether two objects are the same to rounding: their texts are, and their numbers to eight digits.

    A number in a list or table counts as much as nine digits of the largest one there: what rounding leaves of a zero
    differs from one processor, or order of the same sums, to another.
    """
    return _alike(msgspec.json.decode(to_json(one)), msgspec.json.decode(to_json(other)))


def _alike(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, list) and not _numbers(a):
        return len(a) == len(b) and all(map(_alike, a, b))
    if isinstance(a, (list, int, float)) and _numbers(b):
        x, y = np.array(a, float), np.array(b, float)
        return x.shape == y.shape and np.allclose(x, y, 1e-8, 1e-9 * abs(y).max(initial=0.0), equal_nan=True)
    return a == b


def _numbers(a: Any) -> bool:
    """A number, or a list or table of them."""
    try:
        return np.array(a, float).size >= 0
    except (TypeError, ValueError):
        return False

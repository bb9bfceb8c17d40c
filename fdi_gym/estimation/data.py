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

"""What the dicts of a scenario may hold: a plant declares it as types, and msgspec checks a scenario against them.

    class Reference(msgspec.Struct, forbid_unknown_fields=True):
        levels: Annotated[list[Finite], Meta(min_length=1)]

    Plant(..., shapes=Shapes(reference=Reference))

Numbers have bounds (`Meta(ge=..., le=...)`), which NaN and infinity don't keep; `Finite` of `fdi_gym.faults` has only
those. `Annotated` adds the length of a list, `Literal` the words that there are; what may be left out is `UNSET`.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import UNSET


class Shapes(NamedTuple):
    """The types of a scenario's dicts; None where the plant leaves it open: JSON with finite numbers."""

    reference: Any = None
    disturbance: Any = None
    physical: Any = None


OPEN = Shapes()


class Nothing(msgspec.Struct, forbid_unknown_fields=True):
    """A dict without entries."""


def check(name: str, given: Mapping[str, Any], shape: Any) -> None:
    """Raise ValueError where a dict does not have its shape; the message says where, and what the shape has."""
    try:
        msgspec.convert(given, shape)
    except msgspec.ValidationError as error:
        fields = []
        for field, kind in get_type_hints(shape).items() if isinstance(shape, type) else ():
            words = f" ({', '.join(map(str, get_args(kind)))})" if get_origin(kind) is Literal else ""
            fields.append(field + words)
        raise ValueError(f"{name}: {error}; it has {', '.join(fields) or 'no entries'}, not {reprlib.repr(given)}") from None


def together(shape: msgspec.Struct) -> None:
    """Raise ValueError where some fields are given and others not."""
    values = {name: getattr(shape, name) for name in shape.__struct_fields__}
    missing = [name for name, value in values.items() if value is UNSET]
    if 0 < len(missing) < len(values):
        raise ValueError(f"{', '.join(values)} are given together, and {', '.join(missing)} is missing")


def only_with(shape: msgspec.Struct, field: str, needs: Mapping[str, tuple[str, ...]]) -> None:
    """Raise ValueError where a choice of the field lacks what it needs, or comes with what another choice needs."""
    choice = getattr(shape, field)
    wanted = needs.get(choice, ())
    for name in {name for names in needs.values() for name in names}:
        if (getattr(shape, name) is not UNSET) != (name in wanted):
            problem = "missing" if name in wanted else "given"
            raise ValueError(f"the {field} {choice!r} goes with {' and '.join(wanted) or 'nothing'}; {name} is {problem}")

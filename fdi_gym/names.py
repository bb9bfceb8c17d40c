"""What users name: plain names, the nearest of those that exist, and objects as "module:function"."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import re
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

_PLAIN = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9_.-]{0,78}[A-Za-z0-9_-])?", re.ASCII)
_MODULE = re.compile(r"\w+(?:\.\w+)*", re.ASCII)


def unknown(kind: str, name: Any, known: Iterable[str], owner: str = "there are") -> ValueError:
    """The error for a name that does not exist: the nearest one that does, and all that `owner` ("B747Lateral has") does."""
    known = list(known)
    near = difflib.get_close_matches(name, known, 1, 0.4) if isinstance(name, str) else []
    return ValueError(
        f"unknown {kind} {name!r}; {f'did you mean {near[0]}? ' if near else ''}{owner} {', '.join(known) or 'none'}"
    )


def check_name(kind: str, name: str) -> str:
    """The name itself, if a file can be called so and no other folder is reached by it.

    Raises:
        ValueError: It cannot.
    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name) or ".." in name:
        raise ValueError(f"the name of a {kind} is made of up to 80 letters, digits, '_', '-' and '.', not {name!r}")
    return name


def check_diagnoser_name(name: str) -> str:
    """The name itself, if a diagnoser can be called so: a plain name, or "module:function".

    Raises:
        ValueError: It cannot.
    """
    if ":" in name:
        module, function = name.split(":", 1)
        if len(name) > 80 or not _MODULE.fullmatch(module) or not function.isidentifier() or not name.isascii():
            raise ValueError(f"'module:function' names something in a module by up to 80 characters, not {name!r}")
        return name
    return check_name("diagnoser", name)


def file_name(diagnoser: str) -> str:
    """How the files of a diagnoser are called, without suffix."""
    return check_diagnoser_name(diagnoser).replace(":", ".")


def blame(error: BaseException) -> str:
    """An error in somebody's code in one line: what, and where it arose."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}{place}"


def in_a_line(error: ValueError | OSError) -> str:
    """An error that a user can mend, after whose it is."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return " ".join("".join([*(f"{note}: " for note in getattr(error, "__notes__", [])), text]).split())


def find_module(name: str) -> Any:
    """A module by name, imported.

    Raises:
        ValueError: There is none, or it fails when it is imported.
    """
    if not _MODULE.fullmatch(name):
        raise ValueError(f"{name!r} is not the name of a module")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ValueError(f"cannot import {name}: {error}") from error
    except (Exception, SystemExit) as error:
        raise ValueError(f"cannot import {name}: {blame(error)}") from error


def find_function(kind: str, reference: str) -> Any:
    """The function that "module:function" names.

    Raises:
        ValueError: There is none, or its module fails when it is imported.
    """
    module, _, function = reference.partition(":")
    try:
        found = getattr(find_module(module), function, None) if function else None
    except ValueError as error:
        raise ValueError(f"no {kind} {reference!r}: {error}") from error
    if not callable(found):
        raise ValueError(f"no {kind} {reference!r}: {module} has no function {function!r}")
    return found


@contextlib.contextmanager
def blamed(what: str) -> Iterator[None]:
    """Whatever somebody's code raises in this block is a ValueError that names it; its own ValueErrors get a note.

    Args:
        what: Whose code it is: the name of a diagnoser.
    """
    try:
        yield
    except ValueError as error:
        error.add_note(what)
        raise
    except (Exception, SystemExit) as error:
        raise ValueError(f"{what} failed: {blame(error)}") from error

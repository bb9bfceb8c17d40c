"""Files: read within bounds or refused in words, written whole or not at all.

Every JSON file of the package (suites, rows, outcomes, blocks, cards) is read by `decode`, so that one that is huge,
nested without end, cut off, of another kind or not text is the same clear error everywhere.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import socket
import zlib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")
LIMIT = 64 * 2**20  # bytes of the largest file that is read
_PART = re.compile(r"^\..*\.(?P<host>[\w-]*)\.(?P<pid>\d+)\.part$")


class RefusedError(ValueError):
    """A file that is not what it should be, or does not say what the code says; the message names what differs."""


def digest(value: Any) -> str:
    """SHA-256 of the value's canonical JSON."""
    return hashlib.sha256(msgspec.json.encode(value, order="sorted")).hexdigest()


def read_bytes(path: Path, limit: int = LIMIT) -> bytes:
    """The content of a regular file.

    Raises:
        RefusedError: There is none, or it is larger than `limit` bytes.
        OSError: It cannot be read.
    """
    if not path.is_file():  # a pipe or a device would be read for ever
        raise RefusedError(f"{path} is no file")
    with path.open("rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise RefusedError(f"{path} is larger than {limit} bytes")
    return content


def decode(content: bytes | str, kind: type[T], what: str) -> T:
    """JSON text as a value of a type.

    Args:
        content: The text.
        kind: The type: a msgspec.Struct, or any that msgspec takes.
        what: What it should be, for the message: "runs/x.json is not a suite".

    Raises:
        RefusedError: It is not; the message says where.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, UnicodeEncodeError) as error:
        raise RefusedError(f"{what}: {error}") from None
    except RecursionError:
        raise RefusedError(f"{what}: it is nested too deeply") from None


def read_json(path: Path, kind: type[T], what: str, limit: int = LIMIT) -> T:
    """A JSON file as a value of a type; `what` is the noun for the message ("suite").

    Raises:
        RefusedError: It is no such file.
    """
    return decode(read_bytes(path, limit), kind, f"{path} is not a {what}")


def make_room(path: Path) -> None:
    """Make the folder that a file will go into, before anything is computed for it.

    Raises:
        OSError: It cannot be made, or there is a folder where the file would be.
    """
    if path.is_dir():
        raise OSError(errno.EISDIR, f"cannot write {path}: it is a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(error.errno, f"cannot write {path}: {os.strerror(error.errno or 0)}") from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is either there whole or not there.

    Raises:
        OSError: It cannot be written, for example because the disk is full, or something that is no file has that name;
            nothing is left behind.
    """
    if path.exists() and not path.is_file():  # a device or a pipe would be replaced
        raise OSError(errno.EINVAL, f"cannot write {path}: it is no file")
    part = path.with_name(f".{path.name}.{socket.gethostname().replace('.', '-')}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"cannot write {path}: {os.strerror(error.errno or 0)}") from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()  # there only after an error or an interruption


def pretty(value: Any) -> bytes:
    """A value as indented JSON, the one way in which files of ours are written."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"


def sweep(folder: Path) -> None:
    """Remove what processes of this machine that were killed left half written in a folder and those below it."""
    for path in folder.rglob(".*.part"):
        found = _PART.match(path.name)
        if found and found["host"] == socket.gethostname().replace(".", "-") and not _alive(int(found["pid"])):
            path.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True  # somebody else's
    return True


def compress(content: bytes) -> bytes:
    """The content as a gzip file without name and time: the same bytes at every call."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return packer.compress(content) + packer.flush()


def decompress(content: bytes, what: str, limit: int = LIMIT) -> bytes:
    """What `compress` compressed.

    Raises:
        RefusedError: It is no gzip file, is cut off or goes on after its end, or holds more than `limit` bytes.
    """
    unpacker = zlib.decompressobj(31)
    try:
        found = unpacker.decompress(content, limit + 1)
    except zlib.error as error:
        raise RefusedError(f"{what}: it is not a gzip file: {error}") from None
    if len(found) > limit:
        raise RefusedError(f"{what}: it holds more than {limit} bytes")
    if not unpacker.eof or unpacker.unused_data:
        raise RefusedError(f"{what}: it {'goes on after its end' if unpacker.eof else 'is cut off'}")
    return found

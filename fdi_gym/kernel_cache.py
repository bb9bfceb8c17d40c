"""Where compiled kernels are kept on disk, and the names by which their machine code is found.

The cache lies in the user's cache folder (or `FDI_GYM_CACHE_DIR`) under a hash of the file that defines the kernel and
of the files of the package that it imports, so that no edit is ever answered by old code. A damaged file there is an
absent one, and where nothing can be written, everything is compiled in each process.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import platformdirs
from numba.core import caching
from numba.core.serialize import dumps


@functools.cache
def sources(path: Path) -> tuple[Path, ...]:
    """A source file and those of the package that it imports, directly or not: what its kernels can depend on."""
    found, todo = set(), [path.resolve()]
    while todo:
        here = todo.pop()
        if here not in found:
            found.add(here)
            todo += _imported(here)
    return tuple(sorted(found))


# An import of the package and what it names; in a docstring it only makes one file more to watch
_IMPORT = re.compile(
    r"(?:^|[:;])[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|.*)|import[ \t]+(.*))", re.MULTILINE
)


@functools.cache
def _imported(path: Path) -> tuple[Path, ...]:
    """The files of the package that a source file imports. By its lines: its syntax tree would take 40 ms of each start."""
    root, files = Path(__file__).resolve().parent, set()
    for module, names, modules in _IMPORT.findall(path.read_text(encoding="utf-8")):
        found = (
            [module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))]
            if module
            else re.findall(r"[\w.]+", modules)
        )
        for name in found:
            package, *rest = name.split(".")
            if package == root.name and (file := root.joinpath(*rest).with_suffix(".py")).is_file():
                files.add(file)
    return tuple(files)


@functools.cache
def cache_folder(source: str) -> Path | None:
    """The cache folder that belongs to these sources; None where there can be none."""
    if not Path(source).is_file():
        return None
    digest = hashlib.sha256()
    for path in sources(Path(source)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    base = Path(os.environ.get("FDI_GYM_CACHE_DIR") or platformdirs.user_cache_path("fdi_gym"))
    folder = base / f"{Path(source).stem}-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


class CacheFile(caching.IndexDataCacheFile):
    """Data files that begin with the digest of what they hold: machine code is not loaded from a damaged one."""

    def _dump(self, obj: Any) -> bytes:
        data = super()._dump(obj)
        return hashlib.sha256(data).digest() + data

    def _undamaged(self, path: str) -> bytes:
        data = Path(path).read_bytes()
        if hashlib.sha256(data[32:]).digest() != data[:32]:
            raise ValueError(f"{path} is damaged")
        return data[32:]

    def _load_data(self, name: str) -> Any:
        return pickle.loads(self._undamaged(self._data_path(name)))

    def _save_index(self, overloads: Any) -> None:
        with self._open_for_write(self._index_path) as file:
            file.write(self._dump((self._version, self._source_stamp, overloads)))

    def _load_index(self) -> Any:
        if not Path(self._index_path).is_file():
            return {}
        version, stamp, overloads = pickle.loads(self._undamaged(self._index_path))
        return overloads if (version, stamp) == (self._version, self._source_stamp) else {}


class Cache(caching.FunctionCache):
    """numba's cache of a function, in which a damaged file is an absent one and a full or locked disk costs time only."""

    def __init__(self, function: Any, inside: tuple[Any, ...] = ()):
        super().__init__(function)
        self._inside, file = inside, self._cache_file
        self._cache_file = CacheFile(file._cache_path, file._index_name.removesuffix(".nbi"), file._source_stamp)

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        known = sig, codegen.magic_tuple(), self._py_func.__qualname__
        return known if self._inside else super()._index_key(sig, codegen)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As numba's, but None for whatever is damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling finds in bytes that nobody wrote
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """As numba's; nothing happens where nothing can be written."""
        try:
            try:
                super().save_overload(sig, data)
            except ValueError:  # the index is damaged: begin a new one
                self._cache_file.flush()
                super().save_overload(sig, data)
        except OSError:
            pass


_uncached = itertools.count()


def name_around(make: Callable[..., Any], *kernels: Any) -> str:
    """A name that nothing else has for what `make` writes around kernels: by it the machine code is found."""
    if not all(isinstance(k._cache, Cache) for k in kernels):
        return f"uncached{next(_uncached)}"
    known = hashlib.sha256()
    for path in (make.__code__.co_filename, *(k.py_func.__code__.co_filename for k in kernels)):
        known.update(str(cache_folder(path)).encode())
    for k in kernels:
        f = k.py_func
        known.update(f.__qualname__.encode() + f.__code__.co_code)
        known.update(dumps(tuple(cell.cell_contents for cell in f.__closure__ or ())))
    return known.hexdigest()[:16]

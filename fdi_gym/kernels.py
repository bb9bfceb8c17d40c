"""How equations become compiled functions, and how the generic kernels call those of any plant.

A plant file writes its equations as plain functions and marks them with `kernel`. The parameter names say which
role a function has, and the role fixes its compiled signature:

    dynamics(t, x, u, theta, d, p, dx)   xdot, or for a discrete plant (`substeps=0`) the next state
    output(t, x, u, theta, d, p, y)      noise-free sensor values; u is the command held up to t
    control(t, y, r, q, c, u)            the command u from the measurement y; updates the controller state c
    known(t, r, c, out)                  what else the flight computer knows at t, before it computes the command
    project(x, theta)                    puts the state back on its manifold after a step (unit quaternion, jammed fin)
    outside(t, x, r)                     True where the flight ends: validity of the model or loss of control

with t the time [s], x the state, theta the fault parameter, d the disturbance, p the physical parameters, r the row
of exogenous references, q the controller's parameters. A function with any other parameters is a helper that the
file's kernels may call. A kernel must not call a kernel of another file, which is what keeps numba's disk cache valid:
the generic kernels (`integration.py`, `closed_loop.py`) get the addresses of the plant's compiled functions (`address`)
and call through them. So they are compiled once for all plants, and nothing is compiled to bring the two together.

The cache lies in the user's cache folder (or `FDI_GYM_CACHE_DIR`) under a hash of the file that defines the kernel and
of the files of the package that it imports, so that no edit is ever answered by old code. A damaged file there is an
absent one, and where nothing can be written, everything is compiled in each process.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import inspect
import os
import pickle
import re
import sys
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numba
import platformdirs
from numba import boolean, float64, int64, types, void
from numba.core import caching, cgutils, config
from numba.extending import intrinsic

V, M = float64[::1], float64[:, ::1]

_MAP = void(float64, V, V, V, V, V, V)
_CONTROL = void(float64, V, V, V, V, V)
_KNOWN = void(float64, V, V, V)
_PROJECT = void(V, V)
_OUTSIDE = boolean(float64, V, V)
_ROLES = {
    ("t", "x", "u", "theta", "d", "p", "dx"): _MAP,
    ("t", "x", "u", "theta", "d", "p", "y"): _MAP,
    ("t", "y", "r", "q", "c", "u"): _CONTROL,
    ("t", "r", "c", "out"): _KNOWN,
    ("x", "theta"): _PROJECT,
    ("t", "x", "r"): _OUTSIDE,
}


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


njit: Any = numba.njit  # what only kernels call needs no way in from Python or C, slow to compile: `helper`
helper = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)

_signatures: dict[Any, Any] = {}  # of the kernels, compiled when they are first needed
_announced: set[str] = set()  # source files whose cold compilation has been announced
_compiling = threading.RLock()


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


class _CacheFile(caching.IndexDataCacheFile):
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


class _Cache(caching.FunctionCache):
    """numba's cache of a function, in which a damaged file is an absent one and a full or locked disk costs time only."""

    def __init__(self, function: Any):
        super().__init__(function)
        file = self._cache_file
        self._cache_file = _CacheFile(file._cache_path, file._index_name.removesuffix(".nbi"), file._source_stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling finds in bytes that nobody wrote
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            try:
                super().save_overload(sig, data)
            except ValueError:  # the index is damaged: begin a new one
                self._cache_file.flush()
                super().save_overload(sig, data)
        except OSError:
            pass


def _lazily(function: Callable[..., Any], signature: Any) -> Any:
    """The function as numba's dispatcher, cached in the folder of its sources; nothing is compiled yet."""
    folder = cache_folder(function.__code__.co_filename)
    dispatcher = njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)(function)
    if folder is not None:
        settings: Any = config
        before = settings.CACHE_DIR
        settings.CACHE_DIR = str(folder)
        try:
            dispatcher._cache = _Cache(function)  # type: ignore[attr-defined]
        except (RuntimeError, OSError):  # numba finds no place for it
            pass
        finally:
            settings.CACHE_DIR = before
    _signatures[dispatcher] = signature
    return dispatcher


def load(dispatcher: Any) -> Any:
    """The dispatcher, compiled for its role's signature or loaded from the cache."""
    if dispatcher.overloads:
        return dispatcher
    with _compiling:
        if not dispatcher.overloads:
            source = dispatcher.py_func.__code__.co_filename
            folder = cache_folder(source)
            if source not in _announced and not (folder and any(folder.rglob("*.nbi"))):
                print(f"fdi_gym: compiling {Path(source).stem} (once; kept in {folder})", file=sys.stderr, flush=True)
            _announced.add(source)
            dispatcher.compile(_signatures[dispatcher])
            dispatcher.disable_compile()  # other types are an error, not another compilation
    return dispatcher


def uncompiled(modules: Collection[str]) -> list[Any]:
    """The kernels of these modules, as far as they are imported, that the cache should have and does not have yet."""
    found = [d for d in _signatures if d.py_func.__module__ in modules and not d.overloads and isinstance(d._cache, _Cache)]
    return [d for d in found if not Path(d._cache._cache_file._index_path).is_file()]


def kernel(function: Callable[..., Any]) -> Any:
    """Make a plant's function a kernel of the role that its parameter names declare (see the module's docstring)."""
    role = _ROLES.get(tuple(inspect.signature(function).parameters))
    if role is None:
        return numba.njit(error_model="numpy")(function)
    return _lazily(function, role)


def compiled(signature: Any) -> Callable[[Any], Any]:
    """Make a generic kernel: compiled for this signature at its first call, cached; it runs without the GIL."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = _lazily(function, signature)
        dispatcher._compile_for_args = lambda *_: load(dispatcher)  # numba asks this where nothing fits, and calls it
        return dispatcher

    return decorate


class Sent:
    """A kernel under way to another process: by its name where it has one, else by its source; compiled there."""

    def __init__(self, dispatcher: Any):
        self.dispatcher = dispatcher

    def __reduce__(self) -> tuple[Any, ...]:
        function = self.dispatcher.py_func
        if getattr(sys.modules.get(function.__module__), function.__name__, None) is self.dispatcher:
            return _arrived, (function.__module__, function.__name__)
        return kernel, (function,)


def _arrived(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


# ---------------------------------------------------------------------------------------------------------------
# Plant functions as numbers


def address(dispatcher: Any) -> int:
    """The address of a kernel, compiled if need be, by which the generic kernels call it. Valid as long as it lives."""
    (result,) = load(dispatcher).overloads.values()
    return result.library.get_pointer_to_function(result.fndesc.llvm_func_name)


def _function_at(signature: Any) -> Any:
    """An intrinsic that makes numba's first-class function of this signature from an address."""
    function_type = types.FunctionType(signature)

    @intrinsic
    def function_at(typing_context, where):
        def codegen(context, builder, _, arguments):
            function = cgutils.create_struct_proxy(function_type)(context, builder)
            function.jit_addr = builder.inttoptr(arguments[0], cgutils.voidptr_t)
            function.c_addr = function.py_addr = cgutils.get_null_value(cgutils.voidptr_t)
            return function._getvalue()

        return function_type(int64), codegen

    return function_at


map_at, control_at, known_at = _function_at(_MAP), _function_at(_CONTROL), _function_at(_KNOWN)
project_at, outside_at = _function_at(_PROJECT), _function_at(_OUTSIDE)


# ---------------------------------------------------------------------------------------------------------------
# What a plant need not write


@kernel
def known(t, r, c, out):
    """Nothing else is known: the default of a plant without known signals."""


@kernel
def project(x, theta):
    """The state space is flat: the default of a plant without a manifold."""


@kernel
def outside(t, x, r):
    """The model holds everywhere: the default of a plant without a termination rule."""
    return False

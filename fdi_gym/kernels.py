"""How equations become compiled functions, and how the generic kernels call those of any plant.

A plant file writes its equations as plain functions and marks them with `kernel`. The parameter names say which
role a function has, and the role fixes its compiled signature:

    dynamics(t, x, u, theta, d, p, dx)   xdot, or for a discrete plant (`substeps=0`) the next state
    output(t, x, u, theta, d, p, y)      noise-free sensor values; u is the command held up to t
    control(t, y, r, q, c, u)            the command u from the measurement y; updates the controller state c
    known(t, r, c, out)                  what else the flight computer knows at t, before it computes the command
    project(x, theta)                    puts the state back on its manifold after a step (unit quaternion, jammed fin)
    outside(t, x, r)                     True where the flight ends: validity of the model or loss of control
    jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p)
                                         partial derivatives of dx by x, theta, d and p, rows as in dx; they come zeroed

with t the time [s], x the state, theta the fault parameter, d the disturbance, p the physical parameters, r the row
of exogenous references, q the controller's parameters. A function with any other parameters is a helper that the
file's kernels may call, as they may `sincos` of `trigonometry.py`. A kernel must not call a kernel of another plant,
which is what keeps numba's disk cache valid: the generic kernels (`closed_loop.py`, the filters') get the addresses of the
plant's compiled functions (`address`) and call through them. So they are compiled once for all plants. What is called most,
a sample interval of `integration.py`, is compiled anew around each plant's equations (`around`).

`kernel_cache.py` says where the compiled code is kept.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import sys
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba import boolean, float64, int64, types, uint64, void
from numba.core import cgutils, config
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from fdi_gym.kernel_cache import Cache, cache_folder, name_around

V, M = float64[::1], float64[:, ::1]

_MAP = void(float64, V, V, V, V, V, V)
_CONTROL = void(float64, V, V, V, V, V)
_KNOWN = void(float64, V, V, V)
_PROJECT = void(V, V)
_OUTSIDE = boolean(float64, V, V)
_JACOBIAN = void(float64, V, V, V, V, V, M, M, M, M)
_ROLES = {
    ("t", "x", "u", "theta", "d", "p", "dx"): _MAP,
    ("t", "x", "u", "theta", "d", "p", "y"): _MAP,
    ("t", "y", "r", "q", "c", "u"): _CONTROL,
    ("t", "r", "c", "out"): _KNOWN,
    ("x", "theta"): _PROJECT,
    ("t", "x", "r"): _OUTSIDE,
    ("t", "x", "u", "theta", "d", "p", "J_x", "J_theta", "J_d", "J_p"): _JACOBIAN,
}


LINE = 64  # bytes, of the cache: no vector on the stack lies in two
_carray: Any = numba.carray  # type: ignore[attr-defined]  # the array at a pointer
njit: Any = numba.njit
# What only generic kernels call: no way in from Python or C, slow to compile, and, as these themselves, no array of its own
# but on the stack (`floats`, `ints`, `bools`): to count who refers to an array costs more than to look into it
helper = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
inlined = njit(error_model="numpy", inline="always")  # becomes a part of its caller: it may make what that works with
inside = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True)  # an author's own


@helper
def put(values, into):
    """Put values (n,) into the first entries of a vector."""
    for i in range(values.size):
        into[i] = values[i]


_signatures: dict[Any, Any] = {}  # of the kernels, compiled when they are first needed
_announced: set[str] = set()  # source files whose cold compilation has been announced
_compiling = threading.RLock()


def _lazily(function: Callable[..., Any], signature: Any, within: tuple[Any, ...] = (), heap: bool = True) -> Any:
    """The function as numba's dispatcher, cached in the folder of its sources; nothing is compiled yet.

    `within`: kernels of a plant that are compiled into it. It then lies with the first of them.
    """
    folder = cache_folder((within[0].py_func if within else function).__code__.co_filename)
    if not all(isinstance(k._cache, Cache) for k in within):
        folder = None
    dispatcher = njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True, _nrt=heap)(function)
    if folder is not None:
        settings: Any = config
        before = settings.CACHE_DIR
        settings.CACHE_DIR = str(folder)
        try:
            dispatcher._cache = Cache(function, within)  # type: ignore[attr-defined]
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
            home = next(iter(getattr(dispatcher._cache, "_inside", ())), dispatcher)
            source = home.py_func.__code__.co_filename
            folder = cache_folder(source)
            if source not in _announced and not (folder and any(folder.rglob("*.nbi"))):
                print(f"fdi_gym: compiling {Path(source).stem} (once; kept in {folder})", file=sys.stderr, flush=True)
            _announced.add(source)
            dispatcher.compile(_signatures[dispatcher])
            dispatcher.disable_compile()  # other types are an error, not another compilation
    return dispatcher


def uncompiled(modules: Collection[str]) -> list[Any]:
    """The kernels of these modules, as far as they are imported, that the cache should have and does not have yet."""
    own = [d for d in _signatures if d.py_func.__module__ in modules and d.py_func.__closure__ is None]
    found = [d for d in own if not d.overloads and isinstance(d._cache, Cache)]
    return [d for d in found if not Path(d._cache._cache_file._index_path).is_file()]


def kernel(function: Callable[..., Any]) -> Any:
    """Make a plant's function a kernel of the role that its parameter names declare (see the module's docstring)."""
    role = _ROLES.get(tuple(inspect.signature(function).parameters))
    if role is None:
        return numba.njit(error_model="numpy")(function)
    return _lazily(function, role)


def compiled(signature: Any, heap: bool = False) -> Callable[[Any], Any]:
    """Make a generic kernel: compiled for this signature at its first call, cached; it runs without the GIL.

    `heap`: it makes arrays, or calls of NumPy what does.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = _lazily(function, signature, heap=heap)
        dispatcher._compile_for_args = lambda *_: load(dispatcher)  # numba asks this where nothing fits, and calls it
        return dispatcher

    return decorate


@functools.cache
def around(make: Callable[..., Any], signature: Any, *kernels: Any, sizes: tuple[int, ...] = ()) -> Any:
    """The function that `make` writes around a plant's kernels, compiled with them inside it; cached with the first one.

    `sizes`, if any, come first in what `make` gets; it may compile them in.
    """
    function = make(*((sizes,) if sizes else ()), *(inside(k.py_func) for k in kernels))
    function.__qualname__ = "_".join([function.__name__, *map(str, sizes), name_around(make, *kernels)])
    return _lazily(function, signature, kernels)


def stack(*shape: int) -> Any:
    """A function that gives a float64 array of this shape on the stack, uninitialised; it lives as long as its caller."""
    size = max(math.prod(shape), 1)

    def _room_at(typing_context):
        def codegen(context, builder, signature, arguments):
            room = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), size))
            room.align = LINE
            return builder.bitcast(room, context.get_value_type(signature.return_type))

        return types.CPointer(float64)(), codegen

    _room: Any = intrinsic(_room_at)

    @inside
    def array():
        return _carray(_room(), shape)

    return array


def _array(dtype: Any, given: bool) -> Any:
    """An intrinsic that makes an array that nobody counts: at an address, or uninitialised on its caller's stack.

    On the stack it lives as long as its caller, who must not ask for it in a loop.
    """

    def typed(shape: Any) -> tuple[Any, Any]:
        many = isinstance(shape, types.BaseTuple)
        extents = types.UniTuple(types.intp, len(shape)) if many else types.intp
        return types.Array(dtype, len(shape) if many else 1, "C"), extents

    def made(context, builder, kind, extents, shape, address):
        shape = [shape] if extents is types.intp else list(cgutils.unpack_tuple(builder, shape))
        item = context.get_data_type(dtype)
        size = context.get_constant(types.intp, context.get_abi_sizeof(item))
        strides, count = [size], shape[0]
        for extent in shape[:0:-1]:
            strides.insert(0, builder.mul(strides[0], extent))
        for extent in shape[1:]:
            count = builder.mul(count, extent)
        if address is None:
            data = builder.alloca(item, count)
            data.align = LINE
        else:
            data = builder.inttoptr(address, item.as_pointer())
        array = context.make_array(kind)(context, builder)
        populate_array(array, data=data, shape=shape, strides=strides, itemsize=size, meminfo=None)
        return array._getvalue()

    @intrinsic
    def array_at(typing_context, address, shape):
        kind, extents = typed(shape)
        return kind(types.intp, extents), lambda c, b, _, args: made(c, b, kind, extents, args[1], args[0])

    @intrinsic
    def array(typing_context, shape):
        kind, extents = typed(shape)
        return kind(extents), lambda c, b, _, args: made(c, b, kind, extents, args[0], None)

    return array_at if given else array


floats, ints, words, bools = (_array(dtype, False) for dtype in (float64, int64, uint64, boolean))
floats_at = _array(float64, True)


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
# Kernels as numbers


def signature_of(dispatcher: Any) -> Any:
    """What a kernel takes."""
    return _signatures[dispatcher]


@functools.cache
def address(dispatcher: Any) -> int:
    """The address of a kernel, compiled if need be, by which the generic kernels call it."""
    (result,) = load(dispatcher).overloads.values()
    return result.library.get_pointer_to_function(result.fndesc.llvm_func_name)


def function_at(signature: Any) -> Any:
    """An intrinsic that makes numba's first-class function of this signature from an address."""
    function_type = types.FunctionType(signature)

    @intrinsic
    def _at(typing_context, where):
        def codegen(context, builder, _, arguments):
            function = cgutils.create_struct_proxy(function_type)(context, builder)
            function.jit_addr = builder.inttoptr(arguments[0], cgutils.voidptr_t)
            function.c_addr = function.py_addr = cgutils.get_null_value(cgutils.voidptr_t)
            return function._getvalue()

        return function_type(int64), codegen

    return _at


map_at, control_at, known_at = function_at(_MAP), function_at(_CONTROL), function_at(_KNOWN)
outside_at = function_at(_OUTSIDE)


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

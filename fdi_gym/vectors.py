"""Several numbers at a time, for compiled kernels whose inner loops run along rows of matrices.

LLVM unrolls short loops before it looks for vectors, and then makes none; so this says them. Each lane is computed as the
scalar would be: no sum is over lanes, nothing is contracted, and the numbers are the same on every processor.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba import boolean, intp
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

from fdi_gym.integration import LANES
from fdi_gym.kernels import helper


class Lanes(types.Type):
    """The type of a vector of so many numbers."""

    def __init__(self, count: int):
        self.count = count
        super().__init__(name=f"Lanes({count})")


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, fe_type):
        super().__init__(manager, fe_type, ir.VectorType(ir.DoubleType(), fe_type.count))


class Vectors(NamedTuple):
    """Vectors of so many numbers, in memory and out of it."""

    zeros: Any  # zeros(): a vector of zeros
    load: Any  # load(A, i, j): A[i, j : j + count]
    store: Any  # store(A, i, j, v): A[i, j : j + count] = v


@functools.cache
def vectors(count: int) -> Vectors:
    """Functions on vectors of so many numbers."""
    lanes: Any = Lanes(count)
    shape = ir.VectorType(ir.DoubleType(), count)

    def at(context, builder, kind, array, i, j):
        room = context.make_array(kind)(context, builder, array)
        return builder.bitcast(cgutils.get_item_pointer(context, builder, kind, room, [i, j]), shape.as_pointer())

    def _zeros(typing_context):
        return lanes(), lambda context, builder, signature, given: ir.Constant(shape, None)

    def _load(typing_context, A, i, j):
        def codegen(context, builder, signature, given):
            return builder.load(at(context, builder, signature.args[0], *given), align=8)

        return lanes(A, intp, intp), codegen

    def _store(typing_context, A, i, j, v):
        def codegen(context, builder, signature, given):
            builder.store(given[3], at(context, builder, signature.args[0], *given[:3]), align=8)
            return context.get_dummy_value()

        return types.void(A, intp, intp, lanes), codegen

    return Vectors(*(intrinsic(make) for make in (_zeros, _load, _store)))


zeros, load, store = vectors(LANES)


# ---------------------------------------------------------------------------------------------------------------
# A vector in place of a number: + - * / of vectors, and of vectors and numbers


def _spread(builder: Any, kind: Any, value: Any, count: int) -> Any:
    """A number in all lanes; a vector as it is."""
    if isinstance(kind, Lanes):
        return value
    one = builder.insert_element(
        ir.Constant(ir.VectorType(ir.DoubleType(), count), ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
    )
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), count), None))


def _lanes_of(*kinds: Any) -> Any:
    """The type of the vector among these, where they are vectors and real numbers."""
    found = [kind for kind in kinds if isinstance(kind, Lanes)]
    return found[0] if found and all(isinstance(kind, (Lanes, types.Float)) for kind in kinds) else None


def _operation(build: Callable[..., Any]) -> Any:
    """An intrinsic of two or more vectors or numbers; build(builder, *vectors) makes its value."""

    def made(typing_context, given):
        lanes = _lanes_of(*given)
        if lanes is None:
            return None

        def codegen(context, builder, signature, values):
            parts = cgutils.unpack_tuple(builder, values[0])
            return build(
                builder,
                *(_spread(builder, kind, part, lanes.count) for kind, part in zip(given, parts, strict=True)),
            )

        return lanes(given), codegen

    return intrinsic(made)


_ADD = _operation(lambda builder, v, w: builder.fadd(v, w))
_SUBTRACT = _operation(lambda builder, v, w: builder.fsub(v, w))
_MULTIPLY = _operation(lambda builder, v, w: builder.fmul(v, w))
_DIVIDE = _operation(lambda builder, v, w: builder.fdiv(v, w))
_CHOOSE = _operation(lambda builder, c, v, w: builder.select(builder.fcmp_ordered(">", c, ir.Constant(c.type, None)), v, w))


def _overloaded(symbol: Any, operation: Any) -> None:
    @overload(symbol)
    def of_vectors(v, w):
        if _lanes_of(v, w) is not None:
            return lambda v, w: operation((v, w))
        return None


for _symbol, _made in (
    (operator.add, _ADD), (operator.sub, _SUBTRACT), (operator.mul, _MULTIPLY), (operator.truediv, _DIVIDE),
):  # fmt: skip
    _overloaded(_symbol, _made)
    _overloaded(getattr(operator, f"i{_symbol.__name__}"), _made)


@helper
def choose(c, v, w):
    """v where c > 0, else w, also where c is no number; each a vector or a number, one of them a vector."""
    return _CHOOSE((c, v, w))


def _root(typing_context, v):
    def codegen(context, builder, signature, given):
        (vector,) = given
        kind = ir.FunctionType(vector.type, [vector.type])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{v.count}f64"), [vector])

    return (v(v), codegen) if isinstance(v, Lanes) else None


def _any_lane(comparison: str, ordered: bool) -> Any:
    def made(typing_context, v):
        def codegen(context, builder, signature, given):
            (vector,) = given
            compare = builder.fcmp_ordered if ordered else builder.fcmp_unordered
            which = compare(comparison, vector, ir.Constant(vector.type, None))
            bits = builder.bitcast(which, ir.IntType(v.count))
            return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

        return (boolean(v), codegen) if isinstance(v, Lanes) else None

    return intrinsic(made)


root: Any = intrinsic(_root)  # root(v): the square roots
above = _any_lane(">", ordered=True)  # above(v): any lane is above 0
filled = _any_lane("!=", ordered=False)  # filled(v): any lane is not 0

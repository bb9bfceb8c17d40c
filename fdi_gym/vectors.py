"""Several numbers at a time, for compiled kernels whose inner loops run along rows of matrices.

LLVM unrolls short loops before it looks for vectors, and then makes none; so this says them. Each lane is computed as the
scalar would be: no sum is over lanes, nothing is contracted, and the numbers are the same on every processor.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

from llvmlite import ir
from numba import float64, intp
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

from fdi_gym.integration import LANES
from fdi_gym.kernels import helper


@helper
def width(columns):
    """So many columns, in whole vectors of LANES."""
    return (columns + LANES - 1) // LANES * LANES


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
    """What kernels may do with vectors of so many numbers; each is rounded as the scalar's would be."""

    zeros: Any  # zeros(): a vector of zeros
    load: Any  # load(A, i, j): A[i, j : j + count]
    store: Any  # store(A, i, j, v): A[i, j : j + count] = v
    plus: Any  # plus(v, a, w): v + a w
    minus: Any  # minus(v, a, w): v - a w
    over: Any  # over(v, a): v / a


@functools.cache
def vectors(count: int) -> Vectors:
    """Functions on vectors of so many numbers."""
    lanes: Any = Lanes(count)
    shape = ir.VectorType(ir.DoubleType(), count)

    def at(context, builder, kind, array, i, j):
        room = context.make_array(kind)(context, builder, array)
        return builder.bitcast(cgutils.get_item_pointer(context, builder, kind, room, [i, j]), shape.as_pointer())

    def splat(builder, scalar):
        one = builder.insert_element(ir.Constant(shape, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), count), None))

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

    def _plus(typing_context, v, a, w):
        def codegen(context, builder, signature, given):
            return builder.fadd(given[0], builder.fmul(splat(builder, given[1]), given[2]))

        return lanes(lanes, float64, lanes), codegen

    def _minus(typing_context, v, a, w):
        def codegen(context, builder, signature, given):
            return builder.fsub(given[0], builder.fmul(splat(builder, given[1]), given[2]))

        return lanes(lanes, float64, lanes), codegen

    def _over(typing_context, v, a):
        def codegen(context, builder, signature, given):
            return builder.fdiv(given[0], splat(builder, given[1]))

        return lanes(lanes, float64), codegen

    return Vectors(*(intrinsic(make) for make in (_zeros, _load, _store, _plus, _minus, _over)))


zeros, load, store, plus, minus, over = vectors(LANES)

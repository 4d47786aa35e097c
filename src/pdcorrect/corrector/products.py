"""Products of tall and narrow matrices in compiled loops, whose sums stay in registers.

What BLAS does, for callers that are in a parallel loop already, where OpenBLAS may not be
asked.  A factor is stored in strips of 16 columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from pdcorrect.fem.decomposition import OPTIONS

Array = NDArray[Any]

parts: Any = cgutils

STRIP = 16
"""Columns whose sums are in registers together: one of AVX-512 in single precision."""
ROWS = 8
"""Rows of them: enough sums under way to hide how long a fused multiply-add takes."""


def filled_up(count: int, to: int = STRIP) -> int:
    """The next multiple of ``to``."""
    return -(-count // to) * to


def strips(matrix: Array) -> Array:
    """A factor (a, b) as strips (b / 16, a, 16); b is a multiple of 16."""
    return np.ascontiguousarray(matrix.reshape(len(matrix), -1, STRIP).transpose(1, 0, 2))


@njit(**OPTIONS)
def product(x, factor, bias, least, out):  # type: ignore[no-untyped-def]
    """The larger of ``least`` and x factor + bias.

    A ``least`` of 0 is ReLU, minus infinity leaves all as it is; what is not a number stays so.

    Parameters
    ----------
    x : (m, a or more)
        m is a multiple of 8.
    factor : (b / 16, a, 16)
        See `strips`.
    bias : (b,)
    out : (m, b or more)
    """
    for strip in range(factor.shape[0]):
        for row in range(0, x.shape[0], ROWS):
            _tile(x, row, factor, strip, bias, least, out)  # type: ignore[call-arg]


@intrinsic  # type: ignore[misc]
def _tile(typing, x, row, factor, strip, bias, least, out):  # type: ignore[no-untyped-def]
    """Rows ``row`` to row + 7 of `product` in the columns of one strip."""
    number = factor.dtype

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        scalar = context.get_value_type(number)
        vector = ir.VectorType(scalar, STRIP)
        splat = ir.Constant(ir.VectorType(ir.IntType(32), STRIP), None)
        nothing = ir.Constant(vector, ir.Undefined)
        size = context.get_abi_sizeof(scalar)

        def array(index: int) -> tuple[Any, list[Any]]:
            found = context.make_array(signature.args[index])(context, builder, args[index])
            return found.data, parts.unpack_tuple(builder, found.shape)

        def integer(index: int) -> Any:
            return context.cast(builder, args[index], signature.args[index], types.intp)

        def load(pointer: Any, offset: Any) -> Any:
            at = builder.bitcast(builder.gep(pointer, [offset]), vector.as_pointer())
            return builder.load(at, align=size)

        def spread(value: Any) -> Any:
            one = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(one, nothing, splat)

        (xs, (_, x_width)), (ws, (_, depth, _)), (bs, _), (outs, (_, out_width)) = map(
            array, (0, 2, 4, 6)
        )
        first, column = integer(1), builder.mul(integer(3), context.get_constant(types.intp, STRIP))
        rows = [builder.add(first, context.get_constant(types.intp, r)) for r in range(ROWS)]
        sums = [parts.alloca_once_value(builder, load(bs, column)) for _ in rows]
        starts = [builder.mul(r, x_width) for r in rows]
        with parts.for_range(builder, depth, intp=depth.type) as loop:
            line = builder.add(builder.mul(integer(3), depth), loop.index)
            w = load(ws, builder.mul(line, context.get_constant(types.intp, STRIP)))
            for start, total in zip(starts, sums, strict=True):
                value = spread(builder.load(builder.gep(xs, [builder.add(start, loop.index)])))
                by = builder.fmul(value, w, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), by, flags=("contract",)), total)
        floor = spread(context.cast(builder, args[5], signature.args[5], number))
        for r, total in zip(rows, sums, strict=True):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)
            at = builder.gep(outs, [builder.add(builder.mul(r, out_width), column)])
            builder.store(value, builder.bitcast(at, vector.as_pointer()), align=size)
        return context.get_dummy_value()

    return types.void(x, row, factor, strip, bias, least, out), generate

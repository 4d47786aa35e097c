"""Products of tall and narrow matrices in compiled loops, whose sums stay in registers.

What BLAS does, for callers that are in a parallel loop already, where OpenBLAS may not be
asked.  A factor is stored in strips of 16 columns.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from llvmlite import binding, ir
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
WIDE = 3 if binding.get_host_cpu_features().get("avx512f") else 1
"""Strips taken together in single precision, so that what is read of x serves as often.

Three have 24 sums and three lines of the factor, which leave five of AVX-512's 32 registers; AVX2
has 16, of half the length, which one strip fills.
"""


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
    together = 0
    if factor.itemsize == 4:
        together = factor.shape[0] - factor.shape[0] % WIDE
    for strip in range(0, together, WIDE):
        for row in range(0, x.shape[0], ROWS):
            _wide_tile(x, row, factor, strip, bias, least, out)
    for strip in range(together, factor.shape[0]):
        for row in range(0, x.shape[0], ROWS):
            _tile(x, row, factor, strip, bias, least, out)


def _tiles(count: int) -> Any:
    """Rows ``row`` to row + 7 of `product` in the columns of ``count`` strips from ``strip``."""

    @intrinsic  # type: ignore[misc]
    def tile(typing, x, row, factor, strip, bias, least, out):  # type: ignore[no-untyped-def]
        signature = types.void(x, row, factor, strip, bias, least, out)
        return signature, partial(_generate, count, factor.dtype)

    return tile


def _generate(
    count: int, number: Any, context: Any, builder: Any, signature: Any, args: Any
) -> Any:
    """The tile's code; the arguments after ``number``, the type of entries, are Numba's."""
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

    def constant(value: int) -> Any:
        return context.get_constant(types.intp, value)

    def place(pointer: Any, offset: Any) -> Any:
        return builder.bitcast(builder.gep(pointer, [offset]), vector.as_pointer())

    def load(pointer: Any, offset: Any) -> Any:
        return builder.load(place(pointer, offset), align=size)

    def spread(value: Any) -> Any:
        one = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(one, nothing, splat)

    (xs, (_, x_width)), (ws, (_, depth, _)), (bs, _), (outs, (_, out_width)) = map(
        array, (0, 2, 4, 6)
    )
    rows = [builder.add(integer(1), constant(r)) for r in range(ROWS)]
    chosen = [builder.add(integer(3), constant(s)) for s in range(count)]
    columns = [builder.mul(strip, constant(STRIP)) for strip in chosen]
    starts = [builder.mul(r, x_width) for r in rows]
    sums = [[parts.alloca_once_value(builder, load(bs, at)) for at in columns] for _ in rows]
    with parts.for_range(builder, depth, intp=depth.type) as loop:
        lines = [builder.add(builder.mul(strip, depth), loop.index) for strip in chosen]
        factors = [load(ws, builder.mul(line, constant(STRIP))) for line in lines]
        for start, totals in zip(starts, sums, strict=True):
            value = spread(builder.load(builder.gep(xs, [builder.add(start, loop.index)])))
            for factor, total in zip(factors, totals, strict=True):
                by = builder.fmul(value, factor, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), by, flags=("contract",)), total)
    floor = spread(context.cast(builder, args[5], signature.args[5], number))
    for r, totals in zip(rows, sums, strict=True):
        for column, total in zip(columns, totals, strict=True):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)
            at = builder.add(builder.mul(r, out_width), column)
            builder.store(value, place(outs, at), align=size)
    return context.get_dummy_value()


_tile, _wide_tile = _tiles(1), _tiles(WIDE)

"""Products of tall and narrow matrices by vectors of 16 numbers.

What BLAS does, for callers that are in a parallel loop already, where OpenBLAS may not be
asked: sums stay in registers.  A factor is stored in strips of 16 columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.errors import TypingError
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


class _Vectors:
    """Arrays of an intrinsic's arguments, taken by 16 numbers of one type.

    Parameters
    ----------
    context, builder, signature, args
        Of the intrinsic's code generator.
    number
        Numba's type of the numbers.
    """

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any, number: Any) -> None:
        self._context, self._builder, self._number = context, builder, number
        self._signature, self._args = signature, args
        self.kind = ir.VectorType(context.get_value_type(number), STRIP)
        self._size = context.get_abi_sizeof(context.get_value_type(number))

    def array(self, index: int) -> tuple[Any, list[Any]]:
        """Pointer and shape of an argument."""
        kind = self._signature.args[index]
        found = self._context.make_array(kind)(self._context, self._builder, self._args[index])
        return found.data, parts.unpack_tuple(self._builder, found.shape)

    def integer(self, index: int) -> Any:
        """An argument that counts something."""
        given = self._args[index], self._signature.args[index]
        return self._context.cast(self._builder, *given, types.intp)

    def scalar(self, index: int) -> Any:
        """An argument as one of the numbers."""
        given = self._args[index], self._signature.args[index]
        return self._context.cast(self._builder, *given, self._number)

    def count(self, value: int) -> Any:
        """A number of rows or columns."""
        return self._context.get_constant(types.intp, value)

    def _at(self, pointer: Any, offset: Any) -> Any:
        at = self._builder.gep(pointer, [offset])
        return self._builder.bitcast(at, self.kind.as_pointer())

    def load(self, pointer: Any, offset: Any) -> Any:
        """16 numbers from an offset on, wherever they are aligned."""
        return self._builder.load(self._at(pointer, offset), align=self._size)

    def store(self, vector: Any, pointer: Any, offset: Any) -> None:
        """The reverse of `load`."""
        self._builder.store(vector, self._at(pointer, offset), align=self._size)

    def spread(self, value: Any) -> Any:
        """A number 16 times."""
        nothing = ir.Constant(self.kind, ir.Undefined)
        one = self._builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
        same = ir.Constant(ir.VectorType(ir.IntType(32), STRIP), None)
        return self._builder.shuffle_vector(one, nothing, same)


def _check_arrays(*arrays: Any) -> None:
    """Refuse types of arrays that would be misread: vectors know pointers and one type alone."""
    kinds = {(getattr(a, "layout", None), getattr(a, "dtype", None)) for a in arrays}
    if len(kinds) > 1 or kinds.pop()[0] != "C":
        raise TypingError(f"{arrays}: expected C-contiguous arrays of one type of numbers.")


@intrinsic  # type: ignore[misc]
def _tile(typing, x, row, factor, strip, bias, least, out):  # type: ignore[no-untyped-def]
    """Rows ``row`` to row + 7 of `product` in the columns of one strip."""
    _check_arrays(x, factor, bias, out)
    number = factor.dtype

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        v = _Vectors(context, builder, signature, args, number)
        (xs, (_, x_width)), (ws, (_, depth, _)), (bs, _), (outs, (_, out_width)) = map(
            v.array, (0, 2, 4, 6)
        )
        first, column = v.integer(1), builder.mul(v.integer(3), v.count(STRIP))
        rows = [builder.add(first, v.count(r)) for r in range(ROWS)]
        sums = [parts.alloca_once_value(builder, v.load(bs, column)) for _ in rows]
        starts = [builder.mul(r, x_width) for r in rows]
        with parts.for_range(builder, depth, intp=depth.type) as loop:
            line = builder.add(builder.mul(v.integer(3), depth), loop.index)
            w = v.load(ws, builder.mul(line, v.count(STRIP)))
            for start, total in zip(starts, sums, strict=True):
                value = builder.load(builder.gep(xs, [builder.add(start, loop.index)]))
                by = builder.fmul(v.spread(value), w, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), by, flags=("contract",)), total)
        floor = v.spread(v.scalar(5))
        for r, total in zip(rows, sums, strict=True):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)
            v.store(value, outs, builder.add(builder.mul(r, out_width), column))
        return context.get_dummy_value()

    return types.void(x, row, factor, strip, bias, least, out), generate

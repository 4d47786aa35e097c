"""Loops over cells in numba's threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

from pdcorrect.fem.decomposition import OPTIONS

CHUNK = 16
"""Cells that one thread takes at a time."""


class CellLoop:
    """A kernel ``function(begin, end, *arguments)`` of cells, called with their number instead.

    With several threads one loop for all kernels calls it by its address, `CHUNK` cells at a time.
    numba compiles the body of a ``prange`` and all that it calls four times, so a kernel with its
    own takes three times as long to compile.  Kernels must not raise: an exception would wait for
    the interpreter, which waits for the threads.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self.kernel = njit(**{**OPTIONS, "no_cfunc_wrapper": False})(function)
        self._addresses: dict[tuple[Any, ...], int] = {}

    def __call__(self, count: int, *arguments: Any) -> None:
        plain = numba.config.DISABLE_JIT  # type: ignore[attr-defined]
        if plain or count <= CHUNK or numba.get_num_threads() == 1:
            self.kernel(0, count, *arguments)
        else:
            _in_threads(self._address(arguments), count, arguments)

    def _address(self, arguments: tuple[Any, ...]) -> int:
        """Of the C function for arguments of these types."""
        key = tuple(
            (a.dtype, a.ndim, a.flags.num) if isinstance(a, np.ndarray) else type(a)
            for a in arguments
        )
        if key not in self._addresses:
            signature = tuple(
                numba.typeof(a)  # type: ignore[no-untyped-call]
                for a in (0, 0, *arguments)
            )
            self.kernel.compile(signature)
            compiled = self.kernel.overloads[signature]
            name = compiled.fndesc.llvm_cfunc_wrapper_name
            self._addresses[key] = compiled.library.get_pointer_to_function(name)
        return self._addresses[key]


@intrinsic
def _call(typing, address, begin, end, arguments):  # type: ignore[no-untyped-def]
    """Call the C function at an address."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        address, begin, end, packed = values
        unpacked = [builder.extract_value(packed, i) for i in range(len(arguments))]
        kinds = [context.get_value_type(kind) for kind in (types.int64, types.int64, *arguments)]
        function = ir.FunctionType(context.get_value_type(types.none), kinds)
        pointer = builder.inttoptr(address, function.as_pointer())
        return builder.call(pointer, [begin, end, *unpacked])

    return types.none(address, types.int64, types.int64, arguments), generate


@njit(parallel=True, **OPTIONS)
def _in_threads(address, count, arguments):  # type: ignore[no-untyped-def]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        end = min(count, (chunk + 1) * CHUNK)
        _call(address, chunk * CHUNK, end, arguments)  # type: ignore[call-arg]

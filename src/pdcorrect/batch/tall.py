"""Products of large matrices with very few columns.

They take as long as the matrix takes to be read.  The libraries' kernels for matrix
products reach half of a GPU's memory bandwidth with one to four columns; the kernel here
reads each entry once, in order, and uses it for all columns.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor

_MOST_COLUMNS = 4
_ROWS, _COLUMNS, _WARPS = 8, 256, 4


def tall_product(matrices: Tensor, columns: Tensor) -> Tensor:
    """(K, n, n) @ (K, n, m) -> (K, n, m)."""
    count, size, _ = matrices.shape
    few = columns.shape[2] <= _MOST_COLUMNS
    if not (few and matrices.is_cuda and matrices.dtype == torch.float32 and size >= _COLUMNS):
        return matrices @ columns
    import triton

    columns = columns.contiguous()
    out = torch.empty_like(columns)
    grid = (triton.cdiv(size, _ROWS), count)
    _kernel()[grid](
        matrices, columns, out, size, M=columns.shape[2], ROWS=_ROWS, COLUMNS=_COLUMNS,
        num_warps=_WARPS,
    )  # fmt: skip
    return out


@cache
def _kernel() -> Any:
    import triton
    import triton.language as tl

    @triton.jit
    def kernel(a, x, y, n, M: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):  # type: ignore[no-untyped-def]
        k = tl.program_id(1).to(tl.int64)
        row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
        rows = (k * n + row.to(tl.int64)) * n
        s0 = tl.zeros((ROWS, COLUMNS), tl.float32)
        s1 = tl.zeros((ROWS, COLUMNS), tl.float32)
        s2 = tl.zeros((ROWS, COLUMNS), tl.float32)
        s3 = tl.zeros((ROWS, COLUMNS), tl.float32)
        for begin in range(0, n, COLUMNS):
            col = begin + tl.arange(0, COLUMNS)
            inside = col < n
            mask = (row[:, None] < n) & inside[None, :]
            block = tl.load(a + rows[:, None] + col[None, :], mask=mask, other=0.0)
            place = x + (k * n + col) * M
            s0 += block * tl.load(place, mask=inside, other=0.0)[None, :]
            if M > 1:
                s1 += block * tl.load(place + 1, mask=inside, other=0.0)[None, :]
            if M > 2:
                s2 += block * tl.load(place + 2, mask=inside, other=0.0)[None, :]
            if M > 3:
                s3 += block * tl.load(place + 3, mask=inside, other=0.0)[None, :]
        target = y + (k * n + row) * M
        fits = row < n
        tl.store(target, tl.sum(s0, axis=1), mask=fits)
        if M > 1:
            tl.store(target + 1, tl.sum(s1, axis=1), mask=fits)
        if M > 2:
            tl.store(target + 2, tl.sum(s2, axis=1), mask=fits)
        if M > 3:
            tl.store(target + 3, tl.sum(s3, axis=1), mask=fits)

    return kernel

"""Work on cells that a GPU does in one kernel each, where torch's own operations take several.

Products with a small matrix for each cell are memory-bound, but matrix libraries treat
them as if they were large; gathering nodal values and summing cells' values would copy
them on the way.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any
from weakref import WeakMethod

import torch
from torch import Tensor


def as_kernel(function: Callable[..., Any], on_gpu: bool) -> Callable[..., Any]:
    """On a GPU the function as one kernel for tensors of any size; else as it is."""
    return _compiled(function) if on_gpu else function


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return torch.compile(function, dynamic=True)


def small_products(matrices: Tensor, x: Tensor) -> Tensor:
    """A x for each cell, (..., m, n) times (..., n, k)."""
    out: Tensor = as_kernel(_products, True)(matrices, x) if x.is_cuda else matrices @ x
    return out


def rows_of(u: Tensor, numbers: Tensor) -> Tensor:
    """Rows of u (M, k) by their numbers (L,)."""
    out: Tensor = as_kernel(_rows, u.is_cuda)(u, numbers)
    return out


def at_corners(x: Tensor, corners: Tensor) -> Tensor:
    """Values (B, C, K, 3) of fields (B, M, 3) at each scene's own rows ``corners`` (B, C, K)."""
    out: Tensor = as_kernel(_at_corners, x.is_cuda)(x, corners)
    return out


def in_cells(u: Tensor, corners: Tensor, modes: int) -> Tensor:
    """The same by component, (B, C, 3, K), followed by the cells' modes, (B, C, 3, L).

    Modes are the last rows of u (B, U, 3), cell by cell.
    """
    out: Tensor = as_kernel(_in_cells, u.is_cuda)(u, corners, modes)
    return out


def assembled(local: Tensor, slots: Tensor, corners: int) -> Tensor:
    """Fields (B, U, 3) of the cells' values (B, C, L, 3).

    Of L, ``corners`` are summed at the nodes, whose ``slots`` (B N, most) say where they are
    found (see `sums`); the others are modes, which have one cell each.
    """
    scenes = len(local)
    kernel = as_kernel(_summed, local.is_cuda)
    nodal: Tensor = kernel(local, slots, corners).reshape(scenes, -1, 3)
    if local.shape[2] == corners:
        return nodal
    return torch.cat([nodal, local[:, :, corners:].reshape(scenes, -1, 3)], dim=1)


def _products(matrices: Tensor, x: Tensor) -> Tensor:
    terms = [matrices[..., i, None] * x[..., i, None, :] for i in range(x.shape[-2])]
    return _sum(terms)


def _rows(u: Tensor, numbers: Tensor) -> Tensor:
    return u[numbers]


def _at_corners(x: Tensor, corners: Tensor) -> Tensor:
    scene = torch.arange(len(corners), device=x.device)[:, None, None]
    return x[scene, corners]


def _in_cells(u: Tensor, corners: Tensor, modes: int) -> Tensor:
    values = _at_corners(u, corners)
    if modes:
        scenes, cells, _ = corners.shape
        own = u[:, u.shape[1] - modes :].reshape(scenes, cells, -1, 3)
        values = torch.cat([values, own], dim=2)
    return values.transpose(2, 3).contiguous()


def _summed(local: Tensor, slots: Tensor, corners: int) -> Tensor:
    return sums(local[:, :, :corners].reshape(-1, 3), slots)


def sums(values: Tensor, numbers: Tensor) -> Tensor:
    """Sums (M, k) of rows of values (L, k) by their numbers (M, n), in this order.

    A number of L stands for nothing.
    """
    count = len(values)

    def term(column: Tensor) -> Tensor:
        row = values[torch.clamp(column, max=count - 1)]
        return torch.where((column < count)[:, None], row, 0.0)

    first, *others = numbers.unbind(dim=1)
    total = term(first)
    for column in others:
        total = total + term(column)
    return total


def _sum(terms: list[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


class Recorder:
    """Records functions for one device; their intermediate results share memory."""

    def __init__(self, device: torch.device) -> None:
        self._on_gpu = device.type == "cuda"
        self._device = device
        self._pool: Any = None

    def __call__(self, method: Callable[[], None]) -> Callable[[], None]:
        """The method as something to replay, which does not keep the method's owner alive.

        On a GPU it is run twice for this, so what it works on must not matter yet.
        """
        if not self._on_gpu:
            return _unowned(method)
        with torch.cuda.device(self._device):
            stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                method()
                method()
            torch.cuda.current_stream().wait_stream(stream)
            graph = torch.cuda.CUDAGraph()
            with _no_collection(), torch.cuda.graph(graph, pool=self._pool):
                method()
            self._pool = graph.pool()
        return graph.replay


def _unowned(method: Callable[[], None]) -> Callable[[], None]:
    known = WeakMethod(method)

    def call() -> None:
        found = known()
        assert found is not None
        found()

    return call


@contextmanager
def _no_collection() -> Iterator[None]:
    """Work that Python's garbage collection does not interrupt.

    It might free another recording, which is not allowed while one is made.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


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

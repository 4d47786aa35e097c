"""Work on cells that a GPU does in one kernel each, where torch's own operations take several.

Products with a small matrix for each cell are memory-bound, but matrix libraries treat
them as if they were large; gathering nodal values and summing cells' values would copy
them on the way.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import Any, TypeVar, cast
from weakref import WeakMethod

import torch
from torch import Tensor

Function = TypeVar("Function", bound=Callable[..., Any])


def one_kernel(function: Function) -> Function:
    """The function as one kernel on a GPU, for tensors of any size; elsewhere as it is.

    Its first argument is a tensor, which tells where.  It calls none of its kind.
    """

    @wraps(function)
    def call(first: Tensor, *others: Any) -> Any:
        return (_compiled(function) if first.is_cuda else function)(first, *others)

    return cast(Function, call)


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return torch.compile(function, dynamic=True)


def small_products(matrices: Tensor, x: Tensor) -> Tensor:
    """A x for each cell, (..., m, n) times (..., n, k)."""
    return _products(matrices, x) if x.is_cuda else matrices @ x


@one_kernel
def _products(matrices: Tensor, x: Tensor) -> Tensor:
    terms = [matrices[..., i, None] * x[..., i, None, :] for i in range(x.shape[-2])]
    return _sum(terms)


@one_kernel
def rows_of(u: Tensor, numbers: Tensor) -> Tensor:
    """Rows of u (M, k) by their numbers (L,)."""
    return u[numbers]


def _at_corners(x: Tensor, corners: Tensor) -> Tensor:
    """Values (B, C, K, 3) of fields (B, M, 3) at each scene's own rows ``corners`` (B, C, K)."""
    scene = torch.arange(len(corners), device=x.device)[:, None, None]
    return x[scene, corners]


at_corners = one_kernel(_at_corners)


@one_kernel
def in_cells(u: Tensor, corners: Tensor, modes: int) -> Tensor:
    """The same by component, (B, C, 3, K), followed by the cells' modes, (B, C, 3, L).

    Modes are the last rows of u (B, U, 3), cell by cell.
    """
    values = _at_corners(u, corners)
    if modes:
        scenes, cells, _ = corners.shape
        own = u[:, u.shape[1] - modes :].reshape(scenes, cells, -1, 3)
        values = torch.cat([values, own], dim=2)
    return values.transpose(2, 3).contiguous()


def assembled(local: Tensor, slots: Tensor, corners: int) -> Tensor:
    """Fields (B, U, 3) of the cells' values (B, C, L, 3).

    Of L, ``corners`` are summed at the nodes, whose ``slots`` (B N, most) say where they are
    found (see `sums`); the others are modes, which have one cell each.
    """
    scenes = len(local)
    nodal = _summed(local, slots, corners).reshape(scenes, -1, 3)
    if local.shape[2] == corners:
        return nodal
    return torch.cat([nodal, local[:, :, corners:].reshape(scenes, -1, 3)], dim=1)


@one_kernel
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

    return _sum([term(column) for column in numbers.unbind(dim=1)])


def _sum(terms: list[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


_one_thread = threading.Lock()
_inside, _threads = 0, 1


@contextmanager
def one_thread(device: torch.device) -> Iterator[None]:
    """Torch on one CPU thread, if that is the device, as long as any Python thread asks for it.

    Batches on the CPU are small; their products gain nothing from threads that wait for
    each other, and lose much where other processes want the cores.  Numba's kernels, which
    share torch's OpenMP library, change the number for both.
    """
    global _inside, _threads
    if device.type != "cpu":
        yield
        return
    with _one_thread:
        if not _inside:
            _threads = torch.get_num_threads()
        _inside += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _one_thread:
            _inside -= 1
            torch.set_num_threads(_threads)


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
    """Garbage collection might free another recording, which is not allowed while one is made."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()

"""Device work that is launched as a whole.

On a GPU a step is hundreds of small kernels, and launching each from Python takes longer
than running it.  A function that works in place on fixed tensors, and does nothing that
depends on values, is recorded once as a CUDA graph and replayed.  Elsewhere it is called.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakMethod

import torch


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

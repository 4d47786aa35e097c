"""How many threads a step takes."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import numba
from threadpoolctl import ThreadpoolController

_SLACK = 0.5
"""Of the machine's load, which this program is part of."""


@cache
def _threadpools() -> ThreadpoolController:
    return ThreadpoolController()


class _OneThread:
    """BLAS on one thread, as long as any Python thread is inside; as it was after the last."""

    _lock, _inside, _limit = threading.Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._limit = _threadpools().limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside and self._limit is not None:
                self._limit.restore_original_limits()


_one_blas_thread = _OneThread()


@contextmanager
def limited_threads() -> Iterator[None]:
    """BLAS on one thread, and the kernels too on a busy machine.

    Idle BLAS threads spin and take the kernels' cores, and the products here are too small to gain
    from them.  Kernels on two threads take up to three times as long as on one where other programs
    want the cores, and two thirds where none does (``benchmarks``, case busy).
    """
    before = numba.get_num_threads()
    with _one_blas_thread:
        if _busy():
            numba.set_num_threads(1)
        try:
            yield
        finally:
            numba.set_num_threads(before)


def _busy() -> bool:
    """Whether programs want more cores than there are, and no number of threads was asked for."""
    if "NUMBA_NUM_THREADS" in os.environ or not hasattr(os, "getloadavg"):
        return False
    return os.getloadavg()[0] > (os.cpu_count() or 1) + _SLACK

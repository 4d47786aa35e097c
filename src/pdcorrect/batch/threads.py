"""Torch's threads on the CPU."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class _Restored:
    """The number to go back to, shared by all Python threads that are on one torch thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside, self._number = 0, 1

    def enter(self) -> None:
        with self._lock:
            if not self._inside:
                self._number = torch.get_num_threads()
            self._inside += 1
            torch.set_num_threads(1)

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            torch.set_num_threads(self._number)


_restored = _Restored()


@contextmanager
def one_thread(device: torch.device) -> Iterator[None]:
    """Torch on one CPU thread, if that is the device.

    Batches on the CPU are small; their products gain nothing from threads that wait for
    each other, and lose much where other processes want the cores.  Numba's kernels, which
    share torch's OpenMP library, change the number for both.
    """
    if device.type != "cpu":
        yield
        return
    _restored.enter()
    try:
        yield
    finally:
        _restored.leave()

"""Torch's threads on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)

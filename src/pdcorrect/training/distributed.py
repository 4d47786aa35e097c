"""`ProcessGroup`: the processes that train together, each on its own part of the data."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch import distributed as dist

from pdcorrect.errors import InputError


@dataclass(frozen=True)
class ProcessGroup:
    """A process among others, as ``torchrun`` started them; alone by default."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes files and messages."""
        return self.rank == 0

    def mean(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their means over all processes."""
        if self.size == 1:
            return
        flat = torch.cat([t.reshape(-1) for t in tensors])
        dist.all_reduce(flat)
        flat /= self.size
        parts = torch.split(flat, [t.numel() for t in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    def total(self, values: Tensor) -> Tensor:
        """Sum of a tensor over all processes; it is on the CPU."""
        if self.size > 1:
            dist.all_reduce(values)
        return values

    def of_first(self, value: float) -> float:
        """The first process's value."""
        if self.size == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64)
        dist.broadcast(shared, 0)
        return float(shared)

    def same(self, tensors: Sequence[Tensor]) -> None:
        """Give all processes the first one's tensors."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)


@contextlib.contextmanager
def joined(device: str) -> Iterator[tuple[ProcessGroup, str]]:
    """The world that ``torchrun`` describes in the environment, and this process's device."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ProcessGroup(), device
        return
    if device.startswith("cuda:"):
        raise InputError(
            f"device {device!r} for {size} processes: expected 'cuda', of which each process takes "
            "its own."
        )
    if device == "cuda":
        local = int(os.environ.get("LOCAL_RANK", "0"))
        if local >= torch.cuda.device_count():
            raise InputError(
                f"process {local} of this machine, which has {torch.cuda.device_count()} GPUs: "
                "expected one GPU for each process."
            )
        device = f"cuda:{local}"
        torch.cuda.set_device(local)
    dist.init_process_group("cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo")
    try:
        yield ProcessGroup(dist.get_rank(), size), device
    finally:
        dist.destroy_process_group()

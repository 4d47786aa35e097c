"""In which precision a network computes, whatever is around it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Literal

import torch

from pdcorrect.corrector.corrector import Corrector

Amp = Literal["none", "bf16"]


@contextlib.contextmanager
def network_precision(corrector: Corrector, amp: Amp) -> Iterator[None]:
    """Let the network, and nothing else, take its matrix products in bfloat16.

    The coarse solver, which may run between, keeps its own precision.
    """
    if amp == "none":
        yield
        return
    network = corrector.network
    plain, kind = network.forward, next(network.parameters()).device.type

    def forward(*arguments: Any) -> Any:
        with torch.autocast(kind, torch.bfloat16):
            return plain(*arguments)

    vars(network)["forward"] = forward
    try:
        yield
    finally:
        del vars(network)["forward"]

"""What training minimises, and how large the base model's own errors are.

With the base model's error d1 = mean over steps and nodes of the squared distance between
its single steps from the reference and the reference, and D that of its free rollout (both
m2, of one trajectory), the "relative" loss of a frame that is j steps away from the
reference is the mean over the body's nodes of the squared distance over

    d(j) = min((j (j + 1) / 2)^2 d1, D),        d(1) = d1.

The factor is how far j equal one-step errors carry: each of them is an error e of the
positions and so e / h of the velocities, and j of them in the same direction add up to
e (1 + 2 + ... + j) where nothing holds the body back.  The base model itself has a loss of
about one, whether a trajectory moves by metres or trembles by micrometres.  With a weight
``ahead`` what the error will come to in the frames ahead (`pdcorrect.training.vibrations`) is
added, over D, times that weight.  With a bend b a loss x counts as b log(1 + x / b).

The "absolute" loss (thesis, eq. 5-3) sums over a body's nodes distances, or their squares,
of positions in units of 1 / 1000 m.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.training.recipe import Loss

LEAST_ERROR = 1e-30
"""d1 and D count as at least this, m2."""


@dataclass(frozen=True, eq=False)
class BaseErrors:
    """d1 and D of the base model, m2, one a trajectory, (B,)."""

    one_step: Tensor
    rollout: Tensor

    def after(self, steps: Tensor | int) -> Tensor:
        """d(j) for j steps, one number or (B,)."""
        factor = (steps * (steps + 1) / 2) ** 2
        return torch.minimum(factor * self.one_step, self.largest)

    def of(self, trajectories: Tensor) -> BaseErrors:
        """Those of some, by their numbers."""
        return BaseErrors(self.one_step[trajectories], self.rollout[trajectories])

    @property
    def largest(self) -> Tensor:
        """D, at least d1, (B,)."""
        return torch.maximum(self.rollout, self.one_step)


def body_losses(
    loss: Loss,
    errors: Tensor,
    total: Callable[[Tensor], Tensor],
    counts: Tensor,
    scale: Tensor,
    added: Tensor | float = 0.0,
) -> Tensor:
    """The loss of each body, (B,).

    Parameters
    ----------
    loss : Loss
    errors : (..., 3)
        Distances at nodes, m.
    total : callable
        Sums of values (...) over the nodes of each body, (B,), which has ``counts`` (B,).
    scale : (B,)
        d(j), m2.
    added : (B,)
        To relative losses, before they are bent.
    """
    if loss.kind == "relative":
        ratios = total(errors.square().sum(dim=-1)) / (counts * scale) + added
        return ratios if loss.bend is None else loss.bend * torch.log1p(ratios / loss.bend)
    errors = loss.scale * errors
    if loss.power == 1:
        return total(torch.linalg.vector_norm(errors, dim=-1))
    return total(errors.square().sum(dim=-1))


def mean_of(values: Tensor, chosen: Tensor) -> Tensor:
    """Mean of the chosen values; NaN where none is chosen, so that the batch does not count."""
    kept = torch.where(chosen, values, 0.0)
    return kept.sum() / chosen.sum()


@contextlib.contextmanager
def network_precision(corrector: Corrector, amp: Literal["none", "bf16"]) -> Iterator[None]:
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

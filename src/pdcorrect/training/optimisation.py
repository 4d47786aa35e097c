"""Adam with its learning rate, the averaged weights, and the guard against numbers that are none.

Nothing here waits for the device: batches whose gradient is not finite are left out, and
counted, by the optimiser's own kernel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.recipe import Rate, Stage

_TOLD = ("loss_sum", "count", "skipped", "row", "longest")
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")
LARGEST = 1.0
"""Norm of the gradient; larger ones are scaled down to it."""


def rate_at(rate: Rate, progress: float) -> float:
    """Learning rate at a share 0 to 1 of a stage; never zero."""
    if progress < rate.warmup:
        return rate.peak * max(progress / rate.warmup, 1e-3)
    if rate.peak == rate.last or rate.warmup == 1.0:
        return rate.peak
    share = (min(progress, 1.0) - rate.warmup) / (1.0 - rate.warmup)
    return rate.last + 0.5 * (rate.peak - rate.last) * (1.0 + math.cos(math.pi * share))


class Optimiser:
    """Updates a corrector's weights by one stage's rules.

    ``averaged`` takes the averaged weights, if the stage wants them.
    """

    def __init__(
        self, corrector: Corrector, stage: Stage, averaged: Corrector | None, world: ProcessGroup
    ) -> None:
        self._names = [name for name, _ in corrector.network.named_parameters()]
        self._weights: list[Tensor] = [p for _, p in corrector.network.named_parameters()]
        self._averages: list[Tensor] | None = None
        if averaged is not None and stage.ema is not None:
            self._averages = list(averaged.network.parameters())
        self._stage, self._world = stage, world
        self._adam = torch.optim.Adam(self._weights, lr=stage.rate.peak, fused=True)
        device = self._weights[0].device
        # since `take_report`: sum of the finite losses and their number, batches left out; then
        # how many were left out in a row up to now, and at most
        self._bad = torch.zeros((), device=device)
        self._told = torch.zeros(len(_TOLD), dtype=torch.float64, device=device)
        self._counts = dict(zip(_TOLD, self._told.unbind(), strict=True))
        vars(self._adam).update(grad_scale=None, found_inf=self._bad)  # its kernel asks for them

    def step(self, loss: Tensor, progress: float) -> None:
        """Follow the gradient of a loss."""
        self._adam.zero_grad(set_to_none=True)
        if loss.requires_grad:
            loss.backward()  # type: ignore[no-untyped-call]
        for weight in self._weights:
            if weight.grad is None:
                weight.grad = torch.zeros_like(weight)
        grads = [w.grad for w in self._weights if w.grad is not None]
        value = loss.detach().to(grads[0].dtype).reshape(1)
        self._world.mean([*grads, value])
        norm = torch.nn.utils.get_total_norm(grads)
        self._bad.copy_((~(torch.isfinite(norm) & torch.isfinite(value[0]))).float())
        torch.nn.utils.clip_grads_with_norm_(self._weights, LARGEST, norm)
        for group in self._adam.param_groups:
            group["lr"] = rate_at(self._stage.rate, progress)
        self._adam.step()
        if self._averages is not None:
            share = 1.0 - float(self._stage.ema or 0.0)
            with torch.no_grad():
                torch._foreach_lerp_(self._averages, list(self._weights), share)
        self._count(value[0].double())

    def _count(self, loss: Tensor) -> None:
        bad, told = self._bad.double(), self._counts
        told["loss_sum"] += torch.where(self._bad > 0, 0.0, loss)
        told["count"] += 1.0 - bad
        told["skipped"] += bad
        told["row"].copy_((told["row"] + bad) * bad)
        told["longest"].copy_(torch.maximum(told["longest"], told["row"]))

    def take_report(self) -> dict[str, float]:
        """The counts by name; counting starts anew."""
        values: dict[str, float] = dict(zip(_TOLD, self._told.tolist(), strict=True))
        for name, x in self._counts.items():
            x.fill_(values["row"] if name in ("row", "longest") else 0.0)
        return values

    def state_dict(self) -> dict[str, Tensor]:
        """Adam's moments and the counts, by name."""
        state = self._adam.state
        moments = {
            f"adam.{part}.{name}": state[weight][part]
            for name, weight in zip(self._names, self._weights, strict=True)
            for part in _MOMENTS
            if weight in state
        }
        return moments | {f"count.{name}": x.clone() for name, x in self._counts.items()}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where a state was taken."""
        for name, weight in zip(self._names, self._weights, strict=True):
            if f"adam.step.{name}" in tensors:
                self._adam.state[weight] = {
                    part: tensors[f"adam.{part}.{name}"].to(weight.device, torch.float32, copy=True)
                    for part in _MOMENTS
                }
        for name, x in self._counts.items():
            x.copy_(tensors[f"count.{name}"])

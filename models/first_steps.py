"""First steps, and rollouts, of the scenes of a data set's configuration, as a network sees them.

For the scripts beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

import pdcorrect as pc
from pdcorrect.corrector.batch_step import BatchCoarseStep, BatchParts
from pdcorrect.corrector.features import View
from pdcorrect.corrector.model_io import LoadedModel
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.evaluation.rollouts import roll_out
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Scene


def scenes_of(
    config: DatasetConfig, split: str, loads: int | None = None
) -> list[tuple[Scene, int]]:
    """The scenes of a split, mesh by mesh, and how often the reference cuts their cells.

    At most so many loads of each, all by default.  Loads are those that are drawn first:
    `pdcorrect dataset generate` replaces the ones that it rejects.
    """
    return [
        (draw_scene(config, plan, number), plan.refine)
        for plan in make_plan(config)
        if plan.split == split
        for number in range(plan.simulations if loads is None else min(loads, plan.simulations))
    ]


def first_steps(
    model: LoadedModel, scenes: list[tuple[Scene, int]], device: str, batch: int
) -> Iterator[BatchCoarseStep]:
    """Steps from rest of the coarse model that a network corrects, so many scenes at a time."""
    for first in range(0, len(scenes), batch):
        some = scenes[first : first + batch]
        problems = [pc.coarse_model(scene, model.base, refine) for scene, refine in some]
        stepper = pc.BatchStepper(problems, device=device)
        parts = BatchParts(stepper, model.corrector, model.velocity)
        yield BatchCoarseStep(parts, stepper.rest_state(), None)


@torch.no_grad()
def seen_in_rollouts(
    model: LoadedModel,
    problems: Sequence[Problem],
    steps: int,
    device: str,
    look: Callable[[View], Any],
    gate: pc.Gate | None = None,
) -> tuple[list[Any], Tensor]:
    """Roll corrected scenes out from rest: ``look`` at what the network is shown in each step.

    Second: which of them (B,) came to the end without a failure or a refusal.
    """
    corrector, seen = model.corrector, []
    answer = corrector.of_view

    def watched(view: View) -> Tensor:
        seen.append(look(view))
        return answer(view)

    stepper = pc.BatchStepper(problems, device=device)
    corrector.of_view = watched  # type: ignore[method-assign]
    try:
        hybrid = pc.BatchHybrid(stepper, corrector, velocity=model.velocity, gate=gate)
        runs = roll_out(hybrid, stepper, [steps] * len(problems))
    finally:
        del corrector.of_view
    whole = [run.failed is None and not run.refused.any() for run in runs]
    return seen, torch.tensor(whole, device=stepper.device)

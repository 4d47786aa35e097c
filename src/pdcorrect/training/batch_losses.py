"""Where a stage's losses come from: stored single steps, or the hybrid's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.losses import body_losses, network_precision
from pdcorrect.training.recipe import Stage, TrainingConfig
from pdcorrect.training.scenes import SceneGroups
from pdcorrect.training.unrolled import UnrolledBatches
from pdcorrect.training.windows import StepBatch, StepWindows


class Source(Protocol):
    """Losses of one batch after the other."""

    failed: int
    """Scenes that were left out because a step failed."""

    def __len__(self) -> int:
        """Batches of an epoch."""

    def loss(self, corrector: Corrector, iteration: int, steps: int) -> Tensor:
        """Of the next batch, which is number ``iteration`` of the stage."""

    def state_dict(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Where it is: numbers, and tensors by name."""

    def load_state_dict(self, numbers: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """Go on where a state was taken."""


class OneStepBatches:
    """Windows of the training split in random order.

    Parameters
    ----------
    windows : StepWindows
    stage : Stage
    seed : int
    world : ProcessGroup
    """

    def __init__(self, windows: StepWindows, stage: Stage, seed: int, world: ProcessGroup) -> None:
        self._batches = windows.batches(
            stage.batch, seed=seed, rank=world.rank, world_size=world.size
        )
        self._stage, self._seed, self._world = stage, (seed, world.rank), world
        self._generator = torch.Generator(windows.device)
        self.failed = 0

    def __len__(self) -> int:
        """Batches of an epoch."""
        return len(self._batches)

    def loss(self, corrector: Corrector, iteration: int, steps: int) -> Tensor:
        """See `Source`."""
        batch = next(self._batches)
        noise = self._stage.noise
        if noise.tau > 0.0:
            self._generator.manual_seed(_seed(*self._seed, iteration))
            batch = batch.with_noise(noise.tau, noise.relative, self._generator)
        return one_step_loss(corrector, batch, self._stage)

    def state_dict(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """See `Source`."""
        return dict(self._batches.state_dict()), {}

    def load_state_dict(self, numbers: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """See `Source`; all processes are in the same place."""
        self._batches.load_state_dict({**numbers, "rank": self._world.rank})


def one_step_loss(corrector: Corrector, batch: StepBatch, stage: Stage) -> Tensor:
    """Mean loss of the bodies of a batch."""
    with network_precision(corrector, stage.amp):
        correction = corrector(batch.bodies, batch.snapshot)
    bodies, errors = batch.bodies, correction - batch.target
    each = body_losses(stage.loss, errors, bodies.node_sums, bodies.node_counts, batch.scale)
    return each.mean()


def make_source(
    stage: Stage,
    number: int,
    config: TrainingConfig,
    windows: StepWindows,
    groups: SceneGroups,
    world: ProcessGroup,
    teacher: Corrector | None = None,
) -> Source:
    """The source of stage ``number`` of a training."""
    seed = _seed(config.seed, number)
    if stage.kind == "one-step":
        return OneStepBatches(windows, stage, seed, world)
    return UnrolledBatches(groups, stage, velocity=config.velocity, seed=seed, teacher=teacher)


def share_done(stage: Stage, epoch: int, iteration: int, seconds: float) -> float:
    """How much of a stage's budget is spent; ``epoch`` is the number of its batches."""
    if stage.seconds is not None:
        return seconds / stage.seconds
    return iteration / (stage.iterations or (stage.epochs or 1) * epoch)


def _seed(*names: int) -> int:
    """A seed for a stream of random numbers that is named by numbers."""
    return int(np.random.SeedSequence(names).generate_state(1, np.uint32)[0])

"""Where a stage's losses come from: stored single steps, or the hybrid's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pdcorrect.corrector.corrector import Corrector
from pdcorrect.data.reader import TrajectoryLoader
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.losses import body_losses, network_precision
from pdcorrect.training.recipe import Stage, TrainingConfig
from pdcorrect.training.scenes import SceneGroups
from pdcorrect.training.unrolled import UnrolledBatches
from pdcorrect.training.windows import StepBatch, StepWindows


class OneStepBatches:
    """Windows of the training split in random order, epoch after epoch.

    The last few of an epoch, fewer than a batch, are left out.

    Parameters
    ----------
    windows : StepWindows
    stage : Stage
    seed : int
    world : ProcessGroup

    Attributes
    ----------
    failed : int
        Zero: no step is taken.
    """

    def __init__(self, windows: StepWindows, stage: Stage, seed: int, world: ProcessGroup) -> None:
        self._windows, self._stage, self._seed = windows, stage, (seed, world.rank)
        self._shuffle = TrajectoryLoader(
            windows.dataset, stage.batch, seed=seed, block=len(windows.dataset.headers),
            rank=world.rank, world_size=world.size,
        )  # fmt: skip
        self._order = self._shuffle.order()
        self._generator = torch.Generator(windows.device)
        self.failed = 0

    def __len__(self) -> int:
        """Batches of an epoch."""
        return max(1, len(self._order) // self._stage.batch)

    def batch(self, iteration: int) -> StepBatch:
        """Batch number ``iteration`` of the stage."""
        epoch, place = divmod(iteration, len(self))
        if epoch != self._shuffle.epoch:
            self._shuffle.set_epoch(epoch)
            self._order = self._shuffle.order()
        first = place * self._stage.batch
        batch = self._windows.batch(self._order[first : first + self._stage.batch])
        if self._stage.noise.tau == 0.0:
            return batch
        self._generator.manual_seed(_seed(*self._seed, iteration))
        return batch.with_noise(self._stage.noise.tau, self._generator)

    def loss(self, corrector: Corrector, iteration: int, steps: int) -> Tensor:
        """The mean loss of a batch; what is drawn depends on ``iteration``."""
        return one_step_loss(corrector, self.batch(iteration), self._stage)

    def state_dict(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Nothing: all depends on the number of the batch."""
        return {}, {}

    def load_state_dict(self, numbers: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """Nothing to do."""


def one_step_loss(corrector: Corrector, batch: StepBatch, stage: Stage) -> Tensor:
    """Mean loss of the bodies of a batch."""
    with network_precision(corrector, stage.amp):
        correction = corrector(batch.bodies, batch.snapshot)
    bodies, errors = batch.bodies, correction - batch.target
    each = body_losses(stage.loss, errors, bodies.node_sums, bodies.node_counts, batch.scale)
    return each.mean()


Source = OneStepBatches | UnrolledBatches
"""Losses of one batch after the other, and states to go on from."""


def make_source(
    number: int,
    config: TrainingConfig,
    windows: StepWindows,
    groups: SceneGroups,
    world: ProcessGroup,
) -> Source:
    """Where the losses of stage ``number`` of a training come from."""
    stage, seed = config.stages[number], _seed(config.seed, number)
    if stage.kind == "one-step":
        return OneStepBatches(windows, stage, seed, world)
    return UnrolledBatches(groups, stage, seed=seed)


def _seed(*names: int) -> int:
    """A seed for a stream of random numbers that is named by numbers."""
    return int(np.random.SeedSequence(names).generate_state(1, np.uint32)[0])

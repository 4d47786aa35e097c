"""Training batches of the hybrid's own steps, the simulator in the loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.states import in_one
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.training.losses import body_losses, mean_of, network_precision
from pdcorrect.training.recipe import Stage
from pdcorrect.training.scenes import Frames, SceneGroup, SceneGroups

Flags = NDArray[np.bool_]


@dataclass(eq=False)
class Rollouts:
    """Where the scenes of a group are."""

    # (B, N, 3) tensors: m and m/s
    positions: Tensor
    velocities: Tensor
    correction: Tensor  # (n, 3) tensor: of the last step, m; zero if there was none
    # (B,) int: frame of each scene, and steps since it was on the reference; -1 if it is to go back
    frames: Frames
    ages: Frames


class Unrolled(NamedTuple):
    """Outcome of some steps: mean losses (B,), zero where a step failed; which scenes had none
    that failed; and where they are, without derivatives.
    """

    losses: Tensor
    alive: Flags
    end: Rollouts


class UnrolledBatches:
    """Draws groups and start frames, steps the hybrid, and compares it with the reference.

    Attributes
    ----------
    failed : int
        Scenes that were left out because a step failed.
    """

    def __init__(self, groups: SceneGroups, stage: Stage, *, seed: int = 0) -> None:
        self._groups, self._stage = groups, stage
        self._chosen = groups.of(stage.batch, max(stage.steps))
        self._seed = (seed, groups.world.rank)
        self._pool: dict[int, Rollouts] = {}
        self.failed = 0

    def __len__(self) -> int:
        """Groups."""
        return len(self._chosen)

    def loss(self, corrector: Corrector, iteration: int, steps: int) -> Tensor:
        """The mean loss of a group over some steps; what is drawn depends on ``iteration``."""
        rng = np.random.default_rng((*self._seed, 3, iteration))
        number = self._turn(iteration)
        group = self._groups(self._chosen[number])
        start = self._start(number, group, steps, rng)
        found = unroll(group, corrector, start, steps, self._stage)
        self.failed += int((~found.alive).sum())
        if self._stage.start == "pool":
            lost = group.lost(found.end.positions, found.end.frames)
            found.end.ages[~found.alive | lost] = -1
            self._pool[number] = found.end
        return mean_of(found.losses, group.on_device(found.alive))

    def state_dict(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """The pool: numbers, and tensors by name."""
        numbers: dict[str, Any] = {"failed": self.failed, "pool": {}}
        tensors: dict[str, Tensor] = {}
        for k, at in self._pool.items():
            numbers["pool"][str(k)] = {"frames": at.frames.tolist(), "ages": at.ages.tolist()}
            tensors |= {f"{k}.positions": at.positions, f"{k}.velocities": at.velocities}
            tensors[f"{k}.correction"] = at.correction
        return numbers, tensors

    def load_state_dict(self, numbers: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """Go on where a state was taken; pools and counts of processes but the first begin anew."""
        self.failed, self._pool = 0, {}
        if self._seed[1]:
            return
        self.failed = numbers["failed"]
        for key, at in numbers["pool"].items():
            positions, velocities, correction = (
                tensors[f"{key}.{name}"].to(self._groups.device)
                for name in ("positions", "velocities", "correction")
            )
            self._pool[int(key)] = Rollouts(
                positions, velocities, correction, np.array(at["frames"]), np.array(at["ages"])
            )

    def _turn(self, iteration: int) -> int:
        """The group: all in random order, then again."""
        epoch, place = divmod(iteration, len(self))
        return int(np.random.default_rng((*self._seed, 4, epoch)).permutation(len(self))[place])

    def _start(
        self, number: int, group: SceneGroup, steps: int, rng: np.random.Generator
    ) -> Rollouts:
        """States of the reference, at rest or in random frames, or what the pool holds."""
        frames = rng.integers(0, group.steps - steps + 1)
        if self._stage.at_rest > 0.0:
            frames[rng.random(len(group)) < self._stage.at_rest] = 0
        anew = rng.random(len(group)) < self._stage.restart
        positions, velocities = group.states(frames)
        none = torch.zeros(group.nodes, 3, dtype=torch.float64, device=group.device)
        drawn = Rollouts(positions, velocities, none, frames, np.zeros_like(frames))
        before = self._pool.get(number)
        if self._stage.start == "reference" or before is None:
            return drawn
        anew |= (before.ages < 0) | (before.frames + steps > group.steps)
        return _mixed(group, before, drawn, anew)


def unroll(
    group: SceneGroup, corrector: Corrector, start: Rollouts, steps: int, stage: Stage
) -> Unrolled:
    """Step a group and compare each frame with the reference."""
    layer = group.layer(corrector, stage.through_solver)
    positions, velocities, correction = start.positions, start.velocities, start.correction
    frames, ages = start.frames, start.ages
    total = torch.zeros(len(group), dtype=torch.float64, device=group.device)
    living = torch.ones_like(total, dtype=torch.bool)
    for _ in range(steps):
        with network_precision(corrector, stage.amp):
            positions, velocities, correction = layer(
                positions, velocities, [group.time_step * int(k) for k in frames], correction
            )
        fine = group.on_device(np.array(in_one(layer.steps.statuses[-1])))
        living = living & fine & torch.isfinite(positions).flatten(1).all(dim=1)
        frames, ages = frames + 1, ages + 1
        truth, at = group.truth(frames), living[:, None, None]
        # Not a number times zero is not zero: it must not reach what all scenes share.
        positions = torch.where(at, positions, truth)
        velocities = torch.where(at, velocities, 0.0)
        added: Tensor | float = 0.0
        errors, scale = positions - truth, group.errors.after(group.on_device(ages))
        if stage.loss.ahead is not None:
            wrong = torch.where(at, velocities - group.states(frames)[1], 0.0)
            added = stage.loss.ahead * group.vibrations.ahead(errors, wrong)
            added = added / group.errors.largest
        total = total + body_losses(stage.loss, errors, group.sums, group.counts, scale, added)
    end = Rollouts(positions.detach(), velocities.detach(), correction.detach(), frames, ages)
    return Unrolled(torch.where(living, total / steps, 0.0), living.cpu().numpy(), end)


def _mixed(group: SceneGroup, before: Rollouts, drawn: Rollouts, anew: Flags) -> Rollouts:
    """What a pool held, some scenes begun anew."""
    which = group.on_device(anew)
    at, of_nodes = which[:, None, None], group.by_node(which)[:, None]
    return Rollouts(
        torch.where(at, drawn.positions, before.positions),
        torch.where(at, drawn.velocities, before.velocities),
        torch.where(of_nodes, 0.0, before.correction),
        np.where(anew, drawn.frames, before.frames),
        np.where(anew, 0, before.ages),
    )

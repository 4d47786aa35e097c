"""Free rollouts of the hybrid from rest, and the share of the plain model's error they remove.

For choosing weights while training, without a gate and with a lower bound, so that one bad
rollout does not hide what the others say.  What a model is worth is told by
`pdcorrect.evaluation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.placements import Velocity
from pdcorrect.fem.problem import Base
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.recordings import Recording, rounding
from pdcorrect.training.scenes import SceneGroup

LEAST = -100.0
"""Omega of a simulation whose rollout failed or is worse than this, per cent."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Omega of simulations.

    Attributes
    ----------
    omegas : (S,)
        Per cent, in the order of the recordings; at least `LEAST`.
    failed : int
        Rollouts in which a step failed.
    """

    omegas: NDArray[np.float64]
    failed: int

    @property
    def mean(self) -> float:
        """Eq. 7-3, with `LEAST` as the least value."""
        return float(self.omegas.mean())

    @property
    def median(self) -> float:
        """Per cent."""
        return float(np.median(self.omegas))

    @property
    def least(self) -> float:
        """Per cent."""
        return float(self.omegas.min())

    def metrics(self) -> dict[str, float]:
        """By name, for tables and files."""
        return {
            "omega_mean": self.mean, "omega_median": self.median, "omega_least": self.least,
            "failed_rollouts": float(self.failed),
        }  # fmt: skip


class Validation:
    """Rollouts of recorded simulations over all their frames, all together.

    With several processes each one takes a part; all get all scores.

    Parameters
    ----------
    recordings : sequence of Recording
    base : {"plain", "best", "total-mass"}
        Which is corrected; Omega is against "plain" in any case.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        base: Base,
        *,
        velocity: Velocity = "recomputed",
        device: str | torch.device = "cpu",
        world: ProcessGroup | None = None,
    ) -> None:
        self.recordings, self._velocity = tuple(recordings), velocity
        self._world = ProcessGroup() if world is None else world
        self._numbers = range(self._world.rank, len(recordings), self._world.size)
        own = [recordings[i] for i in self._numbers]
        self._group = SceneGroup(own, base, device) if own else None

    @torch.no_grad()
    def __call__(self, corrector: Corrector) -> Scores:
        """Omega of each simulation."""
        found = torch.zeros(2, len(self.recordings), dtype=torch.float64)
        if self._group is not None:
            chosen = list(self._numbers)
            omegas, failed = self._rollout(self._group, corrector)
            found[0, chosen], found[1, chosen] = omegas.cpu(), failed.double().cpu()
        found = self._world.total(found)
        return Scores(found[0].numpy(), int(found[1].sum()))

    def _rollout(self, group: SceneGroup, corrector: Corrector) -> tuple[Tensor, Tensor]:
        """Omega of a group, (B,), and which rollouts failed.

        Those that failed, are sure to end below `LEAST`, or have come to their last frame are
        put back to rest, where they cost little.
        """
        hybrid = BatchHybrid(group.stepper, corrector, velocity=self._velocity)
        rest = group.stepper.rest_state()
        state, previous = group.stepper.initial_state(), None
        total = torch.zeros(len(group), dtype=torch.float64, device=group.device)
        ok = torch.ones(len(group), dtype=torch.bool, device=group.device)
        good = ok.clone()
        squares = [_squares(r) for r in group.recordings]
        plain = torch.tensor(squares, dtype=torch.float64, device=group.device)
        worst = (1.0 - LEAST / 100.0) * plain
        steps = torch.from_numpy(group.steps).to(group.device)
        for frame in range(1, int(group.steps.max()) + 1):
            result = hybrid(state, previous)
            state, previous = result.state, result.correction
            running = steps >= frame
            fine = torch.tensor([s.ok for s in result.coarse.statuses], device=group.device)
            fine &= torch.isfinite(state.positions).flatten(1).all(dim=1) & ~result.refused
            ok &= fine | ~running
            error = state.positions - group.truth(np.minimum(frame, group.steps))
            square = group.sums(error.square().sum(dim=2))
            total += torch.where(running & ok, square, 0.0)
            good &= ok & (total <= worst)
            state = state.where(good & (steps > frame), rest)
        return torch.where(good, 100.0 * (1.0 - total / plain), LEAST), ~ok


def _squares(recording: Recording) -> float:
    """Of the plain model's rollout, over all frames and nodes, m2; at least what rounding makes."""
    distance = recording.plain[1:].astype(np.float64) - recording.reference[1:]
    least = recording.steps * len(recording.points) * rounding(recording.reference)
    return max(float((distance**2).sum()), least)

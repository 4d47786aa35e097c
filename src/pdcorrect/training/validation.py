"""Free rollouts of the hybrid from rest, and the share of the plain model's error they remove.

For choosing weights while training, without a gate and with a lower bound, so that one bad
rollout does not hide what the others say.  What a model is worth is told by
`pdcorrect.evaluation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.evaluation.rollouts import roll_out
from pdcorrect.fem.problem import Base
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.scenes import Recording, SceneGroup, rounding

LEAST = -100.0
"""Omega of a simulation whose rollout failed or is worse than this, per cent."""


class Scores(NamedTuple):
    """Omega of simulations (S,), per cent, at least `LEAST`; rollouts in which a step failed."""

    omegas: NDArray[np.float64]
    failed: int

    @property
    def mean(self) -> float:
        """Eq. 7-3, with `LEAST` as the least value."""
        return float(self.omegas.mean())

    def metrics(self) -> dict[str, float]:
        """By name, for tables and files."""
        return {
            "omega_mean": self.mean, "omega_median": float(np.median(self.omegas)),
            "omega_least": float(self.omegas.min()), "failed_rollouts": float(self.failed),
        }  # fmt: skip


class Validation:
    """Rollouts of recorded simulations over all their frames, all together.

    With several processes each one takes a part; all get all scores.  ``base`` says which model
    is corrected; Omega is against "plain" in any case.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        base: Base,
        *,
        device: str | torch.device = "cpu",
        world: ProcessGroup | None = None,
    ) -> None:
        self.recordings = tuple(recordings)
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
            found[0, chosen], found[1, chosen] = omegas, failed.double()
        found = self._world.total(found)
        return Scores(found[0].numpy(), int(found[1].sum()))

    def _rollout(self, group: SceneGroup, corrector: Corrector) -> tuple[Tensor, Tensor]:
        """Omega of a group, (B,), and which rollouts failed, on the CPU.

        Those that are sure to end below `LEAST` are not gone on with.
        """
        squares = [_squares(r) for r in group.recordings]
        plain = torch.tensor(squares, dtype=torch.float64, device=group.device)
        total, steps = torch.zeros_like(plain), group.on_device(group.steps)

        def worth(frame: int, positions: Tensor) -> Tensor:
            error = positions - group.truth(np.minimum(frame, group.steps))
            total.add_(torch.where(frame <= steps, group.sums(error.square().sum(dim=2)), 0.0))
            return total <= (1.0 - LEAST / 100.0) * plain

        hybrid = BatchHybrid(group.stepper, corrector)
        runs = roll_out(hybrid, group.stepper, group.steps.tolist(), worth)
        # without a gate only corrections that are not finite are refused
        failed = torch.tensor([r.failed is not None or bool(np.any(r.reasons)) for r in runs])
        omegas = (100.0 * (1.0 - total / plain)).clamp(min=LEAST).cpu()
        return torch.where(failed, LEAST, omegas), failed


def _squares(recording: Recording) -> float:
    """Of the plain model's rollout, over all frames and nodes, m2; at least what rounding makes."""
    distance = recording.plain[1:].astype(np.float64) - recording.reference[1:]
    least = recording.steps * recording.reference.shape[1] * rounding(recording.reference)
    return max(float((distance**2).sum()), least)

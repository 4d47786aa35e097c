"""Free rollouts of the hybrid from rest, and the share of the plain model's error they remove."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.states import BatchState
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.placements import Velocity
from pdcorrect.corrector.recordings import Base, Recording
from pdcorrect.corrector.scenes import SceneGroup
from pdcorrect.corrector.world import World

FAILED = -100.0
"""Omega of a simulation whose rollout failed, and the least that counts in means, per cent."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Omega of simulations.

    Attributes
    ----------
    omegas : (S,)
        Per cent, in the order of the recordings.
    failed : int
        Rollouts in which a step failed.
    """

    omegas: NDArray[np.float64]
    failed: int

    @property
    def mean(self) -> float:
        """Eq. 7-3, with `FAILED` as the least value."""
        return float(np.maximum(self.omegas, FAILED).mean())

    @property
    def median(self) -> float:
        """Per cent."""
        return float(np.median(self.omegas))

    @property
    def least(self) -> float:
        """Per cent."""
        return float(self.omegas.min())


class Validation:
    """Rollouts of recorded simulations over all their frames, all together.

    With several processes each one takes a part; all get all scores.

    Parameters
    ----------
    recordings : sequence of Recording
    base : {"plain", "best"}
        Which is corrected; Omega is against "plain" in any case.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        base: Base,
        *,
        velocity: Velocity = "recomputed",
        device: str | torch.device = "cpu",
        world: World | None = None,
    ) -> None:
        self.recordings, self._velocity = tuple(recordings), velocity
        self._world = World() if world is None else world
        self._numbers = range(self._world.rank, len(recordings), self._world.size)
        own = [recordings[i] for i in self._numbers]
        self._group = SceneGroup(own, base, device) if own else None

    @torch.no_grad()
    def __call__(self, corrector: Corrector) -> Scores:
        """Omega of each simulation."""
        found = torch.zeros(2, len(self.recordings), dtype=torch.float64)
        if self._group is not None:
            squares, failed = self._rollout(self._group, corrector)
            plain = np.array([_squares(r) for r in self._group.recordings])
            omegas = 100.0 * (1.0 - squares / plain)
            chosen = list(self._numbers)
            found[0, chosen] = torch.from_numpy(np.where(failed, FAILED, omegas))
            found[1, chosen] = torch.from_numpy(failed.astype(np.float64))
        found = self._world.total(found)
        return Scores(found[0].numpy(), int(found[1].sum()))

    def _rollout(
        self, group: SceneGroup, corrector: Corrector
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Squared distance from the reference over all frames and nodes, m2; what failed."""
        hybrid = BatchHybrid(group.stepper, corrector, velocity=self._velocity)
        rest = group.stepper.rest_state()
        state, previous = rest, None
        total = torch.zeros(len(group), dtype=torch.float64, device=group.device)
        ok = torch.ones(len(group), dtype=torch.bool, device=group.device)
        steps = torch.from_numpy(group.steps).to(group.device)
        for frame in range(1, int(group.steps.max()) + 1):
            result = hybrid(state, previous)
            state, previous = result.state, result.correction
            running = steps >= frame
            fine = torch.tensor([s.ok for s in result.coarse.statuses], device=group.device)
            fine &= torch.isfinite(state.positions).flatten(1).all(dim=1) & ~result.refused
            ok &= fine | ~running
            state = _where(ok, state, rest)
            error = state.positions - group.truth(np.minimum(frame, group.steps))
            square = group.sums(error.square().sum(dim=2))
            total += torch.where(running, square, 0.0)
        return total.cpu().numpy(), ~ok.cpu().numpy()


def _squares(recording: Recording) -> float:
    """Of the plain model's rollout, over all frames and nodes, m2."""
    return float(((recording.plain[1:].astype(np.float64) - recording.reference[1:]) ** 2).sum())


def _where(ok: Tensor, state: BatchState, rest: BatchState) -> BatchState:
    """The state, but rest where it is of no use, which costs little."""
    at = ok[:, None, None]
    return replace(
        state,
        positions=torch.where(at, state.positions, rest.positions),
        velocities=torch.where(at, state.velocities, rest.velocities),
        memory={name: torch.where(at, x, 0.0) for name, x in state.memory.items()},
    )

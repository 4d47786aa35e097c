"""`SceneGroup`: simulations that are stepped together, with their reference on the device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import HybridLayer
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.placements import Velocity
from pdcorrect.training.recordings import Base, Recording, base_errors, make_problems

Frames = NDArray[np.int64]

_LOST = 100.0
"""Squared distance from the reference over that of the base model's rollout."""


class SceneGroup:
    """B recorded simulations in one `BatchStepper`.

    Parameters
    ----------
    recordings : sequence of Recording
    base : {"plain", "best"}
    device : str or torch.device

    Attributes
    ----------
    steps : (B,) int
        T of each simulation.
    errors : BaseErrors
    counts : (B,) tensor
        Nodes.
    """

    def __init__(
        self, recordings: Sequence[Recording], base: Base, device: str | torch.device
    ) -> None:
        self.recordings = tuple(recordings)
        self.stepper = BatchStepper(
            make_problems(recordings, base), device=str(device), recover=False
        )
        self.device = self.stepper.device
        self.steps: Frames = np.array([r.steps for r in recordings])
        self.errors = base_errors(recordings, self.device)
        self.mask = self.stepper.node_mask
        self.counts = self.mask.sum(dim=1).to(torch.float64)
        self._reference = self._padded([r.reference for r in recordings])
        self._layers: dict[tuple[int, bool, Velocity], HybridLayer] = {}

    def __len__(self) -> int:
        return len(self.recordings)

    @property
    def time_step(self) -> float:
        """Seconds."""
        return self.stepper.time_step

    def layer(self, corrector: Corrector, through_solver: bool, velocity: Velocity) -> HybridLayer:
        """The hybrid's step; scenes that fail have no derivatives."""
        key = id(corrector), through_solver, velocity
        if key not in self._layers:
            self._layers = {
                key: HybridLayer(
                    self.stepper, corrector, through_solver=through_solver, velocity=velocity,
                    on_failure="zero",
                )
            }  # fmt: skip
        return self._layers[key]

    def truth(self, frames: Frames) -> Tensor:
        """The reference's positions (B, N, 3), float64, in one frame of each simulation."""
        rows = torch.arange(len(self), device=self.device)
        at = torch.from_numpy(np.asarray(frames)).to(self.device, non_blocking=True)
        return self._reference[rows, at].to(torch.float64)

    def states(self, frames: Frames) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the reference, (B, N, 3).

        Velocities are backward differences; zero in frame 0.
        """
        now = self.truth(frames)
        return now, (now - self.truth(np.maximum(frames - 1, 0))) / self.time_step

    def times(self, frames: Frames) -> list[float]:
        """Seconds."""
        return [self.time_step * int(frame) for frame in frames]

    def sums(self, values: Tensor) -> Tensor:
        """Sums (B,) over the nodes of each scene of values (B, N)."""
        return torch.where(self.mask, values, 0.0).sum(dim=1)

    def lost(self, positions: Tensor, frames: Frames) -> NDArray[np.bool_]:
        """Which scenes are so far from the reference that nothing is to be learned there, (B,)."""
        squares = self.sums((positions - self.truth(frames)).square().sum(dim=2)) / self.counts
        far = ~(squares <= _LOST * torch.maximum(self.errors.rollout, self.errors.one_step))
        found: NDArray[np.bool_] = far.cpu().numpy()
        return found

    def _padded(self, runs: Sequence[NDArray[np.floating]]) -> Tensor:
        """(B, T+1, N, 3), float32; runs that are shorter stay in their last frame."""
        frames, nodes = max(map(len, runs)), self.mask.shape[1]
        out = np.zeros((len(runs), frames, nodes, 3), dtype=np.float32)
        for row, run in zip(out, runs, strict=True):
            row[: len(run), : run.shape[1]] = run
            row[len(run) :, : run.shape[1]] = run[-1]
        return torch.from_numpy(out).to(self.device)


def grouped(
    recordings: Sequence[Recording], size: int, *, seed: int, rank: int = 0, world_size: int = 1
) -> list[list[Recording]]:
    """A rank's groups of at most ``size`` simulations.

    Meshes are in random order and simulations of a mesh stay together, for they share
    factorisations.
    """
    meshes = sorted({(r.split, r.mesh) for r in recordings})
    turn = np.random.default_rng((seed, 2)).permutation(len(meshes))
    place = {mesh: int(k) for mesh, k in zip(meshes, turn, strict=True)}
    ordered = sorted(recordings, key=lambda r: (place[r.split, r.mesh], r.number))
    groups = [ordered[i : i + size] for i in range(0, len(ordered), size)]
    return groups[rank::world_size]

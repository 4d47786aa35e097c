"""`SceneGroup`: simulations that are stepped together, with their reference on the device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import HybridLayer
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.problem import Base
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.losses import BodyModes, Vibrations, body_modes
from pdcorrect.training.recordings import Recording, base_errors, make_problems

Frames = NDArray[np.int64]

_LEAST_FREE = 0.2
"""Of a GPU's memory, when a group is set up."""


class SceneGroup:
    """B recorded simulations in one `BatchStepper`.

    ``modes`` are those of meshes that are known already, by file; new ones are added.  ``steps``
    (B,) is T of each simulation, ``counts`` (B,) its nodes, of which all have ``nodes``.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        base: Base,
        device: str | torch.device,
        modes: dict[Path, BodyModes] | None = None,
    ) -> None:
        self.recordings = tuple(recordings)
        self._modes = {} if modes is None else modes
        self.stepper = BatchStepper(
            make_problems(recordings, base), device=str(device), recover=False
        )
        self.device = self.stepper.device
        self.steps: Frames = np.array([r.steps for r in recordings])
        self.errors = base_errors(recordings, self.device)
        self.mask = self.stepper.node_mask
        self.counts = self.mask.sum(dim=1).to(torch.float64)
        self.nodes = sum(self.stepper.node_counts)
        self._rows = torch.arange(len(self), device=self.device)
        self._reference = self._padded([r.reference for r in recordings])
        self._layers: dict[tuple[int, bool], HybridLayer] = {}

    def __len__(self) -> int:
        return len(self.recordings)

    @property
    def time_step(self) -> float:
        """Seconds."""
        return self.stepper.time_step

    def layer(self, corrector: Corrector, through_solver: bool) -> HybridLayer:
        """The hybrid's step; scenes that fail have no derivatives."""
        key = id(corrector), through_solver
        if key not in self._layers:
            self._layers = {
                key: HybridLayer(
                    self.stepper, corrector, through_solver=through_solver, on_failure="zero"
                )
            }
        return self._layers[key]

    def truth(self, frames: Frames) -> Tensor:
        """The reference's positions (B, N, 3), float64, in one frame of each simulation."""
        return self._reference[self._rows, self.on_device(frames)].to(torch.float64)

    def on_device(self, values: NDArray[Any]) -> Tensor:
        """Numbers of the scenes (B,) on the device, which is not waited for."""
        return torch.from_numpy(np.asarray(values)).to(self.device, non_blocking=True)

    def by_node(self, values: Tensor) -> Tensor:
        """Values (B,) of the scenes at their nodes without padding, (n,)."""
        return values.index_select(0, self._owners)

    @cached_property
    def _owners(self) -> Tensor:
        """Scene of each node, (n,)."""
        counts = self.mask.sum(dim=1)
        return torch.repeat_interleave(self._rows, counts, output_size=self.nodes)

    def states(self, frames: Frames) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the reference, (B, N, 3).

        Velocities are backward differences; zero in frame 0.
        """
        now = self.truth(frames)
        return now, (now - self.truth(np.maximum(frames - 1, 0))) / self.time_step

    @cached_property
    def vibrations(self) -> Vibrations:
        """Small vibrations of the base model's bodies about their shapes at rest."""
        if self.stepper.integrator != "backward-euler":
            raise InputError(
                f"loss.ahead with integrator {self.stepper.integrator!r}: expected backward-euler, "
                "whose velocities are differences of positions, as the reference's are."
            )
        for recording, problem in zip(self.recordings, self.stepper.problems, strict=True):
            if recording.path not in self._modes:  # all its simulations have one material
                try:
                    self._modes[recording.path] = body_modes(problem)
                except ConvergenceError as error:
                    raise ConvergenceError(f"{recording.name}: its modes: {error}") from None
        meshes = list(dict.fromkeys(r.path for r in self.recordings))
        return Vibrations(
            [self._modes[path] for path in meshes],
            [meshes.index(r.path) for r in self.recordings],
            self.steps,
            self.time_step,
            self.mask.shape[1],
            self.device,
        )

    def sums(self, values: Tensor) -> Tensor:
        """Sums (B,) over the nodes of each scene of values (B, N)."""
        return torch.where(self.mask, values, 0.0).sum(dim=1)

    def lost(self, positions: Tensor, frames: Frames) -> NDArray[np.bool_]:
        """Which scenes' mean squared distance is more than the base model's D, (B,)."""
        squares = self.sums((positions - self.truth(frames)).square().sum(dim=2)) / self.counts
        far = ~(squares <= self.errors.largest)
        found: NDArray[np.bool_] = far.cpu().numpy()
        return found

    def _padded(self, runs: Sequence[NDArray[np.floating]]) -> Tensor:
        """(B, T+1, N, 3), float32; runs that are shorter stay in their last frame."""
        frames, nodes = max(map(len, runs)), self.mask.shape[1]
        out = np.zeros((len(runs), frames, nodes, 3), dtype=np.float32)
        for row, run in zip(out, runs, strict=True):
            row[:, : run.shape[1]] = run[np.minimum(np.arange(frames), len(run) - 1)]
        return torch.from_numpy(out).to(self.device)


class SceneGroups:
    """A process's groups of simulations, set up when they are first needed and then kept."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        base: Base,
        device: str | torch.device = "cpu",
        *,
        seed: int = 0,
        world: ProcessGroup | None = None,
    ) -> None:
        self.recordings, self.device = tuple(recordings), torch.device(device)
        self.world = ProcessGroup() if world is None else world
        self._base, self._seed = base, seed
        self._known: dict[tuple[tuple[Path, int], ...], SceneGroup] = {}
        self._modes: dict[Path, BodyModes] = {}

    def of(self, size: int, shortest: int) -> list[list[Recording]]:
        """The simulations of at least so many steps, in groups of at most ``size``.

        Meshes are in random order and simulations of a mesh stay together, for they share
        factorisations.
        """
        usable = [r for r in self.recordings if r.steps >= shortest]
        meshes = list(dict.fromkeys(r.path for r in usable))
        turn = np.random.default_rng((self._seed, 2)).permutation(len(meshes))
        place = {path: int(k) for path, k in zip(meshes, turn, strict=True)}
        ordered = sorted(usable, key=lambda r: (place[r.path], r.number))
        groups = [ordered[i : i + size] for i in range(0, len(ordered), size)]
        found = groups[self.world.rank :: self.world.size]
        if not found:
            raise InputError(
                f"{len(usable)} simulations of {shortest} steps or more, in groups of {size}, "
                f"for {self.world.size} processes: expected a group for each."
            )
        return found

    def __call__(self, recordings: Sequence[Recording]) -> SceneGroup:
        """The group of some simulations."""
        key = tuple((r.path, r.number) for r in recordings)
        if key not in self._known:
            self._make_room()
            self._known[key] = SceneGroup(recordings, self._base, self.device, self._modes)
        return self._known[key]

    def _make_room(self) -> None:
        """Forget groups, which are set up anew when they are needed, if a GPU is nearly full."""
        if self.device.type != "cuda":
            return
        free, total = torch.cuda.mem_get_info(self.device)
        while free < _LEAST_FREE * total and self._known:
            del self._known[next(iter(self._known))]
            torch.cuda.empty_cache()
            free, total = torch.cuda.mem_get_info(self.device)

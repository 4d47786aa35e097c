"""`StepWindows`: single steps of many bodies with the corrections that they need.

They come from the stored predictions of a data set, so no simulator runs.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pdcorrect.corrector.architecture import CorrectorConfig
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.features import Snapshot
from pdcorrect.corrector.placements import ballistic
from pdcorrect.data.configuration import TRAINING
from pdcorrect.data.folder import Folders
from pdcorrect.data.reader import TrajectoryDataset
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Base
from pdcorrect.training.losses import BaseErrors
from pdcorrect.training.recordings import Recording, base_errors
from pdcorrect.training.tables import Numbers, StoredWindows, WindowTables

_SHARE_OF_DEVICE = 0.3
"""Of a GPU's free memory, which the windows may fill."""


@dataclass(frozen=True, eq=False)
class StepBatch:
    """A step of B bodies with n nodes.

    Attributes
    ----------
    bodies : BodyGraph
    snapshot : Snapshot
    target : (n, 3)
        The correction that leads to the reference, m; for placement "guess" to the base
        model's answer.
    scale : (B,)
        Mean squared one-step error of the base model on each trajectory, m2.
    """

    bodies: BodyGraph
    snapshot: Snapshot
    target: Tensor
    scale: Tensor

    def with_noise(self, tau: float, generator: torch.Generator) -> StepBatch:
        """The same with Gaussian noise on the proposal, which the target takes back.

        ``tau`` is the deviation of a component in the root mean square of a component of the
        base model's one-step errors.
        """
        x = self.snapshot.proposed
        noise = torch.randn(x.shape, generator=generator, dtype=x.dtype, device=x.device)
        noise = noise * self.bodies.by_node((self.scale / 3.0).sqrt())[:, None]
        noise = torch.where(self.bodies.free, tau * noise, 0.0)
        snapshot = replace(self.snapshot, proposed=x + noise)
        return replace(self, snapshot=snapshot, target=self.target - noise)


class StepWindows:
    """Windows of a data set's training split.

    They are kept in memory: the device's, or the CPU's if they would fill more than 0.3 of what
    is free on a GPU.

    Parameters
    ----------
    folder : path, or sequence of paths
    recordings : sequence of Recording
        All of the split, for the base model's errors.
    config : CorrectorConfig
    base : {"plain", "best", "total-mass"}
    device : str or torch.device
    without : collection of str
        Files of each data set that are left out, see `pdcorrect.data.folder.shard_paths`.

    Raises
    ------
    InputError
        If the recordings are not those of the split.
    """

    def __init__(
        self,
        folder: Folders,
        recordings: Sequence[Recording],
        config: CorrectorConfig,
        base: Base,
        *,
        device: str | torch.device = "cpu",
        without: Collection[str] = (),
    ) -> None:
        self.config, self.device = config, torch.device(device)
        self._history = "previous-correction" in config.node_features
        steps = 2 if self._history else 1
        self.dataset = TrajectoryDataset(folder, TRAINING, window=steps, base=base, without=without)
        numbers = {header.path: k for k, header in enumerate(self.dataset.headers)}
        wanted = [(h.path, k) for h in self.dataset.headers for k in range(len(h.steps))]
        if sorted((r.path, r.number) for r in recordings) != sorted(wanted):
            raise InputError(
                f"{len(recordings)} recordings for {len(wanted)} simulations: expected those of "
                "the same files, one each."
            )
        columns = max(r.number for r in recordings) + 1
        places = torch.full((len(numbers), columns), -1, dtype=torch.int64)
        for k, r in enumerate(recordings):
            places[numbers[r.path], r.number] = k
        self._recordings = places.to(self.device)
        self._masses = {numbers[r.path]: r.total_mass for r in recordings}
        self._errors = base_errors(recordings, self.device)
        self._tables = WindowTables(self.dataset, self._alone, self._home())

    def _home(self) -> torch.device:
        """Where the tables are kept."""
        size = int(self.dataset.shard_bytes().sum())
        if self.device.type != "cuda":
            return self.device
        free = torch.cuda.mem_get_info(self.device)[0]
        return self.device if size < _SHARE_OF_DEVICE * free else torch.device("cpu")

    def batch(self, indices: Sequence[int] | Numbers, *, last: bool = True) -> StepBatch:
        """The last steps of chosen windows, or the first.

        Windows have two where the network sees the correction of the step before, else one.  Of
        a window's first step that correction is None, as where a simulation begins.
        """
        return self.step_batch(self.windows(indices), last=last)

    def windows(self, indices: Sequence[int] | Numbers) -> StoredWindows:
        """All steps of chosen windows."""
        return self._tables.batch(indices).to(self.device)

    def errors(self, stored: StoredWindows) -> BaseErrors:
        """The base model's on the trajectory of each window."""
        return self._errors.of(self._recordings[stored.file, stored.simulation])

    def step_batch(self, stored: StoredWindows, *, last: bool = True) -> StepBatch:
        """What windows say about a step of theirs."""
        positions, velocities, previous = stored.positions, stored.velocities, None
        bodies, step = stored.bodies, 0
        if self._history and last:
            step = 1
            before, positions = positions, stored.targets[0]
            previous = positions - stored.predictions[0]
            velocities = (positions - before) / bodies.by_node(bodies.time_step)[:, None]
        coarse = stored.predictions[step]
        state = Snapshot(positions, velocities, coarse, stored.forces[step], previous)
        target = stored.targets[step] - coarse
        if self.config.placement != "state":
            h: Any = bodies.by_node(bodies.time_step)[:, None]
            # the clamps of the stored coarse step are where they are prescribed
            start = ballistic(state, h, state.forces, bodies.mass, bodies.free, coarse)
            state = replace(state, proposed=start)
            target = coarse - start if self.config.placement == "guess" else target
        return StepBatch(bodies, state, target, self.errors(stored).after(1))

    def beginnings(self) -> Numbers:
        """Numbers of the windows with which simulations begin."""
        every = np.arange(len(self.dataset))
        return every[self.dataset.places(every)[2] == 0]

    def of_each_mesh(self) -> Numbers:
        """Numbers of one window of each file."""
        files, _, _ = self.dataset.places(np.arange(len(self.dataset)))
        return np.unique(files, return_index=True)[1]

    def _alone(self, window: int) -> BodyGraph:
        """The body of a window, of the base model's mass."""
        found = self.dataset.batch([window])
        body = BodyGraph.of_batch(found).to(dtype=torch.float64)
        mass = self._masses[int(found.file)]
        if mass is None:
            return body
        factor = mass / body.mass.sum()
        return replace(body, mass=factor * body.mass, density=factor * body.density)

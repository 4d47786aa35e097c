"""`StepBatch`: single steps of many bodies with the corrections that they need.

They come from the stored predictions of a data set, so no simulator runs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pdcorrect.corrector.architecture import CorrectorConfig
from pdcorrect.corrector.bodies import KNOWN, BodyGraph
from pdcorrect.corrector.features import Snapshot
from pdcorrect.corrector.placements import ballistic
from pdcorrect.data.configuration import TRAINING
from pdcorrect.data.folder import Folders
from pdcorrect.data.reader import CACHE_BYTES, ShardShuffle, TrajectoryDataset, TrajectoryLoader
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Base
from pdcorrect.training.losses import BaseErrors
from pdcorrect.training.recordings import Recording, base_errors
from pdcorrect.training.resident import ResidentWindows, StoredWindows

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

    def with_noise(self, tau: float, relative: bool, generator: torch.Generator) -> StepBatch:
        """The same with Gaussian noise on the proposal, which the target takes back.

        ``tau`` is the deviation of a component, in m or, if ``relative``, in the root mean
        square of a component of the base model's one-step errors.
        """
        x = self.snapshot.proposed
        noise = torch.randn(x.shape, generator=generator, dtype=x.dtype, device=x.device)
        if relative:
            noise = noise * self.bodies.by_node((self.scale / 3.0).sqrt())[:, None]
        noise = torch.where(self.bodies.free, tau * noise, 0.0)
        snapshot = replace(self.snapshot, proposed=x + noise)
        return replace(self, snapshot=snapshot, target=self.target - noise)


class StepWindows:
    """Endless batches of windows of a data set's training split, on a device.

    Parameters
    ----------
    folder : path, or sequence of paths
    recordings : sequence of Recording
        All of the split, for the base model's errors.
    config : CorrectorConfig
    base : {"plain", "best", "total-mass"}
    device : str or torch.device
    workers : int
        Processes that read ahead; none are needed where the split is kept in memory.
    steps : int
        Of what `windows` gives, at least; `batch` takes the first one or two.
    resident : bool, optional
        Whether all windows are kept in the device's memory, see `ResidentWindows`.  By
        default if they take less than 0.3 of what is free on a GPU, or 4 GiB on the CPU.
    without : collection of str
        Files of each data set that are left out, see `pdcorrect.data.folder.shard_paths`.
    """

    def __init__(
        self,
        folder: Folders,
        recordings: Sequence[Recording],
        config: CorrectorConfig,
        base: Base,
        *,
        device: str | torch.device = "cpu",
        workers: int = 0,
        steps: int = 1,
        resident: bool | None = None,
        without: Collection[str] = (),
    ) -> None:
        self.config, self.device = config, torch.device(device)
        self._history = "previous-correction" in config.node_features
        steps = max(steps, 2 if self._history else 1)
        self.dataset = TrajectoryDataset(folder, TRAINING, window=steps, base=base, without=without)
        size = int(self.dataset.shard_bytes().sum())
        self.resident = _fits(size, self.device) if resident is None else resident
        self._workers = 0 if self.resident else workers
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
        files, first = np.unique(self.dataset.shard_numbers(), return_index=True)
        self._first = dict(zip(files.tolist(), first.tolist(), strict=True))
        self._known: dict[int, BodyGraph] = {}

    def batch(self, indices: Sequence[int], *, last: bool = True) -> StepBatch:
        """The first steps of chosen windows, or the last of those that `batch` looks at.

        These are two where the network sees the correction of the step before, else one.  Of a
        window's first step that correction is None, as where a simulation begins.
        """
        return self.step_batch(self.windows(indices), last=last)

    def windows(self, indices: Sequence[int]) -> StoredWindows:
        """All steps of chosen windows."""
        if self.resident:
            return self._tables.batch(indices)
        return self._stored(self.dataset.batch(indices))

    def errors(self, stored: StoredWindows) -> BaseErrors:
        """The base model's on the trajectory of each window."""
        return self._errors.of(self._recordings[stored.file, stored.simulation])

    @cached_property
    def _tables(self) -> ResidentWindows:
        return ResidentWindows(self.dataset, self._alone, self.device)

    def batches(
        self, size: int, *, seed: int, rank: int = 0, world_size: int = 1
    ) -> EndlessBatches:
        """Batches of ``size`` windows in random order, epoch after epoch."""
        options: dict[str, Any] = {"pin_memory": self.device.type == "cuda" and self._workers > 0}
        if self._workers:
            options |= {"num_workers": self._workers, "persistent_workers": True}
        if self.resident:
            options |= {"assemble": self._tables.batch}
        block = len(self.dataset.headers) if self.resident else None
        shuffle = ShardShuffle(
            self.dataset, seed=seed, block=block, rank=rank, world_size=world_size
        )
        whole = len(shuffle) >= size
        loader = TrajectoryLoader(self.dataset, size, shuffle, drop_last=whole, **options)
        return EndlessBatches(self, loader)

    def step_batch(self, found: Any, *, last: bool = True) -> StepBatch:
        """What `StoredWindows`, or a batch of samples on the CPU, say about a step of theirs."""
        stored, step = found if isinstance(found, StoredWindows) else self._stored(found), 0
        positions, velocities, previous = stored.positions, stored.velocities, None
        bodies = stored.bodies
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

    def _stored(self, found: Any) -> StoredWindows:
        """A batch of samples on the device."""
        files = found.file.tolist()
        found = found.to(self.device, non_blocking=True)
        positions, velocities, targets, predictions, forces = (
            getattr(found, name).to(torch.float64)
            for name in ("positions", "velocities", "targets", "predictions", "forces")
        )
        return StoredWindows(
            self._bodies(found, files), positions, velocities, targets.transpose(0, 1),
            predictions.transpose(0, 1), forces.transpose(0, 1), found.file, found.simulation,
        )  # fmt: skip

    def _bodies(self, found: Any, files: Sequence[int]) -> BodyGraph:
        """The bodies of a batch, with what is computed of them at rest once for each file."""
        for file in set(files) - self._known.keys():
            self._known[file] = self._alone(self._first[file])
        known = [self._known[file] for file in files]
        bodies = replace(
            BodyGraph.of_batch(found).to(dtype=torch.float64),
            **{
                name: torch.cat([getattr(body, name) for body in known])
                for name in ("mass", "density", "cell_size")
            },
        )
        for name in KNOWN:
            vars(bodies)[name] = torch.cat([getattr(body, name) for body in known])
        return bodies

    def _alone(self, window: int) -> BodyGraph:
        """The body of a window, of the base model's mass."""
        found = self.dataset.batch([window]).to(self.device)
        body = BodyGraph.of_batch(found).to(dtype=torch.float64)
        mass = self._masses[int(found.file)]
        if mass is None:
            return body
        factor = mass / body.mass.sum()
        return replace(body, mass=factor * body.mass, density=factor * body.density)


class EndlessBatches:
    """Epoch after epoch of a loader; remembers where it is."""

    def __init__(self, windows: StepWindows, loader: TrajectoryLoader) -> None:
        self._windows, self._loader = windows, loader
        self._epoch: Iterator[Any] | None = None
        self._number = 0

    def __len__(self) -> int:
        """Batches of an epoch."""
        return len(self._loader)

    def __next__(self) -> StepBatch:
        """The next batch."""
        while True:
            if self._epoch is None:
                self._epoch = iter(self._loader)
            found = next(self._epoch, None)
            if found is not None:
                return self._windows.step_batch(found)
            self._number += 1
            self._loader.set_epoch(self._number)
            self._epoch = None

    def state_dict(self) -> dict[str, int]:
        """Where it is; numbers only."""
        return self._loader.state_dict()

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Go on where a state was taken."""
        self._loader.load_state_dict(dict(state))
        self._number, self._epoch = state["epoch"], None


def _fits(size: int, device: torch.device) -> bool:
    """Whether so many bytes may be kept on a device."""
    if device.type == "cuda":
        return size < _SHARE_OF_DEVICE * torch.cuda.mem_get_info(device)[0]
    return size <= CACHE_BYTES

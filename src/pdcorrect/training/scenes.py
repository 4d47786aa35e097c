"""`Recording`: a simulation to learn from; `SceneGroup`: some that are stepped together."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
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
from pdcorrect.data.folder import shard_paths
from pdcorrect.data.schema import PLAIN, REFERENCE, Shard, read_shard
from pdcorrect.data.simulate import rebuilt_problems
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.problem import Base, Problem
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.losses import LEAST_ERROR, BaseErrors, BodyModes, Vibrations, body_modes

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulation."""

    path: Path  # the file, which has one mesh
    dataset: str
    config_hash: str
    content_hash: str
    split: str
    number: int  # on its mesh
    # (T+1, N, 3): the reference, and the rollout of the plain coarse model, m
    reference: Array
    plain: Array
    # mean squared errors of the base model, m2, see `pdcorrect.training.losses`
    one_step: float
    rollout: float

    @property
    def steps(self) -> int:
        """T."""
        return len(self.reference) - 1

    @property
    def name(self) -> str:
        """For messages and tables."""
        return f"{self.dataset}, {self.split}/{self.path.stem}/{self.number}"


def load_recordings(
    folder: str | Path,
    split: str,
    base: Base,
    *,
    scenes: bool = True,
    without: Collection[str] = (),
) -> list[Recording]:
    """The simulations of a split, mesh by mesh, without those of files in ``without``.

    ``scenes`` says whether the base model is to step again, for which it takes the scenes.
    """
    found = []
    for path in shard_paths(folder, split, without):
        runs = dict.fromkeys(_runs(base), ("positions", "predictions"))
        shard = read_shard(path, runs=runs)
        _check_complete(path, shard, base, scenes)
        found += [
            _recording(path, shard, number, split, base) for number in range(len(shard.simulations))
        ]
    return found


def base_errors(recordings: Sequence[Recording], device: str | torch.device = "cpu") -> BaseErrors:
    """Of some simulations, in their order."""
    values = [[r.one_step for r in recordings], [r.rollout for r in recordings]]
    return BaseErrors(*torch.tensor(values, dtype=torch.float64, device=device))


def make_problems(recordings: Sequence[Recording], base: Base) -> list[Problem]:
    """The base model's problems; those of one mesh share its discretisation."""
    known: dict[Path, list[Problem]] = {}
    for path in dict.fromkeys(recording.path for recording in recordings):
        known[path] = rebuilt_problems(read_shard(path, runs=(base,)), path, base)
    return [known[recording.path][recording.number] for recording in recordings]


def data_hash(recordings: Sequence[Recording]) -> str:
    """SHA-256 of the content hashes of the files of some simulations, in their order."""
    digest = hashlib.sha256()
    for path, one in {recording.path: recording for recording in recordings}.items():
        digest.update(f"{one.split}/{path.name} {one.content_hash}\n".encode())
    return digest.hexdigest()


def _check_complete(path: Path, shard: Shard, base: Base, scenes: bool) -> None:
    """Refuse a file of which a simulation lacks what a training of ``base`` needs."""
    for number, simulation in enumerate(shard.simulations):
        runs = simulation.runs
        single = runs[base].predictions if base in runs else None
        lacks = ["scene"] if scenes and not simulation.scene_toml else []
        lacks += [
            f"rollout of run {name!r}"
            for name in _runs(base)
            if name not in runs or runs[name].positions is None
        ]
        lacks += [f"single steps of run {base!r}"] if single is None else []
        if lacks:
            raise InputError(
                f"{path}: simulation {number} has no {', no '.join(lacks)}: expected what a "
                f"training with base = {base!r} needs."
            )


def _runs(base: Base) -> tuple[str, ...]:
    """Whose rollouts are needed."""
    return tuple(dict.fromkeys((REFERENCE, PLAIN, base)))


def _recording(path: Path, shard: Shard, number: int, split: str, base: Base) -> Recording:
    """A simulation that lacks nothing, see `_check_complete`."""
    runs = shard.simulations[number].runs
    reference, plain, rollout = (np.asarray(runs[n].positions) for n in (REFERENCE, PLAIN, base))
    return Recording(
        path=path,
        dataset=str(shard.attributes["dataset"]),
        config_hash=str(shard.attributes["config_hash"]),
        content_hash=shard.content_hash,
        split=split,
        number=number,
        reference=reference,
        plain=plain,
        one_step=_mean_square(np.asarray(runs[base].predictions), reference[1:]),
        rollout=_mean_square(rollout[1:], reference[1:]),
    )


def _mean_square(x: Array, y: Array) -> float:
    """Mean over frames and nodes of the squared distance, m2; at least what rounding makes."""
    distance = x.astype(np.float64) - y
    return max(float((distance**2).sum(axis=2).mean()), rounding(y), LEAST_ERROR)


def rounding(positions: Array) -> float:
    """Squared distance that storing positions in their type may make, m2."""
    size = float(np.abs(positions).max(initial=0.0))
    return (size * float(np.finfo(positions.dtype).eps)) ** 2


Frames = NDArray[np.int64]

_LEAST_FREE = 0.2  # of a GPU's memory, when a group is set up


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

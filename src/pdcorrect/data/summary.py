"""What a data set contains, in numbers: sizes, ranges, errors of the runs, cost."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect.data.folder import Damage, all_shards, read_files, splits_of
from pdcorrect.data.schema import PLAIN, REFERENCE, Shard, Simulation, read_shard
from pdcorrect.errors import InputError
from pdcorrect.metrics import error_corrected, largest_displacement, mean_squared_error, rms_error

Range = tuple[float, float]


@dataclass(frozen=True)
class RunInfo:
    """One run over the simulations that have it; None where nothing tells."""

    simulations: int
    iterations: float | None  # mean of a step
    # of the rollout from the reference's, over that one's RMS displacement, mean over simulations;
    # beside a converged reference the error that counts
    relative_error: float | None
    rms_error: float | None  # the same in m
    # RMS distance from the reference after one step from each of its frames, mean, m
    step_error: float | None
    omega: float | None  # share of the plain run's squared error that it removes, per cent, mean
    seconds: float  # cost, of single steps too


@dataclass(frozen=True)
class SplitInfo:
    """A split, or the whole data set."""

    meshes: int
    simulations: int
    frames: int  # over all simulations, without the rest shape
    bytes: int
    # smallest and largest of its meshes; Pa, dimensionless, kg/m3
    nodes: Range
    young: Range
    poisson: Range
    density: Range
    displacement: Range  # smallest and largest of the simulations' largest ones, m
    rejection_rate: float  # rejected draws over all draws
    rejections: Mapping[str, int]  # rejected draws by "run, reason"
    runs: Mapping[str, RunInfo]
    seconds: float  # cost of all runs


@dataclass(frozen=True)
class DatasetInfo:
    """A data set in numbers, as a whole and by split."""

    name: str
    whole: SplitInfo
    splits: Mapping[str, SplitInfo]
    # files that were left out, and what is wrong with them
    damaged: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> str:
        """All numbers, in SI units and per cent."""
        return json.dumps(asdict(self), indent=2, allow_nan=False)

    def tables(self) -> Iterable[tuple[str, Sequence[str], list[Sequence[str]], int]]:
        """Of sizes, runs and rejected loads title, headings, rows, and columns that are names."""
        several = [("all", self.whole)] if len(self.splits) > 1 else []
        splits = [*self.splits.items(), *several]
        yield (
            f"{self.name}: sizes, materials, and largest displacements of the simulations",
            ("split", "meshes", "simulations", "frames", "MB", "nodes", "E, kPa", "ν",
             "density, kg/m3", "displacement, mm", "loads rejected, %"),
            [(
                name, *map(str, (split.meshes, split.simulations, split.frames)),
                _text(split.bytes, 1e-6), _between(split.nodes), _between(split.young, 1e-3),
                _between(split.poisson), _between(split.density),
                _between(split.displacement, 1e3), _text(split.rejection_rate, 100.0),
            ) for name, split in splits], 1,
        )  # fmt: skip
        yield (
            "runs: mean distance from the reference; Omega, % of the plain run's squared error; "
            "cost",
            ("split", "run", "simulations", "error, %", "RMS, mm", "one step, mm", "Omega",
             "iterations", "s"),
            [(
                name, label, str(run.simulations), _text(run.relative_error, 100.0),
                _text(run.rms_error, 1e3), _text(run.step_error, 1e3), _text(run.omega),
                _text(run.iterations), _text(run.seconds or None),
            ) for name, split in splits for label, run in split.runs.items()], 2,
        )  # fmt: skip
        if self.whole.rejections:
            rows: list[Sequence[str]] = [
                (n, why, str(k)) for n, s in splits for why, k in s.rejections.items()
            ]
            yield "loads rejected", ("split", "reason", "draws"), rows, 2


def dataset_info(
    folder: str | Path, on_file: Callable[[Path], None] | None = None, *, skip_damaged: bool = False
) -> DatasetInfo:
    """Read a data set and summarise it; ``on_file`` is called with each file after it was read.

    With ``skip_damaged`` damaged files are left out, and listed in the result.

    Raises
    ------
    InputError
        If the folder holds no files of meshes.
    FileFormatError
        If one of them is damaged; with ``skip_damaged`` if all are.
    """

    def read(path: Path) -> _Numbers:
        found = _of_mesh(read_shard(path), path)
        if on_file:
            on_file(path)
        return found

    damaged: Damage = {}
    names = splits_of(folder)
    meshes = read_files(all_shards(folder), read, damaged if skip_damaged else None)
    parts = {name: [mesh for mesh in meshes if mesh["split"] == name] for name in names}
    splits = {name: _summary(part) for name, part in parts.items() if part}
    left_out = {f"{p.parent.name}/{p.name}": text for p, text in damaged.items()}
    return DatasetInfo(Path(folder).resolve().name, _summary(meshes), splits, left_out)


_Numbers = dict[str, Any]
"""Of a file, a simulation or a run, by the names in `SplitInfo` and `RunInfo`."""


def _of_mesh(shard: Shard, path: Path) -> _Numbers:
    return {
        "split": path.parent.name,
        "bytes": path.stat().st_size,
        "simulations": list(map(_of_simulation, shard.simulations)),
        "nodes": len(shard.points),
        **{n: _range(getattr(shard, n)) for n in ("young", "poisson", "density")},
    }


def _of_simulation(simulation: Simulation) -> _Numbers:
    run = simulation.runs.get(REFERENCE)
    if run is None or run.positions is None:
        raise InputError(f"a simulation has no rollout {REFERENCE!r}: expected one of each.")
    reference = run.positions.astype(np.float64)
    return {
        "frames": simulation.steps,
        "rejected": simulation.rejected,
        "seconds": simulation.seconds,
        "displacement": largest_displacement(reference),
        "runs": {name: _of_run(simulation, name, reference) for name in simulation.runs},
    }


def _of_run(simulation: Simulation, name: str, reference: Any) -> _Numbers:
    run = simulation.runs[name]
    found: _Numbers = {}
    if "iterations" in run.statistics:
        found["iterations"] = float(run.statistics["iterations"].mean())
    if name == REFERENCE:
        return found
    if run.positions is not None:
        found["rms_error"] = rms_error(run.positions, reference)
        size = rms_error(np.broadcast_to(reference[0], reference.shape), reference)
        if size > 0.0:
            found["relative_error"] = found["rms_error"] / size
        plain = simulation.runs.get(PLAIN)
        base = None if name == PLAIN or plain is None else plain.positions
        if base is not None and mean_squared_error(base, reference) > 0.0:
            found["omega"] = error_corrected(run.positions, base, reference)
    if run.predictions is not None:
        found["step_error"] = rms_error(np.concatenate([reference[:1], run.predictions]), reference)
    return found


def _summary(meshes: Sequence[_Numbers]) -> SplitInfo:
    motions = [motion for mesh in meshes for motion in mesh["simulations"]]
    names = sorted(
        {name for motion in motions for name in motion["runs"]},
        key=lambda name: (name != REFERENCE, name != PLAIN, name),
    )
    reasons = [re.sub(r"step \d+: ", "", text) for m in motions for text in m["rejected"]]
    return SplitInfo(
        meshes=len(meshes),
        simulations=len(motions),
        frames=sum(motion["frames"] for motion in motions),
        bytes=sum(mesh["bytes"] for mesh in meshes),
        **{n: _range([m[n] for m in meshes]) for n in ("nodes", "young", "poisson", "density")},
        displacement=_range([motion["displacement"] for motion in motions]),
        rejection_rate=len(reasons) / (len(reasons) + len(motions)),
        rejections=dict(sorted(Counter(reasons).items())),
        runs={name: _run_info(name, motions) for name in names},
        seconds=sum(sum(motion["seconds"].values()) for motion in motions),
    )


def _range(values: Any) -> Range:
    return float(np.min(values)), float(np.max(values))


def _run_info(name: str, motions: Sequence[_Numbers]) -> RunInfo:
    runs = [motion["runs"][name] for motion in motions if name in motion["runs"]]
    means = {}
    for what in ("iterations", "relative_error", "rms_error", "step_error", "omega"):
        values = [run[what] for run in runs if what in run]
        means[what] = float(np.mean(values)) if values else None
    keys = (name, f"{name} steps")
    seconds = sum(motion["seconds"].get(key, 0.0) for motion in motions for key in keys)
    return RunInfo(simulations=len(runs), seconds=seconds, **means)


def _between(values: Range, factor: float = 1.0) -> str:
    return " - ".join(dict.fromkeys(f"{factor * value:.4g}" for value in values))


def _text(value: float | None, factor: float = 1.0) -> str:
    return "" if value is None else f"{factor * value:.3g}"

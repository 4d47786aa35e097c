"""What a data set contains, in numbers: sizes, ranges, motions, errors of the runs, cost."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdcorrect.data.folder import Damage, all_shards, whole_files
from pdcorrect.data.schema import PLAIN, REFERENCE, Shard, Simulation
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.errors import InputError
from pdcorrect.metrics import error_corrected, largest_displacement, mean_squared_error, rms_error

if TYPE_CHECKING:
    from rich.console import RenderableType

Range = tuple[float, float]


@dataclass(frozen=True)
class Spread:
    """How a quantity is distributed over simulations."""

    mean: float
    smallest: float
    q05: float
    median: float
    q95: float
    largest: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        """Of one value or more."""
        found = np.array(list(values))
        return cls(float(found.mean()), *np.quantile(found, (0, 0.05, 0.5, 0.95, 1)).tolist())


@dataclass(frozen=True)
class RunInfo:
    """One run over the simulations that have it.

    Attributes
    ----------
    simulations : int
    iterations : float or None
        Mean of a step.
    most_iterations : int or None
    relative_error : float or None
        Of the rollout from the reference's, over that one's RMS displacement, mean over
        simulations; beside a converged reference the error that counts.
    rms_error : float or None
        The same in m.
    step_error : float or None
        RMS distance from the reference after one step from each of its frames, mean, m.
    omega : Spread or None
        Share of the plain run's squared error that it removes, per cent.
    """

    simulations: int
    iterations: float | None
    most_iterations: int | None
    relative_error: float | None
    rms_error: float | None
    step_error: float | None
    omega: Spread | None


@dataclass(frozen=True)
class SplitInfo:
    """A split, or the whole data set.

    Attributes
    ----------
    meshes, simulations, frames, bytes : int
        Frames over all simulations, without the rest shape.
    nodes, cells, young, poisson, density : (smallest, largest)
        Of its meshes; Pa, dimensionless, kg/m3.
    displacement, speed, force : Spread
        Of the simulations' largest values, m, m/s (from frame to frame), N.
    rejected : int
        Draws.
    rejection_rate : float
        Rejected draws over all draws.
    runs : mapping of str to RunInfo
    seconds : mapping of str to float
        Cost by run, and of all as "total".
    rejections : mapping of str to int
        Rejected draws by "run, reason"; empty where the files do not say it.
    """

    meshes: int
    simulations: int
    frames: int
    bytes: int
    nodes: Range
    cells: Range
    young: Range
    poisson: Range
    density: Range
    displacement: Spread
    speed: Spread
    force: Spread
    rejected: int
    rejection_rate: float
    runs: Mapping[str, RunInfo]
    seconds: Mapping[str, float]
    rejections: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class DatasetInfo:
    """A data set in numbers, as a whole and by split.

    Attributes
    ----------
    name : str
    whole : SplitInfo
    splits : mapping of str to SplitInfo
    damaged : mapping of str to str
        Files that were left out, and what is wrong with them.
    """

    name: str
    whole: SplitInfo
    splits: Mapping[str, SplitInfo]
    damaged: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> str:
        """All numbers, in SI units and per cent."""
        return json.dumps(asdict(self), indent=2, allow_nan=False)

    def tables(self) -> RenderableType:
        """For rich's console."""
        from rich.console import Group

        return Group(_size_table(self), _motion_table(self), _run_table(self), _draw_table(self))


def dataset_files(folder: str | Path) -> list[Path]:
    """Files of the meshes in a folder, at least one.

    Raises
    ------
    InputError
        If there are none.
    """
    found = all_shards(folder)
    if not found:
        raise InputError(f"{folder}: holds no files of a data set: expected SPLIT/mesh-0000.h5 ...")
    return found


def dataset_info(
    folder: str | Path,
    on_file: Callable[[Path], None] | None = None,
    *,
    skip_damaged: bool = False,
) -> DatasetInfo:
    """Read a data set and summarise it.

    Parameters
    ----------
    folder : path
    on_file : callable, optional
        Called with each file after it was read.
    skip_damaged : bool
        Whether damaged files are left out, and listed in the result.

    Raises
    ------
    InputError
        If the folder holds no files of meshes.
    FileFormatError
        If one of them is damaged; with ``skip_damaged`` if all are.
    """
    damaged: Damage = {}
    meshes: list[_Mesh] = []
    for path in whole_files(dataset_files(folder), damaged if skip_damaged else None):
        shard = read_shard(path)
        step = float(shard.attributes["time_step"])
        every = [_measured(simulation, step) for simulation in shard.simulations]
        meshes.append((shard, path.stat().st_size, every))
        if on_file:
            on_file(path)
    by_split = defaultdict(list)
    for mesh in meshes:
        by_split[str(mesh[0].attributes["split"])].append(mesh)
    splits = {name: _summary(those) for name, those in by_split.items()}
    left_out = {f"{p.parent.name}/{p.name}": text for p, text in damaged.items()}
    return DatasetInfo(Path(folder).resolve().name, _summary(meshes), splits, left_out)


# --- one simulation ----------------------------------------------------------------------

_Mesh = tuple[Shard, int, list[dict[str, Any]]]
"""A file's content, its bytes, and what `_measured` gives of its simulations."""


def _measured(simulation: Simulation, step: float) -> dict[str, Any]:
    reference = _rollout(simulation, REFERENCE)
    speeds = np.linalg.norm(np.diff(reference, axis=0), axis=2) / step
    return {
        "displacement": largest_displacement(reference),
        "speed": float(speeds.max()),
        "force": float(np.linalg.norm(simulation.forces.astype(np.float64), axis=2).max()),
        "simulation": simulation,
        "runs": {name: _measured_run(simulation, name, reference) for name in simulation.runs},
    }


def _rollout(simulation: Simulation, name: str) -> Any:
    """Positions (T+1, N, 3) of a run that must have them, m."""
    run = simulation.runs.get(name)
    if run is None or run.positions is None:
        raise InputError(f"a simulation has no rollout {name!r}: expected one of each.")
    return run.positions.astype(np.float64)


def _measured_run(simulation: Simulation, name: str, reference: Any) -> dict[str, Any]:
    run = simulation.runs[name]
    found: dict[str, Any] = {"iterations": run.statistics.get("iterations", np.zeros(0)).tolist()}
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


# --- summing up --------------------------------------------------------------------------


def _summary(meshes: Sequence[_Mesh]) -> SplitInfo:
    shards = [shard for shard, _, _ in meshes]
    measured = [one for _, _, simulations in meshes for one in simulations]
    simulations: list[Simulation] = [one["simulation"] for one in measured]
    rejected = sum(simulation.attempt for simulation in simulations)
    every = {name for one in measured for name in one["runs"]}
    names = sorted(every, key=lambda name: (name != REFERENCE, name != PLAIN, name))
    reasons = sorted(re.sub(r"step \d+: ", "", r) for s in simulations for r in s.rejected)
    return SplitInfo(
        meshes=len(meshes),
        simulations=len(simulations),
        frames=sum(simulation.steps for simulation in simulations),
        bytes=sum(size for _, size, _ in meshes),
        nodes=_range([len(shard.points) for shard in shards]),
        cells=_range([len(shard.cells) for shard in shards]),
        young=_range(np.concatenate([shard.young for shard in shards])),
        poisson=_range(np.concatenate([shard.poisson for shard in shards])),
        density=_range(np.concatenate([shard.density for shard in shards])),
        displacement=Spread.of(one["displacement"] for one in measured),
        speed=Spread.of(one["speed"] for one in measured),
        force=Spread.of(one["force"] for one in measured),
        rejected=rejected,
        rejection_rate=rejected / (rejected + len(simulations)),
        runs={n: _run_info([m["runs"][n] for m in measured if n in m["runs"]]) for n in names},
        seconds=_seconds(simulations),
        rejections=dict(Counter(reasons)),
    )


def _range(values: Any) -> Range:
    return float(np.min(values)), float(np.max(values))


def _run_info(runs: Sequence[Mapping[str, Any]]) -> RunInfo:
    iterations = [count for run in runs for count in run["iterations"]]
    omegas = [run["omega"] for run in runs if "omega" in run]
    return RunInfo(
        simulations=len(runs),
        iterations=_mean(iterations),
        most_iterations=max(iterations, default=None),
        relative_error=_mean([run["relative_error"] for run in runs if "relative_error" in run]),
        rms_error=_mean([run["rms_error"] for run in runs if "rms_error" in run]),
        step_error=_mean([run["step_error"] for run in runs if "step_error" in run]),
        omega=Spread.of(omegas) if omegas else None,
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _seconds(simulations: Sequence[Simulation]) -> dict[str, float]:
    found: dict[str, float] = defaultdict(float)
    for simulation in simulations:
        for name, seconds in simulation.seconds.items():
            found[name] += seconds
    return {**found, "total": sum(found.values())}


# --- tables ------------------------------------------------------------------------------


def _table(title: str, *headings: str) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0), pad_edge=False,
    )  # fmt: skip
    for number, heading in enumerate(headings):
        left = number == 0 or heading in ("run", "quantity", "reason")
        table.add_column(heading, justify="left" if left else "right", no_wrap=True)
    return table


def _splits(info: DatasetInfo) -> Iterator[tuple[str, SplitInfo]]:
    """Splits, and the whole where there are several."""
    yield from info.splits.items()
    if len(info.splits) > 1:
        yield "all", info.whole


def _size_table(info: DatasetInfo) -> Any:
    table = _table(
        info.name, "split", "meshes", "simulations", "frames", "MB", "nodes", "cells", "E, kPa",
        "ν", "density, kg/m3",
    )  # fmt: skip
    for name, split in _splits(info):
        counts = [str(split.meshes), str(split.simulations), str(split.frames)]
        ranges = [_between(r) for r in (split.nodes, split.cells)]
        ranges += [_between(split.young, 1e-3), _between(split.poisson), _between(split.density)]
        table.add_row(name, *counts, f"{split.bytes / 1e6:.3g}", *ranges)
    return table


def _between(values: Range, factor: float = 1.0) -> str:
    return " - ".join(dict.fromkeys(f"{factor * value:.4g}" for value in values))


def _motion_table(info: DatasetInfo) -> Any:
    heads = "split", "quantity", "mean", "least", "5 %", "median", "95 %", "most"
    table = _table("largest values of each simulation", *heads)
    for name, split in _splits(info):
        for what, spread, factor in (
            ("displacement, mm", split.displacement, 1e3),
            ("speed, m/s", split.speed, 1.0),
            ("nodal force, N", split.force, 1.0),
        ):
            table.add_row(name, what, *(_text(x, factor) for x in asdict(spread).values()))
            name = ""
    return table


def _run_table(info: DatasetInfo) -> Any:
    table = _table(
        "runs: mean distance from the reference; Omega, % of the plain run's squared error; cost",
        "split", "run", "simulations", "error, %", "RMS, mm", "one step, mm", "Omega", "worst",
        "iterations", "most", "s",
    )  # fmt: skip
    for name, split in _splits(info):
        for label, run in split.runs.items():
            omega = ("", "") if run.omega is None else (run.omega.mean, run.omega.smallest)
            cost = sum(split.seconds.get(key, 0.0) for key in (label, f"{label} steps"))
            values = [
                _text(run.relative_error, 100.0),
                _text(run.rms_error, 1e3),
                _text(run.step_error, 1e3),
                *map(_text, omega),
            ]
            values += [_text(run.iterations), _text(run.most_iterations), _text(cost or None)]
            table.add_row(name, label, str(run.simulations), *values)
            name = ""
    return table


def _draw_table(info: DatasetInfo) -> Any:
    table = _table("loads drawn", "split", "kept", "rejected", "reason")
    for name, split in _splits(info):
        table.add_row(name, str(split.simulations), str(split.rejected))
        for reason, count in split.rejections.items():
            table.add_row("", "", str(count), reason)
    return table


def _text(value: float | str | None, factor: float = 1.0) -> str:
    return f"{factor * value:.3g}" if isinstance(value, (int, float)) else value or ""

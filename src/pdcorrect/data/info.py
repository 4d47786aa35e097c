"""What a data set contains, in numbers: sizes, ranges, motions, errors of the runs, cost."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdcorrect.data.folder import Damage
from pdcorrect.data.measuring import (
    MeasuredMesh,
    MeasuredRun,
    MeasuredSimulation,
    Range,
    measure_dataset,
    value_range,
)
from pdcorrect.data.schema import PLAIN, REFERENCE

if TYPE_CHECKING:
    from rich.console import RenderableType


FEWEST = 20
"""Simulations for which a 5 % quantile is told."""


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
    iterations : float
        Mean of a step.
    most_iterations : int
    rms_error, step_error : float or None
        Means over simulations, m; see `MeasuredRun`.
    omega : Spread or None
        Per cent; ``smallest`` is the worst.
    """

    simulations: int
    iterations: float | None
    most_iterations: int | None
    rms_error: float | None
    step_error: float | None
    omega: Spread | None

    def omega_texts(self) -> tuple[str, str, str, str]:
        """Mean, median, 5 % quantile and worst of omega for a table.

        Empty where there is none; a dash for the quantile of fewer than `FEWEST` simulations.
        """
        if self.omega is None:
            return "", "", "", ""
        quantile = _text(self.omega.q05) if self.simulations >= FEWEST else "–"
        mean, median, worst = map(_text, (self.omega.mean, self.omega.median, self.omega.smallest))
        return mean, median, quantile, worst


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
        Of the simulations' largest values, m, m/s, N; see `MeasuredSimulation`.
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

    @classmethod
    def from_json(cls, text: str) -> DatasetInfo:
        """What `to_json` wrote."""
        found = json.loads(text)
        splits = {name: _split_from(split) for name, split in found["splits"].items()}
        return cls(found["name"], _split_from(found["whole"]), splits, found["damaged"])

    def tables(self) -> RenderableType:
        """For rich's console; those without rows are left out."""
        from rich.console import Group

        return Group(*(found for found in (table(self) for table in _TABLES) if found.row_count))


def _split_from(found: dict[str, Any]) -> SplitInfo:
    """A split of a JSON file."""
    ranges = {n: tuple(found[n]) for n in ("nodes", "cells", "young", "poisson", "density")}
    spreads = {n: Spread(**found[n]) for n in ("displacement", "speed", "force")}
    runs = {
        name: RunInfo(**{**run, "omega": Spread(**run["omega"]) if run["omega"] else None})
        for name, run in found["runs"].items()
    }
    return SplitInfo(**{**found, **ranges, **spreads, "runs": runs})


def dataset_info(
    folder: str | Path,
    on_file: Callable[[Path], None] | None = None,
    *,
    skip_damaged: bool = False,
) -> DatasetInfo:
    """Read a data set and summarise it; parameters and errors as of `measure_dataset`.

    With ``skip_damaged`` damaged files are left out and listed in the result.
    """
    damaged: Damage = {}
    meshes = measure_dataset(folder, on_file, damaged if skip_damaged else None)
    return summarise(Path(folder).resolve().name, meshes, damaged)


def summarise(
    name: str, meshes: Sequence[MeasuredMesh], damaged: Mapping[Path, str] | None = None
) -> DatasetInfo:
    """Summary of measured meshes, by split in their order."""
    splits = dict.fromkeys(mesh.split for mesh in meshes)
    parts = {split: _split([m for m in meshes if m.split == split]) for split in splits}
    left_out = {f"{p.parent.name}/{p.name}": text for p, text in (damaged or {}).items()}
    return DatasetInfo(name, _split(meshes), parts, left_out)


def _split(meshes: Sequence[MeasuredMesh]) -> SplitInfo:
    simulations = [simulation for mesh in meshes for simulation in mesh.simulations]
    rejected = sum(simulation.rejected for simulation in simulations)
    every = {name for simulation in simulations for name in simulation.runs}
    names = sorted(every, key=lambda name: (name != REFERENCE, name != PLAIN, name))
    return SplitInfo(
        meshes=len(meshes),
        simulations=len(simulations),
        frames=sum(simulation.frames for simulation in simulations),
        bytes=sum(mesh.bytes for mesh in meshes),
        nodes=value_range([mesh.nodes for mesh in meshes]),
        cells=value_range([mesh.cells for mesh in meshes]),
        young=value_range([mesh.young for mesh in meshes]),
        poisson=value_range([mesh.poisson for mesh in meshes]),
        density=value_range([mesh.density for mesh in meshes]),
        displacement=Spread.of(simulation.displacement for simulation in simulations),
        speed=Spread.of(simulation.speed for simulation in simulations),
        force=Spread.of(simulation.force for simulation in simulations),
        rejected=rejected,
        rejection_rate=rejected / (rejected + len(simulations)),
        runs={n: _run_info([s.runs[n] for s in simulations if n in s.runs]) for n in names},
        seconds=_seconds(simulations),
        rejections=dict(Counter(sorted(r for s in simulations for r in s.reasons))),
    )


def _run_info(runs: Sequence[MeasuredRun]) -> RunInfo:
    iterations = [count for run in runs for count in run.iterations]
    omegas = [run.omega for run in runs if run.omega is not None]
    return RunInfo(
        simulations=len(runs),
        iterations=_mean(iterations),
        most_iterations=max(iterations, default=None),
        rms_error=_mean([run.rms_error for run in runs if run.rms_error is not None]),
        step_error=_mean([run.step_error for run in runs if run.step_error is not None]),
        omega=Spread.of(omegas) if omegas else None,
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _seconds(simulations: Sequence[MeasuredSimulation]) -> dict[str, float]:
    names = dict.fromkeys(name for simulation in simulations for name in simulation.seconds)
    found = {name: sum(s.seconds.get(name, 0.0) for s in simulations) for name in names}
    return {**found, "total": sum(found.values())}


# --- text --------------------------------------------------------------------------------


def _table(title: str, *headings: str) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for number, heading in enumerate(headings):
        left = number == 0 or heading in ("run", "quantity", "reason")
        table.add_column(heading, justify="left" if left else "right", no_wrap=True)
    return table


def _rows(info: DatasetInfo) -> list[tuple[str, SplitInfo]]:
    """Splits, and the whole where there are several."""
    return [*info.splits.items(), *([("all", info.whole)] if len(info.splits) > 1 else [])]


def _size_table(info: DatasetInfo) -> Any:
    headings = "split", "meshes", "simulations", "frames", "MB", "nodes", "cells"
    table = _table(info.name, *headings)
    for name, split in _rows(info):
        counts = [str(split.meshes), str(split.simulations), str(split.frames)]
        size = f"{split.bytes / 1e6:.3g}"
        table.add_row(name, *counts, size, _between(split.nodes), _between(split.cells))
    return table


def _material_table(info: DatasetInfo) -> Any:
    table = _table("materials", "split", "E, kPa", "Poisson's ratio", "density, kg/m3")
    for name, split in _rows(info):
        others = (_between(values) for values in (split.poisson, split.density))
        table.add_row(name, _between(split.young, 1e-3), *others)
    return table


def _between(values: Range, factor: float = 1.0) -> str:
    texts = dict.fromkeys(f"{factor * value:.4g}" for value in values)
    return " - ".join(texts)


def _motion_table(info: DatasetInfo) -> Any:
    table = _table(
        "largest values of each simulation", "split", "quantity", "mean", "least", "5 %", "median",
        "95 %", "most",
    )  # fmt: skip
    for name, split in _rows(info):
        lines = (
            ("displacement, mm", split.displacement, 1e3),
            ("speed, m/s", split.speed, 1.0),
            ("nodal force, N", split.force, 1.0),
        )
        for number, (what, spread, factor) in enumerate(lines):
            values = [f"{factor * value:.3g}" for value in asdict(spread).values()]
            table.add_row("" if number else name, what, *values)
    return table


def _error_table(info: DatasetInfo) -> Any:
    table = _table(
        "mean distance from the reference; Omega, % of the plain run's squared error",
        "split", "run", "RMS, mm", "one step, mm", "Omega", "median", "5 %", "worst",
    )  # fmt: skip
    for split_name, split in _rows(info):
        runs = {name: run for name, run in split.runs.items() if name != REFERENCE}
        for number, (name, run) in enumerate(runs.items()):
            errors = _text(run.rms_error, 1e3), _text(run.step_error, 1e3)
            table.add_row("" if number else split_name, name, *errors, *run.omega_texts())
    return table


def _iteration_table(info: DatasetInfo) -> Any:
    table = _table("solver iterations of a step", "split", "run", "simulations", "mean", "most")
    for split_name, split in _rows(info):
        runs = {name: run for name, run in split.runs.items() if run.iterations is not None}
        for number, (name, run) in enumerate(runs.items()):
            counts = _text(run.iterations), str(run.most_iterations or "")
            table.add_row("" if number else split_name, name, str(run.simulations), *counts)
    return table


def _cost_table(info: DatasetInfo) -> Any:
    table = _table("cost", "split", "run", "s", "s a simulation")
    for split_name, split in _rows(info):
        known = split.seconds if len(split.seconds) > 1 else {}  # not the total of nothing
        for number, (name, seconds) in enumerate(known.items()):
            run = split.runs.get(name.removesuffix(" steps"))
            each = _text(seconds / (run.simulations if run else split.simulations))
            table.add_row("" if number else split_name, name, _text(seconds), each)
    return table


def _draw_table(info: DatasetInfo) -> Any:
    table = _table("loads drawn", "split", "kept", "rejected", "rejected, %")
    for name, split in _rows(info):
        rate = _text(100 * split.rejection_rate)
        table.add_row(name, str(split.simulations), str(split.rejected), rate)
    return table


def _reason_table(info: DatasetInfo) -> Any:
    table = _table("why loads were rejected", "split", "run", "reason", "loads")
    for split_name, split in _rows(info):
        for number, (text, count) in enumerate(split.rejections.items()):
            run, _, reason = text.partition(", ")
            table.add_row("" if number else split_name, run, reason, str(count))
    return table


def _text(value: float | None, factor: float = 1.0) -> str:
    return "" if value is None else f"{factor * value:.3g}"


_TABLES = (
    _size_table, _material_table, _motion_table, _error_table, _iteration_table, _cost_table,
    _draw_table, _reason_table,
)  # fmt: skip

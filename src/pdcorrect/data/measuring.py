"""Each simulation of a data set, measured: sizes, motions, errors of the runs, cost."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect.data.folder import Damage, all_shards, whole_files
from pdcorrect.data.schema import PLAIN, REFERENCE, Run, Shard, Simulation
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.errors import InputError
from pdcorrect.metrics import error_corrected, largest_displacement, mean_squared_error, rms_error

Range = tuple[float, float]
_STEP = re.compile(r"step \d+: ")


@dataclass(frozen=True)
class MeasuredRun:
    """One run of one simulation.

    Attributes
    ----------
    iterations : tuple of int
        Of each step.
    rms_error : float or None
        Of its rollout from the reference's, m.
    step_error : float or None
        RMS distance from the reference after one step from each of its frames, m.
    omega : float or None
        Share of the plain run's squared error that it removes, per cent.
    """

    iterations: tuple[int, ...]
    rms_error: float | None
    step_error: float | None
    omega: float | None


@dataclass(frozen=True)
class MeasuredSimulation:
    """One simulation.

    Attributes
    ----------
    displacement, speed : float
        Largest of a node of the reference, m and m/s (from frame to frame).
    force : float
        Largest nodal force, N.
    frames : int
    rejected : int
        Draws before it.
    reasons : tuple of str
        Of each rejection, "run, reason", where the file says it; without the step's number.
    seconds : mapping of str to float
        Cost by run.
    runs : mapping of str to MeasuredRun
    """

    displacement: float
    speed: float
    force: float
    frames: int
    rejected: int
    reasons: tuple[str, ...]
    seconds: Mapping[str, float]
    runs: Mapping[str, MeasuredRun]


@dataclass(frozen=True)
class MeasuredMesh:
    """One file: its mesh, material and simulations.

    Attributes
    ----------
    split : str
    bytes, nodes, cells : int
    young, poisson, density : (smallest, largest)
        Pa, dimensionless, kg/m3.
    simulations : tuple of MeasuredSimulation
    """

    split: str
    bytes: int
    nodes: int
    cells: int
    young: Range
    poisson: Range
    density: Range
    simulations: tuple[MeasuredSimulation, ...]


def measure_dataset(
    folder: str | Path,
    on_file: Callable[[Path], None] | None = None,
    damaged: Damage | None = None,
) -> list[MeasuredMesh]:
    """Read a data set and measure each simulation.

    Parameters
    ----------
    folder : path
    on_file : callable, optional
        Called with each file after it was read.
    damaged : dict, optional
        Where given, damaged files are left out and noted here.

    Raises
    ------
    InputError
        If the folder holds no files of meshes.
    FileFormatError
        If one of them is damaged; with ``damaged`` if all are.
    """
    meshes = []
    for path in whole_files(dataset_files(folder), damaged):
        meshes.append(_mesh(read_shard(path), path.stat().st_size))
        if on_file:
            on_file(path)
    return meshes


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


def _mesh(shard: Shard, size: int) -> MeasuredMesh:
    step = float(shard.attributes["time_step"])
    return MeasuredMesh(
        split=str(shard.attributes["split"]),
        bytes=size,
        nodes=len(shard.points),
        cells=len(shard.cells),
        young=value_range(shard.young),
        poisson=value_range(shard.poisson),
        density=value_range(shard.density),
        simulations=tuple(_simulation(s, step) for s in shard.simulations),
    )


def value_range(values: Any) -> Range:
    """The smallest and the largest."""
    return float(np.min(values)), float(np.max(values))


def _simulation(simulation: Simulation, step: float) -> MeasuredSimulation:
    reference = _rollout(simulation, REFERENCE)
    velocities = np.diff(reference, axis=0) / step
    return MeasuredSimulation(
        displacement=largest_displacement(reference),
        speed=float(np.linalg.norm(velocities, axis=2).max()),
        force=float(np.linalg.norm(simulation.forces.astype(np.float64), axis=2).max()),
        frames=simulation.steps,
        rejected=simulation.attempt,
        reasons=tuple(_STEP.sub("", text) for text in simulation.rejected),
        seconds=simulation.seconds,
        runs={name: _run(simulation, name, reference) for name in simulation.runs},
    )


def _rollout(simulation: Simulation, name: str) -> Any:
    """Positions (T+1, N, 3) of a run that must have them, m."""
    run = simulation.runs.get(name)
    if run is None or run.positions is None:
        raise InputError(f"a simulation has no rollout {name!r}: expected one of each.")
    return run.positions.astype(np.float64)


def _run(simulation: Simulation, name: str, reference: Any) -> MeasuredRun:
    run = simulation.runs[name]
    steps = run.statistics.get("iterations", np.array([], dtype=np.int32))
    if name == REFERENCE:
        return MeasuredRun(tuple(steps.tolist()), None, None, None)
    rms = None if run.positions is None else rms_error(run.positions, reference)
    one = None
    if run.predictions is not None:
        one = rms_error(np.concatenate([reference[:1], run.predictions]), reference)
    return MeasuredRun(tuple(steps.tolist()), rms, one, _omega(simulation, name, run, reference))


def _omega(simulation: Simulation, name: str, run: Run, reference: Any) -> float | None:
    """Per cent; None where it means nothing."""
    plain = simulation.runs.get(PLAIN)
    if name == PLAIN or run.positions is None or plain is None or plain.positions is None:
        return None
    if mean_squared_error(plain.positions, reference) == 0.0:
        return None
    return error_corrected(run.positions, plain.positions, reference)


# --- summing up --------------------------------------------------------------------------

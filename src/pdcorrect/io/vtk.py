"""A trajectory for ParaView: one VTU a frame and a PVD with the times."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import make_folder, write_bytes
from pdcorrect.errors import InputError, OutputError
from pdcorrect.fem.mesh_files import write_vtu
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.stress import stress, von_mises
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
Data = Callable[[int], Mapping[str, Array]]
"""Extra fields of a frame, by name."""


def write_vtu_series(
    trajectory: Trajectory,
    folder: str | Path,
    *,
    every: int = 1,
    name: str = "run",
    point_data: Data | None = None,
    cell_data: Data | None = None,
    stress_of: Problem | None = None,
) -> Path:
    """Write ``name_0000.vtu`` … and ``name.pvd``; open the latter in ParaView.

    Points are the current positions; ``displacement`` (m) and ``velocity``
    (m/s) are point data.  An older series of the same name in the folder is
    replaced: its PVD goes first and the new one comes last, so that a PVD never
    names files that are missing or of another run.

    Parameters
    ----------
    trajectory : Trajectory
    folder : path
        Created if missing.
    every : int
        Write each such frame; frame 0 always.
    point_data, cell_data : callable, optional
        Frame -> fields (N, ...) or (C, ...).
    stress_of : Problem, optional
        What was stepped (``trajectory.problem``, or `problem_of` a run from a file): adds the
        Cauchy stress averaged to the points, ``stress`` (N, 6), Pa, as xx yy zz xy yz xz, and its
        ``von_mises`` (N,); and of the cells ``cell_von_mises`` (C,), Pa, of the Cauchy stress
        averaged over the cell, and ``smallest_volume_ratio`` (C,), the smallest det F at its
        quadrature points, see `ElasticBody.volume_ratios`.

    Returns
    -------
    Path
        Of the PVD file.

    Raises
    ------
    InputError
        If a frame is not finite, or ``stress_of`` has another mesh; then nothing is touched.
    OutputError
        If the folder cannot be written.
    """
    if every < 1:
        raise InputError(f"every = {every}: expected 1 or more.")
    _check_frames(trajectory, name)
    if stress_of is not None:
        _check_problem(stress_of, trajectory, name)
    files = {k: f"{name}_{k:04d}.vtu" for k in range(0, len(trajectory.times), every)}
    folder = make_folder(folder)
    path, *old = vtu_series(folder, name)
    _delete(path)
    for frame, file in files.items():
        positions = trajectory.positions[frame]
        of_points, of_cells = _stresses(stress_of, positions) if stress_of else ({}, {})
        write_vtu(
            folder / file,
            positions,
            trajectory.cells,
            {
                "displacement": positions - trajectory.points,
                "velocity": trajectory.velocities[frame],
                **of_points,
                **(point_data(frame) if point_data else {}),
            },
            {**of_cells, **(cell_data(frame) if cell_data else {})},
        )
    for other in old:
        if other.name not in files.values():
            _delete(other)
    write_bytes(path, _collection({file: trajectory.times[k] for k, file in files.items()}))
    return path


def vtu_series(folder: Path, name: str) -> list[Path]:
    """What a new series of that name replaces: ``name.pvd``, if it is there or not, and frames.

    Frames are ``name_0000.vtu`` and so on, not those of ``name_2026``.
    """
    own = re.compile(rf"{re.escape(name)}_\d{{4,}}\.vtu")
    frames = sorted(path for path in folder.glob("*.vtu") if own.fullmatch(path.name))
    return [folder / f"{name}.pvd", *frames]


def delete_vtu_series(folder: Path, name: str) -> None:
    """Delete ``name.pvd`` and then its frames, and no other series' files."""
    for path in vtu_series(folder, name):
        _delete(path)


def _delete(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be deleted ({error.strerror}).") from error


def _check_frames(run: Trajectory, name: str) -> None:
    """Refuse what ParaView would draw as nothing."""
    for what, values in (("positions", run.positions), ("velocities", run.velocities)):
        finite = np.isfinite(values).all(axis=(1, 2))
        if not finite.all():
            raise InputError(
                f"{name}: frame {int(finite.argmin())} has {what} that are infinite or not a "
                "number: expected finite ones."
            )


def _check_problem(problem: Problem, run: Trajectory, name: str) -> None:
    """Refuse another mesh than the run's, whose stresses would be of other nodes."""
    here, there = problem.positions.shape, run.points.shape
    if here != there or not np.array_equal(problem.cells, run.cells):
        raise InputError(
            f"{name}: stress_of has {here[0]} nodes and {len(problem.cells)} cells, the run "
            f"{there[0]} and {len(run.cells)}: expected what was stepped, with the same cells."
        )


def _collection(times: Mapping[str, float]) -> bytes:
    """XML of a PVD: files and their times, s."""
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    for file, time in times.items():
        ET.SubElement(collection, "DataSet", timestep=f"{time:.12g}", part="0", file=file)
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text


def _stresses(problem: Problem, positions: Array) -> tuple[dict[str, Array], dict[str, Array]]:
    """Fields of the points and of the cells; a symmetric tensor in ParaView's order."""
    found = stress(problem, positions)
    nodal = found.nodal_cauchy
    weights = found.weights / found.weights.sum(axis=1, keepdims=True)
    by_cell = np.einsum("cq,cqij->cij", weights, found.cauchy)
    of_points = {
        "stress": nodal[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]],
        "von_mises": von_mises(nodal),
    }
    of_cells = {
        "cell_von_mises": von_mises(by_cell),
        "smallest_volume_ratio": problem.volume_ratios(positions),
    }
    return of_points, of_cells

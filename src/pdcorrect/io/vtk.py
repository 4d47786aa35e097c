"""A trajectory for ParaView: one VTU a frame and a PVD with the times."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from glob import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError, OutputError
from pdcorrect.fem.mesh_files import write_vtu
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.stress import stress, von_mises
from pdcorrect.replacement import replacing
from pdcorrect.state import Trajectory

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
    replaced.

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
    OutputError
        If the folder cannot be written.
    """
    if every < 1:
        raise InputError(f"every = {every}: expected 1 or more.")
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created ({error.strerror}).") from error
    for stale in folder.glob(f"{escape(name)}_[0-9][0-9][0-9][0-9]*.vtu"):
        stale.unlink()
    root = ET.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ET.SubElement(root, "Collection")
    for frame in range(0, len(trajectory.times), every):
        file = f"{name}_{frame:04d}.vtu"
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
        time = repr(float(trajectory.times[frame]))
        ET.SubElement(collection, "DataSet", timestep=time, part="0", file=file)
    ET.indent(root)
    path = folder / f"{name}.pvd"
    try:
        with replacing(path) as part:
            ET.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error
    return path


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

"""Mesh files through meshio: hexahedra in, VTU out.  The only module that imports it."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import MeshError, OutputError
from pdcorrect.fem.mesh import HexMesh

_SOLID = ("tetra", "wedge", "pyramid", "hexahedron", "polyhedron")
"""How meshio's names of three-dimensional cells begin."""


def read_hex_mesh(path: str | Path, scale: float = 1.0) -> HexMesh:
    """Read the eight-node hexahedra of a Gmsh, Abaqus or VTU file.

    Nodes that no cell uses are dropped and lower-dimensional cells are ignored.

    Parameters
    ----------
    path : path
    scale : float
        Metres for each unit of length in the file.

    Raises
    ------
    MeshError
        If the file cannot be read, holds no hexahedra or other solid cells as
        well, or has inverted cells.
    """
    path = Path(path)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            mesh = meshio.read(path)
    except SystemExit:
        raise MeshError(f"{path}: meshio cannot read it: expected .msh, .inp or .vtu.") from None
    except Exception as error:  # meshio raises nearly every type on damaged files
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise MeshError(f"{path}: cannot be read as a mesh ({reason}).") from error
    found = sorted({block.type for block in mesh.cells})
    solids = {kind for kind in found if kind.startswith(_SOLID)}
    if solids != {"hexahedron"}:
        raise MeshError(
            f"{path} holds cells of type {', '.join(found) or 'none'}: expected 'hexahedron' "
            "(eight nodes) as the only solid cells."
        )
    cells = np.concatenate([b.data for b in mesh.cells if b.type == "hexahedron"]).astype(np.int64)
    if mesh.points.shape[1] != 3 or cells.size == 0 or cells.max() >= len(mesh.points):
        raise MeshError(f"{path}: its cells and points {mesh.points.shape} do not fit together.")
    used, local = np.unique(cells, return_inverse=True)
    return HexMesh.create(mesh.points[used] * scale, local.reshape(cells.shape))


def write_vtu(
    path: str | Path,
    points: NDArray[np.float64],
    cells: NDArray[np.int64],
    point_data: Mapping[str, NDArray[np.float64]] | None = None,
    cell_data: Mapping[str, NDArray[np.float64]] | None = None,
) -> None:
    """Write hexahedra with data at points (N, ...) and cells (C, ...) as compressed VTU.

    The file appears under its name only when it is complete.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    path = Path(path)
    kind = {8: "hexahedron", 27: "hexahedron27"}[cells.shape[1]]
    mesh = meshio.Mesh(
        points,
        [(kind, cells)],
        point_data=dict(point_data or {}),
        cell_data={name: [values] for name, values in (cell_data or {}).items()},
    )
    part = path.with_name(path.name + ".part")
    try:
        meshio.write(part, mesh, file_format="vtu")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error

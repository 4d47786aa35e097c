"""Mesh files through meshio: hexahedra in, VTU out.  The only module that imports it."""

from __future__ import annotations

import contextlib
import io
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import replacing
from pdcorrect.errors import MeshError, OutputError
from pdcorrect.fem.hexahedron import VTK_EDGES, VTK_FACES
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.mesh_checks import TOLERANCE

_HEXAHEDRA = ("hexahedron", "hexahedron20", "hexahedron27")
"""Cells that are read; of the second-order ones, the corners."""

_BETWEEN = np.zeros((19, 8))
"""Weights of the corners at the nodes 8 to 26 of a straight-sided cell, (19, 8).

In VTK order, which meshio has for Gmsh, Abaqus and VTU alike: middles of edges,
of faces, of the cell.
"""
for _row, _corners in enumerate([*VTK_EDGES, *VTK_FACES, range(8)]):
    _BETWEEN[_row, list(_corners)] = 1 / len(_corners)

_UNREAD_ABAQUS = {
    "INCLUDE", "SYSTEM", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY",
}  # fmt: skip
"""Abaqus keywords that change the mesh and that meshio passes over or reads wrongly."""


def read_hex_mesh(path: str | Path, scale: float = 1.0) -> HexMesh:
    """Read the hexahedra of a Gmsh, Abaqus or VTU file.

    Of cells with 20 or 27 nodes the eight corners are kept, if the cells are
    straight-sided.  Nodes that no cell uses are dropped and lower-dimensional
    cells are ignored.

    Parameters
    ----------
    path : path
    scale : float
        Metres for each unit of length in the file.

    Raises
    ------
    MeshError
        If the file cannot be read, holds no hexahedra or other solid cells as
        well, has curved cells, or its mesh fails a check of `HexMesh.create`.
    """
    path = Path(path)
    mesh = _read(path)
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"{path}: its points are {points.shape}: expected (N, 3).")
    points = points * scale
    solids = [block for block in mesh.cells if block.dim == 3 and len(block.data)]
    for block in solids:
        ragged = block.type.startswith("polyhedron")  # each cell a list of faces
        nodes = np.hstack([np.hstack(cell) for cell in block.data]) if ragged else block.data
        if not nodes.size:
            raise MeshError(f"{path}: its {block.type} cells have no nodes: expected eight each.")
        if nodes.min() < 0 or nodes.max() >= len(points):
            raise MeshError(
                f"{path}: its {block.type} cells refer to nodes that the file does not hold: "
                "expected every node of a cell in the file."
            )
    if not solids or any(block.type not in _HEXAHEDRA for block in solids):
        raise MeshError(f"{path} {_other_cells(mesh.cells, solids, points)}")
    cells = [np.asarray(block.data).astype(np.int64) for block in solids]
    first = 0
    for nodes in cells:
        _check_straight(path, points[nodes], first)
        first += len(nodes)
    corners = np.concatenate([nodes[:, :8] for nodes in cells])
    used, local = np.unique(corners, return_inverse=True)
    try:
        return HexMesh.create(points[used], local.reshape(corners.shape))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None


def _read(path: Path) -> meshio.Mesh:
    """What meshio makes of a file, unless it fails or leaves cells out."""
    out, complaints = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(complaints):
            if path.suffix.lower() == ".inp":
                mesh = meshio.read(_abaqus_text(path), file_format="abaqus")
            else:
                mesh = meshio.read(path)
    except MeshError:
        raise
    except SystemExit:
        reason = (out.getvalue().strip().splitlines() or ["unknown format"])[-1]
        raise MeshError(
            f"{path}: meshio cannot read it ({reason}): expected .msh, .inp or .vtu."
        ) from None
    except Exception as error:  # meshio raises nearly every type on damaged files
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        if isinstance(error, KeyError):
            reason = f"it refers to {', '.join(map(str, error.args))}, which is unknown"
        raise MeshError(f"{path}: cannot be read as a mesh ({reason}).") from error
    said = " ".join(complaints.getvalue().split())
    if "cannot handle" in said:  # the cells of an unknown type are missing from the mesh
        raise MeshError(f"{path}: {said} Expected hexahedra (VTK type 12, 25 or 29) only.")
    return mesh


def _abaqus_text(path: Path) -> io.StringIO:
    """Text of an Abaqus file as meshio understands it.

    Comments go, because meshio takes one for the end of the list that it stands
    in, and types of elements are put in capitals.
    """
    lines = []
    node_lists = instances = 0
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("**"):
                continue
            if line.startswith("*"):
                keyword = line[1:].partition(",")[0].strip().upper()
                node_lists += keyword == "NODE"
                instances += keyword == "INSTANCE"
                if keyword in _UNREAD_ABAQUS:
                    raise MeshError(
                        f"{path}: *{keyword} is not read: expected all nodes and elements "
                        "written out in this file, in one coordinate system."
                    )
                line = line.upper() if keyword == "ELEMENT" else line
            lines.append(line)
    if node_lists > 1 or instances > 1:
        raise MeshError(
            f"{path} has {node_lists} lists *NODE and {instances} *INSTANCE: expected one list "
            "and at most one instance, for their numbers may clash. Export a flat file."
        )
    return io.StringIO("".join(lines))


def _other_cells(
    blocks: list[meshio.CellBlock], solids: list[meshio.CellBlock], points: NDArray[np.float64]
) -> str:
    """The message for a file with no solid cells or with solids that are not hexahedra."""
    counts: Counter[str] = Counter()
    for block in solids or blocks:
        counts[block.type] += len(block.data)
    text = ", ".join(f"{number} of type {kind}" for kind, number in counts.items()) or "none"
    for block in solids:
        if block.type not in _HEXAHEDRA:
            place = points[np.unique(np.hstack(block.data[0]))].mean(axis=0)
            text += f" (the first {block.type} around {place} m)"
            break
    return (
        f"holds these {'solid ' if solids else ''}cells: {text}: expected hexahedra (types "
        f"{', '.join(_HEXAHEDRA)}) as the only solid cells."
    )


def _check_straight(path: Path, nodes: NDArray[np.float64], first: int) -> None:
    """Refuse cells whose nodes (C, 8 or 20 or 27, 3) are not where the corners put them, m."""
    count = nodes.shape[1]
    if count == 8:
        return
    expected = np.einsum("kc,nci->nki", _BETWEEN[: count - 8], nodes[:, :8])
    away = np.linalg.norm(nodes[:, 8:] - expected, axis=2)
    edges = nodes[:, VTK_EDGES[:, 0]] - nodes[:, VTK_EDGES[:, 1]]
    size = np.linalg.norm(edges, axis=2).min(axis=1)
    curved = np.flatnonzero(~(away.max(axis=1) <= TOLERANCE * size))
    if len(curved):
        cell = int(curved[0])
        node = int(np.argmax(away[cell]))
        raise MeshError(
            f"{path}: cell {first + cell} around {nodes[cell, :8].mean(axis=0)} has its node "
            f"{8 + node} {away[cell, node]:.3g} m away from the place between its corners "
            f"({len(curved)} such cells): expected straight-sided cells (in Gmsh: "
            "`Mesh.ElementOrder = 1`)."
        )


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
    try:
        with replacing(path) as part:
            meshio.write(part, mesh, file_format="vtu")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error

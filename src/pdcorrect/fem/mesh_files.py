"""Mesh files: hexahedra and their groups in, VTU out."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import replacing
from pdcorrect.errors import MeshError, OutputError, PdcorrectWarning
from pdcorrect.fem.abaqus_files import read_abaqus
from pdcorrect.fem.gmsh_files import read_gmsh
from pdcorrect.fem.hexahedron import VTK_EDGES, VTK_FACES
from pdcorrect.fem.mesh import Group, HexMesh
from pdcorrect.fem.mesh_checks import TOLERANCE, row_groups
from pdcorrect.fem.mesh_content import Block, Content, Integers, nodes_of
from pdcorrect.fem.vtk_files import read_meshio, read_vtk

_HEXAHEDRA = ("hexahedron", "hexahedron20", "hexahedron27")
"""Cells that are read; of the second-order ones, the corners."""

_QUADRILATERALS = ("quad", "quad8", "quad9")

_BETWEEN = np.zeros((19, 8))
"""Weights of the corners at the nodes 8 to 26 of a straight-sided cell, (19, 8).

In VTK order: middles of edges, of faces, of the cell.
"""
for _row, _corners in enumerate([*VTK_EDGES, *VTK_FACES, range(8)]):
    _BETWEEN[_row, list(_corners)] = 1 / len(_corners)

_CURVED = 0.25
"""Of a cell's longest edge: how far curving puts a node; a quarter of a circle needs 0.21."""
_READERS = {
    ".msh": read_gmsh, ".inp": read_abaqus,
    **dict.fromkeys((".vtu", ".pvtu", ".vtk", ".vts", ".vtr", ".vti"), read_vtk),
}  # fmt: skip
"""By suffix; meshio reads all others."""


def read_hex_mesh(path: str | Path, scale: float = 1.0) -> HexMesh:
    """Read the hexahedra of a Gmsh, Abaqus or VTK file, and its named groups.

    Of cells with 20 or 27 nodes the eight corners are kept; a `PdcorrectWarning` says
    how far others are from between them, if cells are curved.  Nodes that no cell uses
    are dropped; lower-dimensional elements count only as parts of groups.

    Parameters
    ----------
    path : path
    scale : float
        Metres for each unit of length in the file.

    Raises
    ------
    MeshError
        If the file cannot be read, holds no hexahedra or other solid cells as
        well, has cells whose nodes are in another order, or its mesh fails a
        check of `HexMesh.create`.
    """
    path = Path(path)
    try:
        content = _READERS.get(path.suffix.lower(), read_meshio)(path)
    except OSError as error:
        file = error.filename or path  # it may be one that the file names
        raise MeshError(f"{file}: cannot be read ({error.strerror or error}).") from None
    points = content.points * scale
    if points.shape[1:] != (3,):
        raise MeshError(f"{path}: its points are {points.shape}: expected (N, 3).")
    solids = _solids(path, content.blocks, points)
    corners = np.concatenate([block.nodes[:, :8] for block in solids])
    used, local = np.unique(corners, return_inverse=True)
    cells = local.reshape(corners.shape)
    try:
        mesh = HexMesh.create(points[used], cells)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None
    return replace(mesh, groups=_groups(content, used, cells))


def _solids(path: Path, blocks: list[Block], points: NDArray[np.float64]) -> list[Block]:
    """The blocks of solid cells; refuses those that cannot be used."""
    for kind, _, nodes in blocks:
        if nodes.size and not 0 <= nodes.min() <= nodes.max() < len(points):
            raise MeshError(
                f"{path}: its {kind} cells refer to nodes that the file does not hold: "
                "expected every node of a cell in the file."
            )
        if kind in _HEXAHEDRA and len(nodes) and nodes.shape[1] < 8:
            raise MeshError(f"{path}: its {kind} cells have no nodes: expected eight each.")
    solids = [block for block in blocks if block.dimension == 3 and len(block.nodes)]
    if not solids or any(block.kind not in _HEXAHEDRA for block in solids):
        raise MeshError(f"{path} {_other_cells(blocks, solids, points)}")
    first, curved = 0, [np.zeros(0)]
    for block in solids:
        curved.append(_curving(path, points[block.nodes], first))
        first += len(block.nodes)
    away = np.concatenate(curved)
    if len(away):
        warnings.warn(
            f"{path}: {len(away)} of {first} cells are curved, with nodes up to {away.max():.3g} m "
            "away from the places between their corners; the corners alone are used, so that the "
            "body has straight edges",
            PdcorrectWarning,
            stacklevel=3,
        )
    return solids


def _groups(content: Content, used: Integers, cells: Integers) -> dict[str, Group]:
    """Groups of the file as cells, faces and nodes of the mesh, without what it has not."""
    node = np.full(len(content.points), -1)
    node[used] = np.arange(len(used))
    sizes = [len(block.nodes) for block in content.blocks]
    kinds = np.repeat([block.kind for block in content.blocks], sizes)
    solid = np.isin(kinds, _HEXAHEDRA)
    cell = np.where(solid, np.cumsum(solid) - 1, -1)
    face = np.full(len(kinds), -1)
    quads = [block.nodes[:, :4] for block in content.blocks if block.kind in _QUADRILATERALS]
    if quads:
        face[np.isin(kinds, _QUADRILATERALS)] = _faces(cells, node[np.concatenate(quads)])
    out = {}
    for name in content.element_groups | content.node_groups:
        members = content.element_groups.get(name, np.zeros(0, np.int64))
        others = members[(cell[members] < 0) & (face[members] < 0)]
        own = content.node_groups.get(name, np.zeros(0, np.int64))
        nodes = np.append(own, nodes_of(content.blocks, others))
        sides = np.stack(np.divmod(_known(face[members]), 6), axis=1)
        out[name] = Group(_known(cell[members]), sides, _known(node[nodes]))
    return out


def _known(numbers: Integers) -> Integers:
    """Those that are not -1, each once."""
    return np.unique(numbers[numbers >= 0])


def _faces(cells: Integers, quads: Integers) -> Integers:
    """Where quadrilaterals (n, 4) are in `face_groups` of the cells, -1 if they are no face."""
    faces = cells[:, VTK_FACES].reshape(-1, 4)
    order, starts, counts = row_groups(np.sort(np.concatenate([faces, quads]), axis=1) + 1)
    same = np.empty(len(order), dtype=np.int64)
    same[order] = np.repeat(order[starts], counts)  # the first of equal rows: a face, if any is
    found = same[len(faces) :]
    return np.where(found < len(faces), found, -1)


def _other_cells(blocks: list[Block], solids: list[Block], points: NDArray[np.float64]) -> str:
    """The message for a file with no solid cells or with solids that are not hexahedra."""
    counts: Counter[str] = Counter()
    for block in solids or blocks:
        counts[block.kind] += len(block.nodes)
    text = ", ".join(f"{number} of type {kind}" for kind, number in counts.items()) or "none"
    for block in solids:
        if block.kind not in _HEXAHEDRA:
            place = points[np.unique(block.nodes[0])].mean(axis=0)
            text += f" (the first {block.kind} around {place} m)"
            break
    return (
        f"holds these {'solid ' if solids else ''}cells: {text}: expected hexahedra (types "
        f"{', '.join(_HEXAHEDRA)}) as the only solid cells."
    )


def _curving(path: Path, nodes: NDArray[np.float64], first: int) -> NDArray[np.float64]:
    """How far the nodes (C, 8 or 20 or 27, 3) of curved cells are from between their corners, m.

    Refuses nodes farther away than curving puts them, as if in another order.
    """
    count = nodes.shape[1]
    if count == 8:
        return np.zeros(0)
    expected = np.einsum("kc,nci->nki", _BETWEEN[: count - 8], nodes[:, :8])
    away = np.linalg.norm(nodes[:, 8:] - expected, axis=2)
    if count == 27:  # whose faces Abaqus's programs count differently
        apart = np.linalg.norm(nodes[:, None, 20:] - expected[:, 12:, None], axis=3)
        away[:, 12:] = apart.min(axis=2)
    edges = nodes[:, VTK_EDGES[:, 0]] - nodes[:, VTK_EDGES[:, 1]]
    lengths = np.linalg.norm(edges, axis=2)
    farthest = away.max(axis=1)
    wrong = np.flatnonzero(~(farthest <= _CURVED * lengths.max(axis=1)))
    if len(wrong):
        cell = int(wrong[0])
        node = int(np.argmax(away[cell]))
        raise MeshError(
            f"{path}: cell {first + cell} around {nodes[cell, :8].mean(axis=0)} has its node "
            f"{8 + node} {away[cell, node]:.3g} m away from the place between its corners "
            f"({len(wrong)} such cells): expected at most {_CURVED:g} of an edge (in Gmsh: "
            "`Mesh.ElementOrder = 1`)."
        )
    return np.asarray(farthest[farthest > TOLERANCE * lengths.min(axis=1)])


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

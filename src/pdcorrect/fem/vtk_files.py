"""VTK files: by meshio what it reads whole, by VTK in a process of its own all others."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import MeshError
from pdcorrect.fem.mesh_content import Block, Content, Integers

_KINDS: dict[int, tuple[str, list[int]]] = {
    8: ("quad", [0, 1, 3, 2]), 9: ("quad", [*range(4)]),
    23: ("quad8", [*range(8)]), 28: ("quad9", [*range(9)]),
    11: ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6]), 12: ("hexahedron", [*range(8)]),
    25: ("hexahedron20", [*range(20)]), 29: ("hexahedron27", [*range(27)]),
    72: ("hexahedron", [*range(8)]),
}  # fmt: skip
"""Names of VTK's types, and their nodes in the order of the name; Lagrange cells of order 1."""

_BEYOND_MESHIO = re.compile(
    rb'vtkLZ4DataCompressor|type="String"|<VTKFile[^>]* version="[2-9]'
    rb'|type="(PUnstructuredGrid|StructuredGrid|RectilinearGrid|ImageData)"'
    rb"|^DATASET (UNSTRUCTURED_GRID|STRUCTURED_GRID|STRUCTURED_POINTS|RECTILINEAR_GRID)\s",
    re.MULTILINE,
)
"""What VTK reads and meshio does not, or of the last line not always."""

_GHOSTS, _GHOST = "vtkGhostType", 1 | 32
"""VTK's array of cells that another piece has too (1) or that are blanked (32)."""
_VALUE = "value "
"""Before the names of arrays of cells in `vtk_process`, which may be any."""


def read_vtk(path: Path) -> Content:
    """Read points, cells and, as groups ``name=value``, whole numbers of cells.

    Raises
    ------
    MeshError
        If the file is damaged, or needs VTK, which is missing.
    """
    head = _head(path)
    sources = re.findall(rb'<Piece\b[^>]*\bSource\s*=\s*"([^"\0]*)"', head)  # of a .pvtu
    heads = [_head(path.parent / os.fsdecode(source)) for source in sources] or [head]
    pieces = [piece for each in heads for piece in _pieces(each)]
    try:
        return _by_meshio(path, pieces)
    except _Incomplete as error:
        return _by_vtk(path, pieces, str(error))
    except MeshError:
        if not _BEYOND_MESHIO.search(head):
            raise
        return _by_vtk(path, pieces, "of a kind that it does not know")


class _Incomplete(Exception):
    """What meshio does not read of a file."""


def _head(path: Path) -> bytes:
    return path.read_bytes().partition(b"<AppendedData")[0]


def _pieces(head: bytes) -> list[tuple[int, int]]:
    """Numbers of points and cells of each piece of an unstructured grid, as the file says."""
    found = []
    for tag in re.findall(rb"<Piece\b[^>]*NumberOfPoints[^>]*>", head):
        counts = (re.search(rb'%s\s*=\s*"\s*(\d+)' % key, tag) for key in (b"Points", b"Cells"))
        points, cells = (int(count[1]) if count else 0 for count in counts)
        found.append((points, cells))
    legacy = re.search(rb"^POINTS\s+(\d+).*^CELL_TYPES\s+(\d+)", head, re.MULTILINE | re.DOTALL)
    return [(int(legacy[1]), int(legacy[2]))] if legacy and not found else found


def read_meshio(path: Path) -> Content:
    """Read points, cells and groups of their whole numbers by meshio.

    Raises
    ------
    MeshError
        If meshio fails, or leaves out cells.
    """
    try:
        return _by_meshio(path, [])
    except _Incomplete as error:
        raise MeshError(f"{path}: meshio cannot read it ({error}).") from None


def _by_meshio(path: Path, pieces: list[tuple[int, int]]) -> Content:
    if len(pieces) > 1:
        raise _Incomplete(f"it has {len(pieces)} pieces")
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
    except OSError:
        raise
    except (Exception, SystemExit) as error:  # meshio raises nearly every type on damaged files
        told = " ".join(said.getvalue().split()) or f"{type(error).__name__} {error}"
        raise MeshError(
            f"{path}: cannot be read as a mesh ({told[:200]}): expected .msh, .inp or .vtu."
        ) from None
    counts = (len(mesh.points), sum(len(block.data) for block in mesh.cells))
    if "cannot handle" in said.getvalue() or (pieces and [counts] != pieces):
        raise _Incomplete("it leaves out cells")
    if _GHOSTS in mesh.cell_data:
        raise _Incomplete("it has ghost cells")
    blocks = []
    for block in mesh.cells:
        ragged = block.type.startswith("polyhedron")  # each cell a list of faces
        nodes = [np.hstack(cell) for cell in block.data] if ragged else [block.data]
        linear = block.type == "VTK_LAGRANGE_HEXAHEDRON" and nodes[0].shape[1:] == (8,)
        kind = "hexahedron" if linear else block.type
        blocks += [Block(kind, block.dim, np.atleast_2d(own).astype(np.int64)) for own in nodes]
    values = {name: np.concatenate(own) for name, own in mesh.cell_data.items()}
    return Content(np.asarray(mesh.points, dtype=np.float64), blocks, value_groups(values), {})


def value_groups(values: Mapping[str, NDArray[Any]]) -> dict[str, Integers]:
    """Elements by each value of arrays (E,) of whole numbers, unless all values differ."""
    groups: dict[str, Integers] = {}
    for name, own in values.items():
        if own.ndim != 1 or own.dtype.kind not in "iu" or name == _GHOSTS:
            continue
        found, first = np.unique(np.sort(own), return_index=True)
        if len(found) < len(own):
            members = np.split(np.argsort(own, kind="stable"), first[1:])
            groups |= {f"{name}={value}": each for value, each in zip(found, members, strict=True)}
    return groups


def _by_vtk(path: Path, pieces: list[tuple[int, int]], reason: str) -> Content:
    """Read a file by VTK in another process, which some damaged files end."""
    if importlib.util.find_spec("vtkmodules") is None:
        raise MeshError(
            f"{path}: meshio cannot read it ({reason}). Install pyvista, which can (pip install "
            "'pdcorrect[view]'), or save it in ParaView as one unstructured grid of hexahedra "
            "(.vtu, compressor ZLib or none)."
        )
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "grid.npz"
        given = str(path), str(target), _VALUE
        command = [sys.executable, "-m", "pdcorrect.fem.vtk_process", *given]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        if done.returncode != 0:
            *_, last = ["it ended", *done.stderr.split("\n")[-2:-1]]
            raise MeshError(f"{path}: cannot be read by VTK ({last}), nor by meshio ({reason}).")
        with np.load(target) as file:
            grid = dict(file)
    wanted = tuple(map(sum, zip(*pieces, strict=True)))
    found = len(grid["points"]), len(grid["types"])
    if pieces and wanted != found:
        raise MeshError(
            f"{path}: {found[0]} points and {found[1]} cells are read of "
            f"{wanted[0]} and {wanted[1]} that it says it has."
        )
    return _from_grid(path, grid, [points for points, _ in pieces])


def _from_grid(path: Path, grid: Mapping[str, NDArray[Any]], pieces: list[int]) -> Content:
    """Cells of an unstructured grid by type, in their order."""
    points = grid["points"].astype(np.float64) + 0.0  # no -0
    types, starts, nodes = (grid[name].astype(np.int64) for name in ("types", "starts", "nodes"))
    points, place = _merged(points, pieces)
    values = {name.removeprefix(_VALUE): x for name, x in grid.items() if name.startswith(_VALUE)}
    real = values.get(_GHOSTS, np.zeros(len(types), np.int64)) & _GHOST == 0
    blocks, order = [], [np.zeros(0, np.int64)]
    for number, name, dimension in zip(
        np.unique(types), grid["names"], grid["dimensions"], strict=True
    ):
        own = np.flatnonzero((types == number) & real)
        sizes = np.diff(starts)[own]
        for size in np.unique(sizes):
            chosen = own[sizes == size]
            rows = nodes[starts[chosen][:, None] + np.arange(size)]
            if rows.size and not 0 <= rows.min() <= rows.max() < len(place):
                raise MeshError(f"{path}: its cells refer to points that it does not hold.")
            kind, nodes_of_kind = _KINDS.get(int(number), ("", []))
            if len(nodes_of_kind) != size:
                kind, nodes_of_kind = str(name), list(range(size))
            blocks.append(Block(kind, int(dimension), place[rows[:, nodes_of_kind]]))
            order.append(chosen)
    chosen = np.concatenate(order)
    groups = value_groups({name: own[chosen] for name, own in values.items()})
    return Content(points, blocks, groups, {})


def _merged(points: NDArray[np.float64], pieces: list[int]) -> tuple[NDArray[np.float64], Integers]:
    """Points without the copies that other pieces have, and where each of all is among them.

    Pieces that hold one place twice are cut there: then all stays as it is.
    """
    ends = np.cumsum(pieces)
    parts = np.split(points, ends[:-1]) if len(pieces) > 1 else []
    if not parts or any(len(np.unique(part, axis=0)) < len(part) for part in parts):
        return points, np.arange(len(points))
    merged, place = np.unique(points, axis=0, return_inverse=True)
    return merged, place.ravel()

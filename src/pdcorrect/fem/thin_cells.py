"""Cells that lock in bending: trilinear and alone through the thickness of a body."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import PdcorrectWarning
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.mesh_checks import face_groups

_LOCKING = ("hex8", "hex8-mean")


def warn_of_thin_cells(element: str, mesh: HexMesh, free: NDArray[np.bool_]) -> None:
    """Warn once if cells of an element without incompatible modes bend alone."""
    if element not in _LOCKING:
        return
    count = int(bending_alone(mesh, free).sum())
    if count:
        warnings.warn(
            f"element {element!r}: {count} of {len(mesh.cells)} cells are alone through the "
            "thickness and much too stiff in bending: expected 'hex8-enhanced' or finer cells",
            PdcorrectWarning,
            stacklevel=3,
        )


def bending_alone(mesh: HexMesh, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which cells (C,) can bend and have no neighbour on either side along some axis of theirs.

    To bend, a cell has neighbours along another axis and corners that may move along this one;
    ``free`` (N, 3) tells.
    """
    _, order, starts, counts = face_groups(mesh.cells)
    outer = np.zeros(6 * len(mesh.cells), dtype=bool)
    outer[order[starts[counts == 1]]] = True
    sides = outer.reshape(-1, 3, 2)  # the faces on both ends of each axis
    free_standing = outer.reshape(-1, 6).all(axis=1, keepdims=True)
    alone = np.logical_and(sides.all(axis=2), ~free_standing)
    thin = np.flatnonzero(alone.any(axis=1))
    signs = 2.0 * VTK_CORNERS - 1.0
    axes = np.abs(np.einsum("cki,km->cmi", mesh.positions[mesh.cells[thin]], signs))
    along = axes > 0.5 * axes.max(axis=2, keepdims=True)  # (c, axis, component)
    free_corners = free[mesh.cells[thin]].any(axis=1)  # (c, component)
    moves = (free_corners[:, None] & along).any(axis=2)
    bends = np.logical_and(alone[thin], moves)
    found = np.zeros(len(mesh.cells), dtype=bool)
    found[thin] = bends.any(axis=1)
    return found

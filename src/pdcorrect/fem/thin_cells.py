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

    To bend, a cell has neighbours along another axis, and on both of its faces across this one
    corners that may move along it; ``free`` (N, 3) tells.
    """
    _, order, starts, counts = face_groups(mesh.cells)
    outer = np.zeros(6 * len(mesh.cells), dtype=bool)
    outer[order[starts[counts == 1]]] = True
    sides = outer.reshape(-1, 3, 2)  # the faces on both ends of each axis
    neighbours = 6 - outer.reshape(-1, 6).sum(axis=1)
    alone = (sides.sum(axis=2) == 2) * (neighbours > 0)[:, None]  # (C, axis)
    thin = np.flatnonzero(alone.any(axis=1))
    corners = mesh.cells[thin]
    axes = np.abs(np.einsum("cki,km->cmi", mesh.positions[corners], 2.0 * VTK_CORNERS - 1.0))
    along = axes > 0.5 * axes.max(axis=2, keepdims=True)  # (c, axis, component)
    may = np.einsum("cki,cmi->ckm", free[corners].astype(int), along.astype(int)) > 0
    low, high = (((end == VTK_CORNERS) * may).any(axis=1) for end in (0, 1))
    found = np.zeros(len(mesh.cells), dtype=bool)
    found[thin] = (alone[thin] * low * high).any(axis=1)
    return found

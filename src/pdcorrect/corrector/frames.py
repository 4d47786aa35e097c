"""How the surroundings of each node are turned and stretched.

A cell's axes are the means of its four edges along each of its own directions.  The mean
over the cells of a node, M = R U, has a rotation R (polar decomposition): the node's frame.
It turns with the body, at rest too, so what is told in frames does not depend on how the
scene lies in space, nor on how it has turned since.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pdcorrect.fem.hexahedron import VTK_CORNERS

_NEWTON_STEPS = 8
_FLATTEST = 1e-3
"""Least determinant of axes over cell volume; flatter surroundings count as not deformed."""


def cell_axes(positions: Tensor, cells: Tensor) -> Tensor:
    """Axes of cells as columns, (c, 3, 3), m, for positions (n, 3) and cells (c, 8)."""
    signs = torch.as_tensor(2.0 * VTK_CORNERS - 1.0, dtype=positions.dtype, device=positions.device)
    return torch.einsum("cki,kj->cij", positions[cells], signs / 4.0)


def node_axes(positions: Tensor, cells: Tensor) -> Tensor:
    """Means of the axes of the cells that touch a node, (n, 3, 3), m."""
    axes = cell_axes(positions, cells)
    sums = positions.new_zeros(len(positions), 3, 3)
    counts = positions.new_zeros(len(positions))
    for corner in range(cells.shape[1]):
        sums = sums.index_add(0, cells[:, corner], axes)
        counts = counts.index_add(0, cells[:, corner], torch.ones_like(axes[:, 0, 0]))
    return sums / counts[:, None, None]


def polar_rotations(matrices: Tensor) -> Tensor:
    """Rotations R of M = R U for matrices (n, 3, 3) with positive determinants.

    Newton's iteration with scaling (Higham 1986), which can be differentiated.  Where the
    determinant is not positive, or tiny beside the matrix, R is the identity.
    """
    size = matrices.square().sum(dim=(1, 2), keepdim=True).sqrt().clamp_min(1e-300)
    X = matrices / size
    usable = (determinants(X) > _FLATTEST * 3.0**-1.5)[:, None, None]
    identity = torch.eye(3, dtype=X.dtype, device=X.device)
    X = torch.where(usable, X, identity)
    for _ in range(_NEWTON_STEPS):
        inverse = cofactors(X) / determinants(X)[:, None, None]
        scale = (inverse.square().sum(dim=(1, 2)) / X.square().sum(dim=(1, 2))) ** 0.25
        X = 0.5 * (scale[:, None, None] * X + inverse / scale[:, None, None])
    return torch.where(usable, X, identity)


def determinants(A: Tensor) -> Tensor:
    """Of (n, 3, 3), (n,)."""
    return (A[:, 0] * torch.linalg.cross(A[:, 1], A[:, 2])).sum(dim=1)


def cofactors(A: Tensor) -> Tensor:
    """Det A A^-T of (n, 3, 3)."""
    a, b, c = A.unbind(dim=1)
    rows = (torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b))
    return torch.stack(rows, dim=1)


def turned(R: Tensor, x: Tensor) -> Tensor:
    """R x for matrices (n, 3, 3) and vectors (n, 3)."""
    return (R @ x[..., None])[..., 0]


def turned_back(R: Tensor, x: Tensor) -> Tensor:
    """R^T x."""
    return (R.transpose(1, 2) @ x[..., None])[..., 0]


def rotation_vectors(R: Tensor) -> Tensor:
    """Axial parts of R (n, 3, 3), (n, 3): sine of the angle times the axis."""
    upper = (R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1])
    return 0.5 * torch.stack(upper, dim=1)

"""Volume ratios at the corners of cells, where a body may be folded unseen by quadrature points."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from pdcorrect.fem.hexahedron import VTK_CORNERS, shape_derivatives


def corner_jacobians(positions: Tensor, cells: Tensor) -> Tensor:
    """`pdcorrect.fem.hexahedron.corner_jacobians` of tensors: (c, 8), m3."""
    corners = positions.index_select(0, cells.reshape(-1)).reshape(*cells.shape, 3)
    slopes = _slopes(positions.dtype, positions.device) @ corners
    a, b, c = slopes.reshape(len(cells), 3, -1, 3).unbind(dim=1)
    return (a * torch.linalg.cross(b, c)).sum(dim=2)


@cache
def _slopes(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Shape functions' derivatives at the corners, (24, 8)."""
    with torch.inference_mode(False):
        derivatives = shape_derivatives(VTK_CORNERS.astype(float)).reshape(-1, len(VTK_CORNERS))
        return torch.as_tensor(derivatives, dtype=dtype, device=device)


def least_by_body(ratios: Tensor, cells: Tensor, graph: Tensor, bodies: int) -> Tensor:
    """The least of values (c, 8) of each body's cells, (B,); infinite without any.

    What is not a number stays so.
    """
    owner = graph.index_select(0, cells[:, 0])
    least = ratios.amin(dim=1)
    return least.new_full((bodies,), torch.inf).scatter_reduce(0, owner, least, "amin")

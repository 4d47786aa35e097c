"""How the surroundings of each node are turned and stretched.

A cell's axes are the means of its four edges along each of its own directions.  The mean
over the cells of a node at rest has a rotation (polar decomposition): the node's frame at
rest.  The mean of the cells' deformation gradients F = R U (axes now times the inverse of
those at rest) turns it by R.  So a frame turns with the body, at rest too, and what is told
in frames does not depend on how the scene lies in space, nor on how it has turned since.
R does not depend on how a mesh orders the corners of its cells; the frame at rest does.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import torch
from torch import Tensor

from pdcorrect.batch.fused import as_kernel
from pdcorrect.fem.hexahedron import VTK_CORNERS

EDGE_MEANS = (2.0 * VTK_CORNERS - 1.0) / 4.0
"""What a cell's corners count in its axes, (8, 3)."""


def cell_axes(positions: Tensor, cells: Tensor) -> Tensor:
    """Axes of cells as columns, (c, 3, 3), m, for positions (n, 3) and cells (c, 8)."""
    corners = positions.index_select(0, cells.reshape(-1)).reshape(*cells.shape, 3)
    return torch.einsum("cki,kj->cij", corners, _edge_means(positions.dtype, positions.device))


@cache
def _edge_means(dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.as_tensor(EDGE_MEANS, dtype=dtype, device=device)


def node_axes(positions: Tensor, cells: Tensor, counts: Tensor) -> Tensor:
    """Means of the axes of the cells that touch a node, (n, 3, 3), m.

    ``counts`` (n,) are the numbers of these cells.
    """
    return _node_means(cell_axes(positions, cells), cells, counts)


def node_gradients(positions: Tensor, inverses: Tensor, cells: Tensor, counts: Tensor) -> Tensor:
    """Means of the deformation gradients of the cells that touch a node, (n, 3, 3).

    ``inverses`` (c, 3, 3) are those of the cells' axes at rest, 1/m; ``counts`` as above.
    """
    return _node_means(product(cell_axes(positions, cells), inverses), cells, counts)


def _node_means(values: Tensor, cells: Tensor, counts: Tensor) -> Tensor:
    corners = cells.reshape(-1)
    each = values[:, None].expand(-1, cells.shape[1], -1, -1).reshape(-1, 3, 3)
    sums = values.new_zeros(len(counts), 3, 3).index_add(0, corners, each)
    return sums / counts[:, None, None]


def turned(R: Tensor, x: Tensor) -> Tensor:
    """R x for matrices (n, 3, 3) and vectors (n, 3)."""
    return product(R, x[..., None])[..., 0]


def turned_back(R: Tensor, x: Tensor) -> Tensor:
    """R^T x."""
    return product(R.transpose(1, 2), x[..., None])[..., 0]


def product(A: Tensor, B: Tensor) -> Tensor:
    """A B of each node or edge, matrices (n, 3, 3) and (n, 3, k).

    Libraries treat such matrices on a GPU as if they were large: see `unrolled_products`.
    """
    if A.is_cuda and _unrolled.get():
        quick: Tensor = as_kernel(_product, True)(A.contiguous(), B.contiguous())
        return quick
    return A @ B


@contextmanager
def unrolled_products() -> Iterator[None]:
    """Within it a GPU multiplies small matrices by code that is compiled for them.

    For work without derivatives that is recorded: call by call a compiled function takes longer
    to be called than the library's.
    """
    before = _unrolled.set(True)
    try:
        yield
    finally:
        _unrolled.reset(before)


_unrolled: ContextVar[bool] = ContextVar("unrolled", default=False)


def _product(A: Tensor, B: Tensor) -> Tensor:
    first, second, third = (A[:, :, i, None] * B[:, i, None] for i in range(3))
    return first + second + third

"""Dense inverses of nodal matrices, applied as matrix products.

Triangular solves hardly run in parallel; products with a dense inverse do, at the speed
of the memory, and since an inverse is only a preconditioner here it may be stored in
single precision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.sharing import Sharing
from pdcorrect.batch.tall import tall_product
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]


class DenseInverse:
    """R -> A^-1 r on nodal fields (B, N, 3), zero where clamped.

    Parameters
    ----------
    sharing : Sharing
        Which scenes have one matrix.
    free : sequence of (N, 3) bool
        Components that may move, of each distinct problem.
    width : int
        Unknowns a node of the matrices: 3, or 1 where one is the same for all coordinates.
    storage : torch.dtype
        Of the inverses.
    device : torch.device

    Attributes
    ----------
    bytes : int
        Of all inverses.
    """

    def __init__(
        self,
        sharing: Sharing,
        free: Sequence[NDArray[np.bool_]],
        width: int,
        storage: torch.dtype,
        device: torch.device,
    ) -> None:
        self._sharing, self._width, self._free = sharing, width, list(free)
        self._axes = 1
        if width == 1 and any((f != f[:, :1]).any() for f in free):
            self._axes = 3
        size = width * max(map(len, free))
        shape = (len(free), self._axes, size, size)
        self._inverse = torch.zeros(shape, dtype=storage, device=device)
        self.bytes = self._inverse.numel() * self._inverse.element_size()

    def fill(self, i: int, matrix: Tensor) -> bool:
        """Invert one problem's matrix (w N, w N) into the store, if it is positive definite."""
        size = len(matrix)
        for axis in range(self._axes):
            free = self._free[i].ravel() if self._width == 3 else self._free[i][:, axis]
            keep = torch.as_tensor(free.astype(np.float64), device=matrix.device)
            held = (matrix * keep[:, None]).mul_(keep)
            held.diagonal().add_(1.0 - keep)
            factor, info = torch.linalg.cholesky_ex(held)
            if int(info):
                self._inverse[i] = 0.0
                return False
            inverse = torch.cholesky_inverse(factor).mul_(keep[:, None]).mul_(keep)
            self._inverse[i, axis, :size, :size] = inverse.to(self._inverse.dtype)
        return True

    def narrowed(self, sharing: Sharing, kept: Tensor) -> DenseInverse:
        """With some of the matrices."""
        return with_rows(
            self, kept, "_inverse", _sharing=sharing, _free=[self._free[k] for k in kept.tolist()]
        )

    def __call__(self, r: Tensor) -> Tensor:
        """Scenes with one inverse side by side."""
        shared = self._sharing.gathered(r.to(self._inverse.dtype))
        count, most, nodes, _ = shared.shape
        if self._width == 3:
            columns = shared.reshape(count, most, 1, 3 * nodes).permute(0, 2, 3, 1)
        elif self._axes == 1:
            columns = shared.permute(0, 2, 1, 3).reshape(count, 1, nodes, 3 * most)
        else:
            columns = shared.permute(0, 3, 2, 1)
        flat = tall_product(self._inverse.flatten(0, 1), columns.flatten(0, 1))
        x = flat.reshape(count, self._axes, *flat.shape[1:])
        if self._width == 3:
            x = x.permute(0, 3, 1, 2).reshape(count, most, nodes, 3)
        elif self._axes == 1:
            x = x.reshape(count, nodes, most, 3).permute(0, 2, 1, 3)
        else:
            x = x.permute(0, 3, 2, 1)
        return self._sharing.scattered(x.to(r.dtype))


def summed_blocks(
    cells: NDArray[np.int64], blocks: Array, nodes: int, device: torch.device
) -> Tensor:
    """Matrix (w N, w N) in double precision of cells' blocks (C or 1, w K, w K)."""
    width = blocks.shape[1] // cells.shape[1]
    size = width * nodes
    numbers = (width * cells[:, :, None] + np.arange(width)).reshape(len(cells), -1)
    rows = torch.as_tensor(numbers, device=device)
    values = torch.as_tensor(blocks, device=device).expand(len(cells), -1, -1)
    places = (rows[:, :, None] * size + rows[:, None, :]).reshape(-1)
    matrix = torch.zeros(size * size, dtype=torch.float64, device=device)
    return matrix.index_add_(0, places, values.reshape(-1)).reshape(size, size)


def add_mass(matrix: Tensor, problem: Problem, factor: float) -> None:
    """Add a multiple of a problem's mass matrix to a matrix (w N, w N)."""
    width = len(matrix) // len(problem.positions)
    mass = problem.mass_matrix.tocoo()
    values = torch.as_tensor(factor * mass.data, device=matrix.device)
    for k in range(width):
        rows = torch.as_tensor(width * mass.row.astype(np.int64) + k, device=matrix.device)
        columns = torch.as_tensor(width * mass.col.astype(np.int64) + k, device=matrix.device)
        matrix.view(-1).index_add_(0, rows * len(matrix) + columns, values)

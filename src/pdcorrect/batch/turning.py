"""How nodes have turned since rest: the frame in which the rest Hessian is applied."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.decomposition import transposed
from pdcorrect.batch.fused import as_kernel
from pdcorrect.batch.narrowing import with_rows


class Turning:
    """How nodes and modes have turned since rest, as `first_hessian.Rotations`."""

    def __init__(self, cells: CellBatch) -> None:
        self._cells = cells
        n = cells.sizes
        distinct = cells.bodies.distinct
        weights = [p.quadrature.weights for p in distinct]
        shares = [w / w.sum(axis=1, keepdims=True) for w in weights]
        self._shares = cells.repeated(shares, n.cells, n.points)
        held = [np.where(p.free.all(axis=1), 0.0, 1.0) for p in distinct]
        self._held = cells.repeated(held, n.unknowns) > 0.5

    def narrowed(self, cells: CellBatch, rows: Tensor) -> Turning:
        """Of some scenes, with their cells."""
        return with_rows(self, rows, "_shares", "_held", _cells=cells)

    def since_rest(self, y: Tensor) -> list[Tensor]:
        """Rotations of nodes and modes, nine tensors (B, U)."""
        cells, n = self._cells, self._cells.sizes
        u = y - cells.rest
        u = torch.cat([u[:, : n.nodes], torch.zeros_like(u[:, n.nodes :])], dim=1)
        turns = cells.mean_rotations(u, self._shares.flatten(0, 1)).T
        by_cell = turns.reshape(n.scenes, n.cells, 1, 9).expand(-1, -1, n.width, -1)
        sums = [cells.summed(by_cell[..., 3 * i : 3 * i + 3]) for i in range(3)]
        total = torch.cat(sums, dim=-1)  # (B, U, 9)
        identity = torch.eye(3, dtype=y.dtype, device=y.device).reshape(9)
        still = self._held | (total.abs().sum(dim=-1) == 0.0)
        total = torch.where(still[..., None], identity, total)
        out = cells.rotations(total.reshape(-1, 9).T.contiguous())
        return list(out.reshape(9, n.scenes, n.unknowns))


def rotated(R: list[Tensor], x: Tensor, free: Tensor) -> Tensor:
    """R x at each node where it is free, for nine (B, U), (B, U, 3) and 0 or 1 (B, U, 3)."""
    out: Tensor = as_kernel(_rotated, x.is_cuda)(R, x, free)
    return out


def rotated_back(R: list[Tensor], x: Tensor, free: Tensor) -> Tensor:
    """R^T of what is free of x at each node."""
    out: Tensor = as_kernel(_rotated_back, x.is_cuda)(R, x, free)
    return out


def _rotated(R: list[Tensor], x: Tensor, free: Tensor) -> Tensor:
    return _products(R, x) * free


def _rotated_back(R: list[Tensor], x: Tensor, free: Tensor) -> Tensor:
    return _products(transposed(R), x * free)


def _products(R: list[Tensor], x: Tensor) -> Tensor:
    a, b, c = x.unbind(-1)
    rows = [R[3 * i] * a + R[3 * i + 1] * b + R[3 * i + 2] * c for i in range(3)]
    return torch.stack(rows, dim=-1)

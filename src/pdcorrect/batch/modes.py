"""Internal modes of a batch's cells: in equilibrium with the nodes, and following them."""

from __future__ import annotations

import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.points import Tangent

_STEPS = 40
_SETTLED = {torch.float64: 1e-13, torch.float32: 1e-6}
"""Of the cells' size: change of a mode at which its equilibrium is found."""
_ROUNDING = {torch.float64: 1e-13, torch.float32: 1e-5}


def relaxed(cells: CellBatch, positions: Tensor) -> Tensor:
    """Configurations (B, U, 3) with the modes in equilibrium, for positions (B, N, 3).

    Newton's method in each cell, with steps halved until the energy falls, as
    `pdcorrect.fem.internal_modes.relax`.
    """
    n = cells.sizes
    if not n.modes:
        return positions
    y = torch.cat([positions, positions.new_zeros(n.scenes, n.modes, 3)], dim=1)
    size = cells.volumes[1].sum(dim=1).clamp_min(0.0).max() ** (1.0 / 3.0)
    settled = _SETTLED[y.dtype] * size
    best = torch.full((n.scenes * n.cells,), torch.inf, dtype=y.dtype, device=y.device)
    modes = _by_cell(cells, y)
    kept, step = modes.clone(), torch.zeros_like(modes)
    scale = torch.ones_like(best)
    for _ in range(_STEPS):
        H = cells.gradients(y - cells.rest)
        density, P = cells.points.stress(H, cells.point_weights)
        energy = density.sum(dim=1)
        fell = energy <= best + _ROUNDING[y.dtype] * best.abs()
        best, kept = torch.where(fell, energy, best), torch.where(fell[:, None], modes, kept)
        tangent = cells.points.tangent(H, cells.point_weights)
        new = _solved(_blocks(cells, tangent), -_pulled(cells, P))
        scale = torch.where(fell, 1.0, 0.5 * scale)
        step = torch.where(fell[:, None], new, step)
        change = scale[:, None] * step
        if not bool((change.abs() > settled).any()):
            break
        modes = kept + change
        y = _with_modes(cells, y, modes)
    return _with_modes(cells, y, kept)


class Following:
    """Modes that follow the nodes in equilibrium at y (B, U, 3), as `Condensed` does."""

    def __init__(self, cells: CellBatch, y: Tensor) -> None:
        self._cells = cells
        if cells.sizes.modes:
            self._tangent = cells.linearise(y)
            self._matrices = _blocks(cells, self._tangent)

    def response(self, slopes: Tensor) -> Tensor:
        """The modes' change (B, U, 3) with nodes held, for such derivatives as forces."""
        cells, out = self._cells, torch.zeros_like(slopes)
        if not cells.sizes.modes:
            return out
        return _with_modes(cells, out, _solved(self._matrices, _by_cell(cells, slopes)))

    def reduced(self, slopes: Tensor) -> Tensor:
        """Derivatives by the nodes (B, N, 3) of a function of the configuration."""
        nodes = self._cells.sizes.nodes
        if not self._cells.sizes.modes:
            return slopes
        return (slopes - self._cells.apply(self._tangent, self.response(slopes)))[:, :nodes]


def _by_cell(cells: CellBatch, y: Tensor) -> Tensor:
    """The modes of each cell, (B C, 3 (L - K))."""
    return cells.modes(y).flatten(0, 1).flatten(1)


def _with_modes(cells: CellBatch, y: Tensor, modes: Tensor) -> Tensor:
    n = cells.sizes
    return torch.cat([y[:, : n.nodes], modes.reshape(n.scenes, n.modes, 3)], dim=1)


def _pulled(cells: CellBatch, P: Tensor) -> Tensor:
    """Derivatives by the modes (B C, 3 (L - K)) of what has the slopes P (9, B C, Q) by F."""
    rows = P.reshape(3, 3, *P.shape[1:])
    return torch.einsum("ijcq,cmjq->cmi", rows, cells.mode_gradients()).flatten(1)


def _blocks(cells: CellBatch, tangent: Tangent) -> Tensor:
    """The tangents of the modes, (B C, 3 (L - K), 3 (L - K))."""
    gradients = cells.mode_gradients()
    columns = []
    for mode in range(gradients.shape[1]):
        for i in range(3):
            D = gradients.new_zeros(9, len(gradients), gradients.shape[3])
            D[3 * i : 3 * i + 3] = gradients[:, mode].transpose(0, 1)
            columns.append(_pulled(cells, cells.points.product(tangent[:3], D)))
    return torch.stack(columns, dim=2)


def _solved(matrices: Tensor, b: Tensor) -> Tensor:
    """Solutions (B C, k) with matrices that are made positive definite where they are not."""
    largest = matrices.diagonal(dim1=1, dim2=2).amax(dim=1).abs()
    identity = torch.eye(b.shape[1], dtype=b.dtype, device=b.device)
    safe = torch.where(largest > 0.0, 0.0, 1.0)[:, None, None] * identity
    factor, failed = torch.linalg.cholesky_ex(matrices + safe)
    if bool(failed.any()):
        values, vectors = torch.linalg.eigh(matrices + safe)
        values = torch.maximum(values.abs(), 1e-12 * largest[:, None] + safe[:, :1, 0])
        found = vectors @ ((vectors.transpose(1, 2) @ b[..., None]) / values[..., None])
        return found[..., 0]
    return torch.cholesky_solve(b[..., None], factor)[..., 0]

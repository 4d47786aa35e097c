"""A V-cycle of geometric multigrid for the rest Hessian on refined meshes.

The levels are the meshes that the body's own one was refined from (`levels`).  On each but
the coarsest, rough errors are damped before and after the coarse correction by the same
Chebyshev polynomial (`grid`); the coarsest matrix, of the scene's own coarse mesh, has a dense
inverse.  So the cycle B is symmetric, and positive definite since the polynomial's bound of
the eigenvalues is never too small; where the clamps are those of the coarse mesh too, no
eigenvalue of B A is above 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.dense import DenseInverse, summed_blocks
from pdcorrect.batch.grid import Grid
from pdcorrect.batch.levels import Level, hierarchy
from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.sharing import Sharing
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]

_ROUNDING = 1e-9
"""Of the largest nodal mass: to which masses of cells and of the problem count as equal."""


class Multigrid:
    """R -> B r on nodal fields (B, N, 3), zero where clamped; B is about A^-1.

    Parameters
    ----------
    sharing : Sharing
        Which scenes have one matrix.
    blocks : sequence of (C or 1, 24, 24)
        Stiffness of each distinct problem's cells, N/m; one stands for all.
    mass_factor : float
        1/s2.
    storage : torch.dtype
        Of all that is stored and computed here.
    device : torch.device

    Attributes
    ----------
    bytes : int
        Of all levels.
    regular : list of bool
        Whether each distinct problem's coarsest matrix is positive definite, and the nodes'
        blocks on the other levels.
    """

    def __init__(
        self,
        sharing: Sharing,
        blocks: Sequence[Array],
        mass_factor: float,
        storage: torch.dtype,
        device: torch.device,
    ) -> None:
        self._storage = storage
        hierarchies = [
            hierarchy(p.cells, p.free, *with_mass(p, b, mass_factor), p.refine)
            for p, b in zip(sharing.distinct, blocks, strict=True)
        ]
        *finer, coarsest = [list(levels) for levels in zip(*hierarchies, strict=True)]
        sizes = [max(len(level.free) for level in each) for each in (*finer, coarsest)]
        self._grids = [
            Grid(each, coarse, sharing, storage, device)
            for each, coarse in zip(finer, sizes[1:], strict=True)
        ]
        self._coarsest = DenseInverse(sharing, [c.free for c in coarsest], 3, storage, device)
        self.regular = [
            self._coarsest.fill(i, _matrix(level, device))
            and all(grid.regular[i] for grid in self._grids)
            for i, level in enumerate(coarsest)
        ]
        self.bytes = self._coarsest.bytes + sum(grid.bytes for grid in self._grids)

    def narrowed(self, sharing: Sharing, kept: Tensor, rows: Tensor) -> Multigrid:
        """Of some scenes, with the matrices that they have."""
        return with_rows(
            self, rows, _coarsest=self._coarsest.narrowed(sharing, kept),
            _grids=[grid.narrowed(sharing, kept, rows) for grid in self._grids],
        )  # fmt: skip

    def __call__(self, r: Tensor) -> Tensor:
        return self._cycle(0, r.to(self._storage)).to(r.dtype)

    def _cycle(self, depth: int, b: Tensor) -> Tensor:
        if depth == len(self._grids):
            return self._coarsest(b)
        grid = self._grids[depth]
        x = grid.smoothed(b)
        r = grid.residual(b, x)
        x = x + grid.prolonged(self._cycle(depth + 1, grid.restricted(r)))
        return x + grid.smoothed(grid.residual(b, x))


def with_mass(problem: Problem, blocks: Array, factor: float) -> tuple[Array, Array]:
    """The matrix of stiffness and mass: blocks of the cells, and what nodes have besides.

    Nodes have besides what mass rule "per-node" gives them beyond their cells' lumped
    masses, so that the blocks stay alike.  Where that would be negative, at nodes of more
    than eight cells, the cells' own shares make unlike blocks.
    """
    density, rule, space = problem.materials.density, problem.mass_rule, problem.space
    nodal = np.zeros(len(problem.positions))
    if rule == "per-node":
        lumped = density[:, None] * space.cell_masses("lumped").sum(axis=2)
        by_cells = np.bincount(problem.cells.ravel(), lumped.ravel(), minlength=len(nodal))
        besides = problem.mass - by_cells
        if (besides >= -_ROUNDING * problem.mass.max()).all():
            rule, nodal = "lumped", factor * np.maximum(besides, 0.0)
    masses = factor * density[:, None, None] * space.cell_masses(rule)
    if len(blocks) == 1 and rule != "per-node":
        masses = masses[:1]
    return blocks + np.kron(masses, np.eye(3)), nodal


def _matrix(level: Level, device: torch.device) -> Tensor:
    matrix = summed_blocks(level.cells, level.blocks, len(level.free), device)
    matrix.diagonal().add_(torch.as_tensor(np.repeat(level.nodal, 3), device=device))
    return matrix

"""First Hessians of a batch.

"G" is the thesis's global matrix (eq. 3-14), one scalar matrix for all coordinates;
"G-scaled" the same with less volume weight; "rest" the true Hessian of the rest shape,
turned with the body (`pdcorrect.solvers.first_hessian`), which has three unknowns a node
and so nine times the entries.  All three have dense inverses (`DenseInverse`).
"multigrid" is the same Hessian as "rest", inverted approximately by a cycle of multigrid
(`BatchMultigrid`), for meshes that are refined.  Internal modes are eliminated cell by cell.
Scenes that share mesh, material and clamps share what is stored for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.decomposition import transposed
from pdcorrect.batch.elimination import (
    DenseInverse,
    Elimination,
    Sharing,
    add_mass,
    alike_cells,
    rest_blocks,
    scalar_blocks,
    summed_blocks,
)
from pdcorrect.batch.gpu import one_kernel
from pdcorrect.batch.multigrid import BatchMultigrid
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.projective import VOLUME_SCALE


@one_kernel
def _rotated(x: Tensor, R: list[Tensor], free: Tensor) -> Tensor:
    """R x at each node where it is free, for (B, U, 3), nine (B, U) and 0 or 1 (B, U, 3)."""
    return _products(R, x) * free


@one_kernel
def _rotated_back(x: Tensor, R: list[Tensor], free: Tensor) -> Tensor:
    """R^T of what is free of x at each node."""
    return _products(transposed(R), x * free)


def _products(R: list[Tensor], x: Tensor) -> Tensor:
    a, b, c = x.unbind(-1)
    rows = [R[3 * i] * a + R[3 * i + 1] * b + R[3 * i + 2] * c for i in range(3)]
    return torch.stack(rows, dim=-1)


Array = NDArray[np.float64]
Factors = tuple[float, float]
BatchHessian = Literal["auto", "G", "G-scaled", "multigrid", "rest"]


def chosen(name: BatchHessian, problems: Sequence[Problem]) -> BatchHessian:
    """What "auto" is for some problems.

    Raises
    ------
    InputError
        If there is no such name, or no hierarchy of meshes.
    """
    nested = _nested(problems)
    if name == "multigrid" and not nested:
        raise InputError(
            "first_hessian = 'multigrid' for meshes that are not refined alike: expected the same "
            "refine of 2 or more for all, and elements of 8 nodes."
        )
    if name not in get_args(BatchHessian):
        raise InputError(f"first_hessian = {name!r}: expected {', '.join(get_args(BatchHessian))}.")
    if name != "auto":
        return name
    if max(len(p.positions) for p in problems) <= LARGEST_REST:
        return "rest"
    return "multigrid" if nested else "G-scaled"


def _nested(problems: Sequence[Problem]) -> bool:
    """Whether there are as many coarser meshes under each problem's, of hexahedra of 8 nodes."""
    refine = problems[0].refine
    return refine > 1 and all(p.refine == refine and p.cells.shape[1] == 8 for p in problems)


LARGEST_REST = 1500
"""Nodes above which the nine times larger inverse of the rest Hessian does not pay."""


class FirstHessian:
    """R -> H^-1 r, about, on configurations (B, U, 3), zero where clamped.

    ``factors`` are on mass (1/s2) and stiffness, ``storage`` is the inverse's type.

    Attributes
    ----------
    count : int
        Distinct matrices.
    regular : (B,) bool
        Whether there is an inverse; where not, the products mean nothing.

    Raises
    ------
    ConvergenceError
        If no scene's matrix is positive definite.
    """

    def __init__(
        self,
        cells: CellBatch,
        problems: Sequence[Problem],
        factors: Factors,
        kind: BatchHessian,
        storage: torch.dtype = torch.float32,
    ) -> None:
        self._cells, self.kind = cells, kind
        self._sharing = Sharing(problems, cells.device)
        distinct = self._sharing.distinct
        self.count = len(distinct)
        owners = torch.as_tensor(self._sharing.owners, device=cells.device)
        self._turned = kind in ("rest", "multigrid")
        width = 3 if self._turned else 1
        blocks = [_blocks(p, factors[1], kind) for p in distinct]
        nodes = problems[0].cells.shape[1]
        self._modes = Elimination(cells, blocks, owners, nodes, width, storage)
        del blocks
        self._solver: DenseInverse | BatchMultigrid
        if kind == "multigrid":
            self._solver = BatchMultigrid(
                self._sharing, self._modes.blocks, factors[0], storage, cells.device
            )
            regular = self._solver.regular
        else:
            free = [p.free for p in distinct]
            self._solver = DenseInverse(self._sharing, free, width, storage, cells.device)
            regular = self._filled(self._solver, factors[0])
        self._modes.blocks.clear()
        if not any(regular):
            raise ConvergenceError(
                f"scene {problems[0].scene.name!r}: the matrix of the step is not positive "
                "definite: expected clamps, or inertia that matters beside the stiffness."
            )
        self.regular = torch.tensor(regular, device=cells.device)[owners]
        self._rotations: list[Tensor] = []
        if self._turned:
            n = cells.sizes
            weights = [p.quadrature.weights for p in cells.bodies.distinct]
            shares = [w / w.sum(axis=1, keepdims=True) for w in weights]
            self._shares = cells.repeated(shares, n.cells, n.points)
            self._held = cells.free.amin(dim=2) < 0.5
            room = torch.zeros(9, n.scenes, n.unknowns, dtype=cells.dtype, device=cells.device)
            self._rotations = list(room)
        self._free = cells.free

    def _filled(self, solver: DenseInverse, mass_factor: float) -> list[bool]:
        regular = []
        for i, problem in enumerate(self._sharing.distinct):
            nodes, blocks = len(problem.positions), self._modes.blocks[i]
            matrix = summed_blocks(problem.cells, blocks, nodes, self._cells.device)
            add_mass(matrix, problem, mass_factor)
            regular.append(solver.fill(i, matrix))
        return regular

    def turn(self, y: Tensor) -> None:
        """Turn the rest Hessian to a configuration, see `first_hessian.Rotations`."""
        if not self._turned:
            return
        cells, n = self._cells, self._cells.sizes
        u = y - cells.rest
        u = torch.cat([u[:, : n.nodes], torch.zeros_like(u[:, n.nodes :])], dim=1)
        mean = (cells.gradients(u) * self._shares.flatten(0, 1)).sum(dim=-1)
        turns = cells.points.rotations(mean).T
        by_cell = turns.reshape(n.scenes, n.cells, 1, 9).expand(-1, -1, n.width, -1)
        sums = [cells.summed(by_cell[..., 3 * i : 3 * i + 3]) for i in range(3)]
        total = torch.cat(sums, dim=-1)  # (B, U, 9)
        identity = torch.eye(3, dtype=y.dtype, device=y.device).reshape(9)
        still = self._held | (total.abs().sum(dim=-1) == 0.0)
        moved = torch.where(still[..., None], 0.0, total - identity)
        out = cells.points.rotations(moved.reshape(-1, 9).T.contiguous())
        for kept, new in zip(self._rotations, out.reshape(9, n.scenes, n.unknowns), strict=True):
            kept.copy_(new)

    def __call__(self, r: Tensor) -> Tensor:
        if not self._turned:
            return self._solved(r * self._free) * self._free
        x = self._solved(_rotated_back(r, self._rotations, self._free))
        return _rotated(x, self._rotations, self._free)

    def _solved(self, r: Tensor) -> Tensor:
        return self._modes.recovered(self._solver(self._modes.reduced(r)), r)


def _blocks(problem: Problem, stiffness: float, kind: BatchHessian) -> Array:
    """Matrices of the cells, N/m; of one cell if they are alike."""
    alike = alike_cells(problem)
    if kind in ("rest", "multigrid"):
        return rest_blocks(problem, stiffness, alike)
    return scalar_blocks(problem, stiffness, 1.0 if kind == "G" else VOLUME_SCALE, alike)

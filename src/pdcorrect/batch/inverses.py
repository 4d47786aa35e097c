"""First Hessians of a batch: dense inverses, applied as matrix products.

Triangular solves hardly run in parallel; products with a dense inverse do, at the speed
of the memory, and since an inverse is only a preconditioner here it may be stored in
single precision.  Scenes that share mesh, material, clamps and step share one.

"G" is the thesis's global matrix (eq. 3-14), one scalar matrix for all coordinates;
"G-scaled" the same with less volume weight; "rest" the true Hessian of the rest shape,
turned with the body (`pdcorrect.solvers.first_hessian`), which has three unknowns a node
and so nine times the entries; "two-level" is "G-scaled" with a correction from the coarse
mesh (`CoarseCorrection`).  Internal modes are eliminated cell by cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.batch.coarse import CoarseCorrection
from pdcorrect.batch.decomposition import transposed
from pdcorrect.batch.fused import small_products
from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.sharing import Sharing
from pdcorrect.batch.tall import tall_product
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.projective import VOLUME_SCALE

Array = NDArray[np.float64]
Factors = tuple[float, float]
BatchHessian = Literal["auto", "G", "G-scaled", "two-level", "rest"]


def chosen(name: BatchHessian, problems: Sequence[Problem]) -> BatchHessian:
    """What "auto" is for some problems.

    Raises
    ------
    InputError
        If there is no such name, or there are no two levels.
    """
    refined = all(p.refine > 1 for p in problems)
    if name == "two-level" and not refined:
        raise InputError(
            "first_hessian = 'two-level' for meshes that are not refined: expected refine of 2 "
            "or more."
        )
    if name not in get_args(BatchHessian):
        raise InputError(f"first_hessian = {name!r}: expected {', '.join(get_args(BatchHessian))}.")
    if name != "auto":
        return name
    if max(len(p.positions) for p in problems) <= LARGEST_REST:
        return "rest"
    return "two-level" if refined else "G-scaled"


LARGEST_REST = 1500
"""Nodes above which the nine times larger inverse of the rest Hessian does not pay."""


class DenseInverse:
    """R -> H^-1 r on configurations (B, U, 3), zero where clamped.

    Parameters
    ----------
    cells : CellBatch
    problems : sequence of Problem
    factors : (float, float)
        On mass (1/s2) and stiffness.
    kind : {"G", "G-scaled", "two-level", "rest"}
    storage : torch.dtype
        Of the inverse.

    Attributes
    ----------
    bytes : int
        Of all inverses.
    count : int
        Distinct ones.
    regular : (B,) bool
        Whether there is an inverse; where not, the products are zero.

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
        self._width = 3 if kind == "rest" else 1
        self._sharing = Sharing(problems, cells.device)
        distinct, owners = self._sharing.distinct, self._sharing.owners
        self.count = len(distinct)
        self._axes = 1
        if kind != "rest" and any((p.free != p.free[:, :1]).any() for p in problems):
            self._axes = 3
        n = cells.sizes
        size = self._width * n.nodes
        shape = (len(distinct), self._axes, size, size)
        self._inverse = torch.zeros(shape, dtype=storage, device=cells.device)
        self.bytes = self._inverse.numel() * self._inverse.element_size()
        solved, inverted, matrices, regular = [], [], [], []
        for i, problem in enumerate(distinct):
            blocks = _node_blocks(problem, factors, kind)
            kept, inverse, coupling = _eliminated(blocks, problem.cells.shape[1] * self._width)
            solved.append(coupling)
            inverted.append(inverse)
            regular.append(self._fill(i, problem, kept, factors[0]))
            if kind == "two-level":
                matrices.append(_summed(problem, kept, factors[0]) if regular[i] else None)
        if not any(regular):
            raise ConvergenceError(
                f"scene {problems[0].scene.name!r}: the matrix of the step is not positive "
                "definite: expected clamps, or inertia that matters beside the stiffness."
            )
        self.regular = torch.tensor([regular[k] for k in owners], device=cells.device)
        if n.modes:
            modes = self._width * (n.width - problems[0].cells.shape[1])
            nodes = self._width * problems[0].cells.shape[1]
            owner = torch.as_tensor(owners, device=cells.device)
            self._solved = cells.tensor(padded(solved, (n.cells, modes, nodes)))[owner]
            self._mode_inverse = cells.tensor(padded(inverted, (n.cells, modes, modes)))[owner]
        self._coarse: CoarseCorrection | None = None
        if kind == "two-level":
            self._coarse = CoarseCorrection(cells, distinct, matrices, factors, self._sharing)
            self.bytes += self._coarse.bytes
        self._rotations: list[Tensor] = []
        if kind in ("rest", "two-level"):
            self._turning = _Turning(cells, problems)
            room = torch.zeros(9, n.scenes, n.unknowns, dtype=cells.dtype, device=cells.device)
            self._rotations = list(room)
        self._free = cells.configurations([np.where(p.free_unknowns, 1.0, 0.0) for p in problems])

    def narrowed(self, cells: CellBatch, rows: Tensor) -> DenseInverse:
        """Of some scenes with their cells, turned as it is now."""
        sharing, kept = self._sharing.narrowed(rows)
        modes = ("_solved", "_mode_inverse") if cells.sizes.modes else ()
        out = with_rows(
            self, rows, "_free", "regular", *modes,
            _cells=cells, _sharing=sharing, _inverse=self._inverse[kept],
            _rotations=[a[rows] for a in self._rotations],
        )  # fmt: skip
        if self._rotations:
            out._turning = self._turning.narrowed(cells, rows)
        if self._coarse is not None:
            out._coarse = self._coarse.narrowed(sharing, kept)
        return out

    def turn(self, y: Tensor) -> None:
        """Turn the rest Hessian to a configuration."""
        if self._rotations:
            for kept, new in zip(self._rotations, self._turning.since_rest(y), strict=True):
                kept.copy_(new)

    def __call__(self, r: Tensor) -> Tensor:
        r = r * self._free
        n = self._cells.sizes
        turned = self.kind == "rest"
        if turned:
            r = _rotated(transposed(self._rotations), r)
        nodal = (r if not n.modes else self._reduced(r))[:, : n.nodes]
        x = self._product(nodal)
        if self._coarse is not None:
            R = [a[:, : n.nodes] for a in self._rotations]
            x = x + _rotated(R, self._coarse(_rotated(transposed(R), nodal)))
        if n.modes:
            x = self._recovered(x, r)
        if turned:
            x = _rotated(self._rotations, x)
        return x * self._free

    # --- the product ------------------------------------------------------------------

    def _product(self, r: Tensor) -> Tensor:
        """(B, N, 3) -> (B, N, 3), scenes with one inverse side by side."""
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
        return self._sharing.scattered(x.to(self._cells.dtype))

    # --- internal modes ------------------------------------------------------------------

    def _reduced(self, r: Tensor) -> Tensor:
        """Right-hand side with the modes' part moved to the nodes."""
        local = self._cells.local(r)
        nodes = self._solved.shape[-1] // self._width
        modes = self._flat(local[:, :, nodes:])
        back = self._unflat(small_products(self._solved.transpose(-1, -2), modes))
        return r - self._cells.summed(torch.cat([back, local[:, :, nodes:] * 0.0], dim=2))

    def _recovered(self, x: Tensor, r: Tensor) -> Tensor:
        n = self._cells.sizes
        whole = torch.cat([x, x.new_zeros(n.scenes, n.modes, 3)], dim=1)
        nodes = self._solved.shape[-1] // self._width
        modes = self._flat(self._cells.local(r)[:, :, nodes:])
        moved = self._flat(self._cells.local(whole)[:, :, :nodes])
        found = self._unflat(
            small_products(self._mode_inverse, modes) - small_products(self._solved, moved)
        )
        zeros = found.new_zeros(n.scenes, n.cells, nodes, 3)
        return whole + self._cells.summed(torch.cat([zeros, found], dim=2))

    def _flat(self, local: Tensor) -> Tensor:
        """(B, C, k, 3) as columns of what the eliminated blocks multiply."""
        return local if self._width == 1 else local.reshape(*local.shape[:2], -1, 1)

    def _unflat(self, columns: Tensor) -> Tensor:
        return columns if self._width == 1 else columns.reshape(*columns.shape[:2], -1, 3)

    # --- preparation -----------------------------------------------------------------------

    def _fill(self, i: int, problem: Problem, blocks: Array, mass_factor: float) -> bool:
        """Invert one problem's matrix into the store, if it is positive definite."""
        device, width = self._cells.device, self._width
        size = width * len(problem.positions)
        numbers = width * problem.cells[:, :, None] + np.arange(width)
        cells = torch.as_tensor(numbers.reshape(len(numbers), -1), device=device)
        matrix = torch.zeros(size * size, dtype=torch.float64, device=device)
        places = (cells[:, :, None] * size + cells[:, None, :]).reshape(-1)
        matrix.index_add_(0, places, torch.as_tensor(blocks, device=device).reshape(-1))
        mass = problem.mass_matrix.tocoo()
        values = torch.as_tensor(mass_factor * mass.data, device=device)
        for k in range(width):
            rows = torch.as_tensor(width * mass.row.astype(np.int64) + k, device=device)
            columns = torch.as_tensor(width * mass.col.astype(np.int64) + k, device=device)
            matrix.index_add_(0, rows * size + columns, values)
        matrix = matrix.reshape(size, size)
        for axis in range(self._axes):
            free = problem.free.ravel() if width == 3 else problem.free[:, axis]
            keep = torch.as_tensor(free.astype(np.float64), device=device)
            held = matrix * keep[:, None] * keep + torch.diag(1.0 - keep)
            factor, info = torch.linalg.cholesky_ex(held)
            if int(info):
                self._inverse[i] = 0.0
                return False
            inverse = torch.cholesky_inverse(factor) * keep[:, None] * keep
            self._inverse[i, axis, :size, :size] = inverse.to(self._inverse.dtype)
        return True


class _Turning:
    """How nodes and modes have turned since rest, as `first_hessian.Rotations`."""

    def __init__(self, cells: CellBatch, problems: Sequence[Problem]) -> None:
        self._cells = cells
        n = cells.sizes
        shares = [
            p.quadrature.weights / p.quadrature.weights.sum(axis=1, keepdims=True) for p in problems
        ]
        self._shares = cells.tensor(padded(shares, (n.cells, n.points)))
        held = [~p.free.all(axis=1) for p in problems]
        self._held = cells.nodal([np.where(h, 1.0, 0.0) for h in held]) > 0.5
        self._nodes = problems[0].cells.shape[1]

    def narrowed(self, cells: CellBatch, rows: Tensor) -> _Turning:
        return with_rows(self, rows, "_shares", "_held", _cells=cells)

    def since_rest(self, y: Tensor) -> list[Tensor]:
        """Rotations of nodes and modes, nine tensors (B, U)."""
        cells, n = self._cells, self._cells.sizes
        u = y - cells.rest
        u = torch.cat([u[:, : n.nodes], torch.zeros_like(u[:, n.nodes :])], dim=1)
        F = cells.gradients(u, 1.0).reshape(9, n.scenes, n.cells, n.points)
        mean = (F * self._shares).sum(dim=-1).reshape(9, -1)
        turns = cells.rotations(mean).T.reshape(n.scenes, n.cells, 1, 9)
        by_cell = turns.expand(-1, -1, n.width, -1)
        sums = [cells.summed(by_cell[..., 3 * i : 3 * i + 3]) for i in range(3)]
        total = torch.cat(sums, dim=-1)  # (B, U, 9)
        identity = torch.eye(3, dtype=y.dtype, device=y.device).reshape(9)
        still = self._held | (total.abs().sum(dim=-1) == 0.0)
        total = torch.where(still[..., None], identity, total)
        out = cells.rotations(total.reshape(-1, 9).T.contiguous())
        return list(out.reshape(9, n.scenes, n.unknowns))


def _rotated(R: list[Tensor], x: Tensor) -> Tensor:
    a, b, c = x.unbind(-1)
    rows = [R[3 * i] * a + R[3 * i + 1] * b + R[3 * i + 2] * c for i in range(3)]
    return torch.stack(rows, dim=-1)


def _node_blocks(problem: Problem, factors: Factors, kind: BatchHessian) -> Array:
    """Stiffness of each cell, (C, w L, w L), N/m."""
    if kind == "rest":
        rest = problem.extended(problem.positions)
        blocks = factors[1] * problem.linearise(rest, project=True).blocks()
        count, width = blocks.shape[:2]
        return np.ascontiguousarray(blocks.swapaxes(2, 3)).reshape(count, 3 * width, 3 * width)
    weights, lanes = problem.point_weights, problem.quadrature.lanes
    scale = 1.0 if kind == "G" else VOLUME_SCALE
    coefficient = factors[1] * (2.0 * weights[:, 0] + scale * weights[:, 1])
    rows = lanes.reshape(*lanes.shape[:2], -1)
    scaled = (lanes * coefficient[:, None, None, :]).reshape(rows.shape)
    return rows @ scaled.swapaxes(1, 2)


def _summed(problem: Problem, blocks: Array, mass_factor: float) -> sp.csr_matrix:
    """Scalar blocks of the cells (C, K, K) summed, with the mass, (N, N)."""
    cells, width, size = problem.cells, problem.cells.shape[1], len(problem.positions)
    places = (np.repeat(cells, width, axis=1).ravel(), np.tile(cells, width).ravel())
    matrix = sp.coo_matrix((blocks.ravel(), places), shape=(size, size))
    return sp.csr_matrix(matrix + mass_factor * problem.mass_matrix)


def _eliminated(blocks: Array, nodes: int) -> tuple[Array, Array, Array]:
    """Blocks of the nodes with the modes eliminated, K_bb^-1 and K_bb^-1 K_bu."""
    inverse = np.asarray(np.linalg.inv(blocks[:, nodes:, nodes:]), dtype=np.float64)
    solved = inverse @ blocks[:, nodes:, :nodes]
    kept = blocks[:, :nodes, :nodes] - blocks[:, :nodes, nodes:] @ solved
    return np.ascontiguousarray(kept), inverse, solved

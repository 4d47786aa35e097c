"""A V-cycle of geometric multigrid for the rest Hessian on refined meshes.

The levels are the meshes that the body's own one was refined from (`levels`).  On each but
the coarsest, rough errors are damped before and after the coarse correction by the same
Chebyshev polynomial in D^-1 A, with D the nodes' 3 x 3 blocks of A; the coarsest matrix, of
the scene's own coarse mesh, has a dense inverse.  With lambda an upper bound of D^-1 A the
cycle B is symmetric and positive definite, and no eigenvalue of B A is above 1.

Such a bound comes from the cells: x^T A x is the sum of x_c^T A_c x_c, each at most lambda_c
x_c^T D_c x_c with lambda_c the largest eigenvalue of D_c^-1 A_c, so lambda is at most the
largest lambda_c (Fried 1972).  It is 4 to 20 % too large, and never too small.

A is applied cell by cell: values are gathered, multiplied by one 24 x 24 matrix a scene
(where its cells are alike), and summed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import padded
from pdcorrect.batch.dense import DenseInverse, summed_blocks
from pdcorrect.batch.elimination import cellwise
from pdcorrect.batch.fused import as_kernel, rows_of, sums
from pdcorrect.batch.levels import Level, Numbers, hierarchy
from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.sharing import Sharing
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]

DEGREE = 3
"""Of the Chebyshev polynomial in D^-1 A times D^-1: products with D^-1 in one smoothing."""
SMOOTHED = 16.0
"""Ratio of the largest eigenvalue of D^-1 A to the smallest one that the smoother damps."""
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
            _Grid(each, coarse, sharing, storage, device)
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


class _Grid:
    """A level of a batch: its operator, smoother, and the ways to the next coarser one.

    Nodal fields are (B, N, 3), padded.

    Parameters
    ----------
    levels : sequence of Level
        Of the distinct problems.
    coarse : int
        Nodes of the largest next coarser level.
    sharing, storage, device
        See `Multigrid`.

    Attributes
    ----------
    regular : list of bool
        Whether each distinct problem has a smoother.
    """

    def __init__(
        self,
        levels: Sequence[Level],
        coarse: int,
        sharing: Sharing,
        storage: torch.dtype,
        device: torch.device,
    ) -> None:
        self._sharing = sharing
        owners = torch.as_tensor(sharing.owners, device=device)
        nodes = max(len(level.free) for level in levels)
        count = max(len(level.cells) for level in levels)

        def real(arrays: Sequence[Array], *shape: int) -> Tensor:
            return torch.as_tensor(padded(arrays, shape), dtype=storage, device=device)

        def numbers(arrays: Sequence[Numbers], *shape: int) -> Tensor:
            return torch.as_tensor(padded(arrays, shape), device=device)[owners]

        self._cells = numbers([level.cells for level in levels], count, 8)
        places = [_places(level.cells, len(level.free)) for level in levels]
        most = max(p.shape[1] for p in places)
        filled = [np.pad(p, ((0, 0), (0, most - p.shape[1])), constant_values=-1) for p in places]
        self._slots = torch.as_tensor(padded(filled, (nodes, most), fill=-1), device=device)[owners]
        self._alike = all(len(level.blocks) == 1 for level in levels)
        if self._alike:
            self._blocks = real([level.blocks[0] for level in levels], 24, 24)[owners]
        else:
            every = [np.broadcast_to(v.blocks, (len(v.cells), 24, 24)) for v in levels]
            self._blocks = real(every, count, 24, 24)
        self._nodal = real([level.nodal[:, None] for level in levels], nodes, 1)[owners]
        self._free = real([level.free.astype(np.float64) for level in levels], nodes, 3)[owners]
        inverses = [_scaled_inverse(level, device) for level in levels]
        self.regular = [bool(inverse.any()) for inverse in inverses]
        self._inverse = real(inverses, nodes, 3, 3)[owners]
        up, down = zip(*(_tables(level.interpolation) for level in levels), strict=True)
        self._up, self._down = (
            (
                numbers([t for t, _ in tables], size, max(t.shape[1] for t, _ in tables)),
                real([w for _, w in tables], size, max(w.shape[1] for _, w in tables))[owners],
            )
            for tables, size in ((up, nodes), (down, coarse))
        )
        self._count_from()

    def _count_from(self) -> None:
        """Number nodes and cells' values through all scenes, as kernels read them."""
        scenes, nodes, most = self._slots.shape
        values = 8 * self._cells.shape[1]
        scene = torch.arange(scenes, device=self._slots.device)[:, None, None]
        none = torch.tensor(scenes * values, device=scene.device)
        self._flat_cells = (self._cells + nodes * scene).reshape(-1)
        slots = torch.where(self._slots >= 0, self._slots + values * scene, none)
        self._flat_slots = slots.reshape(-1, most)
        coarse = self._down[0].shape[1]
        self._flat_up = (self._up[0] + coarse * scene).flatten(0, 1)
        self._flat_down = (self._down[0] + nodes * scene).flatten(0, 1)

    @property
    def bytes(self) -> int:
        """Memory of its tensors."""
        tensors = (
            self._cells, self._slots, self._blocks, self._nodal, self._free, self._inverse,
            self._flat_cells, self._flat_slots, *self._up, *self._down, self._flat_up,
            self._flat_down,
        )  # fmt: skip
        return sum(t.numel() * t.element_size() for t in tensors)

    def narrowed(self, sharing: Sharing, kept: Tensor, rows: Tensor) -> _Grid:
        """Of some scenes, with the matrices that they have."""
        out = with_rows(
            self, rows, "_cells", "_slots", "_nodal", "_free", "_inverse", _sharing=sharing,
            _blocks=self._blocks[rows if self._alike else kept],
            _up=(self._up[0][rows], self._up[1][rows]),
            _down=(self._down[0][rows], self._down[1][rows]),
        )  # fmt: skip
        out._count_from()
        return out

    def residual(self, b: Tensor, x: Tensor) -> Tensor:
        """B - A x; of no meaning where clamped."""
        local = rows_of(x.reshape(-1, 3), self._flat_cells)
        images = self._images(local.reshape(len(x), -1, 24)).reshape(-1, 3)
        kernel = as_kernel(_residual, x.is_cuda)
        out: Tensor = kernel(b, x, self._nodal, images, self._flat_slots)
        return out

    def smoothed(self, b: Tensor) -> Tensor:
        """A Chebyshev polynomial in D^-1 A, times D^-1 b: symmetric, zero where clamped."""
        kernel = as_kernel(_advanced, b.is_cuda)
        x, step = torch.zeros_like(b), torch.zeros_like(b)
        r = b
        for k, (old, new) in enumerate(_COEFFICIENTS):
            if k:
                r = self.residual(b, x)
            step, x = kernel(self._inverse, r, step, x, old, new)
        return x

    def restricted(self, r: Tensor) -> Tensor:
        """P^T r, on the next coarser level, for a field that counts where free."""
        kernel = as_kernel(_weighted, r.is_cuda)
        flat = (r * self._free).reshape(-1, 3)
        out: Tensor = kernel(flat, self._flat_down, self._down[1].flatten(0, 1))
        return out.reshape(len(r), -1, 3)

    def prolonged(self, x: Tensor) -> Tensor:
        """P x, zero where clamped."""
        kernel = as_kernel(_weighted, x.is_cuda)
        out: Tensor = kernel(x.reshape(-1, 3), self._flat_up, self._up[1].flatten(0, 1))
        return out.reshape(self._free.shape) * self._free

    def _images(self, local: Tensor) -> Tensor:
        """The cells' matrices times their values (B, C, 24)."""
        if self._alike:
            return cellwise(self._blocks, local[..., None])
        shared = self._sharing.gathered(local)  # (K, m, C, 24)
        moved = cellwise(self._blocks, shared.permute(0, 2, 3, 1))
        return self._sharing.scattered(moved.permute(0, 3, 1, 2))


# --- what is one kernel on a GPU -----------------------------------------------------------------


def _residual(b: Tensor, x: Tensor, nodal: Tensor, images: Tensor, slots: Tensor) -> Tensor:
    return b - nodal * x - sums(images, slots).reshape(b.shape)


def _advanced(
    inverse: Tensor, r: Tensor, step: Tensor, x: Tensor, old: float, new: float
) -> tuple[Tensor, Tensor]:
    a, b, c = r.unbind(-1)
    scaled = inverse[..., 0] * a[..., None] + inverse[..., 1] * b[..., None]
    step = old * step + new * (scaled + inverse[..., 2] * c[..., None])
    return step, x + step


def _weighted(values: Tensor, numbers: Tensor, weights: Tensor) -> Tensor:
    total = weights[:, 0, None] * values[numbers[:, 0]]
    for i in range(1, numbers.shape[1]):
        total = total + weights[:, i, None] * values[numbers[:, i]]
    return total


def chebyshev(degree: int, smoothed: float) -> list[tuple[float, float]]:
    """Factors of the last step and of D^-1 r in each step, for eigenvalues from 1/smoothed to 1.

    Saad, Iterative methods for sparse linear systems (2003), algorithm 12.1.
    """
    middle, half = (1.0 + 1.0 / smoothed) / 2.0, (1.0 - 1.0 / smoothed) / 2.0
    out, ratio = [(0.0, 1.0 / middle)], half / middle
    for _ in range(degree - 1):
        before, ratio = ratio, 1.0 / (2.0 * middle / half - ratio)
        out.append((ratio * before, 2.0 * ratio / half))
    return out


_COEFFICIENTS = chebyshev(DEGREE, SMOOTHED)


# --- preparation ---------------------------------------------------------------------------------


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


def largest_eigenvalue(blocks: Array, device: torch.device) -> float:
    """A bound, from the cells (C, 24, 24), of the eigenvalues of D^-1 A.

    D are the nodes' 3 x 3 blocks of A, which may have more on its diagonal than the cells.

    Raises
    ------
    numpy.linalg.LinAlgError
        If those of a cell are not positive definite.
    """
    A = torch.as_tensor(blocks, device=device)
    D = A.new_zeros(A.shape)
    for k in range(0, 24, 3):
        D[:, k : k + 3, k : k + 3] = A[:, k : k + 3, k : k + 3]
    L, info = torch.linalg.cholesky_ex(D)
    if bool(info.any()):
        raise np.linalg.LinAlgError("a cell's matrix has no positive definite diagonal")
    half = torch.linalg.solve_triangular(L, A, upper=False)
    both = torch.linalg.solve_triangular(L, half.transpose(1, 2), upper=False)
    return max(1.0, float(torch.linalg.eigvalsh(both).max()))


def _scaled_inverse(level: Level, device: torch.device) -> Array:
    """D^-1 by the bound of the eigenvalues of D^-1 A, (N, 3, 3), zero where clamped.

    All zero where some D is not positive definite.
    """
    corners = level.blocks.reshape(-1, 8, 3, 8, 3)[:, range(8), :, range(8), :]  # (8, C, 3, 3)
    corners = np.broadcast_to(corners.swapaxes(0, 1), (len(level.cells), 8, 3, 3))
    flat, count = level.cells.ravel(), len(level.free)
    sums = [np.bincount(flat, c, minlength=count) for c in corners.reshape(-1, 9).T]
    D = np.stack(sums, axis=1).reshape(-1, 3, 3) + level.nodal[:, None, None] * np.eye(3)
    free = level.free[:, :, None] & level.free[:, None, :]
    D = np.where(free, D, 0.0) + (~level.free)[:, :, None] * np.eye(3)
    try:
        inverse = np.where(free, np.linalg.inv(D), 0.0)
        return np.asarray(inverse / largest_eigenvalue(level.blocks, device))
    except np.linalg.LinAlgError:
        return np.zeros_like(D)


def _matrix(level: Level, device: torch.device) -> Tensor:
    matrix = summed_blocks(level.cells, level.blocks, len(level.free), device)
    matrix.diagonal().add_(torch.as_tensor(np.repeat(level.nodal, 3), device=device))
    return matrix


def _places(cells: Numbers, count: int) -> Numbers:
    """Where each node occurs in the raveled cells, (N, most), filled up with -1."""
    flat = cells.ravel()
    order = np.argsort(flat, kind="stable")
    return _rows(flat[order], order, count, -1)[0]


def _tables(P: sp.csr_matrix | None) -> tuple[tuple[Numbers, Array], tuple[Numbers, Array]]:
    """Columns and weights of the rows of P (N, n), and of P^T, filled up with zeros."""
    assert P is not None
    out = []
    for matrix in (P, sp.csr_matrix(P.T)):
        matrix = matrix.tocoo()
        order = np.argsort(matrix.row, kind="stable")
        rows, columns = matrix.row[order], matrix.col[order].astype(np.int64)
        numbers, places = _rows(rows, columns, matrix.shape[0], 0)
        weights = np.zeros(numbers.shape)
        weights[rows, places] = matrix.data[order]
        out.append((numbers, weights))
    return out[0], out[1]


def _rows(rows: Numbers, values: Numbers, count: int, fill: int) -> tuple[Numbers, Numbers]:
    """Values by sorted rows as a table (count, most), and the place of each in its row."""
    counts = np.bincount(rows, minlength=count)
    places = np.arange(len(rows)) - (np.cumsum(counts) - counts)[rows]
    out = np.full((count, counts.max()), fill, dtype=np.int64)
    out[rows, places] = values
    return out, places

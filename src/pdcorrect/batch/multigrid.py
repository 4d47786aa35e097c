"""A V-cycle of geometric multigrid for the rest Hessian on refined meshes.

The levels are the meshes that the body's own one was refined from: nested, and so are their
trilinear functions.  A coarse cell's matrix is the sum over its children of W^T A W with W the
weights of a child's corners on the cell's (Galerkin's coarse matrix, cell by cell).  On each level
but the coarsest, rough errors are damped before and after the coarse correction by the same
Chebyshev polynomial; the coarsest matrix, of the scene's own coarse mesh, has a dense inverse.
  So the cycle B is symmetric, and positive definite since the polynomial's bound of
the eigenvalues is never too small; where the clamps are those of the coarse mesh too, no
eigenvalue of B A is above 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import of_all, padded, places, table_rows
from pdcorrect.batch.elimination import DenseInverse, Sharing, cellwise, summed_blocks
from pdcorrect.batch.gpu import one_kernel, rows_of, sums
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Level:
    """A mesh and a matrix on it: of its cells, and a multiple of the identity at each node.

    Attributes
    ----------
    cells : (C, 8) int
    free : (N, 3) bool
    blocks : (C or 1, 24, 24)
        Of the cells; one stands for all.
    nodal : (N,)
        Added to the diagonal of each node.
    interpolation : (N, M) sparse or None
        From the nodes of the next coarser level; None on the coarsest.
    """

    cells: Numbers
    free: NDArray[np.bool_]
    blocks: Array
    nodal: Array
    interpolation: sp.csr_matrix | None


def factors_of(refine: int) -> list[int]:
    """How many parts an edge is cut into from level to level, finest first: prime factors."""
    out, factor = [], 2
    while refine > 1:
        if refine % factor:
            factor += 1
            continue
        out.append(factor)
        refine //= factor
    return out


def hierarchy(
    cells: Numbers, free: NDArray[np.bool_], blocks: Array, nodal: Array, refine: int
) -> list[Level]:
    """The levels of a mesh whose cells are cut into ``refine ** 3``, from the finest's arrays."""
    out = []
    for q in factors_of(refine):
        parents, families, kept = _parents(cells, refine, q)
        P = _interpolation(cells, parents, families, q, len(free))
        out.append(Level(cells, free, blocks, nodal, P))
        blocks = coarse_blocks(blocks, families, q)
        cells, free, nodal, refine = parents, free[kept], P.T @ nodal, refine // q
    return [*out, Level(cells, free, blocks, nodal, None)]


def coarse_blocks(blocks: Array, families: Numbers, q: int) -> Array:
    """Galerkin's blocks of cells whose children are ``families`` (P, q^3)."""
    weights = np.kron(corner_weights(q), np.eye(3))  # (q^3, 24, 24)
    if len(blocks) == 1:
        children = blocks[np.zeros((1, q**3), dtype=np.int64)]
    else:
        children = blocks[families]
    out = np.zeros((len(children), 24, 24))
    for i, W in enumerate(weights):
        out += W.T @ children[:, i] @ W
    return out


def corner_weights(q: int) -> Array:
    """Of the corners of a cell's q^3 children on the cell's, (q^3, 8, 8)."""
    places = _offsets(q)[:, None, :] + VTK_CORNERS  # (q^3, 8, 3)
    far = places[:, :, None, :] / q
    return np.asarray(np.where(VTK_CORNERS == 1, far, 1.0 - far).prod(axis=-1))


def _offsets(q: int) -> Numbers:
    return np.stack(np.meshgrid(*[np.arange(q)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def _parents(cells: Numbers, k: int, q: int) -> tuple[Numbers, Numbers, Numbers]:
    """Cells (P, 8) of q^3 of a mesh's cells each, those (P, q^3), and the nodes that are kept."""
    p = k // q
    places = np.arange(k**3).reshape(p, q, p, q, p, q).transpose(0, 2, 4, 1, 3, 5)
    begins = k**3 * np.arange(len(cells) // k**3)
    families = (begins[:, None] + places.reshape(1, -1)).reshape(-1, q**3)
    corner = np.ravel_multi_index(tuple((q - 1) * VTK_CORNERS.T), (q, q, q))
    corners = cells[families[:, corner], np.arange(8)]
    kept, numbers = np.unique(corners, return_inverse=True)
    return numbers.reshape(-1, 8).astype(np.int64), families, kept


def _interpolation(
    cells: Numbers, parents: Numbers, families: Numbers, q: int, count: int
) -> sp.csr_matrix:
    """Trilinear, from the nodes of ``parents`` to all nodes, (N, M)."""
    nodes = cells[families]  # (P, q^3, 8)
    numbers, weights = np.empty((count, 8), dtype=np.int64), np.empty((count, 8))
    numbers[nodes] = parents[:, None, None, :]
    weights[nodes] = corner_weights(q)
    row, place = np.nonzero(weights)
    entries = (weights[row, place], (row, numbers[row, place]))
    return sp.csr_matrix(entries, shape=(count, int(parents.max()) + 1))


# --- as tables, which torch reads ----------------------------------------------------------------


def table(P: sp.csr_matrix | None, transposed: bool) -> tuple[Numbers, Array]:
    """Columns and weights of the rows of P, or of P^T, filled up with zeros."""
    assert P is not None
    matrix = sp.coo_matrix(P.T if transposed else P)
    order = np.argsort(matrix.row, kind="stable")
    rows, columns = matrix.row[order], matrix.col[order].astype(np.int64)
    numbers, places = table_rows(rows, columns, matrix.shape[0], 0)
    weights = np.zeros(numbers.shape)
    weights[rows, places] = matrix.data[order]
    return numbers, weights


# --- the cycle -------

DEGREE = 3
"""Of the Chebyshev polynomial in D^-1 A times D^-1: products with D^-1 in one smoothing."""

SMOOTHED = 16.0
"""Ratio of the largest eigenvalue of D^-1 A to the smallest one that the smoother damps."""


class Grid:
    """A level of the distinct problems; nodal fields are (B, N, 3), padded.

    ``coarse`` are the nodes of the largest next coarser level.  ``regular`` says of each distinct
    problem whether it has a smoother.
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
        self._factors = torch.tensor(_chebyshev(), dtype=storage, device=device)
        owners = torch.as_tensor(sharing.owners, device=device)
        nodes = max(len(level.free) for level in levels)
        count = max(len(level.cells) for level in levels)

        def real(arrays: Sequence[Array], *shape: int) -> Tensor:
            return torch.as_tensor(padded(arrays, shape), dtype=storage, device=device)

        def numbers(arrays: Sequence[Numbers], fill: int, *shape: int) -> Tensor:
            return torch.as_tensor(padded(arrays, shape, fill), device=device)[owners]

        def weighted(transposed: bool, rows: int, columns: int) -> tuple[Tensor, Tensor]:
            tables = [table(level.interpolation, transposed) for level in levels]
            most = max(t.shape[1] for t, _ in tables)
            weights = real([w for _, w in tables], rows, most)[owners].flatten(0, 1)
            return of_all(numbers([t for t, _ in tables], 0, rows, most), columns), weights

        cells = numbers([level.cells for level in levels], 0, count, 8)
        self._cells = of_all(cells, nodes)
        found = [places(level.cells, len(level.free)) for level in levels]
        slots = numbers(found, -1, nodes, max(p.shape[1] for p in found))
        self._slots = of_all(slots, 8 * count)
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
        self._up, self._down = weighted(False, nodes, coarse), weighted(True, coarse, nodes)

    def residual(self, b: Tensor, x: Tensor) -> Tensor:
        """B - A x; of no meaning where clamped."""
        local = rows_of(x.reshape(-1, 3), self._cells.reshape(-1))
        images = self._images(local.reshape(len(x), -1, 24)).reshape(-1, 3)
        return _residual(b, x, self._nodal, images, self._slots)

    def smoothed(self, b: Tensor) -> Tensor:
        """A Chebyshev polynomial in D^-1 A, times D^-1 b: symmetric, zero where clamped."""
        x, step = torch.zeros_like(b), torch.zeros_like(b)
        r = b
        for k, factors in enumerate(self._factors):
            if k:
                r = self.residual(b, x)
            step, x = _advanced(self._inverse, r, step, x, factors)
        return x

    def restricted(self, r: Tensor) -> Tensor:
        """P^T r, on the next coarser level, for a field that counts where free."""
        flat = (r * self._free).reshape(-1, 3)
        return _weighted(flat, *self._down).reshape(len(r), -1, 3)

    def prolonged(self, x: Tensor) -> Tensor:
        """P x, zero where clamped."""
        return _weighted(x.reshape(-1, 3), *self._up).reshape(self._free.shape) * self._free

    def _images(self, local: Tensor) -> Tensor:
        """The cells' matrices times their values (B, C, 24)."""
        if self._alike:
            return cellwise(self._blocks, local[..., None])
        shared = self._sharing.gathered(local)  # (K, m, C, 24)
        moved = cellwise(self._blocks, shared.permute(0, 2, 3, 1))
        return self._sharing.scattered(moved.permute(0, 3, 1, 2))


@one_kernel
def _residual(b: Tensor, x: Tensor, nodal: Tensor, images: Tensor, slots: Tensor) -> Tensor:
    return b - nodal * x - sums(images, slots).reshape(b.shape)


@one_kernel
def _advanced(
    inverse: Tensor, r: Tensor, step: Tensor, x: Tensor, factors: Tensor
) -> tuple[Tensor, Tensor]:
    a, b, c = r.unbind(-1)
    scaled = inverse[..., 0] * a[..., None] + inverse[..., 1] * b[..., None]
    step = factors[0] * step + factors[1] * (scaled + inverse[..., 2] * c[..., None])
    return step, x + step


@one_kernel
def _weighted(values: Tensor, numbers: Tensor, weights: Tensor) -> Tensor:
    total = weights[:, 0, None] * values[numbers[:, 0]]
    for i in range(1, numbers.shape[1]):
        total = total + weights[:, i, None] * values[numbers[:, i]]
    return total


def _chebyshev() -> list[tuple[float, float]]:
    """Factors of the last step and of D^-1 r in each step, for eigenvalues from 1/SMOOTHED to 1.

    Saad, Iterative methods for sparse linear systems (2003), algorithm 12.1.
    """
    middle, half = (1.0 + 1.0 / SMOOTHED) / 2.0, (1.0 - 1.0 / SMOOTHED) / 2.0
    out, ratio = [(0.0, 1.0 / middle)], half / middle
    for _ in range(DEGREE - 1):
        before, ratio = ratio, 1.0 / (2.0 * middle / half - ratio)
        out.append((ratio * before, 2.0 * ratio / half))
    return out


# --- preparation ---------------------------------------------------------------------------------


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


_ROUNDING = 1e-9
"""Of the largest nodal mass: to which masses of cells and of the problem count as equal."""


class BatchMultigrid:
    """R -> B r on nodal fields (B, N, 3), zero where clamped; B is about A^-1.

    ``blocks`` (C or 1, 24, 24) are the stiffness of each distinct problem's cells, N/m, one for
    all; the mass's factor is in 1/s2, and all is stored and computed in ``storage``.  ``regular``
    says of each distinct problem whether its coarsest matrix is positive definite, and the nodes'
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
    shares = problem.cell_masses if rule == problem.mass_rule else space.cell_masses(rule)
    masses = factor * density[:, None, None] * shares
    if len(blocks) == 1 and rule != "per-node":
        masses = masses[:1]
    return blocks + np.kron(masses, np.eye(3)), nodal


def _matrix(level: Level, device: torch.device) -> Tensor:
    matrix = summed_blocks(level.cells, level.blocks, len(level.free), device)
    matrix.diagonal().add_(torch.as_tensor(np.repeat(level.nodal, 3), device=device))
    return matrix

"""Coarser and coarser meshes under a refined one, with the matrix that each of them sees.

`pdcorrect.fem.mesh.refine` cuts cells by their trilinear maps, so the meshes of a refinement
are nested, and so are their trilinear functions.  A coarse cell's matrix is the sum over its
children of W^T A W with W the weights of a child's corners on the cell's (Galerkin's coarse
matrix, cell by cell: no sparse matrix is formed).  Where all cells are alike, one matrix
stands for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.fem.mesh import VTK_CORNERS

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
    """The levels of a mesh whose cells are cut into ``refine ** 3``, finest first.

    Parameters
    ----------
    cells, free, blocks, nodal
        Of the finest `Level`.
    refine : int
    """
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


def places(cells: Numbers, count: int) -> Numbers:
    """Where each node occurs in the raveled cells, (N, most), filled up with -1."""
    flat = cells.ravel()
    order = np.argsort(flat, kind="stable")
    return _rows(flat[order], order, count, -1)[0]


def table(P: sp.csr_matrix | None, transposed: bool) -> tuple[Numbers, Array]:
    """Columns and weights of the rows of P, or of P^T, filled up with zeros."""
    assert P is not None
    matrix = sp.coo_matrix(P.T if transposed else P)
    order = np.argsort(matrix.row, kind="stable")
    rows, columns = matrix.row[order], matrix.col[order].astype(np.int64)
    numbers, places = _rows(rows, columns, matrix.shape[0], 0)
    weights = np.zeros(numbers.shape)
    weights[rows, places] = matrix.data[order]
    return numbers, weights


def _rows(rows: Numbers, values: Numbers, count: int, fill: int) -> tuple[Numbers, Numbers]:
    """Values by sorted rows as a table (count, most), and the place of each in its row."""
    counts = np.bincount(rows, minlength=count)
    places = np.arange(len(rows)) - (np.cumsum(counts) - counts)[rows]
    out = np.full((count, counts.max()), fill, dtype=np.int64)
    out[rows, places] = values
    return out, places

"""Cell-wise results summed into nodal vectors and sparse matrices, in a fixed order."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem import kernels

Array = NDArray[np.float64]


class Assembly:
    """Connectivity of ``cells`` (C, K) between ``count`` nodes.

    ``start`` (count + 1,) and ``slots`` (C K,) are the places of each node in the raveled cells, as
    compressed rows.
    """

    def __init__(self, cells: NDArray[np.int64], count: int) -> None:
        self.cells = cells
        self.count = count
        flat = cells.ravel()
        self.start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=count))])
        self.slots = np.argsort(flat, kind="stable")

    def check(self, x: Array) -> None:
        """Refuse a nodal vector that is not (N, 3)."""
        if np.shape(x) != (self.count, 3):
            raise InputError(f"x {np.shape(x)}: expected ({self.count}, 3), one row a node.")

    def gathered(self, values: Array) -> Array:
        """Sum cell-wise nodal values (C, K, 3) at the nodes, (N, 3)."""
        out = np.empty((self.count, 3))
        kernels.gather_nodes(self.count, self.start, self.slots, values.reshape(-1, 3), out)
        return out

    def matrix(self, blocks: Array) -> sp.csr_matrix:
        """Sum cell-wise node blocks (C, K, K, 3, 3) into (3N, 3N)."""
        indptr, indices, place = self._pattern
        data = np.zeros((len(indices), 3, 3))
        kernels.add_blocks(place, blocks.reshape(-1, 3, 3), data)
        size = 3 * self.count
        return sp.bsr_matrix((data, indices, indptr), shape=(size, size)).tocsr()

    @cached_property
    def _pattern(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """Block rows and columns, and the place of each cell's node pair among them."""
        rows, columns = node_pairs(self.cells)
        keys, place = np.unique(rows * self.count + columns, return_inverse=True)
        indptr = np.searchsorted(keys, np.arange(self.count + 1) * self.count)
        return indptr.astype(np.int32), (keys % self.count).astype(np.int32), place.ravel()


def node_pairs(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the entries of the cells' matrices (C, K, K), raveled."""
    width = cells.shape[1]
    return np.repeat(cells, width, axis=1).ravel(), np.tile(cells, width).ravel()


def summed_cells(cells: NDArray[np.int64], blocks: Array, count: int) -> sp.csr_matrix:
    """Matrices of the cells (C, K, K) summed into (count, count)."""
    entries = blocks.ravel(), node_pairs(cells)
    return sp.csr_matrix(sp.coo_matrix(entries, shape=(count, count)))


def sparse_times(matrix: sp.csr_matrix, x: Array) -> Array:
    """A sparse matrix times x (n, 3): `scipy.sparse`, whose checks take longer on small bodies."""
    return np.asarray(kernels.sparse_times(matrix.indptr, matrix.indices, matrix.data, x))


def scatter(cells: NDArray[np.int64], values: Array, count: int) -> Array:
    """Sum cell-wise nodal values (C, K, 3) into (count, 3)."""
    return np.asarray(kernels.scatter(cells, values, count))

"""Cell-wise results summed into nodal vectors and sparse matrices, in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem import kernels
from pdcorrect.fem.quadrature import Quadrature

Array = NDArray[np.float64]


class Assembly:
    """Connectivity of ``cells`` (C, K) between ``count`` nodes.

    Attributes
    ----------
    cells : (C, K)
    start : (count + 1,), slots : (C K,)
        The places of each node in the raveled cells, compressed rows.
    """

    def __init__(self, cells: NDArray[np.int64], count: int) -> None:
        self.cells = cells
        self._count = count
        flat = cells.ravel()
        self.start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=count))])
        self.slots = np.argsort(flat, kind="stable")

    def check(self, x: Array) -> None:
        """Refuse a nodal vector that is not (N, 3)."""
        if np.shape(x) != (self._count, 3):
            raise InputError(f"x {np.shape(x)}: expected ({self._count}, 3), one row a node.")

    def matrix(self, blocks: Array) -> sp.csr_matrix:
        """Sum cell-wise node blocks (C, K, K, 3, 3) into (3N, 3N)."""
        indptr, indices, place = self._pattern
        data = np.zeros((len(indices), 3, 3))
        kernels.add_blocks(place, blocks.reshape(-1, 3, 3), data)
        size = 3 * self._count
        return sp.bsr_matrix((data, indices, indptr), shape=(size, size)).tocsr()

    @cached_property
    def _pattern(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """Block rows and columns, and the place of each cell's node pair among them."""
        width = self.cells.shape[1]
        rows = np.repeat(self.cells, width, axis=1).ravel()
        columns = np.tile(self.cells, width).ravel()
        keys, place = np.unique(rows * self._count + columns, return_inverse=True)
        indptr = np.searchsorted(keys, np.arange(self._count + 1) * self._count)
        return indptr.astype(np.int32), (keys % self._count).astype(np.int32), place.ravel()


class MoreTangent(Protocol):
    """A second derivative that is added to that of the quadrature points."""

    def apply(self, x: Array) -> Array:
        """Times x (N, 3)."""

    def add_to(self, blocks: Array) -> None:
        """Add the cells' matrices to blocks (C, L, L, 3, 3)."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The tangent of the elastic energy at one state, see `kernels.linearise_cells`.

    Attributes
    ----------
    left, right : (C, 9, Q)
        Factors of the signed SVD of F.
    tangent : (C, 12, Q)
        Tangent in their frame times the volumes, J.
    correction : MoreTangent, optional
        That of a learned element's own energy.
    """

    assembly: Assembly
    quadrature: Quadrature
    left: Array
    right: Array
    tangent: Array
    correction: MoreTangent | None = None

    def apply(self, x: Array) -> Array:
        """Tangent times x, both (N, 3), without assembling."""
        self.assembly.check(x)
        assembly, out = self.assembly, np.empty_like(x)
        kernels.apply_linearised(
            x, assembly.cells, self.quadrature.lanes, self.left, self.right, self.tangent,
            np.empty((*assembly.cells.shape, 3)), assembly.start, assembly.slots, out,
        )  # fmt: skip
        return out if self.correction is None else out + self.correction.apply(x)

    def assemble(self) -> sp.csr_matrix:
        """The tangent as a sparse matrix (3N, 3N), N/m."""
        return self.assembly.matrix(self.blocks())

    def blocks(self) -> Array:
        """The tangent of each cell, (C, L, L, 3, 3), N/m."""
        count, width = self.assembly.cells.shape
        blocks = np.empty((count, width, width, 3, 3))
        kernels.cell_stiffness(
            self.assembly.cells, self.quadrature.lanes, self.left, self.right, self.tangent, blocks
        )
        if self.correction is not None:
            self.correction.add_to(blocks)
        return blocks

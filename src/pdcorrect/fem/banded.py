"""Tangents in band storage, factorised by LAPACK.

For slender bodies and small meshes a band is as sparse as a general factor, needs no
symbolic analysis, and ``pbtrf`` runs at the speed of the BLAS (``benchmarks``, tangent_factors).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from pdcorrect.fem.assembly import node_pairs
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.fem.factorisation import NotPositiveDefinite

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class BandOrder:
    """An order of a vector problem's free unknowns in which cells couple near neighbours.

    The best of reverse Cuthill-McKee and the six orders by coordinates: ``number`` (N, 3) is the
    row of each component, -1 where it is not free, ``rows`` how many there are, ``bandwidth`` the
    largest distance of coupled ones.
    """

    def __init__(self, positions: Array, cells: Index, free: NDArray[np.bool_]) -> None:
        order = min(_candidates(positions, cells), key=lambda o: _bandwidth(o, cells, free))
        self.number = _numbers(order, free)
        self.rows = int(free.sum())
        self.bandwidth = _bandwidth(order, cells, free)
        self._cells = cells
        self._flat = np.flatnonzero(free.ravel())[np.argsort(self.number[free])]

    @property
    def factor_bytes(self) -> float:
        """Memory of the factor."""
        return 8.0 * self.rows * (self.bandwidth + 1)

    @property
    def factor_flops(self) -> float:
        """Multiplications and additions of a factorisation."""
        return float(self.rows) * self.bandwidth**2

    def assemble(self, blocks: Array) -> Array:
        """The sum of cell blocks (C, K, K, 3, 3), as (n, b + 1).

        Row j holds the entries (j, j), (j + 1, j), ... of the lower triangle.
        """
        band = np.zeros((self.rows, self.bandwidth + 1))
        _add_blocks(self.number, self._cells, blocks, band)
        return band

    def factorise(self, band: Array) -> BandFactor:
        """Cholesky factor of an assembled matrix, which is overwritten.

        Raises
        ------
        NotPositiveDefinite
        """
        try:
            factor = la.cholesky_banded(band.T, overwrite_ab=True, lower=True, check_finite=False)
        except la.LinAlgError as error:
            raise NotPositiveDefinite(str(error)) from None
        if not np.isfinite(factor[0]).all():
            raise NotPositiveDefinite("the band factor is not finite")
        return BandFactor(factor, self._flat)


class BandFactor:
    """A factor L L^T in band storage."""

    backend = "band"

    def __init__(self, factor: Array, flat: Index) -> None:
        self._factor = factor
        self._flat = flat

    def solve(self, b: Array) -> Array:
        """X (N, 3) with A x = b on the free components, zero elsewhere."""
        out = np.zeros(b.size)
        out[self._flat], _ = la.lapack.dpbtrs(self._factor, b.ravel()[self._flat], lower=1)
        return out.reshape(b.shape)


def _candidates(positions: Array, cells: Index) -> Iterator[Index]:
    pairs = node_pairs(cells)
    graph = sp.csr_matrix((np.ones(len(pairs[0]), dtype=np.int8), pairs), 2 * (len(positions),))
    yield reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
    edge = np.ptp(positions[cells], axis=1).min()
    grid = np.round(positions / (1e-3 * edge)).T
    for axes in permutations(range(3)):
        yield np.lexsort(grid[list(axes)])


def _numbers(order: Index, free: NDArray[np.bool_]) -> Index:
    inside = free[order]
    number = np.empty(free.shape, dtype=np.int64)
    number[order] = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    return number


def _bandwidth(order: Index, cells: Index, free: NDArray[np.bool_]) -> int:
    number = _numbers(order, free)[cells].reshape(len(cells), -1)
    low = np.where(number < 0, np.iinfo(np.int64).max, number).min(axis=1)
    return int(np.maximum(number.max(axis=1) - low, 0).max())


@njit(**OPTIONS)
def _add_blocks(number, cells, blocks, band):  # type: ignore[no-untyped-def]
    for c in range(cells.shape[0]):
        for k in range(cells.shape[1]):
            for l in range(cells.shape[1]):
                for a in range(3):
                    i = number[cells[c, k], a]
                    for b in range(3):
                        j = number[cells[c, l], b]
                        if i >= j >= 0:
                            band[j, i - j] += blocks[c, k, l, a, b]

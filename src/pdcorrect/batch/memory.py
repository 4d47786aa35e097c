"""How much memory a batch takes."""

from __future__ import annotations

from pdcorrect.batch.cells import Sizes
from pdcorrect.batch.minimise import HISTORY

_LIBRARIES = 4e8
"""Bytes of the libraries' work spaces and of small tensors."""
_INVERTING = 6
"""Matrices in double precision while one is inverted."""
_VECTORS, _NUMBERS_A_POINT = 40, 120
"""Of working memory: configurations, and numbers at each quadrature point."""
_GRIDS = 420
"""Bytes a node of the finest mesh, of all finer levels of multigrid and a cycle's work on them."""
_MATRIX = 4 * 24**2 * 8 // 7
"""Bytes of a cell's matrix with its share of those of coarser cells."""


def expected_bytes(
    sizes: Sizes, distinct: int, width: int, coarse: int = 0, matrices: int = 0
) -> int:
    """Expected peak memory of steps and derivatives on a GPU, in double precision.

    4 K (w N)^2 bytes for K distinct inverses of bodies of N nodes, with w = 3 for the first
    Hessian "rest" and 1 for others, and the larger of

    - 48 (w N)^2, while one of them is made;
    - B (24 U (2 m + 40) + 960 C Q) for B scenes of U nodes and internal modes and C cells of
      Q points, with m pairs of L-BFGS, while steps are taken;

    and 0.4 GB.  Within a third of what was measured from 64 coarse scenes or one fine one
    on (``benchmarks``, batch.py).

    With the first Hessian "multigrid", N is that of the coarsest mesh, and the levels above
    take 420 B N' + 2633 n bytes more for N' nodes and n unlike cells.

    Parameters
    ----------
    sizes : Sizes
    distinct : int
        Scenes with unlike mesh, material or clamps.
    width : int
        Unknowns a node of the first Hessian: 3 for "rest" and "multigrid", else 1.
    coarse : int
        Nodes of the coarsest mesh with "multigrid", else 0.
    matrices : int
        Cells that have a matrix of their own with "multigrid".
    """
    square = (width * (coarse or sizes.nodes)) ** 2
    levels = sizes.scenes * sizes.nodes * _GRIDS + matrices * _MATRIX if coarse else 0
    vectors = 24 * sizes.unknowns * (2 * HISTORY + _VECTORS)
    points = 8 * sizes.cells * sizes.points * _NUMBERS_A_POINT
    working = sizes.scenes * (vectors + points)
    dense = 4 * distinct * square
    return int(dense + levels + max(8 * _INVERTING * square, working) + _LIBRARIES)

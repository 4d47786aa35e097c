"""Smoothed aggregation (Vanek, Mandel and Brezina 1996) and conjugate gradients with it.

pyamg forms the aggregates.  The rest is here because the cycle has to advance
several right-hand sides together and to be the same in every run, whereas pyamg
estimates spectral radii from random vectors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]
Product = Callable[[Array], Array]


class NotPositiveDefinite(ArithmeticError):
    """The matrix has a pivot or a direction of curvature that is zero or negative."""


@dataclass(eq=False)
class Solution:
    """The last iterate, whether the tolerance was met, and the number of products.

    ``convex`` is False where a direction of negative curvature, ``downhill``, ended the iteration.
    """

    x: Array
    converged: bool
    convex: bool
    steps: int
    downhill: Array | None = None


def conjugate_gradients(
    product: Product,
    b: Array,
    precondition: Product,
    *,
    tolerance: float,
    max_steps: int,
    start: Array | None = None,
    residual_share: float = math.inf,
    settled: Callable[[Array, Array], bool] | None = None,
) -> Solution:
    """Solve A x = b for symmetric A.

    Parameters
    ----------
    product, precondition : callable
        x -> A x, and an approximation of b -> A^-1 b, on arrays of b's shape.
    tolerance : float
        Of the residual in the preconditioner's norm, relative to its first value.
    start : array, optional
        First iterate; zero by default.
    residual_share : float
        Largest Euclidean norm of the residual, of b's: the preconditioner's norm
        hides modes that the preconditioner takes for much stiffer than they are.
    settled : callable, optional
        (x, last change of x) -> whether x is good enough; a further condition.
    """
    x = np.zeros_like(b) if start is None else start
    r = b.copy() if start is None else b - product(x)
    z = precondition(r)
    r_z = float(np.vdot(r, z))
    target, direction = tolerance**2 * r_z, z
    limit = (residual_share**2) * float(np.vdot(b, b))
    for step in range(1, max_steps + 1):
        if not r_z > 0.0 or not math.isfinite(r_z):
            return Solution(x, r_z == 0.0, not r_z < 0.0, step - 1)
        image = product(direction)
        curvature = float(np.vdot(direction, image))
        if not curvature > 0.0:
            return Solution(x if step > 1 else z, False, False, step, direction)
        alpha = r_z / curvature
        change = alpha * direction
        x = x + change
        r = r - alpha * image
        z = precondition(r)
        r_z, old = float(np.vdot(r, z)), r_z
        small = float(np.vdot(r, r)) <= limit
        if small and r_z <= target and (settled is None or settled(x, change)):
            return Solution(x, True, True, step)
        direction = z + (r_z / old) * direction
    return Solution(x, False, True, max_steps)


_COARSEST = 400
"""Unknowns at which a dense factor takes over."""

_DEGREE = 2
"""Of the Chebyshev smoother; Gauss-Seidel takes fewer steps, but one column at a time."""

_SMOOTHED = 8.0
"""Ratio of the largest eigenvalue of D^-1 A to the smallest one that the smoother damps."""

_LANCZOS_STEPS = 15
_RADIUS_MARGIN = 1.1


class _Level:
    """A on one level, its scaled Chebyshev smoother, and the way up from the next level.

    ``near_nullspace`` becomes the next level's.
    """

    def __init__(self, matrix: sp.csr_matrix, near_nullspace: Array) -> None:
        from pyamg.aggregation import fit_candidates, standard_aggregation

        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            raise NotPositiveDefinite("the matrix has diagonal entries that are not positive")
        aggregates, _ = standard_aggregation(matrix)
        tentative, coarse = fit_candidates(aggregates, near_nullspace)
        tentative = sp.csc_matrix(tentative)
        kept = np.flatnonzero(np.asarray(abs(tentative).sum(axis=0)))
        tentative = tentative[:, kept].tocsr()  # small aggregates have fewer motions
        self.near_nullspace: Array = coarse[kept]
        self.matrix, self.inverse_diagonal = matrix, 1.0 / diagonal[:, None]
        self.radius = _RADIUS_MARGIN * _largest_eigenvalue(matrix, diagonal)
        scaling = sp.diags_array(1.0 / diagonal)
        smoothing = (4.0 / 3.0 / self.radius) * (scaling @ (matrix @ tentative))
        self.prolongation = sp.csr_matrix(tentative - smoothing)
        self.restriction = sp.csr_matrix(self.prolongation.T)

    def smooth(self, r: Array) -> tuple[Array, Array]:
        """A polynomial in D^-1 A that damps rough errors, times D^-1 r; and what is left of r."""
        upper, lower = self.radius, self.radius / _SMOOTHED
        middle, half = (upper + lower) / 2, (upper - lower) / 2
        ratio = half / middle
        step = self.inverse_diagonal * r / middle
        x = step
        r = r - self.matrix @ step
        for _ in range(_DEGREE - 1):
            old, ratio = ratio, 1.0 / (2.0 * middle / half - ratio)
            step = (ratio * old) * step + (2.0 * ratio / half) * (self.inverse_diagonal * r)
            x = x + step
            r = r - self.matrix @ step
        return x, r


class Multigrid:
    """A V-cycle for a symmetric positive definite matrix, in place of a factor.

    ``near_nullspace`` (n, k) are vectors that the matrix hardly resists: the constant by default,
    which is right for G; a tangent needs the `rigid_motions`.

    Raises
    ------
    NotPositiveDefinite
        Where a level shows it; not every indefinite matrix is noticed.
    """

    backend = "amg"

    def __init__(self, matrix: sp.spmatrix, near_nullspace: Array | None = None) -> None:
        matrix = sp.csr_matrix(matrix)
        if not np.isfinite(matrix.data).all():
            raise NotPositiveDefinite("the matrix has entries that are not finite")
        if near_nullspace is None:
            near_nullspace = np.ones((matrix.shape[0], 1))
        self._levels: list[_Level] = []
        while matrix.shape[0] > _COARSEST:
            level = _Level(matrix, near_nullspace)
            self._levels.append(level)
            near_nullspace = level.near_nullspace
            matrix = sp.csr_matrix(level.restriction @ matrix @ level.prolongation)
            if matrix.shape[0] > 0.7 * level.matrix.shape[0]:
                break  # no longer coarser
        try:
            self._coarsest = la.cho_factor(matrix.toarray(), check_finite=False)
        except la.LinAlgError as error:
            raise NotPositiveDefinite(f"the coarsest level: {error}") from None

    def solve(self, b: Array) -> Array:
        """Approximately A^-1 b, for b (n,) or (n, m): linear in b, symmetric and positive."""
        b = np.asarray(b, dtype=np.float64)
        return self._cycle(0, b.reshape(len(b), -1)).reshape(b.shape)

    def _cycle(self, depth: int, b: Array) -> Array:
        if depth == len(self._levels):
            return la.cho_solve(self._coarsest, b, check_finite=False)
        level = self._levels[depth]
        x, r = level.smooth(b)
        correction = level.prolongation @ self._cycle(depth + 1, level.restriction @ r)
        change, _ = level.smooth(r - level.matrix @ correction)
        return x + correction + change


def _largest_eigenvalue(matrix: sp.csr_matrix, diagonal: Array) -> float:
    """Of D^-1 A, a few per cent too small, by Lanczos's method from a fixed start.

    Gershgorin's bound is twice that for a tangent and takes half as many steps again.
    """
    scale = 1.0 / np.sqrt(diagonal)
    v = np.random.default_rng(0).normal(size=len(diagonal))
    v, old, beta = v / np.linalg.norm(v), np.zeros_like(v), 0.0
    main, side = [], []
    for _ in range(_LANCZOS_STEPS):
        w = scale * (matrix @ (scale * v)) - beta * old
        main.append(float(w @ v))
        w -= main[-1] * v
        beta = float(np.linalg.norm(w))
        side.append(beta)
        if not beta > 1e-10 * abs(main[0]):
            break
        v, old = w / beta, v
    return float(la.eigvalsh_tridiagonal(main, side[: len(main) - 1]).max())


def rigid_motions(x: Array) -> Array:
    """Translations and linearised rotations of points x (N, 3): (3 N, 6), of similar size."""
    x = x - x.mean(axis=0)
    x = x / max(float(np.abs(x).max()), 1e-300)
    translations = np.broadcast_to(np.eye(3), (len(x), 3, 3))
    rotations = np.cross(np.eye(3)[:, None], x).transpose(1, 2, 0)
    return np.concatenate([translations, rotations], axis=2).reshape(-1, 6)

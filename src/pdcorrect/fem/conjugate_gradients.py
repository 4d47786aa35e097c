"""Preconditioned conjugate gradients that notice negative curvature.

SciPy's `cg` neither checks the curvature nor lets the caller decide when a
solution is good enough in length; both matter here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Product = Callable[[Array], Array]


class NotPositiveDefinite(ArithmeticError):
    """The matrix has a pivot or a direction of curvature that is zero or negative."""


@dataclass(eq=False)
class Solution:
    """Outcome of `conjugate_gradients`.

    Attributes
    ----------
    x : array
        The last iterate.
    converged : bool
        Whether the tolerance was met.
    convex : bool
        False where a direction of negative curvature ended the iteration.
    steps : int
        Products with the matrix.
    """

    x: Array
    converged: bool
    convex: bool
    steps: int


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
    b : array
    tolerance : float
        Of the residual in the preconditioner's norm, relative to its first
        value.
    max_steps : int
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
            return Solution(x if step > 1 else z, False, False, step)
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

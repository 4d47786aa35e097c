"""Newton's loop, and truncated Newton with G-preconditioned conjugate gradients.

The latter is the first fallback: it sees the true curvature, so it gets through
places where L-BFGS stalls, and it needs no factor besides G's.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.conjugate_gradients import conjugate_gradients
from pdcorrect.solvers.lbfgs import (
    MinimiserOptions,
    Minimum,
    Objective,
    Solve,
    largest_displacement,
    line_search,
)
from pdcorrect.state import Status

Array = NDArray[np.float64]

_INNER_STEPS = 400


Direction = Callable[[Array, Array], tuple[Array, bool]]
"""(p, gradient) -> (minus the Newton step, whether the exact, positive Hessian gave it)."""


def newton_loop(
    objective: Objective, start: Array, direction: Direction, options: MinimiserOptions
) -> Minimum:
    """Minimise ``objective`` from ``start`` (N, 3) along the steps of ``direction``.

    Converged when a Newton step of the exact Hessian is shorter than the
    tolerance; ``options.history`` is not used.
    """
    p = start
    value, gradient = objective.value_and_gradient(p)
    evaluations, estimate, status = 1, math.inf, Status.ITERATION_LIMIT
    for iteration in range(options.max_iterations + 1):
        if not math.isfinite(value):
            status = Status.NOT_FINITE
            break
        step, exact = direction(p, gradient)
        estimate = largest_displacement(step) if exact else math.inf
        if estimate <= options.tolerance:
            status = Status.CONVERGED
            break
        if iteration == options.max_iterations:
            break
        found = line_search(objective, p, value, gradient, step)
        evaluations += found.evaluations
        if found.step == 0.0:
            status = Status.LINE_SEARCH
            break
        p, value, gradient = found.positions, found.value, found.gradient
    return Minimum(p, value, gradient, status, iteration, evaluations, estimate)


def newton_cg(
    objective: Objective, start: Array, solve: Solve, options: MinimiserOptions
) -> Minimum:
    """`newton_loop` with conjugate gradients preconditioned by ``solve``.

    Where these meet negative curvature, the direction found so far is used, or
    minus the preconditioned gradient at the first step.
    """
    return newton_loop(
        objective, start, lambda p, gradient: _direction(objective, p, gradient, solve), options
    )


def _direction(objective: Objective, p: Array, gradient: Array, solve: Solve) -> tuple[Array, bool]:
    """The (truncated) Newton direction, and whether it is one of the exact, positive Hessian."""
    found = conjugate_gradients(
        objective.hessian_operator(p), -gradient, solve, tolerance=1e-3, max_steps=_INNER_STEPS
    )
    return found.x, found.converged and found.convex

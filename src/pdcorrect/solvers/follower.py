"""Loads that follow the body, sampled where the step's equation is.

They have no potential, so a step is a fixed point y = g(y): g minimises gamma with the loads
held as at y.  Anderson's acceleration (Walker and Ni 2011) makes few iterations of it, also
where the plain one diverges because the loads are stiffer than the body.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pdcorrect.solvers.minimise import Minimum
from pdcorrect.solvers.step import StepObjective
from pdcorrect.state import Status

Array = NDArray[np.float64]

MOST = 60
"""Fixed-point iterations of a step."""
DEPTH = 6
"""Earlier iterations that Anderson's acceleration uses."""
_NOISE = 1e-4
"""Singular values of their differences, over the largest, that are noise of inner minima."""


class Anderson:
    """The next iterate of a fixed point, from all pairs (y, g(y)) so far, as flat arrays."""

    def __init__(self, depth: int = DEPTH) -> None:
        self._depth = depth
        self._images: list[Array] = []
        self._residuals: list[Array] = []

    def __call__(self, y: Array, image: Array) -> Array:
        self._images = [*self._images, image][-self._depth :]
        self._residuals = [*self._residuals, image - y][-self._depth :]
        if len(self._images) == 1:
            return image
        steps = np.diff(np.stack(self._residuals, axis=1), axis=1)
        weights = np.linalg.lstsq(steps, self._residuals[-1], rcond=_NOISE)[0]
        return image - np.diff(np.stack(self._images, axis=1), axis=1) @ weights


def settle(objective: StepObjective, start: Array, minimise: Callable[[Array], Minimum]) -> Minimum:
    """Minimise from ``start`` with loads that follow the body, and friction, as at the minimum.

    ``minimise``, from a configuration on, takes no iteration where the remaining distance is
    within the tolerance.
    """
    accelerate = Anderson()
    y = start
    found = minimise(y)
    for _ in range(MOST):
        if not found.status.ok:
            break
        p = found.positions
        way = accelerate(y.ravel(), p.ravel()).reshape(y.shape) - p
        y = p + objective.longest_step(p, way) * way
        if not objective.follow(y):
            break
        again = minimise(y)
        found = again.after(found)
        if again.iterations == 0:
            break
    else:
        found.status = Status.ITERATION_LIMIT
    return found

"""The configuration that a step's equation was solved for, from the state that it led to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.solvers.integrators import Integrator, solution
from pdcorrect.solvers.step import StepObjective
from pdcorrect.state import StepResult

Array = NDArray[np.float64]

_MODE_STEPS, _SETTLED = 100, 1e-13
"""Newton steps to find internal modes, and the last one's length, of the cell size."""


def step_solution(
    objective: StepObjective, integrate: Integrator, time_step: float, result: StepResult
) -> Array:
    """Y (N + B, 3) of the step that ``objective`` belongs to.

    Raises
    ------
    ConvergenceError
        If internal modes are not found.
    """
    problem = objective.problem
    scheme = integrate.scheme(objective.state, time_step)
    y = solution(scheme, objective.state, result.state, problem)
    if problem.scene.damping.stiffness and problem.space.internal:
        y = _damped_modes(objective, y)
    return y


def _damped_modes(objective: StepObjective, y: Array) -> Array:
    """Y with internal modes in equilibrium with their damping too, by Newton's method."""
    problem, nodes = objective.problem, len(objective.problem.positions)
    for _ in range(_MODE_STEPS):
        _, gradient = objective.value_and_gradient(y)
        gradient[:nodes] = 0.0
        blocks = objective.cell_hessians(y, project=True)
        following = Condensed(blocks, problem.space.local, problem.cells.shape[1])
        change = following.recovered(np.zeros((nodes, 3)), gradient)
        y = y - change
        if np.abs(change).max() <= _SETTLED * problem.cell_size:
            return y
    raise ConvergenceError(
        f"internal modes of the step are not in equilibrium after {_MODE_STEPS} Newton steps: "
        "expected a state that a step converged to."
    )

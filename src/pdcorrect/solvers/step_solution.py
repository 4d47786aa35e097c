"""The configuration that a step's equation was solved for, from the state that it led to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.solvers.integrators import Integrator, equal_steps, solution
from pdcorrect.solvers.step import StepObjective
from pdcorrect.state import State, StepResult

Array = NDArray[np.float64]

_MODE_STEPS, _SETTLED = 100, 1e-13
"""Newton steps to find internal modes, and the last one's length, of the cell size."""
_BALANCE = 10.0
"""Of the residual that a step reports.  Its internal modes need not be in equilibrium."""
_ROUNDING = 1e-11
"""Of positions: what they are off by moves the residual by the stiffness times that."""


def step_solution(
    objective: StepObjective, integrate: Integrator, time_step: float, result: StepResult
) -> Array:
    """Y (N + B, 3) of the step that ``objective`` belongs to.

    Raises
    ------
    InputError
        If the result is not that step's: it is at another time, or out of balance by more
        than it reports.
    ConvergenceError
        If internal modes are not found.
    """
    problem = objective.problem
    _check_time(objective.state, time_step, result)
    scheme = integrate.scheme(objective.state, time_step)
    y = solution(scheme, objective.state, result.state, problem)
    objective.follow(y)
    damping = problem.scene.damping
    if (damping.stiffness or damping.viscosity) and problem.space.internal:
        y = _damped_modes(objective, y)
    _check_balance(objective, y, result)
    return y


def _check_time(state: State, time_step: float, result: StepResult) -> None:
    taken = result.state.time - state.time
    if not equal_steps(taken, time_step):
        raise InputError(
            f"the result is {taken:g} s after the state, but time_step = {time_step:g} s: expected "
            "the state that the step started from and the time step that it was given."
        )


def _check_balance(objective: StepObjective, y: Array, result: StepResult) -> None:
    _, gradient = objective.value_and_gradient(y)
    found, allowed = float(np.abs(gradient).max()), _BALANCE * result.residual
    if found <= allowed:
        return
    stiffest = float(objective.problem.scalar_matrix(*objective.factors).diagonal().max())
    if not found <= allowed + _ROUNDING * stiffest * float(np.abs(y).max()):
        raise InputError(
            f"the result is out of balance by {found:.2g} N as a step from this state with these "
            f"forces, but reports {result.residual:.2g} N: expected the stepper, state and forces "
            "that it was made with."
        )


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

"""Derivatives of one implicit step by everything that goes into it (thesis eq. 3-21 to 3-38).

With r(y, theta) = 0 the step's equation on the free components (`schemes`) and the state
after the step a linear function of y, a loss L has

    dL/dtheta = partial L - x . dr/dtheta,    H x = dL/dy,

with H = dr/dy the second derivative of gamma, which is symmetric.  Internal modes of cells
are part of y.  Where a component of y is prescribed, its own derivative is that of L less
H x there.

That r = 0 is assumed: the gradients are those at the y that was reached, and err by the
first order in its distance from the solution; `Gradients.estimated_errors` tells by how
much.  On a kink of the energy (see `energies`) they are those of the branch that is taken.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.solvers.adjoint_solve import AdjointSolver
from pdcorrect.solvers.gradients import Gradients, TakenStep
from pdcorrect.solvers.implicit import ImplicitStepper, positive
from pdcorrect.solvers.integrators import Integrator, equal_steps, solution
from pdcorrect.solvers.step import StepObjective, nodal_array
from pdcorrect.solvers.threads import limited_threads
from pdcorrect.state import State, Status, StepResult

Array = NDArray[np.float64]

_MODE_STEPS, _SETTLED = 100, 1e-13
"""Newton steps to find internal modes, and the last one's length, of the cell size."""
_BALANCE = 10.0
"""Of the residual that a step reports.  Its internal modes need not be in equilibrium."""
_ROUNDING = 1e-11
"""Of positions: what they are off by moves the residual by the stiffness times that."""


def adjoint(
    stepper: ImplicitStepper,
    state: State,
    result: StepResult,
    grad_positions: Array | None = None,
    grad_velocities: Array | None = None,
    *,
    grad_memory: Mapping[str, Array] | None = None,
    forces: Array | None = None,
    time_step: float | None = None,
    solver: AdjointSolver = "auto",
    tolerance: float = 1e-6,
) -> Gradients:
    """Derivatives of a loss by the inputs of the step ``result = stepper(state)``.

    Parameters
    ----------
    stepper : ProjectiveDynamics or Newton
    state : State
        At the start of the step.
    result : StepResult
        Of the step.
    grad_positions, grad_velocities : (N, 3), optional
        Derivatives of the loss by the positions (1/m) and velocities (s/m) after the step.
    grad_memory : mapping of str to (N, 3), optional
        And by entries of its memory, by name.
    forces : (N, 3), optional
        The extra nodal forces that the step was given, N.
    time_step : float, optional
        The step it was given, s; the stepper's own by default.
    solver : {"auto", "cg", "direct", "fixed-point"}
        Of the linear system, see `solve_adjoint`.
    tolerance : float
        Of its residual, relative.  The default suits steps solved to the default
        tolerance; for gradients of steps that were solved closely it may be 1e-12.

    Returns
    -------
    Gradients
        ``positions``, ``velocities``, ``forces``, ``memory`` and ``clamped_positions``
        like the arrays; ``young``, ``poisson``, ``mu``, ``lam`` and ``density`` one a
        cell; ``time_step`` a number; ``friction`` and ``obstacle_positions`` one an obstacle.

    Raises
    ------
    InputError
        If shapes or names are wrong, the step failed or was taken in parts, or the result
        is not that of a step from ``state`` with these forces and this time step.
    ConvergenceError
        If the linear system cannot be solved.
    """
    if solver not in get_args(AdjointSolver):
        raise InputError(f"solver = {solver!r}: expected {', '.join(get_args(AdjointSolver))}.")
    positive("tolerance", tolerance)
    if not result.status.ok:
        raise InputError(f"the step {result.status.value}: expected one that has a result.")
    if result.status is Status.SUBSTEPPED:
        raise InputError(
            "the step converged only in smaller parts, which are steps of their own: expected a "
            "step in one. Take smaller time steps, and the adjoint of each."
        )
    grad_memory = grad_memory or {}
    known = result.state.memory
    unknown = [name for name in grad_memory if name not in known]
    if unknown:
        raise InputError(
            f"grad_memory has {', '.join(unknown)}: expected names in the memory of the state "
            f"after the step ({', '.join(known) or 'it has none'})."
        )
    after = {"positions": grad_positions, "velocities": grad_velocities, **grad_memory}
    checked = {
        name: np.zeros_like(state.positions)
        if g is None
        else nodal_array(stepper.problem, f"grad_{name}", g)
        for name, g in after.items()
    }
    remembered = tuple(state.memory)
    state, h = stepper.accepted(state, forces, time_step)
    integrate = stepper.integrate.held(state, h)
    step = TakenStep(stepper, state, remembered, forces, h, integrate, solver, tolerance)
    with limited_threads():
        y = step_solution(step.objective(h), integrate, h, result)
        return Gradients(step, checked, y)


def step_solution(
    objective: StepObjective, integrate: Integrator, time_step: float, result: StepResult
) -> Array:
    """Y (N + B, 3) of the step that ``objective`` belongs to.

    `InputError` is raised if the result is not that step's: it is at another time, or out of
    balance by more than it reports; `ConvergenceError` if internal modes are not found.
    """
    problem = objective.problem
    taken = result.state.time - objective.state.time
    if not equal_steps(taken, time_step):
        raise InputError(
            f"the result is {taken:g} s after the state, but time_step = {time_step:g} s: expected "
            "the state that the step started from and the time step that it was given."
        )
    scheme = integrate.scheme(objective.state, time_step)
    y = solution(scheme, objective.state, result.state, problem)
    objective.follow(y)
    damping = problem.scene.damping
    if (damping.stiffness or damping.viscosity) and problem.space.internal:
        y = _damped_modes(objective, y)
    _check_balance(objective, y, result)
    return y


def _check_balance(objective: StepObjective, y: Array, result: StepResult) -> None:
    _, gradient = objective.value_and_gradient(y)
    found, allowed = float(np.abs(gradient).max()), _BALANCE * result.residual
    if found <= allowed:
        return
    stiffest = float(objective.problem.scalar_matrix(*objective.factors).diagonal().max())
    if objective.problem.rollers is not None:
        stiffest = max(stiffest, float(objective.problem.rollers.stiffness.max()))
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
        change = following.response(gradient)
        y = y - change
        if np.abs(change).max() <= _SETTLED * problem.cell_size:
            return y
    raise ConvergenceError(
        f"internal modes of the step are not in equilibrium after {_MODE_STEPS} Newton steps: "
        "expected a state that a step converged to."
    )

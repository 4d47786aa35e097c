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

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.solvers.adjoint_solve import (
    AdjointSolver,
    check_solver,
)
from pdcorrect.solvers.gradients import Gradients, TakenStep
from pdcorrect.solvers.implicit import ImplicitStepper, positive, quiet_blas
from pdcorrect.solvers.step import nodal_array
from pdcorrect.solvers.step_solution import step_solution
from pdcorrect.state import State, Status, StepResult

Array = NDArray[np.float64]


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
        cell; ``time_step`` a number.

    Raises
    ------
    InputError
        If shapes or names are wrong, the step failed or was taken in parts, or the result
        is not that of a step from ``state`` with these forces and this time step.
    ConvergenceError
        If the linear system cannot be solved.
    """
    check_solver(solver)
    positive("tolerance", tolerance)
    _check_status(result.status)
    grad_memory = grad_memory or {}
    _check_names(grad_memory, result.state)
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
    with quiet_blas():
        y = step_solution(step.objective(h), integrate, h, result)
        return Gradients(step, checked, y)


def _check_status(status: Status) -> None:
    if not status.ok:
        raise InputError(f"the step {status.value}: expected one that has a result.")
    if status is Status.SUBSTEPPED:
        raise InputError(
            "the step converged only in smaller parts, which are steps of their own: expected a "
            "step in one. Take smaller time steps, and the adjoint of each."
        )


def _check_names(grad_memory: Mapping[str, Array], after: State) -> None:
    unknown = [name for name in grad_memory if name not in after.memory]
    if unknown:
        raise InputError(
            f"grad_memory has {', '.join(unknown)}: expected names in the memory of the state "
            f"after the step ({', '.join(after.memory) or 'it has none'})."
        )

"""Forces that clamps exert on the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.integrators import accelerations as accelerations_at
from pdcorrect.solvers.integrators import forces_at
from pdcorrect.solvers.step import check_input
from pdcorrect.state import State

Array = NDArray[np.float64]


def reactions(
    problem: Problem,
    state: State,
    accelerations: Array | None = None,
    forces: Array | None = None,
) -> Array:
    """Forces of the clamps on the body: r = M a - f_int - f_ext + C v where clamped.

    Parameters
    ----------
    problem : Problem
    state : State
        Loads are taken at its time and positions.
    accelerations : (N, 3), optional
        a, m/s2.  By default those that the forces at this state give the free
        components, with none where clamped: right for clamps that hold or move
        uniformly.  A step of backward Euler from v to v' has (v' - v) / h; zeros leave
        inertia out.
    forces : (N, 3), optional
        Nodal forces besides the scene's loads, N, as given to the step.

    Returns
    -------
    (N, 3)
        N; zero on free components.

    Raises
    ------
    InputError
        If shapes are wrong or a number is not finite.
    """
    check_input(problem, state, forces)
    if accelerations is None:
        accelerations = accelerations_at(problem, state, forces)
    else:
        accelerations = np.asarray(accelerations, dtype=np.float64)
        _check(accelerations, problem.positions.shape)
    out = problem.mass_times(accelerations) - forces_at(problem, state, forces)
    out[problem.free] = 0.0
    return out


def _check(accelerations: Array, shape: tuple[int, ...]) -> None:
    if accelerations.shape != shape:
        raise InputError(
            f"accelerations have shape {accelerations.shape}: expected {shape}, one row for each "
            "node of the problem."
        )
    if not np.isfinite(accelerations).all():
        raise InputError("accelerations contain NaN or infinite entries: expected finite numbers.")

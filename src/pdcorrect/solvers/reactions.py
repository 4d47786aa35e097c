"""Forces that clamps and obstacles exert on the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.multigrid import conjugate_gradients
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.viscosity import Stretches, small_strain_stress
from pdcorrect.solvers.contact import Sliding
from pdcorrect.solvers.step import check_input, nodal_array
from pdcorrect.state import State

Array = NDArray[np.float64]

_MASS_TOLERANCE, _MASS_STEPS = 1e-15, 200
"""Of solving with a consistent mass matrix, whose condition does not depend on the mesh."""


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
    acting, rollers = forces_at(problem, state, forces), problem.rollers
    if accelerations is None:
        accelerations = solve_mass(problem, acting)
    else:
        accelerations = nodal_array(problem, "accelerations", accelerations)
    missing = problem.mass_times(accelerations) - acting
    if rollers is None:
        return np.where(problem.free, 0.0, missing)
    return np.asarray(missing - rollers.along(missing * problem.free))


def contact_forces(problem: Problem, state: State, before: State | None = None) -> Array:
    """Forces of a scene's obstacles on the body.

    Parameters
    ----------
    problem : Problem
    state : State
    before : State, optional
        One step earlier: friction is that of the motion since then, as in the step itself.
        Otherwise it is that of the velocities, which ring where nodes stick.

    Returns
    -------
    (obstacles, N, 3)
        On each node, N; those on all nodes add up to an obstacle's whole force.

    Raises
    ------
    InputError
        If the scene has no obstacles, shapes are wrong, or a point is inside an obstacle.
    """
    contact = problem.contact
    if contact is None:
        raise InputError("the scene has no obstacles: expected one or more.")
    check_input(problem, state, None)
    x, h = contact.at(state.positions), 1.0
    if before is not None:
        check_input(problem, before, None)
        h = state.time - before.time
        if not h > 0.0:
            raise InputError(f"before.time = {before.time:g}: expected less than {state.time:g} s.")
    out = np.zeros((len(contact.obstacles), *state.positions.shape))
    for i, part in enumerate(contact.touching(x, state.time)):
        if not np.isfinite(part.value):
            raise InputError(f"the body reaches into obstacles[{i}]: expected positions outside.")
        forces = np.zeros_like(x)
        forces[part.points] = part.force[:, None] * part.normals
        obstacle = contact.obstacles[i]
        if before is None:
            carried = x + obstacle.velocities(x, state.time) - contact.at(state.velocities)
        else:
            carried = obstacle.carried(contact.at(before.positions), before.time, state.time)
        sliding = Sliding(contact.frictions[i], part, carried, contact.slips[i] * h)
        forces[part.points] += sliding.value_and_forces(sliding.motions(x))[1]
        out[i] = contact.spread(forces, len(state.positions))
    return out


def forces_at(problem: Problem, state: State, forces: Array | None = None) -> Array:
    """f_int + f_ext - C v at a state, (N, 3), N, without the clamps' forces.

    ``forces`` (N, 3), N, act besides the scene's loads.
    """
    damping = problem.scene.damping
    out = problem.forces(state.positions)
    out += problem.external_forces(state.time, None, state.positions)
    if forces is not None:
        out += forces
    if problem.fibres is not None:
        out += problem.fibres.energy_and_forces(state.positions - problem.positions, state.time)[1]
    if problem.contact is not None:
        out += contact_forces(problem, state).sum(axis=0)
    if damping.mass:
        out -= damping.mass * problem.mass_times(state.velocities)
    if damping.stiffness:
        K = problem.stiffness(state.positions, project=True)
        out -= damping.stiffness * (K @ state.velocities.ravel()).reshape(out.shape)
    if damping.viscosity:
        here = problem.relaxed(state.positions)
        at = Stretches(problem, here)
        rate = at.rates(problem.lifted(here, state.velocities))
        out -= damping.viscosity * at.forces(small_strain_stress(problem, rate))[: len(out)]
        if problem.correction is not None:
            u = state.positions - problem.positions
            stress = problem.correction.stress(problem.correction.rates(u, state.velocities))
            out -= damping.viscosity * problem.correction.pulled(u, stress)
    return out


def solve_mass(problem: Problem, force: Array) -> Array:
    """Accelerations (N, 3), m/s2, by a force (N, 3), N; none where clamped."""

    def movable(x: Array) -> Array:
        free = x * problem.free
        return free if problem.rollers is None else problem.rollers.along(free)

    if problem.mass_is_diagonal:
        return movable(force) / problem.mass[:, None]
    diagonal = problem.mass_matrix.diagonal()[:, None]
    found = conjugate_gradients(
        lambda x: movable(problem.mass_times(x)) + diagonal * (x - movable(x)),
        movable(force),
        lambda r: r / diagonal,
        tolerance=_MASS_TOLERANCE,
        max_steps=_MASS_STEPS,
    )
    if not found.converged:
        raise ConvergenceError(
            f"M a = f was not solved in {found.steps} steps of conjugate gradients: expected "
            "finite forces and densities within a factor of 1e6 of each other."
        )
    return found.x

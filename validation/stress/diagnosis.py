"""Why a run is not where it has to be: other equilibria, and steps with more than one answer."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scenarios import Array, Scenario
from solvers import Run

import pdcorrect as pc

ENDS = (
    "force out of balance / (E face)", "least stiffness / at rest", "least det F at Gauss points",
    "at corners",
)  # fmt: skip
PARTING = (
    "frame", "apart, cells", "objective, J", "of the other method, J",
    "least curvature / at rest", "of the other method",
)  # fmt: skip
_APART = 1e-2
"""Cells, above which two answers to a step count as two."""
_MOST = 2000
"""Nodes of bodies whose eigenvalues are asked for."""


def minimum(found: Run) -> tuple[float, float, float, float]:
    """Whether a run ended at a minimum of the elastic energy, see `ENDS`.

    Largest force out of balance over Young's modulus times a cell's face; smallest eigenvalue
    of the stiffness over that at rest; smallest det F at the quadrature points and, for
    the trilinear map of the nodes, at the corners.
    """
    problem, end = found.problem, found.positions[-1]
    face = problem.scene.material.young * problem.cell_size**2
    force = np.abs(problem.forces(end) * problem.free).max() / face
    softest = _least(problem, problem.stiffness(end))
    return (
        float(force), softest / _least(problem, problem.stiffness(problem.positions)),
        float(problem.volume_ratios(end).min()), found.least_corner,
    )  # fmt: skip


def parting(
    scenario: Scenario, found: Run, truth: Run
) -> tuple[int, float, float, float, float, float] | None:
    """Where a run and the same steps by the other method part, see `PARTING`.

    The first frame that has them apart, by how far, and of both answers to its step the
    objective |p - o - h v|²_M / (2 h²) + W(p) - f·p and the smallest eigenvalue of its
    second derivative M/h² + K, over that at rest: negative at a saddle point.
    """
    problem, cell = found.problem, found.problem.cell_size
    apart = np.linalg.norm(found.positions - truth.positions, axis=2).max(axis=1) / cell
    frames = np.flatnonzero(apart > _APART)
    if not len(frames) or len(problem.positions) > _MOST:
        return None
    frame = int(frames[0])
    answers = found.positions[frame], truth.positions[frame]
    mass = problem.mass_matrix if not problem.mass_is_diagonal else sp.diags(problem.mass)
    inertia = sp.kron(mass / problem.time_step**2, sp.eye(3))
    rest = _least(problem, inertia + problem.stiffness(problem.positions))
    energies = [_objective(scenario, found, frame, p) for p in answers]
    curvatures = [_least(problem, inertia + problem.stiffness(p)) / rest for p in answers]
    return frame, float(apart[frame]), energies[0], energies[1], curvatures[0], curvatures[1]


def _objective(scenario: Scenario, run: Run, frame: int, positions: Array) -> float:
    """Of the step that ends with a frame, by backward Euler without damping, J."""
    problem, h, before = run.problem, run.problem.time_step, run.positions[frame - 1]
    velocity = scenario.state(problem).velocities
    if frame > 1:
        velocity = (before - run.positions[frame - 2]) / h
    forces = problem.external_forces((frame - 1) * h, frame * h)
    if scenario.forces:
        forces = forces + scenario.forces(problem, frame - 1)
    moved = np.where(problem.free, positions - before, 0.0)
    ahead = np.where(problem.free, moved - h * velocity, 0.0)
    kinetic = 0.5 / h**2 * float(np.vdot(ahead, problem.mass_times(ahead)))
    return kinetic + problem.energy(positions) - float(np.vdot(forces, moved))


def _least(problem: pc.Problem, matrix: sp.spmatrix) -> float:
    """Smallest eigenvalue on what is free."""
    free = problem.free.ravel()
    return float(np.linalg.eigvalsh(matrix.toarray()[np.ix_(free, free)])[0])

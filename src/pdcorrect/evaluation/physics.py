"""Energies and stresses along a trajectory, by a coarse model."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.graph import velocities
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.stress import stress
from pdcorrect.metrics import EnergyBalance

Array = NDArray[np.float64]

_STRESS_FRAMES = 10


def energies(problem: Problem, positions: Array) -> EnergyBalance:
    """Energies of a rollout from rest, and the work of the loads, by a coarse model.

    Velocities are backward differences of the positions, and loads act along the path as in
    the solver: those that follow the body are sampled where a step starts.
    """
    h, speeds = problem.time_step, velocities(positions, problem.time_step)
    work = [
        float(np.vdot(problem.external_forces(t * h, (t + 1) * h, x), y - x))
        for t, (x, y) in enumerate(pairwise(positions))
    ]
    none = np.zeros(len(positions))
    return EnergyBalance(
        kinetic=np.array([0.5 * np.vdot(v, problem.mass_times(v)) for v in speeds]),
        elastic=np.array([problem.energy(x) for x in positions]),
        external_work=np.concatenate([[0.0], np.cumsum(work)]),
        clamp_work=none,
        damping_loss=none,
    )


def stress_error(problem: Problem, positions: Array, reference: Array) -> float | None:
    """Relative RMS difference of Cauchy stress at quadrature points, by rest volume.

    Over about ten frames, evenly spaced, the last one among them.  None if a cell is flat or
    the reference has no stress.
    """
    frames = np.unique(np.linspace(0, len(reference) - 1, _STRESS_FRAMES + 1).round()[1:])
    difference = size = 0.0
    for frame in frames.astype(int):
        ours, truth = (stress(problem, x[frame]) for x in (positions, reference))
        weights = truth.weights[..., None, None]
        difference += float((weights * (ours.cauchy - truth.cauchy) ** 2).sum())
        size += float((weights * truth.cauchy**2).sum())
    return float(np.sqrt(difference / size)) if size and np.isfinite(difference) else None

"""Compile the kernels before the tests, whose processes then find them in numba's cache.

``python tests/compile_kernels.py trilinear`` and ``modes`` share the work between two processes.
"""

import sys

import numpy as np

import pdcorrect as pc
from conftest import beam

DAMPING = {"mass": 1.0, "stiffness": 1e-3, "viscosity": 1e-3}
SMALL = (2, 2, 2)


def step(problem):
    """By both solvers, and derivatives of one."""
    for kind in (pc.ProjectiveDynamics, pc.Newton):
        stepper, state = kind(problem), problem.rest_state()
        result = stepper(state)
        pc.adjoint(stepper, state, result, problem.positions)


def trilinear():
    step(pc.discretise(beam(SMALL)))
    step(pc.discretise(beam(SMALL, damping=DAMPING)))


def modes():
    best, learned = (
        pc.discretise(choose(beam(SMALL, damping=DAMPING)))
        for choose in (pc.best_coarse, pc.learned_coarse)
    )
    best.relaxed(best.positions)  # first what the other process does not compile
    u = np.zeros_like(learned.positions)
    for function in ("strains", "energy_and_forces", "tangent"):
        getattr(learned.correction, function)(u)
    for problem in (best, learned):
        step(problem)


if __name__ == "__main__":
    {"trilinear": trilinear, "modes": modes}[sys.argv[1]]()

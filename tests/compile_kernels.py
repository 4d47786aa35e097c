"""Compile the kernels before the tests, whose processes then find them in numba's cache.

``python tests/compile_kernels.py trilinear`` and ``modes`` share the work between two processes.
"""

import sys

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
    problem = pc.discretise(pc.best_coarse(beam(SMALL, damping=DAMPING)))
    problem.relaxed(problem.positions)  # the longest one, which the other process needs last
    step(problem)
    step(pc.discretise(pc.learned_coarse(beam(SMALL, damping=DAMPING))))


if __name__ == "__main__":
    {"trilinear": trilinear, "modes": modes}[sys.argv[1]]()

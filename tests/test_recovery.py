"""From flattened, random and inverted states back to rest, by every solver and element."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam

ELEMENTS = ["hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex27"]


def flattened(problem):
    """All free nodes pressed into the plane z = 0."""
    return np.where(problem.free, problem.positions * [1.0, 1.0, 0.0], problem.positions)


def scrambled(problem):
    """Free nodes displaced by up to one cell in each direction."""
    noise = np.random.default_rng(5).uniform(-1.0, 1.0, problem.positions.shape)
    return problem.positions + problem.cell_size * noise * problem.free


def inside_out(problem):
    """The last layer of cells mirrored: its end face pushed through the one before."""
    p = problem.positions.copy()
    x, size = p[:, 0], problem.cell_size
    plane = x.max() - size
    p[:, 0] = np.where(x > plane, 2.0 * plane - x, x)
    return p


def smallest_determinant(problem, positions):
    displacement = problem.relaxed(positions).copy()
    displacement[: len(positions)] -= problem.positions
    u = displacement[problem.space.local]
    F = np.eye(3) + np.einsum("cki,cqkj->cqij", u, problem.quadrature.gradients)
    return np.linalg.det(F).min()


@pytest.mark.parametrize("start", [flattened, scrambled, inside_out])
@pytest.mark.parametrize("element", ELEMENTS)
def test_a_clamped_beam_comes_back_to_rest(start, element):
    problem = pc.discretise(beam((6, 2, 2), loads=[], poisson=0.4), element=element)
    positions = start(problem)
    assert smallest_determinant(problem, positions) < 1e-9
    state = pc.State(positions, np.zeros_like(positions))
    run = pc.rollout(pc.ProjectiveDynamics(problem), 60, state=state)
    assert smallest_determinant(problem, run.positions[-1]) > 0.5
    left = np.linalg.norm(run.positions[-1] - problem.positions, axis=1).max()
    assert left < 0.02 * problem.cell_size
    assert run.stats["elastic_energy"][-1] < 1e-4 * problem.energy(positions)


@pytest.mark.parametrize("start", [flattened, scrambled, inside_out])
def test_newton_comes_back_too(start):
    problem = pc.discretise(beam((6, 2, 2), loads=[], poisson=0.4))
    positions = start(problem)
    state = pc.State(positions, np.zeros_like(positions))
    run = pc.rollout(pc.Newton(problem), 40, state=state)
    assert smallest_determinant(problem, run.positions[-1]) > 0.5
    left = np.linalg.norm(run.positions[-1] - problem.positions, axis=1).max()
    assert left < 0.05 * problem.cell_size

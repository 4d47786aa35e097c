"""From flattened, random and inverted states back to rest, by every solver and element."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.fem.hexahedron import corner_jacobians

ELEMENTS = [
    "hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced", "hex27",
]  # fmt: skip


def flattened(problem):
    """All free nodes pressed into the plane z = 0."""
    return np.where(problem.free, problem.positions * [1.0, 1.0, 0.0], problem.positions)


def scrambled(problem, seed=5):
    """Free nodes displaced by up to one cell in each direction."""
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, problem.positions.shape)
    return problem.positions + problem.cell_size * noise * problem.free


def inside_out(problem):
    """The last layer of cells mirrored: its end face pushed through the one before."""
    p = problem.positions.copy()
    x, size = p[:, 0], problem.cell_size
    plane = x.max() - size
    p[:, 0] = np.where(x > plane, 2.0 * plane - x, x)
    return p


STARTS = [flattened, scrambled, inside_out]
CASES = [(e, s) for e in ELEMENTS for s in STARTS if (e, s) != ("hex8-bubble", inside_out)]


def damped_beam():
    """By backward Euler, whose own damping brings it to rest in few frames."""
    return beam(
        (6, 2, 2), loads=[], poisson=0.4, damping={"mass": 20.0},
        time={"integrator": "backward-euler"},
    )  # fmt: skip


def released(solver, problem, start, frames=40):
    """A run from a state without velocity, which is flat or inverted somewhere."""
    positions = start(problem)
    assert problem.volume_ratios(positions).min() < 1e-9
    return pc.rollout(solver(problem), frames, state=pc.State(positions, np.zeros_like(positions)))


def assert_upright_at_corners(problem, run):
    """Every frame after the start, at the corners of its cells too, where no quadrature point is.

    The trilinear map of the corners says nothing about the cells of hex27.
    """
    if problem.element == "hex27":
        return
    rest = corner_jacobians(problem.positions, problem.cells)
    for positions in run.positions[1:]:
        assert (corner_jacobians(positions, problem.cells) / rest).min() > 0.5


@pytest.mark.parametrize(("element", "start"), CASES)
def test_a_clamped_beam_comes_back_to_rest(element, start):
    problem = pc.discretise(damped_beam(), element=element)
    run = released(pc.ProjectiveDynamics, problem, start)
    assert set(run.stats["status"]) <= {"CONVERGED", "RECOVERED", "SUBSTEPPED"}
    assert run.stats["smallest_volume_ratio"].min() > 0.5
    assert_upright_at_corners(problem, run)
    assert np.abs(run.positions[-1] - problem.positions).max() < 1e-4 * problem.cell_size


@pytest.mark.parametrize("start", STARTS)
def test_newton_comes_back_too(start):
    problem = pc.discretise(damped_beam())
    run = released(pc.Newton, problem, start)
    assert set(run.stats["status"]) <= {"CONVERGED", "RECOVERED", "SUBSTEPPED"}
    assert_upright_at_corners(problem, run)
    assert np.abs(run.positions[-1] - problem.positions).max() < 1e-4 * problem.cell_size


def test_incompatible_modes_can_hold_a_folded_cell_and_the_status_says_so():
    """The modes of hex8-bubble let every quadrature point of a folded cell look right.

    That is a true minimum of the element's energy.
    """
    problem = pc.discretise(damped_beam(), element="hex8-bubble")
    run = released(pc.ProjectiveDynamics, problem, inside_out)
    assert run.stats["status"][-1] == "INVERTED"
    assert run.stats["smallest_volume_ratio"][-1] < 0
    assert np.abs(run.velocities[-1]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("element", ELEMENTS)
def test_random_states_come_back_or_the_status_says_that_they_did_not(element):
    """Twenty of them; only hex8-bubble is known to stay folded, seldom."""
    problem, folded = pc.discretise(damped_beam(), element=element), []
    for seed in range(20):
        run = released(pc.ProjectiveDynamics, problem, lambda p, seed=seed: scrambled(p, seed))
        at_rest = np.abs(run.positions[-1] - problem.positions).max() < 1e-4 * problem.cell_size
        assert at_rest == (run.stats["status"][-1] != "INVERTED")
        if not at_rest:
            folded.append(seed)
    print(element, "stayed folded from seeds", folded)
    assert len(folded) <= (6 if element == "hex8-bubble" else 0)

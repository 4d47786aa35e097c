"""Forces of the clamps: balance of forces, moments and momentum."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import CLAMPED, GRAVITY, beam
from pdcorrect.errors import InputError

PRESSURE = {"kind": "pressure", "pressure": 300.0, "region": {"plane": "z", "at": "max"}}
WEIGHT = 6 * 4 * 0.02**3 * 1e3 * 9.81


def settled(**changes):
    problem = pc.discretise(beam(time={"integrator": "quasi-static"}, **changes))
    return problem, pc.Newton(problem, tolerance=1e-9)(problem.rest_state()).state


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean", "hex27"])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_a_cantilever_at_rest_is_held_up_by_its_weight(element, mass):
    problem, state = settled(solver={"element": element, "mass": mass})
    found = pc.reactions(problem, state)
    assert (found[problem.free] == 0).all()
    np.testing.assert_allclose(found.sum(axis=0), [0, 0, WEIGHT], atol=1e-6 * WEIGHT)


def test_forces_and_moments_balance_in_the_bent_shape():
    push = np.zeros((3 * 3 * 7, 3))
    push[-1] = [0.01, 0.05, -0.02]
    scene = beam(loads=[*GRAVITY, PRESSURE], time={"integrator": "quasi-static"})
    problem = pc.discretise(scene)
    state = pc.Newton(problem, tolerance=1e-9)(problem.rest_state(), forces=push).state
    loads = problem.external_forces(0.0, None, state.positions) + push
    everything = pc.reactions(problem, state, forces=push) + loads
    np.testing.assert_allclose(everything.sum(axis=0), 0, atol=1e-6 * WEIGHT)
    moment = np.cross(state.positions, everything).sum(axis=0)
    np.testing.assert_allclose(moment, 0, atol=1e-6 * WEIGHT * 0.12)
    assert np.abs(np.cross(problem.positions, everything).sum(axis=0)).max() > 1e-3 * WEIGHT * 0.12


def test_rollers_push_only_along_the_components_that_they_hold():
    roller = {"region": {"plane": "x", "at": "max"}, "components": ["z"]}
    problem, state = settled(clamps=[*CLAMPED, roller])
    found = pc.reactions(problem, state)
    end = np.isclose(problem.positions[:, 0], 0.12)
    assert (found[end][:, :2] == 0).all()
    assert found[end, 2].sum() == pytest.approx(0.4 * WEIGHT, rel=0.15)  # 3/8 in a slender beam
    assert found[:, 2].sum() == pytest.approx(WEIGHT, rel=1e-6)


DAMPING = {"mass": 3.0, "stiffness": 0.002}


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_a_step_of_backward_euler_changes_momentum_by_what_acts(mass):
    """Reactions with the step's accelerations are those of the step's own equations."""
    problem = pc.discretise(
        beam(solver={"mass": mass}, time={"step": 0.002, "integrator": "backward-euler"})
    )
    run = pc.rollout(pc.Newton(problem, tolerance=1e-9), frames=2)
    change = (run.velocities[2] - run.velocities[1]) / 0.002
    found = pc.reactions(problem, run.state(2), accelerations=change)
    momentum = problem.mass_times(change).sum(axis=0)
    np.testing.assert_allclose(found.sum(axis=0) - [0, 0, WEIGHT], momentum, atol=1e-6 * WEIGHT)
    assert np.abs(momentum).max() > 0.05 * WEIGHT


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_without_given_accelerations_those_of_the_forces_are_taken(mass):
    """Total force, damping of the moving body included, is the rate of change of momentum."""
    problem = pc.discretise(
        beam(solver={"mass": mass, "element": "hex8-mean"}, damping=DAMPING, time={"step": 0.003})
    )
    run = pc.rollout(pc.Newton(problem), frames=8)
    state = run.state()
    found = pc.reactions(problem, state)
    step = pc.Newton(problem, tolerance=1e-11, integrator="midpoint", time_step=2e-5)
    after = step(state).state
    rate = problem.mass_times(after.velocities - state.velocities).sum(axis=0) / 2e-5
    drag = 3.0 * problem.mass_times(state.velocities).sum(axis=0)
    total = found.sum(axis=0) - [0, 0, WEIGHT] - drag
    np.testing.assert_allclose(total, rate, atol=0.01 * WEIGHT)
    without = pc.reactions(problem, state, np.zeros_like(found)).sum(axis=0)
    difference = np.abs(without - found.sum(axis=0)).max()
    assert (difference > 1e-4 * WEIGHT) == (mass == "consistent")


def test_wrong_input_is_named():
    problem = pc.discretise(beam((2, 1, 1)))
    state = problem.rest_state()
    with pytest.raises(InputError, match="accelerations has shape"):
        pc.reactions(problem, state, np.zeros((2, 3)))
    with pytest.raises(InputError, match="accelerations of node 0"):
        pc.reactions(problem, state, np.full_like(problem.positions, np.nan))
    with pytest.raises(InputError, match="forces has shape"):
        pc.reactions(problem, state, forces=np.zeros((2, 3)))

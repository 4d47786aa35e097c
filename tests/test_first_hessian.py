"""True Hessians as L-BFGS's first: the same answers in fewer iterations, turned, resumable."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, cross, disturbed, rotation
from pdcorrect.solvers.first_hessian import Rotations, TrueHessian
from pdcorrect.solvers.integrators import backward_euler
from pdcorrect.solvers.rollout import continue_from
from pdcorrect.solvers.step import StepObjective
from pdcorrect.solvers.tangent_solver import TangentFactory

ELEMENTS = ["hex8", "hex8-mean", "hex8-bubble", "hex27"]


@pytest.mark.parametrize("kind", ["rest", "lagged"])
@pytest.mark.parametrize("element", ELEMENTS)
def test_it_reaches_the_same_answer_in_fewer_iterations(kind, element):
    problem = pc.discretise(cross(), element=element)
    by_g = pc.rollout(pc.ProjectiveDynamics(problem, 1e-8, first_hessian="G-scaled"), 5)
    run = pc.rollout(pc.ProjectiveDynamics(problem, 1e-8, first_hessian=kind), 5)
    assert set(by_g.stats["status"]) == set(run.stats["status"]) == {"CONVERGED"}
    assert np.abs(by_g.positions - run.positions).max() < 1e-8
    assert run.stats["iterations"].sum() < 0.35 * by_g.stats["iterations"].sum()


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
def test_a_turned_hessian_is_that_of_the_turned_body(element):
    """Exactly, for a rigid rotation of the whole body."""
    problem = pc.discretise(beam((3, 2, 1), clamps=[], loads=[]), element=element)
    bent, R = disturbed(problem, 0.05), rotation()
    hessian = TrueHessian(TangentFactory(problem), lagged=True)

    def objective(positions):
        state = pc.State(positions, np.zeros_like(positions))
        stage = backward_euler(problem, state, 0.01)
        return StepObjective(problem, state, stage, np.zeros_like(positions))

    hessian.solver(objective(bent))
    hessian.note(5, 0.0)
    turned = hessian.solver(objective(bent @ R.T))
    assert hessian.age == 1
    exact = TrueHessian(TangentFactory(problem), lagged=True).solver(objective(bent @ R.T))
    r = np.random.default_rng(2).normal(size=(problem.unknowns, 3))
    scale = np.abs(exact(r)).max()
    np.testing.assert_allclose(turned(r), exact(r), rtol=0, atol=1e-5 * scale)


def test_it_is_symmetric_and_positive_where_parts_turn_differently(rng):
    problem = pc.discretise(beam((6, 2, 2), loads=[]), element="hex8-bubble")
    x, y, z = problem.positions.T
    angle = 12.0 * x
    twisted = np.stack(
        [x, y * np.cos(angle) - z * np.sin(angle), y * np.sin(angle) + z * np.cos(angle)], axis=1
    )
    twisted = np.where(problem.free, twisted, problem.positions)
    state = pc.State(twisted, np.zeros_like(twisted))
    stage = backward_euler(problem, state, 0.01)
    objective = StepObjective(problem, state, stage, np.zeros_like(twisted))
    solve = TrueHessian(TangentFactory(problem), lagged=False).solver(objective)
    a, b = rng.normal(size=(2, problem.unknowns, 3)) * problem.free_unknowns
    assert np.vdot(a, solve(b)) == pytest.approx(np.vdot(b, solve(a)), rel=1e-9)
    assert np.vdot(a, solve(a)) > 0
    held = ~problem.free_unknowns
    assert not solve(b)[held].any()


def test_rotations_of_a_rigidly_turned_body_are_that_rotation():
    problem = pc.discretise(beam((3, 2, 1), clamps=[], loads=[]))
    rotations, R = Rotations(problem), rotation(7)
    before = problem.cell_rotations(problem.positions)
    found = rotations.since(before, problem.positions @ R.T)
    np.testing.assert_allclose(found, np.broadcast_to(R, found.shape), atol=1e-12)


def test_with_the_rest_shape_a_step_depends_on_its_state_alone():
    problem = pc.discretise(cross())
    stepper = pc.ProjectiveDynamics(problem, first_hessian="rest")
    run = pc.rollout(stepper, 6)
    assert "hessian_age" not in run.stats
    again = pc.ProjectiveDynamics(problem, first_hessian="rest")(run.state(4))
    np.testing.assert_array_equal(again.state.positions, run.positions[5])


def test_a_lagged_hessian_is_kept_for_several_frames():
    problem = pc.discretise(beam((24, 2, 2)))
    run = pc.rollout(pc.ProjectiveDynamics(problem, first_hessian="lagged"), 40)
    ages = run.stats["hessian_age"]
    assert ages[0] == 0
    assert ages.max() >= 5


def test_at_rest_it_is_never_renewed():
    """All steps of backward Euler have one inertia; the first of others may have another."""
    problem = pc.discretise(beam(loads=[], time={"integrator": "backward-euler"}))
    run = pc.rollout(pc.ProjectiveDynamics(problem, first_hessian="lagged"), 10)
    np.testing.assert_array_equal(run.stats["hessian_age"], np.arange(10))


@pytest.mark.parametrize("kind", ["rest", "lagged"])
@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "generalised-alpha"])
@pytest.mark.parametrize("stop", [1, 7])
def test_a_resumed_run_equals_the_uninterrupted_one_bit_by_bit(kind, integrator, stop):
    problem = pc.discretise(cross(time={"integrator": integrator}), element="hex8-bubble")

    def stepper():
        return pc.ProjectiveDynamics(problem, first_hessian=kind).prepare()

    whole = pc.rollout(stepper(), 12)
    first = pc.rollout(stepper(), stop)
    again = stepper()
    rest = pc.rollout(again, 12 - stop, state=continue_from(again, first))
    np.testing.assert_array_equal(rest.positions, whole.positions[stop:])
    np.testing.assert_array_equal(rest.velocities, whole.velocities[stop:])
    assert (kind == "lagged") == ("hessian_age" in whole.stats)
    for name in set(whole.stats) - {"seconds"}:
        np.testing.assert_array_equal(rest.stats[name], whole.stats[name][stop:])


@pytest.mark.parametrize("kind", ["rest", "lagged"])
def test_a_hessian_that_does_not_serve_is_renewed_within_the_step(kind):
    """From random positions the tangent of any earlier shape says little about the minimum.

    Which is the end of the step by backward Euler; others would go on from it and fold cells.
    """
    problem = pc.discretise(beam((12, 2, 2), time={"integrator": "backward-euler"}))
    state = pc.State(disturbed(problem, 1.0), np.zeros_like(problem.positions))
    result = pc.ProjectiveDynamics(problem, first_hessian=kind, recover=False)(state)
    assert result.status is pc.Status.CONVERGED
    exact = pc.ProjectiveDynamics(problem, 1e-8, first_hessian="G")(state)
    assert np.abs(result.state.positions - exact.state.positions).max() < 2e-5 * problem.cell_size


def test_auto_takes_the_rest_shape_in_a_band_or_by_multigrid():
    small = pc.ProjectiveDynamics(pc.discretise(beam()))
    assert small.first_hessian == "rest"
    assert small.describe()["factorisation"] == "band"
    assert "rest shape" in small.describe()["first_hessian"]
    slab = TangentFactory(pc.discretise(beam((30, 30, 2))))
    assert slab.backend == "band"
    block = TangentFactory(pc.discretise(beam((30, 30, 30))))
    assert block.backend == "amg"
    assert pc.ProjectiveDynamics(pc.discretise(beam()), backend="splu").first_hessian == "G-scaled"


def test_a_cycle_of_multigrid_is_a_first_hessian_too():
    problem = pc.discretise(cross())
    band = pc.rollout(pc.ProjectiveDynamics(problem, 1e-8), 4)
    cycle = pc.rollout(pc.ProjectiveDynamics(problem, 1e-8, backend="amg"), 4)
    assert np.abs(cycle.positions - band.positions).max() < 1e-8
    by_g = pc.rollout(pc.ProjectiveDynamics(problem, 1e-8, first_hessian="G-scaled"), 4)
    assert cycle.stats["iterations"].sum() < 0.6 * by_g.stats["iterations"].sum()

"""Unusual scenes: they end with an answer or a named failure, never with a wrong success."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import GRAVITY, beam, cross
from pdcorrect.errors import ConvergenceError
from pdcorrect.solvers.rollout import continue_from


def test_a_static_step_without_a_solution_is_not_replaced_by_motion():
    """Nearly incompressible, pushed together far beyond what the element can hold."""
    scene = beam(
        (6, 2, 2), poisson=0.4999, material={"young": 1e5, "energy": "neo-hookean"},
        loads=[{"kind": "gravity", "acceleration": [-2000.0, 0.0, 0.0]}],
    )  # fmt: skip
    problem = pc.discretise(scene, element="hex8-bubble-mean")
    result = pc.Newton(problem, integrator="quasi-static")(problem.rest_state())
    load = problem.external_forces(0.01)
    out_of_balance = np.abs((problem.forces(result.state.positions) + load) * problem.free).max()
    assert not result.state.velocities.any()
    assert result.status.ok == (out_of_balance < 1e-5 * np.abs(load).max())


def test_a_fallback_is_not_hidden_by_inverted_cells(monkeypatch):
    from pdcorrect.solvers import implicit

    problem = pc.discretise(beam((3, 1, 1), loads=[]))
    turned = problem.positions.copy()
    turned[problem.positions[:, 0] > 0.05, 0] = 0.0
    monkeypatch.setattr(pc.Problem, "volume_ratios", lambda self, p: -np.ones(3))
    stepper = pc.ProjectiveDynamics(problem)
    assert stepper(problem.rest_state()).status is pc.Status.INVERTED
    short = pc.ProjectiveDynamics(problem, max_iterations=1, first_hessian="G")
    state = pc.State(turned, np.zeros_like(turned))
    assert implicit._SUBSTEP_LEVELS == 4
    assert short(state).status in (pc.Status.RECOVERED, pc.Status.SUBSTEPPED)


CRUSHED = {
    "volume only": ({"energy": "volume-only"}, 1.0),
    "St. Venant-Kirchhoff, crushed": ({"energy": "st-venant-kirchhoff"}, 0.3),
}


@pytest.mark.parametrize("name", CRUSHED)
@pytest.mark.parametrize(
    "make",
    [
        pc.ProjectiveDynamics,
        lambda problem: pc.ProjectiveDynamics(problem, first_hessian="lagged").prepare(),
        lambda problem: pc.Newton(problem, linear_solver="cg"),
        lambda problem: pc.Newton(problem, linear_solver="direct"),
    ],
    ids=["rest", "lagged", "Newton by cg", "Newton by a factor"],
)
def test_modes_without_stiffness_end_in_a_result(name, make):
    material, share = CRUSHED[name]
    problem = pc.discretise(beam((3, 1, 1), material=material), element="hex8-bubble")
    positions = problem.positions * [share, 1.0, 1.0]
    result = make(problem)(pc.State(positions, np.zeros_like(positions)))
    assert np.isfinite(result.state.positions).all() or not result.status.ok


def test_a_tangent_that_cannot_be_condensed_is_refused_by_name():
    scene = beam((3, 1, 1), material={"energy": "volume-only"})
    problem = pc.discretise(scene, element="hex8-bubble")
    with pytest.raises(ConvergenceError, match="internal modes"):
        problem.stiffness(problem.positions)


@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "generalised-alpha"])
def test_with_damping_too_a_step_depends_on_its_state_alone(integrator):
    scene = cross(time={"integrator": integrator}, damping={"stiffness": 2e-3, "mass": 1.0})
    problem = pc.discretise(scene, element="hex8-bubble")
    whole = pc.rollout(pc.ProjectiveDynamics(problem), 9)
    again = pc.ProjectiveDynamics(problem)
    first = pc.rollout(pc.ProjectiveDynamics(problem), 5)
    rest = pc.rollout(again, 4, state=continue_from(again, first))
    np.testing.assert_array_equal(rest.positions, whole.positions[5:])
    np.testing.assert_array_equal(rest.stats["iterations"], whole.stats["iterations"][5:])


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "generalised-alpha"])
def test_forces_given_by_hand_act_as_the_same_load_of_the_scene(integrator):
    time = {"integrator": integrator}
    by_scene = pc.discretise(beam((2, 1, 1), clamps=[], loads=GRAVITY, time=time))
    by_hand = pc.discretise(beam((2, 1, 1), clamps=[], loads=[], time=time))
    weight = by_scene.external_forces(0.0)
    expected = pc.rollout(pc.Newton(by_scene), 3)
    found = pc.rollout(pc.Newton(by_hand), 3, forces=lambda state: weight)
    np.testing.assert_allclose(found.positions, expected.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.velocities, expected.velocities, rtol=0, atol=1e-10)


@pytest.mark.parametrize("integrator", ["backward-euler", "midpoint", "generalised-alpha"])
def test_the_elastic_energy_is_that_of_the_positions(integrator):
    """Also where the step solves for a configuration inside it."""
    problem = pc.discretise(beam((4, 1, 1), time={"integrator": integrator}), element="hex8-bubble")
    run = pc.rollout(pc.Newton(problem), 5)
    expected = [problem.energy(p) for p in run.positions[1:]]
    np.testing.assert_allclose(run.stats["elastic_energy"], expected, rtol=1e-6)


def test_accelerations_with_a_consistent_mass_solve_it():
    problem = pc.discretise(beam((5, 3, 2)), mass="consistent")
    from pdcorrect.solvers.reactions import forces_at, solve_mass

    state = problem.rest_state()
    a = solve_mass(problem, forces_at(problem, state) * problem.free)
    left = (problem.mass_times(a) - forces_at(problem, state)) * problem.free
    assert np.abs(left).max() < 1e-12 * np.abs(forces_at(problem, state)).max()
    assert not a[~problem.free].any()


def test_bdf2_starts_anew_after_a_step_of_another_length():
    problem = pc.discretise(beam((2, 1, 1), clamps=[], loads=GRAVITY))
    coarse = pc.Newton(problem, integrator="bdf2", time_step=0.01)
    fine = pc.Newton(problem, integrator="bdf2", time_step=0.001)
    state = pc.rollout(coarse, 3).state(-1)
    result = fine(state)
    change = (result.state.velocities - state.velocities) / 0.001
    np.testing.assert_allclose(change, np.broadcast_to([0, 0, -9.81], change.shape), atol=1e-6)

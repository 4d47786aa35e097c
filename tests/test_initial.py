"""`[initial]`: where runs start, what free motion conserves, and what is refused."""

import re
import warnings

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import ELEMENTS, beam
from pdcorrect.errors import PdcorrectWarning, SceneError

SPIN = [3.0, -2.0, 5.0]
GRADIENT = [[0.0, 2.0, -1.0], [0.5, 0.0, 3.0], [1.0, -4.0, 0.0]]


def free(**changes):
    """A body that flies and spins, without loads."""
    initial = {"velocity": [1.0, 2.0, -3.0], "angular_velocity": SPIN}
    return beam((4, 2, 1), **{"clamps": [], "loads": [], "initial": initial, **changes})


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("refine", [1, 2])
def test_the_field_is_the_scene_s_on_every_mesh(element, refine):
    initial = {
        "velocity": [1.0, 2.0, 3.0], "angular_velocity": SPIN, "velocity_gradient": GRADIENT,
        "centre": [0.1, -0.2, 0.3],
    }  # fmt: skip
    problem = pc.discretise(free(initial=initial), refine, element=element)
    arms = problem.positions - [0.1, -0.2, 0.3]
    w = np.array(SPIN)
    skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    expected = [1.0, 2.0, 3.0] + arms @ (skew + GRADIENT).T
    state = problem.initial_state()
    np.testing.assert_allclose(state.velocities, expected, atol=1e-14)
    np.testing.assert_array_equal(state.positions, problem.positions)
    assert state.time == 0.0
    assert not problem.rest_state().velocities.any()


@pytest.mark.parametrize("mass", ["lumped", "averaged", "consistent", "per-node"])
def test_the_centre_is_that_of_mass_on_every_mesh(mass):
    heavy = {"region": {"box": [[0, 0, 0], [0.04, 1, 1]]}, "young": 1e6, "poisson": 0.3,
             "density": 4e3}  # fmt: skip
    scene = free(initial={"angular_velocity": SPIN}, materials=[heavy], solver={"mass": mass})
    centre = (4 * np.array([0.02, 0.02, 0.01]) + [0.06, 0.02, 0.01]) / 5
    for refine in (1, 2):
        problem = pc.discretise(scene, refine)
        expected = np.cross(SPIN, problem.positions - centre)
        np.testing.assert_allclose(problem.initial_state().velocities, expected, atol=1e-12)


@pytest.mark.parametrize("integrator", ["midpoint", "backward-euler", "generalised-alpha"])
def test_free_flight_keeps_momentum_and_moves_as_told(integrator):
    initial = {"velocity": [1.0, 2.0, -3.0]}
    scene = free(initial=initial, time={"integrator": integrator})
    run = pc.rollout(pc.Newton(pc.discretise(scene), tolerance=1e-11), 5)
    expected = run.points + run.times[:, None, None] * [1.0, 2.0, -3.0]
    np.testing.assert_allclose(run.positions, expected, atol=1e-9)


def angular_drift(scene, frames):
    problem = pc.discretise(scene)
    run = pc.rollout(pc.Newton(problem, tolerance=1e-11), frames)
    assert problem.mass_is_diagonal
    angular = pc.metrics.angular_momentum(run.positions, run.velocities, problem.mass)
    return pc.metrics.relative_drift(angular)


def test_angular_momentum_errs_less_with_smaller_steps():
    drifts = []
    for halvings in (1, 2):
        time = {"step": 2e-3 / halvings, "integrator": "generalised-alpha"}
        drifts.append(angular_drift(free(time=time), 6 * halvings))
    assert drifts[1] < 0.35 * drifts[0] < 1e-3


def test_clamps_win_and_it_is_told():
    scene = beam(initial={"velocity": [0.0, 1.0, 0.0]}, loads=[])
    problem = pc.discretise(scene)
    with pytest.warns(PdcorrectWarning, match="initial"):
        state = problem.initial_state()
    np.testing.assert_array_equal(state.velocities, np.where(problem.free, [0.0, 1.0, 0.0], 0.0))
    roller = {"region": {"plane": "x", "at": 0.0}, "components": ["x"]}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.initial_state()  # told already
        problem.rest_state()
        pc.discretise(scene.with_changes(clamps=[roller])).initial_state()  # along the plane


def test_the_program_tells_it_once(program, tmp_path):
    scene = beam((2, 2, 2), initial={"velocity": [0.0, 0.1, 0.0]}, time={"frames": 1})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    out = tmp_path / "report"
    status, _, err = program("compare", tmp_path / "scene.toml", "-o", out, "--no-figures")
    assert status == 0
    assert sum(line.startswith("warning: ") for line in err.splitlines()) == 1


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "generalised-alpha"])
def test_a_body_that_moves_with_its_clamp_is_not_shaken(integrator):
    drive = {"times": [0.0, 10.0], "displacement": [[0.0, 0.0, 0.0], [0.0, 0.0, 10.0]]}
    scene = free(
        clamps=[{"region": {"plane": "x", "at": "min"}, "motion": drive}],
        initial={"velocity": [0.0, 0.0, 1.0]}, solver={"mass": "averaged"},
        time={"step": 0.01, "frames": 5, "integrator": integrator},
    )  # fmt: skip
    problem = pc.discretise(scene)
    with pytest.warns(PdcorrectWarning, match="follow the clamps"):
        run = pc.rollout(pc.Newton(problem, tolerance=1e-11))
    rigid = problem.positions + run.times[:, None, None] * np.array([0.0, 0.0, 1.0])
    assert np.abs(run.positions - rigid).max() < 1e-9
    assert np.abs(run.velocities - [0.0, 0.0, 1.0]).max() < 1e-7


def test_frame_zero_is_the_initial_state_and_survives_files(program, tmp_path):
    scene = free(time={"frames": 2})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    problem = pc.discretise(scene)
    start = problem.initial_state().velocities
    run = pc.rollout(pc.ProjectiveDynamics(problem))
    np.testing.assert_array_equal(run.velocities[0], start)
    assert np.abs(run.positions[1] - run.points).max() > 0.005
    command = ("simulate", tmp_path / "scene.toml", "-o", tmp_path / "run.h5")
    assert program(*command, "--vtu", tmp_path / "vtu")[0] == 0
    stored = pc.load_trajectory(tmp_path / "run.h5")
    np.testing.assert_array_equal(stored.velocities, run.velocities)
    assert pc.Scene.from_toml(stored.scene_toml) == scene
    first = sorted((tmp_path / "vtu").glob("*.vtu"))[0]
    np.testing.assert_allclose(meshio.read(first).point_data["velocity"], start, rtol=1e-6)
    still = pc.rollout(pc.ProjectiveDynamics(problem), 1, state=problem.rest_state())
    assert np.abs(still.positions - still.points).max() < 1e-12


def test_energy_of_frame_zero_is_kinetic():
    run = pc.rollout(pc.Newton(pc.discretise(free())), 2)
    balance = pc.metrics.energy_balance(run)
    problem, v = run.problem, run.velocities[0]
    assert balance.kinetic[0] == pytest.approx(0.5 * np.vdot(v, problem.mass_times(v)))
    assert balance.elastic[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"initial": {"velocity": [0.0, float("nan"), 0.0]}}, "initial.velocity"),
        ({"initial": {"velocity": [0.0, 1.0]}}, "initial.velocity"),
        ({"initial": {"angular_velocity": [0.0, np.inf, 0.0]}}, "initial.angular_velocity"),
        ({"initial": {"angular_velocity": 3.0}}, "initial.angular_velocity"),
        ({"initial": {"velocity_gradient": [[0.0] * 3] * 2}}, "initial.velocity_gradient"),
        ({"initial": {"centre": ["a", 0.0, 0.0]}}, "initial.centre"),
        ({"initial": {"speed": [1.0, 0.0, 0.0]}}, "initial.speed"),
        ({"time": {"integrator": "quasi-static"}}, "quasi-static"),
    ],
)
def test_wrong_input_names_the_key(changes, key):
    with pytest.raises(SceneError, match=re.escape(key)):
        free(**changes)

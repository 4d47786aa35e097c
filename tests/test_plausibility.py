"""What looks wrong is told before it is computed, and what went wrong ends with a status."""

import warnings

import numpy as np
import pytest
from typer.testing import CliRunner

import pdcorrect as pc
from conftest import CLAMPED, beam
from pdcorrect.cli.program import app
from pdcorrect.errors import ConvergenceError, PdcorrectWarning, SceneError
from pdcorrect.evaluation.run_report import lost_energy
from pdcorrect.fem.clamps import Clamps, check_held

QUASI_STATIC = {"step": 0.1, "frames": 1, "integrator": "quasi-static"}


def plausible(**changes):
    element = {"element": "hex8-enhanced", "mass": "averaged"}
    return beam((2, 1, 1), **{"solver": element, **changes})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"body": {"cell_size": 60.0}, "time": {"step": 10.0}}, "120 m"),
        ({"body": {"cell_size": 4e-5}, "time": {"step": 1e-6}}, "8e-05 m"),
        ({"material": {"density": 1e-3}, "time": {"step": 1e-5}}, "0.001 kg"),
        ({"material": {"young": 0.1}, "time": {"step": 1e-4}}, "steps"),
        ({"material": {"young": 2e11}, "time": {"step": 1.0}}, "steps"),
        ({"material": {"young": 50.0}}, "50 Pa"),
    ],
)
def test_magnitudes_of_other_units_get_one_line(changes, named):
    with pytest.warns(PdcorrectWarning, match=named) as told:
        pc.discretise(plausible(**changes))
    assert len(told) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"body": {"cell_size": 40.0}, "material": {"young": 3e10, "density": 2400.0}},
        {"body": {"cell_size": 2e-4}, "time": {"step": 1e-4}},
        {"material": {"young": 2e11, "density": 7800.0}, "time": {"step": 1e-3}},
        {"material": {"young": 2e11}, "time": QUASI_STATIC},
    ],
)
def test_usual_magnitudes_get_none(changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pc.discretise(plausible(**changes))


@pytest.mark.parametrize(("step", "told"), [(2e-3, True), (1e-6, False)])
def test_what_the_time_steps_lose_is_the_dissipation_of_the_balance(step, told):
    scene = plausible(
        clamps=[], loads=[], time={"step": step, "integrator": "backward-euler"},
        initial={"velocity_gradient": [[20.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]},
    )  # fmt: skip
    problem = pc.discretise(scene)
    run = pc.rollout(pc.ProjectiveDynamics(problem), 2)
    balance = pc.metrics.energy_balance(run)
    lost, text = balance.dissipation[-1], lost_energy(problem, run.stats)
    assert bool(lost > 0.2 * balance.total[0]) is told
    assert bool(text) is told
    assert not told or f"{lost:.4g} J" in text


X, Y, Z = ({"region": {"plane": axis, "at": "min"}, "components": [axis]} for axis in "xyz")
EDGE = {"region": {"plane": [1, 0, 1], "at": "min"}}


@pytest.mark.parametrize(
    ("clamps", "loose"),
    [
        ([], "move along x and y and z and turn about x and y and z"),
        ([X], "move along y and z and turn about x"),
        ([X, Y], "move along z:"),
        ([EDGE], "turn about y:"),
        ([{"region": {"nodes": [0, 7]}}], r"turn about \["),
    ],
)
@pytest.mark.parametrize("kind", [pc.Newton, pc.ProjectiveDynamics])
def test_statics_name_the_rigid_motion_that_clamps_leave(kind, clamps, loose):
    problem = pc.discretise(plausible(clamps=clamps, time=QUASI_STATIC))
    with pytest.raises(SceneError, match=loose):
        kind(problem)


@pytest.mark.parametrize("clamps", [CLAMPED, [X, Y, Z], [{"region": {"nodes": [0, 1, 2]}}]])
def test_held_statics_step(clamps):
    stepper = pc.Newton(pc.discretise(plausible(clamps=clamps, time=QUASI_STATIC)))
    assert stepper(stepper.problem.rest_state()).status.ok


def test_an_obstacle_may_hold_statics():
    floor = {"shape": "plane", "normal": [0, 0, 1], "point": [0, 0, -1e-4]}
    weight = {"kind": "gravity", "acceleration": [0, 0, -9.81]}
    scene = plausible(clamps=[X, Y], loads=[weight], time=QUASI_STATIC, obstacles=[floor])
    problem = pc.discretise(scene)
    result = pc.Newton(problem)(problem.rest_state())
    carried = pc.contact_forces(problem, result.state).sum(axis=(0, 1))
    np.testing.assert_allclose(carried, [0, 0, 9.81 * problem.mass.sum()], rtol=1e-6, atol=1e-9)


SLIDE = [{"kind": "gravity", "acceleration": [0.1, 0, -9.81]}]
PUSH = {"kind": "pressure", "pressure": 1e3, "region": {"plane": "z", "at": "max"}}


@pytest.mark.parametrize(
    ("kind", "clamps", "loads", "loose"),
    [
        (pc.Newton, [Y], SLIDE, "move along x"),
        (pc.ProjectiveDynamics, [Y], SLIDE, "move along x"),
        (pc.Newton, [EDGE], [{**PUSH, "follower": True}], "turn about y"),
    ],
)
def test_statics_that_no_obstacle_holds_name_the_motion_where_they_fail(kind, clamps, loads, loose):
    floor = {"shape": "plane", "point": [0, 0, -0.1], "normal": [0, 0, 1]}
    scene = plausible(clamps=clamps, loads=loads, time=QUASI_STATIC, obstacles=[floor])
    with pytest.raises(ConvergenceError, match=f"the body .*{loose}"):
        pc.rollout(kind(pc.discretise(scene)))


def test_rounding_is_no_turn():
    problem = pc.discretise(beam((2, 2, 2), clamps=[X, Y], time=QUASI_STATIC))
    with pytest.raises(SceneError, match="move along z:"):
        pc.Newton(problem)


def test_many_clamped_nodes_are_checked_in_little_memory():
    count = 40_000
    places = np.random.default_rng(0).normal(size=(count, 3))
    free = np.ones((count, 3), dtype=bool)
    free[:, 0] = free[0, 1] = False
    cells = np.arange(count).reshape(-1, 8)
    cells[1:, 0] = cells[0, 0]
    with pytest.raises(SceneError, match="move along z and turn about"):
        check_held(places, cells, Clamps(free, places, ()))


def test_each_part_of_a_body_needs_its_clamps():
    occupancy = [[[1]], [[0]], [[1]]]
    body = {"shape": "voxels", "occupancy": occupancy, "cell_size": 0.02}
    scene = plausible().model_dump(mode="python", exclude_unset=True, by_alias=True)
    apart = pc.Scene(**{**scene, "body": body, "time": QUASI_STATIC})
    with pytest.raises(SceneError, match="part of the body at node 8"):
        pc.Newton(pc.discretise(apart))


@pytest.mark.parametrize(("options", "status"), [([], 1), (["--allow-inverted"], 0)])
def test_inverted_frames_end_with_status_1_unless_allowed(tmp_path, options, status):
    press = {"times": [0, 0.01], "displacement": [[0, 0, 0], [-0.045, 0, 0]]}
    clamps = [*CLAMPED, {"region": {"plane": "x", "at": "max"}, "motion": press}]
    scene = plausible(clamps=clamps, loads=[], time={"step": 0.01, "frames": 1})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    output = tmp_path / "run.h5"
    command = ["simulate", str(tmp_path / "scene.toml"), "-o", str(output), *options]
    done = CliRunner().invoke(app, command)
    run = pc.load_trajectory(output)
    assert np.min(run.stats["smallest_volume_ratio"]) <= 0
    assert done.exit_code == status
    assert CliRunner().invoke(app, [*command, "--resume"]).exit_code == status

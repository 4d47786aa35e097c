"""Clamps along any direction: the same motion in a turned frame, reactions, work, derivatives."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import InputError, SceneError
from pdcorrect.fem.mesh import HexMesh

TURN = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
TIMES = np.linspace(0, 0.1, 101)
PUSH = {"times": TIMES.tolist(), "displacement": [[0, 0, 40 * t**3] for t in TIMES]}
BOTTOM = [0, 3, 6, 9, 12, 15, 18, 21]
"""Nodes of the lowest layer of 3 x 1 x 2 cells."""


def problems(integrator="generalised-alpha", motion=None, **changes):
    """A block on rollers along z, and all of it turned."""
    out = []
    for R in (np.eye(3), TURN):
        normal, gravity = R @ [0, 0, 1.0], R @ [3.0, 1.0, -9.0]
        course = None
        if motion:
            course = {**motion, "displacement": [(R @ d).tolist() for d in motion["displacement"]]}
        clamp = {"region": {"nodes": BOTTOM}, "normal": normal.tolist()}
        scene = beam(
            (3, 1, 2),
            clamps=[clamp | ({"motion": course} if course else {})],
            loads=[{"kind": "gravity", "acceleration": gravity.tolist()}],
            material={"young": 2e4},
            time={"step": 0.01, "integrator": integrator},
            solver={"element": "hex8-enhanced", "mass": "averaged", "tolerance": 1e-7},
            **changes,
        )
        plain = pc.discretise(scene).mesh
        mesh = HexMesh.create(plain.positions @ R.T, plain.cells)
        out.append(pc.discretise(scene, mesh=mesh))
    return out


@pytest.mark.parametrize("kind", [pc.Newton, pc.ProjectiveDynamics])
@pytest.mark.parametrize("motion", [None, PUSH])
@pytest.mark.parametrize("integrator", ["generalised-alpha", "midpoint"])
def test_the_turned_block_moves_as_the_other(kind, motion, integrator):
    straight, turned = problems(integrator, motion)
    assert straight.rollers is None
    assert turned.rollers is not None
    first, second = (pc.rollout(kind(problem), frames=8) for problem in (straight, turned))
    size = np.abs(first.positions - first.points).max()
    assert size > 0.005
    np.testing.assert_allclose(second.positions, first.positions @ TURN.T, atol=2e-4 * size)
    works = [pc.metrics.energy_balance(run).clamp_work for run in (first, second)]
    np.testing.assert_allclose(works[1], works[0], atol=1e-9 + 0.02 * abs(works[0]).max())


def test_reactions_are_those_of_the_turned_block():
    found = []
    for problem in problems():
        run = pc.rollout(pc.ProjectiveDynamics(problem, 1e-9), frames=3)
        found.append(pc.reactions(problem, run.state()))
    scale = abs(found[0]).max()
    assert found[0][:, 2].sum() > 0
    np.testing.assert_allclose(found[1], found[0] @ TURN.T, atol=1e-3 * scale)
    assert (found[1][~np.isin(np.arange(24), BOTTOM)] == 0).all()


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "generalised-alpha"])
def test_derivatives_through_rollers_are_differences(integrator):
    _, turned = problems(integrator, PUSH)
    stepper, rng = pc.Newton(turned, 1e-11), np.random.default_rng(0)
    start = stepper(turned.rest_state()).state
    by_positions, by_velocities, way = rng.normal(size=(3, *turned.positions.shape))
    result, e = stepper(start), 1e-6
    found = pc.adjoint(
        stepper, start, result, by_positions, 1e-2 * by_velocities, tolerance=1e-12
    )  # fmt: skip

    def loss(state):
        end = stepper(state).state
        return np.vdot(by_positions, end.positions) + 1e-2 * np.vdot(by_velocities, end.velocities)

    for name in ("positions", "velocities"):
        moved = [replace(start, **{name: getattr(start, name) + s * e * way}) for s in (1, -1)]
        slope = (loss(moved[0]) - loss(moved[1])) / (2 * e)
        assert np.vdot(getattr(found, name), way) == pytest.approx(slope, rel=1e-5)


def test_rollers_hold_statics_or_are_missed():
    corner = [{"region": {"nodes": [0]}, "normal": n} for n in ([1, 1, 0], [1, -1, 0], [0, 0, 1])]
    more = [{"region": {"nodes": [i]}, "normal": n} for i, n in ((18, [0, 1, 1]), (18, [0, 1, -1]))]
    last = [{"region": {"nodes": [2]}, "normal": [0, 1, 0]}]
    scene = beam((3, 1, 2), time={"step": 0.1, "integrator": "quasi-static"})
    held = pc.Newton(pc.discretise(scene.with_changes(clamps=corner + more + last)))
    assert held(held.problem.rest_state()).status.ok
    with pytest.raises(SceneError, match="turn about"):
        pc.Newton(pc.discretise(scene.with_changes(clamps=corner + more)))


def test_scenes_with_rollers_are_read_again():
    scene = beam(clamps=[{"region": {"plane": "x", "at": "min"}, "normal": [1, 0, 1]}])
    assert pc.Scene.from_toml(scene.to_toml()) == scene


def test_wrong_rollers_are_refused():
    for clamp, key in (
        ({"normal": [0, 0, 0]}, "normal"),
        ({"normal": [1, 0, 1], "components": ["x"]}, "components"),
    ):
        with pytest.raises(SceneError, match=key):
            beam(clamps=[{"region": {"plane": "x", "at": "min"}, **clamp}])
    _, turned = problems()
    for options in ({"method": "local-global"}, {"first_hessian": "G"}, {"backend": "splu"}):
        with pytest.raises(InputError, match="rollers"):
            pc.ProjectiveDynamics(turned, **options)


@pytest.mark.parametrize("integrator", ["backward-euler", "midpoint", "generalised-alpha"])
def test_clamps_and_rollers_of_one_node_share_its_reaction(integrator):
    """Two directions that are not at right angles hold a node as those along two axes do."""
    end = {"region": {"plane": "x", "at": "min"}}
    course = {"motion": {**PUSH, "displacement": [[d[2], 0, 0] for d in PUSH["displacement"]]}}
    scene = beam(
        (3, 1, 2),
        clamps=[{**end, "components": ["x", "z"], **course}],
        loads=[{"kind": "gravity", "acceleration": [1, 1, -9]}],
        material={"young": 2e4},
        time={"step": 0.01, "integrator": integrator},
        solver={"element": "hex8-enhanced", "mass": "averaged", "tolerance": 1e-8},
    )
    oblique = [{**end, "components": ["x"], **course}, {**end, "normal": [1, 0, 1], **course}]
    twice = [{**end, "normal": n, **course} for n in ([1, 0, 2], [1, 0, -1])]
    found = []
    for clamps in (scene.clamps, oblique, twice):
        problem = pc.discretise(scene.with_changes(clamps=clamps))
        run = pc.rollout(pc.Newton(problem), frames=6)
        rate = (run.velocities[-1] - run.velocities[-2]) / 0.01
        works = pc.metrics.energy_balance(run).clamp_work
        forces = [pc.reactions(problem, run.state(), a) for a in (rate, None)]
        found.append([works, run.positions[-1], run.velocities[-1], *forces])
    for others in found[1:]:
        for k, (expected, got) in enumerate(zip(found[0], others, strict=True)):
            close = 1e-3 if k else 0.03  # works: the clamps' accelerations are others
            np.testing.assert_allclose(got, expected, atol=close * np.abs(expected).max())


def test_runs_start_along_their_rollers():
    for problem in problems(initial={"velocity": [1, 1, 1]}):
        speeds = problem.initial_state().velocities
        normal = TURN[:, 2] if problem.rollers else np.array([0, 0, 1.0])
        np.testing.assert_allclose(speeds[BOTTOM] @ normal, 0, atol=1e-12)
        assert np.abs(speeds[BOTTOM]).max() > 0.1


def test_a_step_in_parts_remembers_forces_without_those_of_rollers():
    _, problem = problems()
    stepper = pc.Newton(problem, 1e-9)
    state = stepper(problem.rest_state()).state
    whole = stepper(state).state.memory["internal_forces"]
    parts = stepper._substeps(state, None, stepper.time_step, Counter()).state
    size = np.abs(whole).max()
    np.testing.assert_allclose(parts.memory["internal_forces"], whole, atol=0.2 * size)

"""Contact with obstacles: geometry, derivatives, statics, friction, impact, bad input."""

import numba
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, slow_unless
from pdcorrect.errors import InputError, PdcorrectWarning, SceneError
from pdcorrect.fem import contact, obstacles
from pdcorrect.fem.contact import barrier
from pdcorrect.fem.obstacles import RigidObstacle
from pdcorrect.scene import Box, Cylinder, Plane, Sphere
from pdcorrect.solvers import contact as friction
from pdcorrect.solvers.implicit import _Effort
from pdcorrect.solvers.tangent_solver import TangentFactory

MOTION = {
    "times": [0, 1], "displacement": [[0, 0, 0], [0.1, 0, 0.2]], "rotation": [0, 50], "axis": "y",
}  # fmt: skip
SHAPES = {
    "plane": Plane(shape="plane", point=[0, 0, 0.1], normal=[1, 2, 3.0]),
    "sphere": Sphere(shape="sphere", centre=[0.1, 0, 0], radius=0.3, motion=MOTION),
    "cylinder": Cylinder(
        shape="cylinder", centre=[0, 0.1, 0], axis=[1, 1, 0], radius=0.2, length=0.5, motion=MOTION
    ),
    "bar": Cylinder(shape="cylinder", centre=[0, 0.1, 0], axis=[1, 1, 0], radius=0.2),
    "box": Box(shape="box", box=[[-0.2, -0.3, -0.1], [0.2, 0.1, 0.4]], motion=MOTION),
}
FLOOR = {"shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1]}
TIME = 0.5
WAY = np.array([0.3, 0.5, -1.0])


def block(obstacles=(FLOOR,), height=0.0, gravity=(0.0, 0.0, -9.81), cells=(2, 2, 1), **changes):
    """A soft block of 5 cm cells above z = 0."""
    body = {"cells": list(cells), "cell_size": 0.05, "origin": [0, 0, height]}
    settings = {
        "body": body,
        "material": {"young": 5e4, "poisson": 0.3},
        "time": {"step": 0.005},
        "clamps": [],
        "loads": [{"kind": "gravity", "acceleration": list(gravity)}],
        "solver": {"element": "hex8-enhanced", "mass": "averaged"},
        "obstacles": list(obstacles),
    }
    return beam(**{**settings, **changes})


def outside(obstacle, count=200):
    x = np.random.default_rng(0).normal(size=(count, 3))
    return x[obstacle.gaps(x, TIME) > 0.05]


@pytest.mark.parametrize("shape", SHAPES)
def test_derivatives_of_gaps_are_those_of_differences(shape):
    obstacle, e = RigidObstacle(SHAPES[shape]), 1e-6
    x = outside(obstacle)
    first, second = obstacle.derivatives(x, TIME)
    moved = [(x + e * axis, x - e * axis) for axis in np.eye(3)]
    gaps = [obstacle.gaps(a, TIME) - obstacle.gaps(b, TIME) for a, b in moved]
    slopes = [obstacle.derivatives(a, TIME)[0] - obstacle.derivatives(b, TIME)[0] for a, b in moved]
    np.testing.assert_allclose(first, np.stack(gaps, axis=1) / (2 * e), atol=1e-8)
    np.testing.assert_allclose(second, np.stack(slopes, axis=2) / (2 * e), atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
def test_paths_stop_where_sampling_finds_the_surface(shape):
    obstacle = RigidObstacle(SHAPES[shape])
    x = outside(obstacle)
    ways = np.random.default_rng(1).normal(size=x.shape) - x
    shares = np.linspace(0, 1, 4001)
    for start, way in zip(x, ways, strict=True):
        gaps = obstacle.gaps(start + shares[:, None] * way, TIME)
        sampled = shares[np.argmax(gaps < 0)] if (gaps < 0).any() else 1.0
        found = min(1.0, obstacle.first_hit(start[None], way[None], TIME))
        assert abs(found - sampled) < 2 * shares[1] or (  # a graze between samples
            sampled == 1.0 and gaps.min() < 1e-3
        )


def test_the_barrier_joins_zero_with_two_derivatives():
    s, e = np.linspace(0.05, 0.99, 50), 1e-6
    value, first, second = barrier(s)
    np.testing.assert_allclose(first, (barrier(s + e)[0] - barrier(s - e)[0]) / (2 * e), rtol=1e-5)
    np.testing.assert_allclose(second, (barrier(s + e)[1] - barrier(s - e)[1]) / (2 * e), rtol=1e-5)
    assert min(value.min(), -first.max(), second.min()) > 0
    np.testing.assert_allclose(np.stack(barrier(np.array([1.0, 2.0]))), 0.0)
    np.testing.assert_allclose(np.stack(barrier(np.array([1 - 1e-4]))), 0.0, atol=1e-3)
    assert np.isinf(barrier(np.array([0.0, -1.0]))[0]).all()


@pytest.mark.parametrize("element", ["hex8", "hex8-enhanced", "hex27"])
@pytest.mark.parametrize("refine", [1, 2])
def test_contact_points_share_the_whole_surface(element, refine):
    problem = pc.discretise(block(), refine, element=element, mass="lumped")
    points = problem.contact.points
    assert points.areas.sum() == pytest.approx(2 * 0.1 * 0.1 + 4 * 0.1 * 0.05, rel=1e-12)
    np.testing.assert_allclose(points.operator.sum(axis=1), 1.0)
    at = points.operator @ problem.positions
    by_cell = np.einsum("pk,pki->pi", points.local, problem.positions[problem.cells[points.cells]])
    np.testing.assert_allclose(by_cell, at, atol=1e-15)
    assert len(np.unique(at.round(9), axis=0)) == len(at)


def pressed(integrator, friction=0.4):
    """A block between a turning plane and a ball that moves down, some steps after the start."""
    plane = {"times": [0, 1], "displacement": [[0, 0, 0], [1, 0, 0.2]], "rotation": [0, 20]}
    ball = {"times": [0, 1], "displacement": [[0, 0, 0], [0.1, 0, -0.25]]}
    obstacles = [
        {**FLOOR, "normal": [0.1, 0, 1], "friction": friction, "motion": plane},
        {"shape": "sphere", "centre": [0.05, 0.025, 0.2], "radius": 0.139, "friction": friction,
         "motion": ball},
    ]  # fmt: skip
    scene = block(obstacles, 0.01, cells=(2, 1, 1), time={"step": 0.004, "integrator": integrator})
    problem = pc.discretise(scene)
    stepper = pc.Newton(problem, 1e-13)
    state = problem.initial_state()
    state = pc.State(state.positions, state.velocities + np.array([0.5, 0.1, -0.3]), 0.0)
    for _ in range(8):
        result = stepper(state)
        assert result.status.ok
        state = result.state
    gaps = problem.contact.gaps(state.positions, state.time).min(axis=1)
    assert (gaps < problem.contact.distances).all()
    return scene, stepper, state


@pytest.mark.parametrize(
    "integrator",
    slow_unless(
        ("generalised-alpha", "backward-euler"),
        ("generalised-alpha", "backward-euler", "bdf2", "midpoint"),
    ),
)
def test_adjoint_gradients_are_those_of_differences(integrator):
    scene, stepper, state = pressed(integrator)
    rng, shape = np.random.default_rng(1), state.positions.shape
    by = {"positions": rng.normal(size=shape), "velocities": 0.01 * rng.normal(size=shape)}
    result = stepper(state)
    found = pc.adjoint(stepper, state, result, by["positions"], by["velocities"], tolerance=1e-11)

    def loss(stepper=stepper, forces=None, **changes):
        before = pc.State(
            changes.get("positions", state.positions), changes.get("velocities", state.velocities),
            state.time, state.memory,
        )  # fmt: skip
        after = stepper(before, forces).state
        return sum(np.vdot(g, getattr(after, name)) for name, g in by.items())

    def other(i, key, t):
        obstacles = [o.model_dump(exclude_none=True) for o in scene.obstacles]
        if isinstance(key, str):
            obstacles[i]["friction"] += t
        else:
            ways = np.array(obstacles[i]["motion"]["displacement"]) + t * np.array(key)
            obstacles[i]["motion"]["displacement"] = ways.tolist()
        problem = pc.discretise(scene.with_changes(obstacles=obstacles))
        return loss(pc.Newton(problem, 1e-13))

    def differs(function, e, exact):
        assert (function(e) - function(-e)) / (2 * e) == pytest.approx(exact, rel=2e-4)

    d = rng.normal(size=shape)
    differs(lambda t: loss(positions=state.positions + t * d), 1e-8, np.vdot(found.positions, d))
    differs(lambda t: loss(velocities=state.velocities + t * d), 1e-6, np.vdot(found.velocities, d))
    differs(lambda t: loss(forces=t * d), 1e-4, np.vdot(found.forces, d))
    for i in (0, 1):
        differs(lambda t, i=i: other(i, "friction", t), 1e-4, found.friction[i])
        differs(lambda t, i=i: other(i, WAY, t), 1e-8, found.obstacle_positions[i] @ WAY)
    if integrator == "backward-euler":
        problem = stepper.problem
        differs(
            lambda t: loss(pc.Newton(problem, 1e-13, time_step=0.004 + t)), 1e-8, found.time_step
        )


@pytest.mark.parametrize("stepper", [pc.Newton, pc.ProjectiveDynamics])
def test_a_block_at_rest_carries_its_weight(stepper):
    problem = pc.discretise(block(damping={"viscosity": 0.02}, time={"step": 0.01}))
    run = pc.rollout(stepper(problem), frames=100)
    state = run.state(-1)
    assert np.abs(state.velocities).max() < 1e-5
    weight = 9.81 * problem.mass.sum()
    force = pc.contact_forces(problem, state)
    assert force.shape == (1, len(problem.mass), 3)
    np.testing.assert_allclose(force.sum(axis=(0, 1)), [0, 0, weight], atol=1e-3 * weight)
    assert state.positions[:, 2].min() > -1e-3 * 0.05
    assert run.stats["smallest_gap"].min() > 0


@pytest.mark.parametrize(
    ("stepper", "degrees", "friction"),
    slow_unless(
        [(pc.ProjectiveDynamics, 30, 0.3), (pc.Newton, 20, 0.2), (pc.ProjectiveDynamics, 20, 0.5)],
        [
            (stepper, *pair)
            for stepper in (pc.Newton, pc.ProjectiveDynamics)
            for pair in ((30, 0.3), (20, 0.2), (20, 0.5))
        ],
    ),
)
def test_sliding_on_an_incline_obeys_coulomb(stepper, degrees, friction):
    a, g = np.radians(degrees), 9.81
    gravity = (g * np.sin(a), 0.0, -g * np.cos(a))
    scene = block([{**FLOOR, "friction": friction}], 0.0, gravity, damping={"viscosity": 0.02})
    problem = pc.discretise(scene)
    run = pc.rollout(stepper(problem), frames=60)
    speeds = run.velocities[:, :, 0] @ problem.mass / problem.mass.sum()
    if np.tan(a) < friction:
        assert abs(speeds[-1]) < problem.contact.slips[0]
        return
    acceleration = (speeds[-1] - speeds[30]) / (run.times[-1] - run.times[30])
    assert acceleration == pytest.approx(g * (np.sin(a) - friction * np.cos(a)), rel=0.01)
    assert (run.stats["friction_loss"][31:] > 0).all()


def test_a_rebound_loses_the_less_energy_the_shorter_its_steps():
    floor = {**FLOOR, "distance": 0.01, "stiffness": 5e4}
    lost = []
    for step in (1e-3, 2.5e-4):
        scene = block([floor], 0.02, cells=(1, 1, 1), time={"step": step, "spectral_radius": 1.0})
        run = pc.rollout(pc.Newton(pc.discretise(scene), 1e-8), frames=round(0.16 / step))
        balance = pc.metrics.energy_balance(run)
        assert balance.contact.max() > 0.1 * balance.total.max()
        lost.append(balance.dissipation[-1] / balance.external_work.max())
    assert 0.0 < lost[1] < 0.6 * lost[0]


@pytest.mark.parametrize(
    ("shape", "integrator"),
    [
        ("sphere", "bdf2"), ("cylinder", "midpoint"), ("box", "backward-euler"),
        *((shape, "generalised-alpha") for shape in ("sphere", "cylinder", "box", "plane")),
    ],
)  # fmt: skip
def test_nothing_is_entered_or_crossed_at_high_speed(shape, integrator):
    thin = {
        "plane": FLOOR,
        "sphere": {"shape": "sphere", "centre": [0.04, 0.06, -0.03], "radius": 0.03},
        "cylinder": {"shape": "cylinder", "centre": [0.04, 0.06, -0.01], "axis": [1, 1, 0],
                     "radius": 0.01},
        "box": {"shape": "box", "box": [[-1, -1, -0.001], [1, 1, 0.0]]},
    }[shape]  # fmt: skip
    scene = block(
        [{**thin, "friction": 0.2}], 0.03, time={"step": 0.01, "integrator": integrator},
        initial={"velocity": [0, 0, -3.0 if shape == "sphere" else -8.0]},
    )  # fmt: skip
    problem = pc.discretise(scene)
    run = pc.rollout(pc.ProjectiveDynamics(problem), frames=15)
    assert np.isfinite(run.positions).all()
    x = problem.contact
    gaps = [x.gaps(p, t).min() for p, t in zip(run.positions, run.times, strict=True)]
    assert min(gaps) > 0
    assert set(run.stats["status"]) <= {"CONVERGED", "RECOVERED", "INVERTED"}
    if shape in ("plane", "box"):
        assert run.positions[:, :, 2].min() > 0


def test_a_gripper_lifts_what_it_squeezes():
    """Two boxes close, hold by friction alone and lift."""

    def jaw(sign):
        x = [-0.06, -0.01] if sign < 0 else [0.11, 0.16]
        ways = [[0, 0, 0], [-sign * 0.015, 0, 0], [-sign * 0.015, 0, 0.05]]
        return {
            "shape": "box", "box": [[x[0], -0.02, -0.02], [x[1], 0.12, 0.07]], "friction": 0.8,
            "motion": {"times": [0, 0.1, 0.3], "displacement": ways},
        }  # fmt: skip

    scene = block([FLOOR, jaw(-1), jaw(1)], damping={"viscosity": 0.03}, time={"step": 0.01})
    problem = pc.discretise(scene)
    run = pc.rollout(pc.ProjectiveDynamics(problem), frames=55)
    rise = (run.positions[-1] - problem.positions)[:, 2] @ problem.mass / problem.mass.sum()
    assert 0.045 < rise < 0.055
    weight = 9.81 * problem.mass.sum()
    pairs = [(run.state(k), run.state(k - 1)) for k in range(46, 56)]
    each = [pc.contact_forces(problem, *pair).sum(axis=1) for pair in pairs]
    forces = np.mean(each, axis=0)
    np.testing.assert_allclose(forces[0], 0, atol=1e-9)
    np.testing.assert_allclose(forces[1:, 2].sum(), weight, rtol=0.05)
    np.testing.assert_allclose(forces[1, 0], -forces[2, 0], rtol=0.05)


def test_energy_of_a_lifted_block_is_the_work_of_what_lifts_it():
    lift = {"times": [0, 0.1], "displacement": [[0, 0, 0], [0.02, 0, 0.05]]}
    floor = {**FLOOR, "friction": 0.5, "motion": lift}
    scene = block([floor], damping={"viscosity": 0.01}, time={"step": 0.001})
    run = pc.rollout(pc.Newton(pc.discretise(scene), 1e-7), frames=100)
    balance = pc.metrics.energy_balance(run)
    work = balance.obstacle_work[-1]
    assert work > 9.81 * 0.5 * 0.05
    assert 0.0 < balance.dissipation[-1] < 0.1 * work
    stored = balance.total[-1] - balance.total[0]
    lost = balance.damping_loss[-1] + balance.friction_loss[-1] + balance.dissipation[-1]
    assert stored == pytest.approx(work + balance.external_work[-1] - lost, rel=1e-12)


def test_a_step_in_parts_leaves_contact_out_of_what_it_remembers():
    scene = block(damping={"viscosity": 0.02}, time={"step": 0.01})
    stepper = pc.Newton(pc.discretise(scene), 1e-8)
    state = pc.rollout(stepper, frames=100).state(-1)
    whole, parts = stepper(state).state, stepper._substeps(state, None, 0.01, _Effort()).state
    difference = parts.memory["internal_forces"] - whole.memory["internal_forces"]
    np.testing.assert_allclose(difference, 0, atol=1e-3)
    assert np.abs(stepper(parts).state.velocities).max() < 1e-4


@pytest.mark.parametrize(("height", "speed", "step"), [(0.02, -2.0, 0.01), (0.04, -4.0, 0.01)])
def test_a_path_that_ends_on_the_surface_is_stepped_whole(height, speed, step):
    scene = block(
        [FLOOR], height, gravity=(0, 0, 0), initial={"velocity": [0, 0, speed]}, time={"step": step}
    )
    run = pc.rollout(pc.Newton(pc.discretise(scene)), frames=3)
    assert set(run.stats["status"]) == {"CONVERGED"}


@pytest.mark.parametrize("stepper", [pc.Newton, pc.ProjectiveDynamics])
def test_a_body_too_near_an_obstacle_is_pushed_away(stepper):
    """Newton's steps are as short as the gap there, far from the minimum."""
    problem = pc.discretise(block([FLOOR], 0.02, cells=(1, 1, 1)))
    state = problem.initial_state()
    near = pc.State(state.positions - np.array([0, 0, 0.02 - 1e-13]), state.velocities)
    result = stepper(problem)(near)
    assert result.status.ok
    assert result.stats["smallest_gap"] > 0.1 * problem.contact.distances[0]
    assert result.residual < 1e-3 * 9.81 * problem.mass.sum()


KERNELS = {
    contact: ["barrier", "_add_product", "_add_blocks"],
    friction: ["_friction", "_friction_tangent"],
    obstacles: ["_gaps", "_derivatives", "_first_hit"],
}


@pytest.mark.parametrize("stepper", [pc.Newton, pc.ProjectiveDynamics])
def test_the_first_step_that_touches_compiles_nothing(stepper, monkeypatch):
    run = set()

    def watch(module, name):
        kernel = getattr(module, name)

        def watched(*args):
            run.add((name, *map(numba.typeof, args)))
            return kernel(*args)

        monkeypatch.setattr(module, name, watched)

    for module, names in KERNELS.items():
        for name in names:
            watch(module, name)
    falling = block([{**FLOOR, "friction": 0.4}], 1e-3, initial={"velocity": [0, 0, -1.0]})
    problem = pc.discretise(falling)
    made = stepper(problem).prepare()
    prepared = set(run)
    assert made(problem.initial_state()).stats["contact_energy"] > 0.0
    assert run == prepared


@pytest.mark.parametrize("stepper", [pc.Newton, pc.ProjectiveDynamics])
def test_a_column_that_a_plate_squeezes_ends_at_a_minimum(stepper):
    """Straight it would be at a saddle, along which no force shows the way down."""
    plate = {
        "shape": "plane", "point": [0, 0, 0.25], "normal": [0, 0, -1],
        "motion": {"times": [0, 1], "displacement": [[0, 0, 0], [0, 0, -0.03]]},
    }  # fmt: skip
    foot = [{"region": {"plane": "z", "at": "min"}}]
    still = {"step": 1.0, "integrator": "quasi-static"}
    scene = block([plate], gravity=(0, 0, 0), cells=(1, 1, 5), clamps=foot, time=still)
    problem = pc.discretise(scene)
    moved, state = stepper(problem), problem.initial_state()
    result = moved(state)
    assert result.status.ok
    aside = np.abs(result.state.positions - problem.positions)[:, :2].max()
    assert aside > 0.1 * problem.cell_size
    y = np.concatenate([result.state.positions, result.modes])
    _, exact = TangentFactory(problem).factorise(moved.objective(state, None, 1.0), y)
    assert exact


def test_a_moving_plate_does_not_pass_through_a_body():
    plate = {
        "shape": "box", "box": [[-0.2, -0.2, 0.0], [0.3, 0.3, 0.005]],
        "motion": {"times": [0, 0.024], "displacement": [[0, 0, 0], [0, 0, 0.24]]},
    }  # fmt: skip
    scene = block([plate], 0.05, gravity=(0, 0, 0), time={"step": 0.012})
    problem = pc.discretise(scene)
    run = pc.rollout(pc.ProjectiveDynamics(problem), frames=4)
    assert run.positions[-1][:, 2].min() > 0.24


def test_a_run_goes_on_bit_for_bit_from_a_file(tmp_path):
    lift = {"times": [0, 1], "displacement": [[0, 0, 0], [0.3, 0, 0.2]], "rotation": [0, 20]}
    scene = block([{**FLOOR, "friction": 0.4, "motion": lift}], cells=(2, 1, 1))
    whole = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)), frames=10)
    assert (whole.stats["smallest_gap"] < 5e-4).sum() > 5  # it hops in between
    part = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)), frames=6)
    pc.save_trajectory(tmp_path / "run.h5", part)
    half, again = pc.load_trajectory(tmp_path / "run.h5"), pc.Scene.from_toml(scene.to_toml())
    assert again == scene
    rest = pc.rollout(pc.ProjectiveDynamics(pc.discretise(again)), 4, state=half.state(-1))
    np.testing.assert_array_equal(rest.positions[1:], whole.positions[7:])
    np.testing.assert_array_equal(rest.velocities[1:], whole.velocities[7:])


@pytest.mark.parametrize("element", ["hex8", "hex27"])
def test_held_points_take_no_part(element):
    clamps = [{"region": {"plane": "z", "at": "max"}}]
    free, held = (
        pc.discretise(block(clamps=c), element=element, mass="lumped").contact.points
        for c in ([], clamps)
    )
    assert free.areas.sum() - held.areas.sum() == pytest.approx(
        0.1 * 0.1 + 4 * 0.1 * 0.025 / 3, rel=1e-9
    )  # the face, and a sixth of the height of the cells beside it


def test_a_body_that_falls_past_an_obstacle_moves_as_without_it():
    far = [{"shape": "sphere", "centre": [1.0, 1.0, 1.0], "radius": 0.1, "friction": 0.5}]
    with_it, without = (
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(block(o, 0.5))), frames=5) for o in (far, [])
    )
    np.testing.assert_allclose(with_it.positions, without.positions, atol=1e-9)
    assert "smallest_gap" not in without.stats


@pytest.mark.parametrize(
    ("obstacle", "key"),
    [
        ({**FLOOR, "normal": [0, 0, 0]}, "normal"),
        ({**FLOOR, "friction": -0.1}, "friction"),
        ({**FLOOR, "distance": 0.0}, "distance"),
        ({"shape": "cone", "point": [0, 0, 0]}, "shape"),
        ({"shape": "sphere", "centre": [0, 0, 0], "radius": 0}, "radius"),
        ({"shape": "cylinder", "centre": [0, 0, 0], "axis": [0, 0, 0], "radius": 1}, "axis"),
        ({"shape": "box", "box": [[0, 0, 0], [1, 0, 1]]}, "box"),
        ({**FLOOR, "normal": [0, 0, 1e-200]}, "normal"),
        ({**FLOOR, "point": [0, 0, 0.01]}, "obstacles[0]"),
        ({"shape": "box", "box": [[0, 0, -8e-4], [1, 1, 0]]}, "distance"),
    ],
)
def test_wrong_obstacles_are_refused_by_name(obstacle, key):
    with pytest.raises(SceneError) as refused:
        pc.discretise(block([obstacle]))
    assert key in str(refused.value)


def test_batches_and_correctors_refuse_obstacles():
    pytest.importorskip("torch")
    solver, time = {"element": "hex27"}, {"step": 0.01, "substeps": 2}
    problem = pc.discretise(block(solver=solver, time=time))
    with pytest.raises(InputError, match="obstacles"):
        pc.BatchStepper([problem])
    with pytest.raises(InputError) as refused:
        pc.HybridStepper(pc.ProjectiveDynamics(problem), None)
    for reason in ("obstacles", "27 nodes", "substeps = 2"):  # all in one
        assert reason in str(refused.value)


def test_small_obstacles_are_warned_of():
    ball = {"shape": "sphere", "centre": [0.05, 0.05, -0.02], "radius": 0.01}
    with pytest.warns(PdcorrectWarning, match=r"obstacles\[0\]"):
        pc.discretise(block([ball]))


def test_what_obstacles_exclude_is_refused():
    problem = pc.discretise(block())
    state = problem.initial_state()
    with pytest.raises(InputError, match="obstacles"):
        pc.ProjectiveDynamics(problem, method="local-global")
    with pytest.raises(InputError, match="before"):
        pc.contact_forces(problem, state, state)
    inside = pc.State(state.positions - np.array([0, 0, 0.01]), state.velocities)
    with pytest.raises(InputError, match=r"obstacles\[0\]"):
        pc.contact_forces(problem, inside)
    result = pc.Newton(problem)(inside)
    assert result.status is pc.Status.NOT_FINITE
    problem = pc.discretise(block([]))  # where there are none
    stepper, state = pc.Newton(problem), problem.initial_state()
    found = pc.adjoint(stepper, state, stepper(state), np.ones_like(state.positions))
    with pytest.raises(InputError, match="obstacles"):
        _ = found.friction
    with pytest.raises(InputError, match="obstacles"):
        pc.contact_forces(problem, state)

"""Loads over a step: momentum of an impulse, order in time, and loads that follow the body."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from pdcorrect.solvers import follower

SECOND = ["bdf2", "midpoint", "generalised-alpha"]
ALL = ["backward-euler", *SECOND]
CELL = 0.05


def beam(cells=(3, 2, 2), *, held=True, **sections):
    """A soft beam of the best coarse model, held at x = 0 or free."""
    given = {
        "body": {"shape": "beam", "cells": list(cells), "cell_size": CELL},
        "material": {"young": 1e5, "poisson": 0.4, "density": 1e3},
        "clamps": [{"region": {"plane": "x", "at": 0.0}}] if held else [],
        "solver": {"element": "hex8-bubble", "mass": "averaged", "tolerance": 1e-9},
    }
    return pc.discretise(pc.Scene(**given, **sections))


def momentum(problem, velocities):
    return (problem.mass[:, None] * velocities).sum(axis=0)


# --- impulses ------------------------------------------------------------------------------


def pushed(integrator, step, duration, start=0.0):
    load = {
        "kind": "body-force", "density": [0.0, 300.0, 500.0], "window": [start, start + duration],
    }  # fmt: skip
    time = {"step": step, "frames": 40, "integrator": integrator}
    problem = beam((2, 1, 1), held=False, time=time, loads=[load])
    wanted = 2 * CELL**3 * duration * np.array([0.0, 300.0, 500.0])
    return problem, wanted


@pytest.mark.parametrize("integrator", ALL)
@pytest.mark.parametrize("start", [0.0, 0.013])
@pytest.mark.parametrize(("step", "duration"), [(0.01, 0.003), (0.01, 0.025), (0.004, 0.01)])
def test_a_body_has_the_momentum_of_the_impulse_at_any_step(integrator, step, duration, start):
    problem, wanted = pushed(integrator, step, duration, start)
    run = pc.rollout(pc.ProjectiveDynamics(problem))
    found = momentum(problem, run.velocities[-1])
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("integrator", ["backward-euler", "midpoint"])
def test_one_step_methods_have_it_after_every_step(integrator):
    problem, wanted = pushed(integrator, 0.01, 0.003)
    run = pc.rollout(pc.ProjectiveDynamics(problem), 3)
    for velocities in run.velocities[1:]:
        assert momentum(problem, velocities) == pytest.approx(wanted, rel=1e-6, abs=1e-12)


def test_a_transient_after_an_impulse_dies_out_as_powers_of_the_scheme():
    problem, wanted = pushed("generalised-alpha", 0.01, 0.003)
    run = pc.rollout(pc.ProjectiveDynamics(problem), 12)
    off = np.array([momentum(problem, v)[2] for v in run.velocities[1:]]) / wanted[2] - 1.0
    assert off[1:] / off[:-1] == pytest.approx(-0.5, rel=1e-3)  # (1 - 2 r)/(2 - r) at r = 0.8
    assert abs(off[0]) < 0.06


# --- loads that follow the body ------------------------------------------------------------

TIMES = np.linspace(0.0, 0.5, 501)
SMOOTH = np.column_stack([TIMES, np.sin(np.pi * TIMES / 0.4) ** 4]).tolist()
FOLLOWERS = {
    "pressure": {
        "kind": "pressure", "pressure": 2.5e3, "region": {"plane": "z", "at": 2 * CELL},
    },
    "torsion": {"kind": "torsion", "strength": 3e4, "attraction": 0.3},
}  # fmt: skip


def followed(name, integrator, **time):
    load = {**FOLLOWERS[name], "follower": True, "table": SMOOTH}
    return beam((3, 1, 2), time={"step": 0.02, "frames": 10, "integrator": integrator, **time},
                loads=[load])  # fmt: skip


@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        *(("pressure", integrator) for integrator in ALL),
        ("torsion", "generalised-alpha"),
        *(pytest.param("torsion", integrator, marks=pytest.mark.slow) for integrator in ALL[:3]),
    ],
)
def test_loads_that_follow_keep_the_order_in_time(name, integrator):
    problem = followed(name, integrator)
    ends = []
    for steps in (40, 80, 160):
        stepper = pc.Newton(problem, 1e-8, time_step=0.3 / steps)
        run = pc.rollout(stepper, steps)
        assert set(run.stats["status"]) == {"CONVERGED"}
        ends.append(run.positions[-1])
    changes = [np.linalg.norm(b - a) for a, b in pairwise(ends)]
    order = np.log2(changes[-2] / changes[-1])
    least, most = (0.5, 1.5) if integrator == "backward-euler" else (1.6, 2.6)
    assert least < order < most


@pytest.mark.parametrize("method", [pc.ProjectiveDynamics, pc.Newton])
@pytest.mark.parametrize("integrator", [*ALL, "quasi-static"])
def test_a_step_is_in_balance_with_the_loads_where_it_ends(integrator, method):
    problem = beam(
        time={"step": 0.02, "frames": 3, "integrator": integrator},
        loads=[{**load, "follower": True} for load in FOLLOWERS.values()],
    )
    stepper, state = method(problem, tolerance=1e-10), problem.rest_state()
    for _ in range(3):
        before, result = state, stepper(state)
        state = result.state
        assert result.status is pc.Status.CONVERGED
    objective = stepper.objective(before, None, stepper.time_step)
    scheme = stepper.integrate.scheme(before, stepper.time_step)
    y = problem.relaxed((state.positions - before.positions) / scheme.gain + before.positions)
    objective.follow(y)
    left = np.abs(objective.value_and_gradient(y)[1]).max()
    assert left < 1e-6 * np.abs(objective.forces).max()


def finger(frames):
    """A finger with a closed chamber above its middle, under pressure, held at one end."""
    occupancy = np.ones((10, 3, 4), dtype=int)
    occupancy[1:9, 1, 2] = 0
    c = 0.005
    chamber = [[c, c, 2 * c], [9 * c, 2 * c, 3 * c]]
    load = {
        "kind": "pressure", "pressure": 3e4, "follower": True, "region": {"box": chamber},
        "table": [[0.0, 0.0], [1.0, 1.0]],
    }  # fmt: skip
    return pc.discretise(
        pc.Scene(
            body={"shape": "voxels", "cell_size": c, "occupancy": occupancy.tolist()},
            material={"young": 2e5, "poisson": 0.45, "density": 1e3},
            clamps=[{"region": {"plane": "x", "at": "min"}}], loads=[load],
            time={"step": 1.0 / frames, "frames": frames, "integrator": "quasi-static"},
            solver={"element": "hex8-bubble", "mass": "averaged"},
        )
    )  # fmt: skip


def test_one_quasi_static_step_ends_where_eight_do():
    ends = []
    for frames in (1, 8):
        problem = finger(frames)
        run = pc.rollout(pc.ProjectiveDynamics(problem))
        assert set(run.stats["status"]) == {"CONVERGED"}
        ends.append(run.positions[-1] - problem.positions)
    assert np.abs(ends[1]).max() > 0.1 * problem.cell_size
    assert np.abs(ends[0] - ends[1]).max() < 1e-3 * np.abs(ends[1]).max()


def test_loads_that_do_not_settle_are_told(monkeypatch):
    monkeypatch.setattr(follower, "MOST", 1)
    problem = finger(1)
    result = pc.ProjectiveDynamics(problem)(problem.rest_state())
    assert result.status is pc.Status.ITERATION_LIMIT
    assert not result.status.ok


def test_loads_settle_at_a_tight_tolerance():
    """Where inner minima are as far off as the loads' changes are large."""
    scene = pc.Scene.load(Path(__file__).parents[1] / "examples" / "pressure_finger.toml")
    load = {**scene.loads[0].model_dump(exclude_none=True), "pressure": 3e4}
    problem = pc.discretise(scene.with_changes(loads=[load], time={"substeps": 1}))
    run = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-7), 4)
    assert set(run.stats["status"]) == {"CONVERGED"}

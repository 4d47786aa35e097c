"""What errors come to in the frames ahead: against modes, simulations and drifting bodies."""

from dataclasses import replace

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.modes import modes

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.training import scenes  # noqa: E402
from pdcorrect.training.losses import MODES, Vibrations, body_modes  # noqa: E402
from pdcorrect.training.scenes import (  # noqa: E402
    SceneGroup,
    SceneGroups,
    load_recordings,
)
from pdcorrect.training.unrolled import Rollouts, unroll  # noqa: E402

STEP = 0.01  # s
CPU = torch.device("cpu")


def held_beam(**changes):
    return pc.discretise(beam((6, 1, 1), loads=[], **changes))


def of_one(problem, steps=60, count=MODES, step=STEP):
    bodies = [body_modes(problem, count)]
    return Vibrations(bodies, [0], np.array([steps]), step, len(problem.positions), CPU)


def ahead(vibrations, positions, velocities):
    """Of one body, for arrays (N, 3)."""
    errors = (torch.from_numpy(np.array(x))[None] for x in (positions, velocities))
    return vibrations.ahead(*errors).item()


def simulated(problem, positions, velocities, steps):
    """Mean over steps and nodes of the squared distance from rest."""
    stepper = pc.ProjectiveDynamics(problem)
    state = replace(
        problem.rest_state(), positions=problem.positions + positions, velocities=velocities
    )
    total = 0.0
    for _ in range(steps):
        state = stepper(state).state
        total += ((state.positions - problem.positions) ** 2).sum(axis=1).mean()
    return total / steps


@pytest.mark.parametrize("mode", [0, 2, 3])
@pytest.mark.parametrize(("x", "y"), [(1.0, 0.0), (0.0, 1.0), (0.7, -0.5)])
def test_it_is_what_backward_euler_makes_of_a_mode(mode, x, y):
    problem = held_beam(time={"step": STEP, "integrator": "backward-euler", "frames": 1})
    found = modes(problem, 4)
    size = 1e-5 / np.abs(found.shapes[mode]).max()  # m: small strains
    e, v = x * size * found.shapes[mode], y * 30.0 * size * found.shapes[mode]
    for steps in (1, 5, 25):
        expected = simulated(problem, e, v, steps)
        assert ahead(of_one(problem, steps), e, v) == pytest.approx(expected, rel=2e-3)


def test_it_is_nearly_that_of_a_mix_of_modes_and_others_do_not_count():
    problem = held_beam(time={"step": STEP, "integrator": "backward-euler", "frames": 1})
    found, generator = modes(problem, 4), np.random.default_rng(4)
    e, v = (
        scale * np.einsum("m,mnd->nd", generator.normal(size=4), found.shapes)
        for scale in (1e-6, 3e-5)
    )
    expected = simulated(problem, e, v, 40)
    assert ahead(of_one(problem, 40), e, v) == pytest.approx(expected, rel=0.1)

    problem = held_beam()
    shapes, two = modes(problem, 4).shapes, of_one(problem, count=2)
    none = np.zeros_like(shapes[0])
    assert ahead(two, none, shapes[3]) < 1e-10 * ahead(two, none, shapes[0])


def test_a_body_without_clamps_drifts():
    """Rigid modes are orthogonal by mass and nearly so by node: what they share is left out."""
    problem = pc.discretise(beam((4, 1, 1), clamps=[], loads=[]))
    e, v = np.zeros((2, len(problem.positions), 3))
    e[:, 1], v[:, 1] = 0.2, 0.3
    drift = ((0.2 + 0.3 * STEP * np.arange(1, 31)) ** 2).mean()
    assert ahead(of_one(problem, 30), e, v) == pytest.approx(drift, rel=0.05)


def test_bodies_of_a_batch_are_independent():
    one, two = held_beam(), pc.discretise(beam((3, 2, 2), loads=[]))
    nodes = max(len(one.positions), len(two.positions))
    steps = np.array([60, 30, 40])
    both = Vibrations([body_modes(p) for p in (one, two)], (1, 0, 1), steps, STEP, nodes, CPU)
    x, v = np.random.default_rng(0).normal(size=(2, 3, nodes, 3))
    found = both.ahead(torch.from_numpy(x), torch.from_numpy(v))
    alone = [
        ahead(of_one(p, steps[i]), x[i, : len(p.positions)], v[i, : len(p.positions)])
        for i, p in enumerate((two, one, two))
    ]
    assert found.tolist() == pytest.approx(alone, rel=1e-5)


def test_a_body_with_few_free_components_has_fewer_modes():
    problem = pc.discretise(beam((1, 1, 1), loads=[]))
    free = int(problem.free.sum())
    assert len(body_modes(problem, free + 5).frequencies) == free - 1
    h, boxes = 0.02, ([0, 1, 1], [1, 0, 1], [1, 1, 0])  # of a cell: all nodes but one
    held = [{"region": {"box": [[0.0] * 3, [h * x for x in box]]}} for box in boxes]
    plane = {"region": {"box": [[0.0] * 3, [h] * 3]}, "components": ["x", "y"]}
    hinged = pc.discretise(beam((1, 1, 1), loads=[], clamps=[*held, plane]))
    assert hinged.free.sum() == 1
    assert len(body_modes(hinged).frequencies) == 0


# --- in a loss ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def recordings(folder):
    return load_recordings(folder, "training", "plain")


@pytest.fixture(scope="module")
def group(recordings):
    return SceneGroup(recordings, "plain", "cpu")


def started(group, frames):
    positions, velocities = group.states(frames)
    none = torch.zeros(group.nodes, 3, dtype=torch.float64)
    return Rollouts(positions, velocities, none, frames, np.zeros_like(frames))


@pytest.mark.parametrize("bend", [None, 0.3])
def test_it_is_added_over_the_error_of_the_base_models_rollout(group, folder, bend):
    frames = np.array([2, 7, 11])
    losses = {}
    for weight in (None, 0.7):
        stage = samples.unrolled(loss={"bend": bend, "ahead": weight})
        silent = samples.fitted(folder, samples.config(stage), silent=True)
        found = unroll(group, silent, started(group, frames), 1, stage)
        losses[weight] = found.losses if bend is None else bend * torch.expm1(found.losses / bend)
    truth, speeds = group.states(frames + 1)
    errors = found.end.positions - truth, found.end.velocities - speeds
    largest = torch.maximum(group.errors.rollout, group.errors.one_step)
    expected = group.vibrations.ahead(*errors) / largest
    assert (expected > 1e-3).all()
    torch.testing.assert_close(losses[0.7] - losses[None], 0.7 * expected)


def test_it_has_a_gradient(group, folder):
    frames, grads = np.array([0, 3, 5]), []
    corrector = samples.fitted(folder, samples.config(samples.unrolled()))
    for loss in ({}, {"ahead": 1.0}):
        stage = samples.unrolled(loss=loss, through_solver=True)
        corrector.network.zero_grad()
        unroll(group, corrector, started(group, frames), 2, stage).losses.mean().backward()
        grads.append(torch.cat([p.grad.flatten() for p in corrector.network.parameters()]))
    assert torch.isfinite(grads[1]).all()
    assert (grads[1] - grads[0]).norm() > 1e-3 * grads[0].norm()


def test_a_scene_that_fails_leaves_the_others_theirs(group, folder):
    stage = samples.unrolled(loss={"ahead": 1.0})
    silent = samples.fitted(folder, samples.config(stage), silent=True)
    frames = np.array([2, 7, 11])
    good = unroll(group, silent, started(group, frames), 1, stage)
    start = started(group, frames)
    start.positions[1] = torch.nan
    found = unroll(group, silent, start, 1, stage)
    assert found.alive.tolist() == [True, False, True]
    assert found.losses[1] == 0.0
    torch.testing.assert_close(found.losses[[0, 2]], good.losses[[0, 2]])


def test_modes_of_a_mesh_are_computed_once_or_the_recording_is_named(recordings, monkeypatch):
    asked = []

    def counted(problem):
        asked.append(problem)
        return body_modes(problem)

    monkeypatch.setattr(scenes, "body_modes", counted)
    groups = SceneGroups(recordings, "plain")
    for chosen in (recordings[:1], recordings, recordings[1:]):
        groups(chosen).vibrations  # noqa: B018
    assert len(asked) == len({r.path for r in recordings})

    def failing(problem):
        raise ConvergenceError("the search did not end.")

    monkeypatch.setattr(scenes, "body_modes", failing)
    with pytest.raises(ConvergenceError, match=r"training/mesh-0000/\d"):
        SceneGroup(recordings, "plain", "cpu").vibrations  # noqa: B018
    moved = SceneGroup(recordings, "plain", "cpu")
    moved.stepper.integrator = "midpoint"
    with pytest.raises(InputError, match="'midpoint'"):
        moved.vibrations  # noqa: B018

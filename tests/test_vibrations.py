"""How far velocities' errors swing bodies: against modes, simulations and drifting bodies."""

from dataclasses import replace

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.fem.modes import modes

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.training.losses import LEAST_ERROR  # noqa: E402
from pdcorrect.training.recordings import load_recordings  # noqa: E402
from pdcorrect.training.scenes import SceneGroup  # noqa: E402
from pdcorrect.training.unrolled import Rollouts, unroll  # noqa: E402
from pdcorrect.training.vibrations import MODES, Vibrations  # noqa: E402

LONG = 1e3  # s


def held_beam(**changes):
    return pc.discretise(beam((6, 1, 1), loads=[], **changes))


def of_one(problem, duration=LONG, count=MODES):
    nodes = len(problem.positions)
    device = torch.device("cpu")
    return Vibrations([problem], [0], np.array([duration]), nodes, device, count)


def test_a_mode_swings_by_its_velocity_over_its_frequency():
    problem = held_beam()
    found = modes(problem, 3)
    for shape, frequency in zip(found.shapes, found.frequencies, strict=True):
        amplitude = 0.5 / (2 * np.pi * frequency)
        expected = 0.5 * amplitude**2 * (shape**2).sum() / len(shape)
        reach = of_one(problem).reach(torch.from_numpy(0.5 * shape)[None])
        assert reach.tolist() == pytest.approx([expected], rel=1e-5)


def test_modes_that_are_left_out_do_not_count():
    problem = held_beam()
    shapes = torch.from_numpy(modes(problem, 4).shapes)
    two = of_one(problem, count=2)
    assert two.reach(shapes[3:4]).item() < 1e-10 * two.reach(shapes[:1]).item()


def test_it_is_what_a_simulation_comes_to():
    """Of the second-order integrator over whole periods, from rest with any small velocities."""
    step = 1e-3
    problem = held_beam(time={"step": step, "integrator": "midpoint", "frames": 1})
    generator = np.random.default_rng(4)
    smooth = modes(problem, 3)
    weights = generator.normal(size=3) * smooth.frequencies
    speeds = 1e-4 * np.einsum("m,mnd->nd", weights, smooth.shapes)
    steps = round(10 / smooth.frequencies[0] / step)
    stepper = pc.ProjectiveDynamics(problem)
    state = replace(problem.rest_state(), velocities=speeds)
    squares = []
    for _ in range(steps):
        state = stepper(state).state
        squares.append(((state.positions - problem.positions) ** 2).sum(axis=1).mean())
    reach = of_one(problem).reach(torch.from_numpy(speeds)[None]).item()
    assert np.mean(squares) == pytest.approx(reach, rel=0.05)


def test_a_body_without_clamps_drifts():
    """Rigid modes are orthogonal by mass and nearly so by node: what they share is left out."""
    problem = pc.discretise(beam((4, 1, 1), clamps=[], loads=[]))
    v = torch.zeros(1, len(problem.positions), 3, dtype=torch.float64)
    v[..., 1] = 0.3
    drift = (0.3 * 2.0) ** 2 / 3
    assert of_one(problem, duration=2.0).reach(v).item() == pytest.approx(drift, rel=0.05)


def test_bodies_of_a_batch_are_independent():
    one, two = held_beam(), pc.discretise(beam((3, 2, 2), loads=[]))
    nodes = max(len(one.positions), len(two.positions))
    both = Vibrations([one, two], [1, 0, 1], np.full(3, LONG), nodes, torch.device("cpu"))
    v = torch.from_numpy(np.random.default_rng(0).normal(size=(3, nodes, 3)))
    alone = [
        of_one(p).reach(v[i : i + 1, : len(p.positions)]).item()
        for i, p in enumerate((two, one, two))
    ]
    assert both.reach(v).tolist() == pytest.approx(alone, rel=1e-5)


def test_a_body_with_few_free_components_has_fewer_modes():
    problem = pc.discretise(beam((1, 1, 1), loads=[]))
    free = int(problem.free.sum())
    v = torch.from_numpy(1e-3 * problem.free[None].astype(float))
    assert of_one(problem, count=free + 5).reach(v).item() > 0.0


# --- in a loss ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def group(folder):
    return SceneGroup(load_recordings(folder, "training", "plain"), "plain", "cpu")


def started(group, frames):
    positions, velocities = group.states(frames)
    none = torch.zeros(group.nodes, 3, dtype=torch.float64)
    return Rollouts(positions, velocities, none, frames, np.zeros_like(frames))


@pytest.mark.parametrize("bend", [None, 0.3])
def test_it_is_added_over_the_error_of_the_base_models_rollout(group, folder, bend):
    frames = np.array([2, 7, 11])
    losses = {}
    for swing in (None, 0.7):
        stage = samples.unrolled(loss={"bend": bend, "swing": swing})
        silent = samples.fitted(folder, samples.config(stage), silent=True)
        found = unroll(group, silent, started(group, frames), 1, stage)
        losses[swing] = found.losses if bend is None else bend * torch.expm1(found.losses / bend)
    wrong = found.end.velocities - group.states(frames + 1)[1]
    reach = group.vibrations.reach(wrong)
    assert (reach > LEAST_ERROR).all()
    expected = 0.7 * reach / torch.maximum(group.errors.rollout, group.errors.one_step)
    torch.testing.assert_close(losses[0.7] - losses[None], expected)


def test_it_has_a_gradient(group, folder):
    stage = samples.unrolled(loss={"swing": 1.0}, through_solver=True)
    corrector = samples.fitted(folder, samples.config(stage))
    frames = np.array([0, 3, 5])
    unroll(group, corrector, started(group, frames), 2, stage).losses.mean().backward()
    plain = samples.unrolled(through_solver=True)
    grads = [p.grad.clone() for p in corrector.network.parameters()]
    corrector.network.zero_grad()
    unroll(group, corrector, started(group, frames), 2, plain).losses.mean().backward()
    others = [p.grad for p in corrector.network.parameters()]
    assert any(
        (a - b).abs().max() > 1e-6 * b.abs().max() for a, b in zip(grads, others, strict=True)
    )
    assert all(torch.isfinite(g).all() for g in grads)


def test_a_scene_that_fails_leaves_the_others_theirs(group, folder):
    stage = samples.unrolled(loss={"swing": 1.0})
    silent = samples.fitted(folder, samples.config(stage), silent=True)
    frames = np.array([2, 7, 11])
    good = unroll(group, silent, started(group, frames), 1, stage)
    start = started(group, frames)
    start.positions[1] = torch.nan
    found = unroll(group, silent, start, 1, stage)
    assert found.alive.tolist() == [True, False, True]
    assert found.losses[1] == 0.0
    torch.testing.assert_close(found.losses[[0, 2]], good.losses[[0, 2]])

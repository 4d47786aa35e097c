"""Training: what is minimised, by which rules, and that it goes on exactly where it stopped."""

import csv
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.corrector.bodies import KNOWN  # noqa: E402
from pdcorrect.corrector.features import View  # noqa: E402
from pdcorrect.corrector.gate import Gate  # noqa: E402
from pdcorrect.corrector.model_io import load_model, save_model  # noqa: E402
from pdcorrect.corrector.normaliser import Moments  # noqa: E402
from pdcorrect.data.schema import write_shard  # noqa: E402
from pdcorrect.data.shard_arrays import read_arrays  # noqa: E402
from pdcorrect.data.shard_reader import read_shard  # noqa: E402
from pdcorrect.errors import (  # noqa: E402
    ConvergenceError,
    FileFormatError,
    FileVersionError,
    InputError,
)
from pdcorrect.metrics import error_corrected  # noqa: E402
from pdcorrect.scene import Scene  # noqa: E402
from pdcorrect.training.checkpoints import read_checkpoint, write_checkpoint  # noqa: E402
from pdcorrect.training.config import (  # noqa: E402
    Loss,
    Rate,
    TrainingConfig,
)
from pdcorrect.training.fitting import fit_normaliser, widen_ranges  # noqa: E402
from pdcorrect.training.losses import BaseErrors, body_losses, mean_of  # noqa: E402, mean_of
from pdcorrect.training.optimisation import Optimiser, rate_at  # noqa: E402
from pdcorrect.training.progress import check_same  # noqa: E402
from pdcorrect.training.recordings import _mean_square, base_errors, load_recordings  # noqa: E402
from pdcorrect.training.scenes import SceneGroup, SceneGroups, grouped  # noqa: E402
from pdcorrect.training.sources import OneStepBatches, one_step_loss, share_done  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402
from pdcorrect.training.unrolled import Rollouts, UnrolledBatches, unroll  # noqa: E402
from pdcorrect.training.validation import Scores, Validation  # noqa: E402
from pdcorrect.training.world import World, joined  # noqa: E402

ROOT = Path(__file__).parent.parent
BASIC = '[[stages]]\nkind = "one-step"\niterations = 1\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The same with five frames."""
    return samples.dataset(tmp_path_factory.mktemp("short"), frames=5)


pytestmark = pytest.mark.usefixtures("few_threads")


# --- configuration -----------------------------------------------------------------------


UNROLLED = BASIC.replace("one-step", "unrolled")
FORCED = '[corrector]\nchanges = {placement = "force"}\n'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("seeds = 1\n" + BASIC, "seeds: unknown key"),
        (BASIC + "rates = 1.0\n", r"stages.0.rates: unknown key; did you mean rate\?$"),
        ("batch = 3\n" + BASIC, r"batch: unknown key; it belongs to \[\[stages\]\]\.$"),
        (BASIC + "seed = 3\n", r"stages.0.seed: .*; it belongs to the top, above all tables\.$"),
        (BASIC + "peak = 0.1\n", r"stages.0.peak: .*; it belongs to \[stages.rate\]\.$"),
        (BASIC + "[stages.rate]\nbatch = 3\n", r"rate.batch: .*; it belongs to \[\[stages\]\]\.$"),
        ("[corrector]\nwidth = 3\n" + BASIC, r"it belongs to \[corrector.changes\]\.$"),
        ("vorkers = 3\n" + BASIC, r"vorkers: unknown key; did you mean workers\?$"),
        (BASIC + "vorkers = 3\n", r"did you mean workers, which belongs to the top, above all"),
        (BASIC + "seconds = 1.0\n", "stages.0 .*exactly one of seconds, iterations, epochs"),
        (BASIC + "through_solver = true\n", "stages.0 .*through_solver has no meaning"),
        (BASIC + "batch = 0\n", "stages.0.batch = 0"),
        (BASIC.replace("one-step", "unrolled") + "steps = [4, 2]\n", "stages.0.steps"),
        (BASIC.replace("one-step", "unrolled") + "steps = 0\n", "stages.0.steps"),
        (BASIC.replace("one-step", "unrolled") + "[stages.noise]\ntau = 0.1\n", "noise has no"),
        (BASIC.replace("one-step", "two-step"), 'stages.0.kind = "two-step"'),
        (BASIC + "[stages.loss]\nkind = 'absolute'\nbend = 1.0\n", "loss .*bend has no meaning"),
        (BASIC + "[stages.loss]\nkind = 'absolute'\nahead = 1.0\n", "loss .*ahead has no meaning"),
        (BASIC + "loss = {ahead = 1.0}\n", "stages.0 .*loss.ahead has no meaning"),
        (UNROLLED + "loss = {ahead = 0.0}\n", "stages.0.loss.ahead = 0.0"),
        (UNROLLED + "teacher = 'tiny'\nloss = {ahead = 1.0}\n", "teacher: loss.ahead"),
        ("velocity = 'kept'\n" + UNROLLED + "loss = {ahead = 1.0}\n", "stages.0: loss.ahead is of"),
        (BASIC + "teacher = 'tiny'\n", "stages.0 .*teacher has no meaning"),
        (BASIC + "at_rest = 0.5\n", "stages.0 .*at_rest has no meaning"),
        (UNROLLED + "at_rest = 1.5\n", "stages.0.at_rest = 1.5"),
        (UNROLLED + "teacher = 'tiny'\nthrough_solver = true\n", "teacher: .*step by step"),
        (FORCED + UNROLLED + "teacher = 'tiny'\n", "stages.0: a teacher teaches"),
        ("stages = []\n", r"stages = \[\]: expected a list of at least 1, got 0.$"),
        (
            BASIC + "[[stages]]\nkind = 'one-step'\nbatch = 'x'\n",
            'stages.1.batch = "x": expected an',
        ),
        (
            '[corrector]\npreset = "huge"\n' + BASIC,
            r"corrector.preset = \"huge\": expected one of 'thesis',",
        ),
        (
            "[corrector]\nchanges = {widths = 3}\n" + BASIC,
            r"corrector.changes.widths: unknown key; did you mean width\?$",
        ),
        (
            "[corrector]\nchanges = {layers = 0}\n" + BASIC,
            "changes.layers = 0: expected at least 1.$",
        ),
        ("[corrector]\nchanges = {edge_features = ['load']}\n" + BASIC, "feature 'load': expected"),
        ('[corrector]\nchanges = {placement = "force"}\n' + BASIC, "through the solver"),
        ("[validate_every]\nseconds = 1.0\niterations = 2\n" + BASIC, "validate_every"),
        ("base = 'plain", "not valid TOML"),
        ("start_from = 3\n" + BASIC, "start_from = 3: expected a string"),
        ("start_from = ''\n" + BASIC, 'start_from = "": expected .*; leave the key out for none.$'),
        (UNROLLED + "teacher = ' '\n", 'stages.0.teacher = " ": .*; leave the key out for none.$'),
        (
            "[body]\nshape = 'beam'\n",
            "looks like a scene; expected the configuration of a training",
        ),
        ("family = 'cross'\n", "looks like the configuration of a data set; expected"),
    ],
)
def test_a_wrong_configuration_is_refused_by_its_key(text, told):
    with pytest.raises(InputError, match=told):
        TrainingConfig.from_toml(text)


def test_a_configuration_comes_back_from_its_toml():
    stage = samples.unrolled(steps=(1, 4), start="pool", rate=Rate(peak=0.1))
    settings = samples.config(samples.one_step(clip=None), stage, select="median")
    text = settings.to_toml()
    again = TrainingConfig.from_toml(text)
    assert again.stages[1] == stage
    assert again.select == "median"
    # TOML has no null: what is left out is the default.
    assert again.stages[0].clip == 1.0


TRAININGS = [*(ROOT / "examples" / "training").glob("*.toml"), *(ROOT / "models").rglob("*/*.toml")]


@pytest.mark.parametrize(
    "path", sorted(TRAININGS), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_the_examples_and_recipes_can_be_read(path):
    TrainingConfig.load(path)


def told(settings, own):
    """What the table of recipes has in its columns "corrects", "seconds" and "goes on with"."""
    parts = []
    for stage in settings.stages:
        if stage.kind == "one-step":
            parts.append(f"single {stage.seconds:g}")
            continue
        steps = stage.steps if isinstance(stage.steps, tuple) else (stage.steps,)
        detached = "" if stage.through_solver else " detached"
        parts.append(f"{', '.join(map(str, steps))}{detached}: {stage.seconds:g}")
    start = ""
    if settings.start_from:
        name = Path(settings.start_from).parent
        start = f"`{name.name}`" if name.parent.name == own else f"`{name.parent.name}/{name.name}`"
    return settings.base.replace("-", " "), "; ".join(parts), start


def test_each_recipe_has_its_row_in_the_table():
    folder = ROOT / "models" / "recipes"
    lines = (folder / "README.md").read_text(encoding="utf-8").splitlines()
    cells = [[c.strip() for c in line.split("|")[1:-1]] for line in lines if line.startswith("| `")]
    rows = {row[0].strip("`"): tuple(row[1:4]) for row in cells}
    recipes = {str(p.relative_to(folder).with_suffix("")): p for p in folder.glob("*/*.toml")}
    assert rows == {
        name: told(TrainingConfig.load(path), path.parent.name) for name, path in recipes.items()
    }


def test_the_thesis_is_an_example():
    settings = TrainingConfig.load(ROOT / "examples" / "training" / "thesis.toml")
    (stage,) = settings.stages
    assert settings.corrector.preset == "thesis"
    assert (stage.batch, stage.epochs, stage.horizon(0.5)) == (1, 20, 1)
    assert (stage.loss.kind, stage.loss.scale) == ("absolute", 1000.0)


def test_the_horizon_grows_in_equal_parts():
    stage = samples.unrolled(steps=(1, 2, 8))
    shares = (0.0, 0.3, 0.34, 0.65, 0.67, 0.99, 1.0)
    assert [stage.horizon(s) for s in shares] == [1, 1, 2, 2, 8, 8, 8]


def test_the_rate_rises_and_falls():
    rate = Rate(peak=1.0, last=0.1, warmup=0.2)
    assert rate_at(rate, 0.1) == pytest.approx(0.5)
    assert rate_at(rate, 0.2) == pytest.approx(1.0)
    assert rate_at(rate, 0.6) == pytest.approx(0.55)
    assert rate_at(rate, 1.0) == pytest.approx(0.1)
    assert 0 < rate_at(rate, 0.0) < 0.01
    assert rate_at(Rate(peak=0.3, last=0.3, warmup=0.0), 0.7) == 0.3


def test_budgets_are_counted_in_epochs_iterations_or_seconds():
    assert share_done(samples.one_step(iterations=8), 100, 2, 50.0) == 0.25
    stage = samples.one_step(iterations=None, epochs=2)
    assert share_done(stage, 10, 5, 50.0) == 0.25
    stage = samples.one_step(iterations=None, seconds=200.0)
    assert share_done(stage, 10, 5, 50.0) == 0.25


# --- losses ------------------------------------------------------------------------------


def sums(values):
    """Two bodies: of two nodes and of one."""
    return torch.stack([values[0] + values[1], values[2]])


ERRORS = torch.tensor([[0.003, 0.0, 0.004], [0.0, 0.0, 0.0], [0.0, 0.012, 0.005]]).double()


@pytest.mark.parametrize(
    ("loss", "expected"),
    [
        (Loss(kind="relative"), [25e-6 / (2 * 1e-5), 169e-6 / 4e-5]),
        (Loss(kind="relative", bend=0.5), [0.5 * np.log(3.5), 0.5 * np.log(9.45)]),
        (Loss(kind="absolute", power=1), [5.0, 13.0]),
        (Loss(kind="absolute", power=2), [25.0, 169.0]),
        (Loss(kind="absolute", power=2, scale=1.0), [25e-6, 169e-6]),
    ],
)
def test_losses_by_hand(loss, expected):
    scale = torch.tensor([1e-5, 4e-5]).double()
    found = body_losses(loss, ERRORS, sums, torch.tensor([2, 1]), scale)
    assert found.tolist() == pytest.approx(expected)


def test_the_gradient_of_a_distance_of_zero_is_zero():
    errors = ERRORS.clone().requires_grad_()
    body_losses(Loss(kind="absolute", power=1), errors, sums, None, None).sum().backward()
    assert errors.grad[1].tolist() == [0.0, 0.0, 0.0]
    assert errors.grad[0].tolist() == pytest.approx([600.0, 0.0, 800.0])


def test_expected_errors_of_the_base_model_grow_to_those_of_its_rollout():
    errors = BaseErrors(torch.tensor([1e-6, 1e-6, 1e-4]), torch.tensor([1e-3, 2e-5, 1e-6]))
    assert errors.after(1).tolist() == pytest.approx([1e-6, 1e-6, 1e-4])
    assert errors.after(2).tolist() == pytest.approx([9e-6, 9e-6, 1e-4])
    steps = torch.tensor([3, 3, 1])
    assert errors.after(steps).tolist() == pytest.approx([36e-6, 2e-5, 1e-4])


@pytest.mark.parametrize("base", ["plain", "best"])
def test_recorded_errors_are_mean_squared_distances(folder, base):
    recordings = load_recordings(folder, "training", base)
    _, motions = read_arrays(folder / "training" / "mesh-0003.h5", (base,), (base,))
    for recording, motion in zip(recordings[1:], motions, strict=True):
        truth = motion.positions[1:].astype(np.float64)
        for found, run in (
            (recording.one_step, motion.predictions[base]),
            (recording.rollout, motion.rollouts[base][1:]),
        ):
            assert found == pytest.approx(((run - truth) ** 2).sum(axis=2).mean(), rel=1e-6)


# --- windows -----------------------------------------------------------------------------


def test_a_window_asks_for_what_the_base_model_lacks(folder):
    settings = samples.config(samples.one_step())
    windows, recordings = samples.windows(folder, settings)
    batch = windows.batch([3, 20 + 5])  # frame 3 of the first mesh, 5 of the second's first
    _, motions = read_arrays(folder / "training" / "mesh-0003.h5", ("plain",))
    nodes = len(recordings[0].points)
    motion = motions[0]
    wanted = motion.positions[6].astype(float) - motion.predictions["plain"][5]
    np.testing.assert_allclose(batch.target[nodes:].numpy(), wanted, atol=1e-8)
    np.testing.assert_array_equal(
        batch.snapshot.proposed[nodes:].numpy(), motion.predictions["plain"][5]
    )
    assert batch.scale.tolist() == [r.one_step for r in recordings[:2]]
    assert batch.snapshot.correction is None


def remembering():
    """A configuration whose network sees the correction of the step before."""
    names = ("node-type", "previous-correction", "strain", "load", "acceleration")
    changes = {**samples.SMALL["changes"], "node_features": names}
    return samples.config(samples.one_step(), corrector={"preset": "compact", "changes": changes})


@pytest.mark.parametrize("resident", [False, True])
def test_a_network_that_remembers_sees_the_correction_of_the_step_before(folder, resident):
    windows, _ = samples.windows(folder, remembering(), resident=resident)
    plain, _ = samples.windows(folder, samples.config(samples.one_step()))
    first, begins = windows.batch([3], last=False), plain.batch([3])
    assert first.snapshot.correction is None
    for name in ("positions", "velocities", "proposed", "forces"):
        torch.testing.assert_close(getattr(first.snapshot, name), getattr(begins.snapshot, name))
    torch.testing.assert_close(first.target, begins.target)
    found, before, now = windows.batch([3]), plain.batch([3]), plain.batch([4])
    torch.testing.assert_close(found.snapshot.correction, before.target)
    torch.testing.assert_close(found.target, now.target)
    torch.testing.assert_close(found.snapshot.positions, now.snapshot.positions)
    torch.testing.assert_close(
        found.snapshot.velocities, now.snapshot.velocities, rtol=1e-5, atol=1e-5
    )


def test_a_first_guess_is_to_become_the_base_models_answer(folder):
    changes = {**samples.SMALL["changes"], "placement": "guess"}
    settings = samples.config(
        samples.one_step(), corrector={"preset": "compact", "changes": changes}
    )
    guess = samples.windows(folder, settings)[0].batch([7])
    state = samples.windows(folder, samples.config(samples.one_step()))[0].batch([7])
    torch.testing.assert_close(
        guess.snapshot.proposed + guess.target, state.snapshot.proposed, rtol=0, atol=1e-12
    )
    h, bodies = 0.01, state.bodies
    moved = h * state.snapshot.velocities
    moved = moved + h**2 * state.snapshot.forces / bodies.mass[:, None] * bodies.free
    torch.testing.assert_close(guess.snapshot.proposed, state.snapshot.positions + moved)


@pytest.mark.parametrize("placement", ["force", "guess"])
def test_what_is_proposed_before_the_step_holds_the_clamps_where_the_coarse_step_has_them(
    folder, placement
):
    changes = {**samples.SMALL["changes"], "placement": placement}
    architecture = {"preset": "compact", "changes": changes}
    stage = samples.unrolled(through_solver=True) if placement == "force" else samples.one_step()
    windows, _ = samples.windows(folder, samples.config(stage, corrector=architecture))
    found = windows.dataset.batch([7, 26])
    batch = windows.step_batch(found)
    held, state = ~batch.bodies.free, batch.snapshot
    assert held.any()
    ahead = state.positions + 0.01 * state.velocities  # as clamps that do not move always were
    assert torch.equal(state.proposed[held], ahead[held])
    found.predictions[:, -1][held] += 0.003
    moved = windows.step_batch(found)
    predicted = found.predictions[:, -1].to(torch.float64)
    assert torch.equal(moved.snapshot.proposed[held], predicted[held])
    assert torch.equal(moved.snapshot.proposed[~held], state.proposed[~held])
    if placement == "guess":
        assert not moved.target[held].any()


@pytest.mark.parametrize("relative", [False, True])
def test_noise_is_seen_and_to_be_corrected(folder, relative):
    settings = samples.config(samples.one_step())
    batch = samples.windows(folder, settings)[0].batch(list(range(0, 60, 4)))
    generator = torch.Generator().manual_seed(1)
    tau = 0.5 if relative else 2e-3
    noisy = batch.with_noise(tau, relative, generator)
    noise = noisy.snapshot.proposed - batch.snapshot.proposed
    torch.testing.assert_close(
        noisy.snapshot.proposed + noisy.target, batch.snapshot.proposed + batch.target
    )
    assert not noise[~batch.bodies.free].any()
    free = batch.bodies.free.all(dim=1)
    unit = batch.bodies.by_node((batch.scale / 3).sqrt())[:, None] if relative else 1.0
    sizes = (noise / unit)[free]
    assert float(sizes.square().mean().sqrt()) == pytest.approx(tau, rel=0.05)
    assert abs(float(sizes.mean())) < 0.1 * tau
    assert noisy.snapshot.positions is batch.snapshot.positions


@pytest.mark.parametrize("features", [("node-type", "strain"), ("load", "previous-correction")])
@pytest.mark.parametrize("placement", ["state", "force"])
def test_windows_kept_in_memory_are_those_that_are_read(folder, features, placement):
    changes = {**samples.SMALL["changes"], "node_features": features, "placement": placement}
    stage = samples.unrolled(through_solver=True) if placement == "force" else samples.one_step()
    settings = samples.config(stage, corrector={"preset": "compact", "changes": changes})
    kept, read = (
        samples.windows(folder, settings, resident=resident)[0] for resident in (True, False)
    )
    chosen = [45, 3, 18, 45, 20, 56, 0]  # both meshes, all simulations, first and last windows
    pairs = [(kept.batch(chosen), read.batch(chosen))]
    several = kept.batches(8, seed=3), read.batches(8, seed=3)
    pairs += [(next(several[0]), next(several[1])) for _ in range(2 * len(several[0]))]
    assert several[0].state_dict() == several[1].state_dict()
    for one, other in pairs:
        assert torch.equal(one.target, other.target)
        assert torch.equal(one.scale, other.scale)
        for x, y in ((one.bodies, other.bodies), (one.snapshot, other.snapshot)):
            for field in fields(x):
                a, b = getattr(x, field.name), getattr(y, field.name)
                assert (a is None and b is None) or (a.dtype == b.dtype and torch.equal(a, b))
        for name in KNOWN:
            assert torch.equal(vars(one.bodies)[name], vars(other.bodies)[name])


def test_windows_that_memory_does_not_hold_are_read(folder, monkeypatch):
    settings = samples.config(samples.one_step())
    assert samples.windows(folder, settings)[0].resident
    monkeypatch.setattr("pdcorrect.training.windows.CACHE_BYTES", 10**5)
    assert not samples.windows(folder, settings)[0].resident


@pytest.mark.parametrize("index", [60, 10**6])
def test_there_is_no_window_beyond_the_last(folder, index):
    windows, _ = samples.windows(folder, samples.config(samples.one_step()))
    assert len(windows.dataset) == 60
    with pytest.raises(IndexError, match=str(index)):
        windows.batch([0, index])


def test_what_is_known_of_the_rest_is_that_of_the_bodies(folder):
    windows, _ = samples.windows(folder, samples.config(samples.one_step()))
    bodies = windows.batch([3, 45, 4]).bodies
    anew = bodies.to()
    for name in KNOWN:
        torch.testing.assert_close(vars(bodies)[name], getattr(anew, name))
        assert len(getattr(bodies, name)) > 50 or name == "node_counts"


# --- normalisation -----------------------------------------------------------------------


def test_the_normaliser_has_zero_mean_and_unit_deviation_on_the_training_split(folder):
    architecture = {"preset": "thesis", "changes": {"layers": 1, "width": 8}}
    settings = samples.config(samples.one_step(), corrector=architecture)
    corrector = samples.fitted(folder, settings)
    windows, _ = samples.windows(folder, settings)
    fit_normaliser(corrector, windows, 10**6)
    every = windows.batch(range(len(windows.dataset)))
    normaliser = corrector.normaliser
    np.testing.assert_allclose(
        normaliser.force__mean.numpy(), every.snapshot.forces.mean(dim=0).numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        normaliser.force__deviation.numpy(),
        every.snapshot.forces.std(dim=0, correction=0).numpy(),
    )
    target = every.target[every.bodies.free.all(dim=1)]
    assert float(normaliser.output_scale) == pytest.approx(float(target.square().mean().sqrt()))


def test_bodies_of_the_training_split_are_like_it(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    corrector = samples.fitted(folder, settings)
    fit_normaliser(corrector, windows, 10**6)
    every = windows.batch(range(len(windows.dataset)))
    view = View(every.bodies, every.snapshot)
    averages = every.bodies.body_means(corrector.inputs(view)[0])
    normaliser = corrector.normaliser
    np.testing.assert_allclose(
        normaliser.average_mean.numpy(), averages.mean(dim=0).numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        normaliser.average_low.numpy(), averages.amin(dim=0).numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        normaliser.average_high.numpy(), averages.amax(dim=0).numpy(), atol=1e-12
    )
    assert 1.0 < float(corrector.unlike(view).max()) <= 3.5 + 1e-9


def test_bodies_of_the_training_split_are_known_whatever_part_is_fitted_to(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    corrector = samples.fitted(folder, settings)
    corrector.normaliser.shape_low.fill_(torch.nan)
    fit_normaliser(corrector, windows, 1)
    bodies = windows.batch(range(len(windows.dataset))).bodies
    assert len(torch.unique(bodies.shapes, dim=0)) > 1
    assert not corrector.shape_excess(bodies).any()
    normaliser = corrector.normaliser
    assert torch.equal(normaliser.shape_low, bodies.shapes.double().amin(dim=0))
    assert torch.equal(normaliser.shape_high, bodies.shapes.double().amax(dim=0))
    normaliser.shape_low += 1.0  # as of larger bodies
    assert (corrector.shape_excess(bodies) > 0.5).any()
    widen_ranges(corrector, windows, 1)
    assert not corrector.shape_excess(bodies).any()
    assert torch.equal(normaliser.shape_high, bodies.shapes.double().amax(dim=0))


def test_the_time_step_of_the_training_data_is_fitted_and_widened(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    corrector, size = samples.fitted(folder, settings), 0.05
    step = windows.dataset.headers[0].time_step / size
    normaliser = corrector.normaliser
    normaliser.time_step_low.fill_(torch.nan)
    fit_normaliser(corrector, windows, 1)
    assert normaliser.time_steps == pytest.approx((step, step), rel=1e-6)
    bodies = windows.batch([0]).bodies
    assert bodies.time_steps.tolist() == pytest.approx([np.log(step)], abs=1e-6)
    assert corrector.time_step_excess(bodies).tolist() == [0.0]
    for shift in (np.log(2.0), -np.log(2.0)):  # as of data with another step
        normaliser.time_step_low += shift
        normaliser.time_step_high += shift
        assert corrector.time_step_excess(bodies).tolist() == pytest.approx([np.log(2.0)], abs=1e-6)
        both = sorted((step, step * np.exp(shift)))
        widen_ranges(corrector, windows, 1)
        assert normaliser.time_steps == pytest.approx(both, rel=1e-6)
        fit_normaliser(corrector, windows, 1)
        assert normaliser.time_steps == pytest.approx((step, step), rel=1e-6)


def test_stored_bodies_have_the_measures_of_those_that_are_drawn():
    """What a training fits to is what `models/fit_shapes.py` fitted to without data."""
    home = Path(__file__).parents[1]
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(home / "datasets" / "tiny", settings)
    corrector = samples.fitted(home / "datasets" / "tiny", settings)
    fit_normaliser(corrector, windows, 1)
    drawn = load_model(home / "models" / "tiny").corrector.normaliser
    for part in ("shape_low", "shape_high"):
        found = getattr(corrector.normaliser, part)
        torch.testing.assert_close(found, getattr(drawn, part), rtol=0.0, atol=1e-5)


def test_fitting_to_a_part_is_a_matter_of_the_seed_alone(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    found = []
    for seed in (0, 0, 1):
        corrector = samples.fitted(folder, settings)
        fit_normaliser(corrector, windows, 10, seed)
        found.append(corrector.normaliser.state_dict())
    for name, x in found[0].items():
        assert torch.equal(x, found[1][name])
    assert found[0]["output_scale"] != found[2]["output_scale"]


@pytest.mark.parametrize("remembers", [False, True])
def test_first_steps_are_within_the_ranges_of_a_fit_to_a_part(folder, remembers):
    settings = remembering() if remembers else samples.config(samples.one_step())
    # windows of one step, whatever the network asks for: what it sees when it begins
    windows, _ = samples.windows(folder, samples.config(samples.one_step()))
    corrector = samples.fitted(folder, settings)
    _, _, steps = windows.dataset.places(range(len(windows.dataset)))
    first, others = np.flatnonzero(steps == 0), np.flatnonzero(steps == 10)
    fit_normaliser(corrector, samples.windows(folder, settings)[0], len(first))

    def outside(numbers):
        batch = windows.batch(numbers.tolist())
        return corrector.outside(View(batch.bodies, batch.snapshot), 0.0)

    assert not outside(first).any()
    assert outside(others).any()  # so few windows do not hold all of the rest


# --- steps of the optimiser --------------------------------------------------------------


def weights(corrector):
    return torch.cat([p.detach().reshape(-1).clone() for p in corrector.network.parameters()])


def test_batches_without_a_finite_gradient_change_nothing_and_are_counted(folder):
    settings = samples.config(samples.one_step())
    corrector = samples.fitted(folder, settings)
    optimiser = Optimiser(corrector, settings.stages[0], None, World())
    some = next(iter(corrector.network.parameters()))

    def loss(factor):
        return factor * sum(p.square().sum() for p in corrector.network.parameters())

    optimiser.step(loss(1.0), 0.5)
    before, moments = weights(corrector), optimiser.state_dict()
    moments = {n: x.clone() for n, x in moments.items() if n.startswith("adam")}
    optimiser.step(loss(torch.nan), 0.5)
    optimiser.step((some - some.detach()).abs().sqrt().sum(), 0.5)  # infinite derivatives only
    assert torch.equal(weights(corrector), before)
    for name, x in optimiser.state_dict().items():
        if name.startswith("adam"):
            assert torch.equal(x, moments[name]), name
    told = optimiser.take_report()
    assert (told["count"], told["skipped"], told["longest"]) == (1, 2, 2)
    optimiser.step(loss(1.0), 0.5)
    assert not torch.equal(weights(corrector), before)
    optimiser.step(loss(torch.inf), 0.5)
    told = optimiser.take_report()
    assert (told["count"], told["skipped"], told["longest"]) == (1, 1, 2)
    assert optimiser.take_report()["longest"] == 1


def test_training_ends_with_an_error_after_many_such_batches(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(
        OneStepBatches, "loss",
        lambda self, corrector, *_: torch.nan * next(corrector.network.parameters()).sum(),
    )  # fmt: skip
    settings = samples.config(
        samples.one_step(iterations=20), most_skipped=5, report_every=2, base="plain"
    )
    training = Training(settings, folder, tmp_path / "out")
    with pytest.raises(ConvergenceError, match="stage 0, iteration 6: 6 batches in a row"):
        training.run()


def test_gradients_are_clipped(folder):
    settings = samples.config(samples.one_step(clip=0.25))
    corrector = samples.fitted(folder, settings)
    optimiser = Optimiser(corrector, settings.stages[0], None, World())
    optimiser.step(1e3 * sum(p.square().sum() for p in corrector.network.parameters()), 0.5)
    grads = [p.grad for p in corrector.network.parameters()]
    assert float(torch.nn.utils.get_total_norm(grads)) == pytest.approx(0.25, rel=1e-4)


def test_averaged_weights_follow_by_their_decay(folder):
    settings = samples.config(samples.one_step(ema=0.75))
    corrector, averaged = samples.fitted(folder, settings), samples.fitted(folder, settings)
    before = weights(averaged)
    optimiser = Optimiser(corrector, settings.stages[0], averaged, World())
    optimiser.step(sum(p.square().sum() for p in corrector.network.parameters()), 0.5)
    torch.testing.assert_close(weights(averaged), 0.75 * before + 0.25 * weights(corrector))
    assert not torch.equal(weights(averaged), before)


def test_bfloat16_is_close_to_full_precision_but_not_the_same(folder):
    settings = samples.config(samples.one_step())
    corrector = samples.fitted(folder, settings)
    batch = samples.windows(folder, settings)[0].batch([3, 30])
    full, half = (
        one_step_loss(corrector, batch, samples.one_step(amp=amp)).item()
        for amp in ("none", "bf16")
    )
    assert half == pytest.approx(full, rel=0.05)
    assert half != full
    assert one_step_loss(corrector, batch, samples.one_step()).item() == full


# --- scenes ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def group(folder):
    recordings = load_recordings(folder, "training", "plain")
    return SceneGroup(recordings, "plain", "cpu")


def started(group, frames):
    positions, velocities = group.states(frames)
    none = torch.zeros(int(group.counts.sum()), 3, dtype=torch.float64)
    return Rollouts(positions, velocities, none, frames, np.zeros_like(frames))


def test_groups_hold_all_simulations_once_and_meshes_stay_together():
    recordings = load_recordings(samples.TINY, "training", "plain")
    every = [
        group
        for rank in (0, 1)
        for group in grouped(recordings, 3, seed=5, rank=rank, world_size=2)
    ]
    assert sorted(r.name for g in every for r in g) == sorted(r.name for r in recordings)
    whole = [r for g in grouped(recordings, 3, seed=5) for r in g]
    meshes = [r.mesh for r in whole]
    assert len([1 for a, b in itertools.pairwise(meshes) if a != b]) == 5
    assert meshes != [r.mesh for g in grouped(recordings, 3, seed=6) for r in g]


def test_states_of_the_reference_have_backward_differences(group):
    frames = np.array([0, 4, 20])
    positions, velocities = group.states(frames)
    truth = group.recordings[1].reference.astype(float)
    count = truth.shape[1]
    np.testing.assert_array_equal(positions[1, :count].numpy(), truth[4])
    np.testing.assert_allclose(velocities[1, :count].numpy(), (truth[4] - truth[3]) / 0.01)
    assert not velocities[0].any()
    assert not positions[0, group.stepper.node_counts[0] :].any()


def test_one_unrolled_step_without_correction_has_the_loss_of_the_stored_prediction(group, folder):
    settings = samples.config(samples.unrolled())
    silent = samples.fitted(folder, settings, silent=True)
    frames = np.array([2, 7, 11])
    found = unroll(group, silent, started(group, frames), 1, settings.stages[0])
    windows, _ = samples.windows(folder, settings)
    batch = windows.batch([2, 20 + 7, 40 + 11])
    squares = batch.bodies.body_means(batch.target.square().sum(dim=1)) / batch.scale
    assert found.alive.all()
    torch.testing.assert_close(found.losses, squares, rtol=2e-3, atol=0)


def test_unrolled_losses_are_means_over_steps_and_ages_count(group, folder):
    settings = samples.config(samples.unrolled(steps=2))
    silent = samples.fitted(folder, settings, silent=True)
    start = replace(started(group, np.array([2, 7, 11])), ages=np.array([0, 3, 0]))
    both = unroll(group, silent, start, 2, settings.stages[0])
    first = unroll(group, silent, start, 1, settings.stages[0])
    second = unroll(group, silent, first.end, 1, settings.stages[0])
    torch.testing.assert_close(both.losses, (first.losses + second.losses) / 2)
    assert both.end.ages.tolist() == [2, 5, 2]
    assert both.end.frames.tolist() == [4, 9, 13]
    errors = base_errors(group.recordings).after(torch.tensor([2, 5, 2]))
    truth = group.truth(np.array([4, 9, 13]))
    squares = group.sums((both.end.positions - truth).square().sum(dim=2)) / group.counts
    torch.testing.assert_close(second.losses, squares / errors)


@pytest.mark.parametrize("through_solver", [False, True])
def test_weights_get_the_derivative_of_the_unrolled_loss(group, folder, through_solver):
    settings = samples.config(samples.unrolled(through_solver=through_solver))
    corrector = samples.fitted(folder, settings)
    start = started(group, np.array([5, 6, 7]))
    steps = 2 if through_solver else 1  # what is left out without is only what is earlier
    bias = corrector.network.decoder[-1].bias

    def loss():
        return unroll(group, corrector, start, steps, settings.stages[0]).losses.mean()

    loss().backward()
    slope, h = float(bias.grad[1]), 1e-3
    values = []
    with torch.no_grad():
        for sign in (1, -1):
            bias[1] += sign * h
            values.append(loss().item())
            bias[1] -= sign * h
    assert slope == pytest.approx((values[0] - values[1]) / (2 * h), rel=2e-3)


def test_scenes_whose_step_fails_are_left_out(group, folder, monkeypatch):
    settings = samples.config(samples.unrolled(batch=3))
    corrector = samples.fitted(folder, settings)
    fine = unroll(group, corrector, started(group, np.array([5, 6, 7])), 2, settings.stages[0])
    start = started(group, np.array([5, 6, 7]))
    start.positions[1, 20] = torch.nan
    found = unroll(group, corrector, start, 2, settings.stages[0])
    assert found.alive.tolist() == [True, False, True]
    assert found.losses[1] == 0.0
    torch.testing.assert_close(found.losses[[0, 2]], fine.losses[[0, 2]])
    batches = UnrolledBatches(SceneGroups(group.recordings, "plain"), settings.stages[0])
    monkeypatch.setattr("pdcorrect.training.unrolled.unroll", lambda *_: found)
    loss = batches.loss(corrector, 0, 2)
    assert loss.item() == pytest.approx(found.losses[[0, 2]].mean().item())
    assert batches.failed == 1


def test_a_pool_goes_on_where_it_was(folder):
    recordings = load_recordings(folder, "training", "plain")
    stage = samples.unrolled(start="pool", restart=0.0, lost=1e9, steps=2)
    corrector = samples.fitted(folder, samples.config(stage), silent=True)
    batches = UnrolledBatches(SceneGroups(recordings, "plain"), stage)
    ages = []
    for iteration in range(3):
        batches.loss(corrector, iteration, 2)
        numbers, _ = batches.state_dict()
        ages.append(numbers["pool"]["0"]["ages"])
        assert all(f <= 20 for f in numbers["pool"]["0"]["frames"])
    assert ages[0] == [2, 2, 2]
    assert any(age == 4 for age in ages[1])
    always = UnrolledBatches(
        SceneGroups(recordings, "plain"), stage.model_copy(update={"restart": 1.0})
    )
    for iteration in range(2):
        always.loss(corrector, iteration, 2)
        assert always.state_dict()[0]["pool"]["0"]["ages"] == [2, 2, 2]


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_the_states_of_the_reference_is_at_rest(folder, share):
    recordings = load_recordings(folder, "training", "plain")
    groups = SceneGroups(recordings, "plain")
    batches = UnrolledBatches(groups, samples.unrolled(at_rest=share, steps=2))
    group = groups(recordings)
    starts = np.concatenate([
        batches._start(0, group, 2, np.random.default_rng(k)).frames for k in range(100)
    ])  # fmt: skip
    expected = share + (1.0 - share) / 19  # of the frames 0 to 18 in any case
    assert np.mean(starts == 0) == pytest.approx(expected, abs=0.08)


def test_rollouts_that_are_lost_go_back_to_the_reference(folder):
    recordings = load_recordings(folder, "training", "plain")
    stage = samples.unrolled(start="pool", restart=0.0, steps=2)
    corrector = samples.fitted(folder, samples.config(stage), silent=True)
    for lost, expected in ((1e9, [False] * 3), (1e-9, [True] * 3)):
        chosen = stage.model_copy(update={"lost": lost})
        batches = UnrolledBatches(SceneGroups(recordings, "plain"), chosen)
        batches.loss(corrector, 0, 2)
        ages = batches.state_dict()[0]["pool"]["0"]["ages"]
        assert [age < 0 for age in ages] == expected


def test_a_scene_is_lost_by_its_squared_distance_over_the_base_models(group):
    frames = np.array([5, 6, 7])
    truth = group.truth(frames)
    rollout = torch.maximum(group.errors.rollout, group.errors.one_step)
    away = torch.tensor([0.9, 1.1, 1.9]).double()
    moved = truth.clone()
    moved[..., 0] += (away * rollout).sqrt()[:, None]
    assert group.lost(moved, frames, 1.0).tolist() == [False, True, True]
    assert group.lost(moved, frames, 2.0).tolist() == [False, False, False]
    assert group.lost(moved * torch.nan, frames, 2.0).all()


def test_a_teacher_is_asked_about_the_states_that_the_learner_meets(group, folder):
    settings = samples.config(samples.unrolled(batch=3))
    learner, teacher = (samples.fitted(folder, settings) for _ in range(2))
    with torch.no_grad():
        for weight in teacher.network.parameters():
            weight.add_(0.05 * torch.randn_like(weight))
    stage, frames = settings.stages[0], np.array([5, 6, 7])
    same = unroll(group, learner, started(group, frames), 2, stage, teacher=learner)
    assert same.losses.tolist() == [0.0, 0.0, 0.0]
    found = unroll(group, learner, started(group, frames), 1, stage, teacher=teacher)
    layer = group.layer(learner, False, "recomputed")
    before = started(group, frames)
    assert layer.watch is None
    layer.watch = (views := []).append
    _, _, own = layer(before.positions, before.velocities, group.times(frames), before.correction)
    layer.watch = None
    (view,) = views
    apart = layer.padded(own - teacher.of_view(view)).square().sum(dim=2)
    expected = group.sums(apart) / (group.counts * group.errors.one_step)
    torch.testing.assert_close(found.losses, expected)
    assert (found.losses > 0).all()


def test_what_a_teacher_knows_is_learned(folder, tmp_path):
    settings = samples.config(samples.one_step(iterations=40, rate=Rate(peak=3e-3)))
    Training(settings, folder, tmp_path / "teacher").run()
    stage = samples.unrolled(
        iterations=30, start="pool", teacher=str(tmp_path / "teacher" / "model"),
        rate=Rate(peak=3e-3),
    )  # fmt: skip
    told = []
    training = Training(
        samples.config(stage, report_every=10, seed=1), folder, tmp_path / "learner",
        on_report=lambda _, row: told.append(row),
    )  # fmt: skip
    training.run()
    losses = [row["loss"] for row in told if "loss" in row]
    assert losses[-1] < 0.5 * losses[0]


def test_a_teacher_of_another_kind_is_refused(folder, tmp_path):
    samples_of = samples.config(samples.one_step(iterations=1), base="best")
    Training(samples_of, folder, tmp_path / "best").run()
    teacher = str(tmp_path / "best" / "model")
    stage = samples.unrolled(teacher=teacher)
    with pytest.raises(InputError, match="its base is 'best': expected 'plain', as here\\.$"):
        Training(samples.config(stage), folder, tmp_path / "out")
    with pytest.raises(InputError, match="velocity is 'recomputed': expected 'kept'"):
        Training(samples.config(stage, base="best", velocity="kept"), folder, tmp_path / "out")
    missing = samples.unrolled(teacher=str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="nowhere"):
        Training(samples.config(missing), folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_scenes_that_failed_count_once_after_several_processes_resume(folder):
    recordings = load_recordings(folder, "training", "plain")
    stage = samples.unrolled(steps=1)
    numbers = {"failed": 3, "pool": {}}
    counts = []
    for rank in (0, 1):
        batches = UnrolledBatches(
            SceneGroups(recordings, "plain", rank=rank, world_size=2),
            stage.model_copy(update={"batch": 1}),
        )
        batches.load_state_dict(numbers, {})
        counts.append(batches.failed)
    assert counts == [3, 0]


def test_stages_share_the_groups_that_are_alike(folder, tmp_path, monkeypatch):
    made = []

    class Counted(SceneGroup):
        def __init__(self, recordings, *others):
            made.append([r.name for r in recordings])
            super().__init__(recordings, *others)

    monkeypatch.setattr("pdcorrect.training.scenes.SceneGroup", Counted)
    settings = samples.config(
        samples.unrolled(steps=1, iterations=2), samples.unrolled(steps=2, iterations=2)
    )
    Training(settings, folder, tmp_path / "out").run()
    assert len(made) == len({tuple(names) for names in made}) == 1


@pytest.mark.parametrize("split", ["training", "validation"])
def test_splits_of_which_files_are_missing_are_refused_unless_asked_for(split, tmp_path):
    data, output = tmp_path / "data", tmp_path / "out"
    shutil.copytree(ROOT / "datasets" / "tiny", data)
    (data / split / "mesh-0001.h5").unlink()
    settings = samples.config(samples.one_step(iterations=1))
    with pytest.raises(InputError, match=rf"{split}: 1 of the files .* as mesh-0001\.h5"):
        Training(settings, data, output)
    assert not output.exists()
    Training(settings, data, output, incomplete=True)


def test_too_long_a_horizon_is_refused(folder):
    recordings = load_recordings(folder, "training", "plain")
    with pytest.raises(InputError, match="0 simulations of 21 steps or more"):
        UnrolledBatches(SceneGroups(recordings, "plain"), samples.unrolled(steps=21))


# --- validation --------------------------------------------------------------------------


@pytest.mark.parametrize("base", ["plain", "best"])
def test_a_silent_corrector_has_the_omega_of_its_base_model(folder, base):
    settings = samples.config(samples.one_step(), base=base)
    recordings = load_recordings(folder, "validation", base)
    scores = Validation(recordings, base)(samples.fitted(folder, settings, silent=True))
    _, motions = read_arrays(folder / "validation" / "mesh-0001.h5", (), ("plain", "best"))
    expected = [
        error_corrected(m.rollouts[base], m.rollouts["plain"], m.positions) for m in motions
    ]
    assert scores.failed == 0
    np.testing.assert_allclose(scores.omegas, expected, atol=0.01)
    assert scores.mean == pytest.approx(np.mean(scores.omegas))


def test_where_the_plain_model_has_no_error_there_is_only_error_to_add(folder):
    recordings = load_recordings(folder, "validation", "plain")
    perfect = [replace(r, plain=r.reference) for r in recordings]
    corrector = samples.fitted(folder, samples.config(samples.one_step()), silent=True)
    assert Validation(perfect, "plain")(corrector).omegas.tolist() == [-100.0] * len(perfect)
    same = [replace(r, reference=r.reference[:1].repeat(3, axis=0)) for r in recordings]
    still = [replace(r, plain=r.reference, scene_toml=_unloaded(r)) for r in same]
    assert (Validation(still, "plain")(corrector).omegas >= 0.0).all()


def _unloaded(recording):
    scene = Scene.from_toml(recording.scene_toml)
    return scene.model_copy(update={"loads": ()}).to_toml()


def test_processes_that_are_to_share_a_gpu_are_refused(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="for 2 processes: expected 'cuda'"), joined("cuda:1"):
        pass


def test_errors_below_the_rounding_of_storage_are_not_learned():
    x = np.linspace(1.0, 2.0, 12, dtype=np.float32).reshape(1, 4, 3)
    rounding = (2.0 * np.finfo(np.float32).eps) ** 2
    assert _mean_square(x, x) == pytest.approx(rounding)
    y = x + np.float32(0.01)
    assert _mean_square(y, x) == pytest.approx(3e-4, rel=1e-3)


def test_a_corrector_that_ruins_rollouts_has_the_least_omega(folder):
    settings = samples.config(samples.one_step())
    corrector = samples.fitted(folder, settings)
    corrector.normaliser.output_scale.fill_(1e9)
    scores = Validation(load_recordings(folder, "validation", "plain"), "plain")(corrector)
    assert scores.omegas.tolist() == [-100.0, -100.0]


# --- files -------------------------------------------------------------------------------


def test_a_checkpoint_comes_back(tmp_path):
    tensors = {"a": torch.tensor([1.0, np.pi]), "b": torch.tensor(3), "c": torch.zeros(0, 2)}
    write_checkpoint(tmp_path / "c", {"x": 0.1 + 0.2, "list": [1, None]}, tensors)
    content, found = read_checkpoint(tmp_path / "c")
    assert content == {"x": 0.1 + 0.2, "list": [1, None]}
    assert all(torch.equal(found[n], x) and found[n].dtype == x.dtype for n, x in tensors.items())


def test_every_damaged_checkpoint_is_refused_by_name(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(path, {"iteration": 12}, {"a": torch.arange(6.0), "b": torch.ones(2, 2)})
    whole = path.read_bytes()
    for i in range(len(whole)):
        path.write_bytes(whole[:i] + bytes([whole[i] ^ 0x41]) + whole[i + 1 :])
        try:
            content, tensors = read_checkpoint(path)
        except FileFormatError as error:
            assert path.name in str(error)
        else:  # a byte that means nothing, such as padding
            assert content == {"iteration": 12}
            assert torch.equal(tensors["a"], torch.arange(6.0))
            assert torch.equal(tensors["b"], torch.ones(2, 2))
    path.write_bytes(whole[:-3])
    with pytest.raises(FileFormatError, match=path.name):
        read_checkpoint(path)
    path.write_bytes(whole.replace(b'"version":"4"', b'"version":"9"'))
    with pytest.raises(FileVersionError, match="version 9"):
        read_checkpoint(path)


def test_other_settings_are_refused_by_their_key():
    one = {"config": {"stages": [{"batch": 3}, {"batch": 4}]}, "data": "a"}
    check_same(one, json.loads(json.dumps(one)), "file")
    other = {"config": {"stages": [{"batch": 3}, {"batch": 5}]}, "data": "a"}
    with pytest.raises(InputError, match=r"file: was begun with config.stages.1.batch = 4"):
        check_same(one, other, "file")


def refused_change(before, now):
    """What is told of two configurations that differ."""
    one, other = ({"config": each.model_dump(mode="json")} for each in (before, now))
    check_same(one, json.loads(json.dumps(one)), "file")
    with pytest.raises(InputError) as refusal:
        check_same(one, other, "file")
    told = str(refusal.value)
    assert told.startswith("file: was begun ")
    assert told.endswith(": expected the same; begin another one in another folder.")
    return told.removeprefix("file: was begun ").partition(": expected the same")[0]


@pytest.mark.parametrize(
    ("changes", "key", "value", "default"),
    [
        ({"fitting": {"anew": True}}, "fitting.anew", "true", "false"),
        ({"fitting": {"widen": False}}, "fitting.widen", "false", "true"),
        ({"without": ["training/mesh-0042"]}, "without", '["training/mesh-0042"]', "[]"),
    ],
)
def test_a_setting_that_is_not_written_is_told_as_its_default(changes, key, value, default):
    plain = samples.config(samples.one_step(), start_from="tiny")
    changed = samples.config(samples.one_step(), start_from="tiny", **changes)
    assert refused_change(changed, plain) == (
        f"with config.{key} = {value}, and is now to go on with {default} (the default)"
    )
    assert refused_change(plain, changed) == (
        f"with config.{key} = {default} (the default), and is now to go on with {value}"
    )


def test_a_setting_without_a_default_is_told_as_not_there():
    preset = samples.config(samples.one_step(), corrector={"preset": "compact"})
    changed = samples.config(
        samples.one_step(), corrector={"preset": "compact", "changes": {"width": 8}}
    )
    key = "config.corrector.changes.width"
    assert refused_change(changed, preset) == f"with {key} = 8, and is now to go on without it"
    assert refused_change(preset, changed) == f"without {key}, and is now to go on with 8"
    unclipped = samples.config(samples.one_step(clip=None))
    assert refused_change(samples.config(samples.one_step()), unclipped) == (
        "with config.stages.0.clip = 1.0, and is now to go on with none"
    )
    with pytest.raises(InputError, match='begun without start, and is now to go on with "a":'):
        check_same({}, {"start": "a"}, "file")
    old = samples.config(samples.one_step()).model_dump(mode="json")
    del old["seed"]  # as of an earlier version of the code, which had no such key
    with pytest.raises(InputError, match="begun without config.seed, and is now to go on with 0:"):
        check_same({"config": old}, {"config": {**old, "seed": 0}}, "file")
    del old["fitting"]
    with pytest.raises(InputError, match="was begun without config.fitting, and is"):
        check_same({"config": old}, {"config": {**old, "fitting": {"windows": 3}}}, "file")


# --- whole trainings ---------------------------------------------------------------------

MIXED = (
    samples.one_step(iterations=7, noise={"tau": 0.2}, ema=0.9),
    samples.unrolled(iterations=5, steps=(1, 2), start="pool", batch=2, restart=0.5),
)


def trained(settings, folder, output, **options):
    training = Training(settings, folder, output, **options)
    training.run()
    return training


def rows(output):
    """The history without its times."""
    with (output / "history.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


OFTEN = {
    "checkpoint_every": {"iterations": 2}, "validate_every": {"iterations": 4}, "report_every": 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def uninterrupted(short, tmp_path_factory):
    """A training of both kinds of stages in one go, and its folder."""
    torch.set_num_threads(1)
    output = tmp_path_factory.mktemp("whole")
    return trained(samples.config(*MIXED, **OFTEN), short, output), output


def same_files(one, other):
    """Whether two trainings have the same weights, moments and histories, bit by bit."""
    (_, mine), (_, others) = (read_checkpoint(x / "checkpoint.safetensors") for x in (one, other))
    assert mine.keys() == others.keys()
    assert all(torch.equal(x, others[name]) for name, x in mine.items())
    assert rows(one) == rows(other)
    assert len(rows(one)) > 5


@pytest.mark.parametrize("stop", [None, 10], ids=["early", "late"])
def test_a_training_that_was_interrupted_ends_with_the_same_bits(
    short, uninterrupted, tmp_path, stop, monkeypatch
):
    if stop is None:  # another place at each run
        stop = random.Random(os.getpid()).randrange(1, 7)
    settings = samples.config(*MIXED, **OFTEN)
    whole, folder_of_whole = uninterrupted
    step, done = Optimiser.step, []

    def interrupted(self, *arguments):
        if len(done) == stop:
            raise KeyboardInterrupt
        done.append(1)
        step(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Optimiser, "step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            trained(settings, short, tmp_path)
    torch.randn(3)  # the program's own random numbers have no say
    parts = trained(settings, short, tmp_path, resume=True)
    assert parts.progress.total == whole.progress.total == 12
    assert torch.equal(weights(parts.corrector), weights(whole.corrector)), f"stop = {stop}"
    same_files(folder_of_whole, tmp_path)


def test_a_training_leaves_the_best_model_with_its_record(short, tmp_path):
    settings = samples.config(samples.one_step(iterations=6), validate_every={"iterations": 3})
    training = trained(settings, short, tmp_path / "out")
    found = load_model(tmp_path / "out" / "model")
    table = [row for row in rows(tmp_path / "out") if row["omega_mean"]]
    best = max(float(row["omega_mean"]) for row in table)
    assert len(table) == 2
    assert found.record.metrics["omega_mean"] == pytest.approx(best, rel=1e-4)
    assert found.record.dataset == "tiny"
    assert found.record.training["config"]["stages"][0]["iterations"] == 6
    assert found.record.training["integrator"] == found.integrator == "backward-euler"
    assert len(found.record.dataset_hash) == 64
    assert torch.equal(weights(found.corrector), weights(training.corrector))
    scores = Validation(load_recordings(short, "validation", "plain"), "plain")(found.corrector)
    assert scores.mean == pytest.approx(best, rel=1e-4)
    assert TrainingConfig.load(tmp_path / "out" / "config.toml") == settings
    assert list((tmp_path / "out" / "tensorboard").iterdir())


@pytest.mark.parametrize("begin", ["best", "last"])
def test_a_stage_begins_from_the_best_or_the_last_weights(short, tmp_path, begin, monkeypatch):
    settings = samples.config(
        samples.one_step(iterations=3), samples.one_step(iterations=1, begin=begin),
        validate_every={"iterations": 1},
    )  # fmt: skip
    found, shown = [], iter([5.0, 7.0, 6.0, 1.0])

    def judge(self, corrector):
        found.append(weights(corrector))
        return Scores(np.array([next(shown)]), 0)

    monkeypatch.setattr(Validation, "__call__", judge)
    monkeypatch.setattr(
        Optimiser, "step", lambda self, *_: [w.data.add_(1.0) for w in self._weights]
    )
    training = trained(settings, short, tmp_path / "out")
    torch.testing.assert_close(found[3], found[1 if begin == "best" else 2] + 1.0)
    assert torch.equal(weights(training.corrector), found[1])


def test_training_ends_early_when_it_no_longer_helps(short, tmp_path):
    stage = samples.one_step(iterations=50, patience=2, rate={"peak": 1e-12, "last": 1e-12})
    settings = samples.config(stage, validate_every={"iterations": 1})
    training = trained(settings, short, tmp_path / "out")
    assert training.progress.total < 25
    assert training.progress.stage == 1


def test_a_training_without_a_validation_split_keeps_its_last_weights(tmp_path):
    data = samples.dataset(tmp_path / "data", training=(0,), validation=())
    training = trained(samples.config(samples.one_step()), data, tmp_path / "out")
    found = load_model(tmp_path / "out" / "model").corrector
    assert torch.equal(weights(found), weights(training.corrector))


def test_the_command_trains_stops_in_time_and_goes_on(short, tmp_path, program):
    text = samples.config(samples.one_step(iterations=3), report_every=1).to_toml()
    (tmp_path / "c.toml").write_text(text)
    call = ("train", tmp_path / "c.toml", "--data", short, "-o", tmp_path / "out")
    status, _, err = program(*call, "--evaluate", "eval")
    assert (status, (tmp_path / "out").exists()) == (2, False)
    assert "eval" in err
    status, out, err = program(*call, "--seconds", 1e-6)
    assert status == 1, err
    assert "not finished after 1 iterations" in out
    status, _, err = program(*call)
    assert status == 2
    assert "--resume" in err
    status, out, err = program(*call, "--resume", "--evaluate", "validation")
    assert status == 0, err
    assert "removed, %" in out
    summary = json.loads((tmp_path / "out" / "evaluation" / "summary.json").read_text())
    assert summary["data"]["split"] == "validation"
    assert summary["gate"] == Gate().model_dump()
    assert [row["iteration"] for row in rows(tmp_path / "out") if row["loss"]] == ["1", "2", "3"]
    status, out, err = program(*call, "--resume")
    assert status == 0, err
    (tmp_path / "c.toml").write_text(text.replace("batch = 3", "batch = 2"))
    status, _, err = program(*call, "--resume")
    assert status == 2
    assert "config.stages.0.batch = 3" in err


# --- several processes -------------------------------------------------------------------

_WORKER = """
import sys
from pdcorrect.training.training import Training
from pdcorrect.training.config import TrainingConfig
from pdcorrect.training.world import joined
import torch
torch.set_num_threads(1)
with joined("cpu") as (world, device):
    assert world.size == 2
    Training(TrainingConfig.load(sys.argv[1]), sys.argv[2], sys.argv[3], world=world).run()
"""


@pytest.mark.slow
def test_two_processes_train_like_one_with_both_batches(folder, tmp_path):
    settings = samples.config(
        samples.one_step(iterations=3, batch=2), checkpoint_every={"iterations": 3}
    )
    (tmp_path / "c.toml").write_text(settings.to_toml())
    script = tmp_path / "worker.py"
    script.write_text(_WORKER)
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone",
        str(script), str(tmp_path / "c.toml"), str(folder), str(tmp_path / "out"),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(rows(tmp_path / "out")) == 2

    corrector = Training(settings, folder, tmp_path / "one").corrector
    windows, _ = samples.windows(folder, settings)
    stage = settings.stages[0]
    optimiser = Optimiser(corrector, stage, None, World())
    from pdcorrect.training.sources import make_source

    parts = [
        make_source(stage, 0, settings, windows, SceneGroups([], "plain"), World(rank, 2))
        for rank in (0, 1)
    ]
    for k in range(3):
        loss = sum(part.loss(corrector, k, 1) for part in parts) / 2
        optimiser.step(loss, k / 3)
    found = load_model(tmp_path / "out" / "model").corrector
    torch.testing.assert_close(weights(found), weights(corrector), rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_a_killed_training_ends_with_the_same_bits(short, uninterrupted, tmp_path):
    settings = samples.config(*MIXED, **OFTEN)
    (tmp_path / "c.toml").write_text(settings.to_toml())
    output = tmp_path / "out"
    call = [
        sys.executable, "-m", "pdcorrect.cli.main", "train", tmp_path / "c.toml", "--data", short,
        "-o", output, "--resume",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    killed = 0
    for _ in range(3):
        known = [r["iteration"] for r in rows(output)] if (output / "history.csv").exists() else []
        process = subprocess.Popen(call, env=environment, stdout=subprocess.PIPE, text=True)
        process.stdout.readline()
        time.sleep(random.Random(f"{os.getpid()} {known}").uniform(0, 0.5))
        process.kill()
        process.communicate()
        killed += process.returncode == -9
    assert killed
    assert subprocess.run(call, env=environment, stdout=subprocess.PIPE).returncode == 0
    same_files(uninterrupted[1], output)


# --- slow --------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_trajectory_is_learned_by_heart(tmp_path):
    data = samples.dataset(tmp_path / "data", training=(0,), validation=())
    (data / "validation").mkdir(exist_ok=True)
    text = (data / "training" / "mesh-0000.h5").read_bytes()
    (data / "validation" / "mesh-0000.h5").write_bytes(text)
    architecture = {"preset": "compact", "changes": {"layers": 3, "width": 48}}
    settings = samples.config(
        samples.one_step(iterations=500, batch=20, rate={"peak": 4e-3}, noise={"tau": 0.03}),
        samples.unrolled(
            begin="last", iterations=60, steps=(5, 10, 20), batch=1, through_solver=True,
            rate={"peak": 6e-4},
        ),
        corrector=architecture, validate_every={"iterations": 520}, base="best",
    )  # fmt: skip
    training = trained(settings, data, tmp_path / "out")
    assert training.progress.best >= 99.9


def test_a_batch_without_a_scene_that_stepped_has_no_loss():
    values, none = torch.ones(2), torch.zeros(2, dtype=torch.bool)
    assert torch.isnan(mean_of(values, none))
    values = torch.tensor([1.0, torch.nan])
    assert mean_of(values, ~torch.isnan(values)) == 1.0


# --- starting from a model ------------------------------------------------------------------


@pytest.fixture(scope="module")
def earlier(short, tmp_path_factory):
    """A model that was trained for a moment."""
    output = tmp_path_factory.mktemp("earlier")
    trained(samples.config(samples.one_step()), short, output)
    return output / "model"


def test_a_training_starts_from_a_models_weights_and_normalisation(earlier, tmp_path):
    data = samples.dataset(tmp_path / "data", training=(3,), validation=(1,), frames=4)
    settings = samples.config(samples.one_step(), start_from=str(earlier))
    before = load_model(earlier).corrector
    training = Training(settings, data, tmp_path / "out")
    assert torch.equal(weights(training.corrector), weights(before))
    mine, theirs = training.corrector.normaliser, before.normaliser
    assert mine.output_scale == theirs.output_scale
    for name, known in theirs.named_buffers():
        found = mine.get_buffer(name)
        if name.endswith("__low"):
            assert (found <= known).all()
        elif name.endswith("__high"):
            assert (found >= known).all()
        else:
            assert torch.equal(found, known), name
    training.run()
    assert not torch.equal(weights(training.corrector), weights(before))
    found = load_model(tmp_path / "out" / "model")
    assert found.record.training["config"]["start_from"] == str(earlier)
    assert found.data_sets == load_model(earlier).data_sets  # of one configuration


def test_a_model_that_went_on_names_all_data_sets_that_it_has_learned(earlier, tmp_path):
    data = samples.dataset(tmp_path / "data", training=(3,), validation=(1,), frames=4)
    for path in data.rglob("*.h5"):
        shard = read_shard(path)
        other = {**shard.attributes, "dataset": "other", "config_hash": "0" * 64}
        path.unlink()
        write_shard(path, replace(shard, attributes=other), "float32")
    settings = samples.config(samples.one_step(), start_from=str(earlier))
    Training(settings, data, tmp_path / "out").run()
    (before,) = load_model(earlier).data_sets
    found = load_model(tmp_path / "out" / "model")
    assert found.data_sets == [before, ("other", "0" * 64)]
    assert found.record.dataset == "tiny+other"


def test_the_ranges_of_a_start_grow_by_the_new_data(short, earlier, tmp_path):
    settings = samples.config(samples.one_step(), start_from=str(earlier))
    training = Training(settings, short, tmp_path / "same")
    known = training.corrector.normaliser
    fitted = known.get_buffer("deformation__high").clone()
    assert fitted == load_model(earlier).corrector.normaliser.get_buffer("deformation__high")
    further = {name: Moments() for name in known.names}
    for name, moments in further.items():
        width = len(known.get_buffer(f"{name.replace('-', '_')}__low"))
        moments.add(torch.full((1, width), 1e3))
    known.widen(further)
    assert known.get_buffer("deformation__high") == 1e3
    assert known.get_buffer("deformation__low") < fitted


def test_the_ranges_of_a_start_may_stay_and_the_weights_become_the_same(short, earlier, tmp_path):
    model = load_model(earlier)
    model.corrector.normaliser.shape_high -= 1.0  # as of other bodies
    model.corrector.normaliser.time_step_high += 1.0  # and of longer time steps, too
    start = save_model(model.corrector, tmp_path / "start", record=model.record)
    found = {}
    for widen in (True, False):
        settings = samples.config(
            samples.one_step(), start_from=str(start), fitting={"widen": widen}
        )
        Training(settings, short, tmp_path / str(widen)).run()
        found[widen] = load_model(tmp_path / str(widen) / "model").corrector
        assert ("widen" in settings.model_dump()["fitting"]) is not widen
    for name, known in model.corrector.normaliser.named_buffers():
        assert torch.equal(found[False].normaliser.get_buffer(name), known), name
    assert (found[True].normaliser.shape_high > model.corrector.normaliser.shape_high).all()
    assert torch.equal(weights(found[True]), weights(found[False]))
    assert not torch.equal(weights(found[True]), weights(model.corrector))


def test_a_start_that_training_only_worsens_is_what_is_kept(short, earlier, tmp_path):
    ruin = samples.one_step(iterations=3, rate={"peak": 1.0, "last": 1.0, "warmup": 0.0})
    settings = samples.config(ruin, start_from=str(earlier))
    trained(settings, short, tmp_path / "out")
    kept = load_model(tmp_path / "out" / "model").corrector
    assert torch.equal(weights(kept), weights(load_model(earlier).corrector))


def test_a_start_of_another_architecture_is_refused_with_the_difference(short, earlier, tmp_path):
    other = {"preset": "compact", "changes": {"layers": 2, "width": 8}}
    settings = samples.config(samples.one_step(), start_from=str(earlier), corrector=other)
    with pytest.raises(InputError, match=r"that model has layers = 1, unlike corrector"):
        Training(settings, short, tmp_path / "out")
    settings = samples.config(samples.one_step(), start_from=str(tmp_path / "nothing"))
    with pytest.raises(InputError, match="not there: expected a folder with model.json and"):
        Training(settings, short, tmp_path / "out")


def test_a_start_of_another_base_or_velocity_is_refused(short, earlier, tmp_path):
    for changes, told in (
        ({"base": "best"}, "start_from = .*its base is 'plain': expected 'best', as here, or fit"),
        ({"velocity": "kept"}, "its velocity is 'recomputed': expected 'kept'"),
    ):
        settings = samples.config(samples.one_step(), start_from=str(earlier), **changes)
        with pytest.raises(InputError, match=told):
            Training(settings, short, tmp_path / "out")


def test_a_training_does_not_go_on_with_another_teacher(short, earlier, tmp_path):
    teacher = tmp_path / "teacher"
    shutil.copytree(earlier, teacher)
    stage = samples.unrolled(teacher=str(teacher), iterations=3)
    settings = samples.config(stage, checkpoint_every={"iterations": 1})
    assert not Training(settings, short, tmp_path / "out").run(seconds=0.0)
    other = load_model(teacher)
    with torch.no_grad():
        next(other.corrector.network.parameters()).add_(0.1)
    save_model(other.corrector, teacher, record=other.record)
    with pytest.raises(InputError, match="teachers"):
        Training(settings, short, tmp_path / "out", resume=True)


def test_a_training_does_not_go_on_from_another_start(short, earlier, tmp_path):
    start = tmp_path / "start"
    shutil.copytree(earlier, start)
    settings = samples.config(samples.one_step(), start_from=str(start))
    trained(settings, short, tmp_path / "out")
    assert Training(settings, short, tmp_path / "out", resume=True).progress.stage == 1
    altered = load_model(start).corrector
    altered.network.decoder[0].bias.data += 1.0
    save_model(altered, start, record=load_model(earlier).record)
    with pytest.raises(InputError, match="was begun with start = "):
        Training(settings, short, tmp_path / "out", resume=True)

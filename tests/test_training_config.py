"""Settings of a training, what is minimised, and files of checkpoints."""

import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.data.schema import read_shard  # noqa: E402
from pdcorrect.errors import FileFormatError, FileVersionError, InputError  # noqa: E402
from pdcorrect.training.losses import BaseErrors, body_losses, mean_of  # noqa: E402
from pdcorrect.training.optimisation import rate_at  # noqa: E402
from pdcorrect.training.progress import (  # noqa: E402
    check_same,
    read_checkpoint,
    write_checkpoint,
)
from pdcorrect.training.recipe import Loss, Rate, TrainingConfig  # noqa: E402
from pdcorrect.training.scenes import _mean_square, load_recordings  # noqa: E402

ROOT = Path(__file__).parent.parent

# --- configuration -----------------------------------------------------------------------

BASIC = '[[stages]]\nkind = "one-step"\niterations = 1\n'
UNROLLED = BASIC.replace("one-step", "unrolled")
START = 'start_from = "tiny"\n'


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("seeds = 1\n" + BASIC, "seeds"),
        (BASIC + "rates = 1.0\n", r"stages\[0\]\.rates: .*rate"),
        ("batch = 3\n" + BASIC, r"batch: .*stages"),
        (BASIC + "seed = 3\n", r"stages\[0\]\.seed"),
        (BASIC + "peak = 0.1\n", r"stages\[0\]\.peak: .*stages\.rate"),
        (BASIC + "[stages.rate]\nbatch = 3\n", r"stages\[0\]\.rate\.batch: .*stages"),
        ("[corrector]\nwidth = 3\n" + BASIC, r"corrector\.width: .*corrector\.changes"),
        ("fiting = {}\n" + BASIC, "fiting: .*fitting"),
        (BASIC + "fiting = {}\n", r"stages\[0\]\.fiting: .*fitting"),
        (BASIC + "seconds = 1.0\n", r"stages\[0\] .*seconds, iterations, epochs"),
        (BASIC + "through_solver = true\n", r"stages\[0\] .*through_solver"),
        (BASIC + "batch = 0\n", r"stages\[0\]\.batch = 0"),
        (UNROLLED + "steps = [4, 2]\n", r"stages\[0\]\.steps = \[4, 2\]"),
        (UNROLLED + "steps = 0\n", r"stages\[0\]\.steps.* = 0"),
        (UNROLLED + "[stages.noise]\ntau = 0.1\n", r"stages\[0\] .*noise"),
        (BASIC.replace("one-step", "two-step"), r'stages\[0\]\.kind = "two-step"'),
        (BASIC + "[stages.loss]\nkind = 'absolute'\nbend = 1.0\n", "loss .*bend"),
        (BASIC + "[stages.loss]\nkind = 'absolute'\nahead = 1.0\n", "loss .*ahead"),
        (BASIC + "loss = {ahead = 1.0}\n", r"stages\[0\] .*loss\.ahead"),
        (UNROLLED + "loss = {ahead = 0.0}\n", r"stages\[0\]\.loss\.ahead = 0\.0"),
        (BASIC + "at_rest = 0.5\n", r"stages\[0\] .*at_rest"),
        (UNROLLED + "at_rest = 1.5\n", r"stages\[0\]\.at_rest = 1\.5"),
        ("stages = []\n", r"stages = \[\]"),
        (BASIC + "[[stages]]\nkind = 'one-step'\nbatch = 'x'\n", r'stages\[1\]\.batch = "x"'),
        ('[corrector]\npreset = "huge"\n' + BASIC, r"corrector\.preset = \"huge\""),
        ("[corrector]\nchanges = {widths = 3}\n" + BASIC, r"corrector\.changes\.widths: .*width"),
        ("[corrector]\nchanges = {layers = 0}\n" + BASIC, r"corrector\.changes\.layers = 0"),
        ("[corrector]\nchanges = {edge_features = ['load']}\n" + BASIC, "'load'"),
        ("[validate_every]\nseconds = 1.0\niterations = 2\n" + BASIC, "validate_every"),
        ("base = 'plain", "TOML"),
        ("start_from = 3\n" + BASIC, "start_from = 3"),
        ("start_from = ''\n" + BASIC, 'start_from = ""'),
        ("[body]\nshape = 'beam'\n", "body"),
        ("family = 'cross'\n", "family"),
        (BASIC + "[fitting]\nwiden = false\n", r"fitting\.widen = false "),
        (START + BASIC + "[fitting]\nwiden = 0\n", r"fitting\.widen = 0"),
    ],
)
def test_a_wrong_configuration_is_refused_by_its_key(text, named):
    with pytest.raises(InputError, match=named):
        TrainingConfig.from_toml(text)


def test_a_configuration_comes_back_from_its_toml():
    stage = samples.unrolled(steps=(1, 4), start="pool", rate=Rate(peak=0.1))
    settings = samples.config(samples.one_step(ema=0.5), stage, start_from="tiny")
    text = settings.to_toml()
    again = TrainingConfig.from_toml(text)
    assert again == settings
    assert again.stages[1] == stage


TRAININGS = [*(ROOT / "examples" / "training").glob("*.toml"), *(ROOT / "models").rglob("*/*.toml")]


@pytest.mark.parametrize(
    "path", sorted(TRAININGS), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_the_examples_and_recipes_can_be_read(path):
    TrainingConfig.load(path)


def test_the_thesis_is_an_example():
    settings = TrainingConfig.load(ROOT / "examples" / "training" / "thesis.toml")
    (stage,) = settings.stages
    assert settings.corrector.preset == "thesis"
    assert (stage.batch, stage.epochs, stage.horizon(0.5)) == (1, 20, 1)
    assert (stage.loss.kind, stage.loss.scale) == ("absolute", 1000.0)


def test_horizon_rate_and_budget_follow_the_share_of_a_stage():
    stage = samples.unrolled(steps=(1, 2, 8))
    shares = (0.0, 0.3, 0.34, 0.65, 0.67, 0.99, 1.0)
    assert [stage.horizon(s) for s in shares] == [1, 1, 2, 2, 8, 8, 8]
    rate = Rate(peak=1.0, last=0.1, warmup=0.2)
    assert rate_at(rate, 0.1) == pytest.approx(0.5)
    assert rate_at(rate, 0.2) == pytest.approx(1.0)
    assert rate_at(rate, 0.6) == pytest.approx(0.55)
    assert rate_at(rate, 1.0) == pytest.approx(0.1)
    assert 0 < rate_at(rate, 0.0) < 0.01
    assert rate_at(Rate(peak=0.3, last=0.3, warmup=0.0), 0.7) == 0.3
    assert samples.one_step(iterations=8).share_done(100, 2, 50.0) == 0.25
    for budget in ({"epochs": 2}, {"seconds": 200.0}):
        stage = samples.one_step(iterations=None, **budget)
        assert stage.share_done(10, 5, 50.0) == 0.25


@pytest.mark.parametrize(
    ("before", "now", "key", "values"),
    [
        ({"batch": 3}, {"batch": 2}, "config.stages[0].batch", ("3", "2")),
        ({}, {"ema": 0.5}, "config.stages[0].ema", ("none", "0.5")),
        ({"fitting": {"widen": False}}, {}, "config.fitting.widen", ("false", "true")),
        ({}, {"without": ["training/mesh-0042"]}, "config.without", ("[]", "mesh-0042")),
        (
            {"corrector": {"preset": "compact", "changes": {"width": 8}}},
            {"corrector": {"preset": "compact"}}, "config.corrector.changes.width", ("8",),
        ),
    ],
)  # fmt: skip
def test_other_settings_are_refused_by_their_key(before, now, key, values):
    def dumped(changes):
        stage = {name: changes[name] for name in ("batch", "ema") if name in changes}
        rest = {name: value for name, value in changes.items() if name not in stage}
        settings = samples.config(samples.one_step(**stage), start_from="tiny", **rest)
        return {"config": settings.model_dump(mode="json")}

    one, other = dumped(before), dumped(now)
    check_same(one, json.loads(json.dumps(one)), "file")
    with pytest.raises(InputError) as refusal:
        check_same(one, other, "file")
    told = str(refusal.value)
    assert told.startswith("file: ")
    assert key in told.replace("stages.0", "stages[0]")
    assert all(value in told for value in values), told


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


def test_losses_without_a_distance_or_without_a_scene():
    errors = ERRORS.clone().requires_grad_()
    body_losses(Loss(kind="absolute", power=1), errors, sums, None, None).sum().backward()
    assert errors.grad[1].tolist() == [0.0, 0.0, 0.0]
    assert errors.grad[0].tolist() == pytest.approx([600.0, 0.0, 800.0])
    values, none = torch.ones(2), torch.zeros(2, dtype=torch.bool)
    assert torch.isnan(mean_of(values, none))
    values = torch.tensor([1.0, torch.nan])
    assert mean_of(values, ~torch.isnan(values)) == 1.0


def test_expected_errors_of_the_base_model_grow_to_those_of_its_rollout():
    errors = BaseErrors(torch.tensor([1e-6, 1e-6, 1e-4]), torch.tensor([1e-3, 2e-5, 1e-6]))
    assert errors.after(1).tolist() == pytest.approx([1e-6, 1e-6, 1e-4])
    assert errors.after(2).tolist() == pytest.approx([9e-6, 9e-6, 1e-4])
    steps = torch.tensor([3, 3, 1])
    assert errors.after(steps).tolist() == pytest.approx([36e-6, 2e-5, 1e-4])


@pytest.mark.parametrize("base", ["plain", "best"])
def test_recorded_errors_are_mean_squared_distances(tmp_path, base):
    folder = samples.dataset(tmp_path)
    recordings = load_recordings(folder, "training", base)
    simulations = read_shard(folder / "training" / "mesh-0003.h5").simulations
    for recording, simulation in zip(recordings[1:], simulations, strict=True):
        truth = simulation.runs["reference"].positions[1:].astype(np.float64)
        stored = simulation.runs[base]
        for found, run in (
            (recording.one_step, stored.predictions),
            (recording.rollout, stored.positions[1:]),
        ):
            assert found == pytest.approx(((run - truth) ** 2).sum(axis=2).mean(), rel=1e-6)


def test_errors_below_the_rounding_of_storage_are_not_learned():
    x = np.linspace(1.0, 2.0, 12, dtype=np.float32).reshape(1, 4, 3)
    rounding = (2.0 * np.finfo(np.float32).eps) ** 2
    assert _mean_square(x, x) == pytest.approx(rounding)
    y = x + np.float32(0.01)
    assert _mean_square(y, x) == pytest.approx(3e-4, rel=1e-3)


# --- checkpoints -------------------------------------------------------------------------


def test_checkpoints_come_back_and_every_damaged_one_is_refused_by_name(tmp_path):
    tensors = {"a": torch.tensor([1.0, np.pi]), "b": torch.tensor(3), "c": torch.zeros(0, 2)}
    write_checkpoint(tmp_path / "c", {"x": 0.1 + 0.2, "list": [1, None]}, tensors)
    content, found = read_checkpoint(tmp_path / "c")
    assert content == {"x": 0.1 + 0.2, "list": [1, None]}
    assert all(torch.equal(found[n], x) and found[n].dtype == x.dtype for n, x in tensors.items())

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
    path.write_bytes(whole.replace(b'"version":"1"', b'"version":"9"'))
    with pytest.raises(FileVersionError, match="version 9"):
        read_checkpoint(path)

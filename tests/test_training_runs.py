"""Whole trainings: interrupted, killed or in several processes, they end with the same bits."""

import csv
import json
import os
import random
import subprocess
import sys
import time

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.corrector.gate import Gate  # noqa: E402
from pdcorrect.corrector.model_io import load_model  # noqa: E402
from pdcorrect.errors import ConvergenceError  # noqa: E402
from pdcorrect.training.distributed import ProcessGroup  # noqa: E402
from pdcorrect.training.optimisation import Optimiser  # noqa: E402
from pdcorrect.training.progress import read_checkpoint  # noqa: E402
from pdcorrect.training.recipe import TrainingConfig  # noqa: E402
from pdcorrect.training.scenes import load_recordings  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402
from pdcorrect.training.validation import Scores, Validation  # noqa: E402
from pdcorrect.training.windows import OneStepBatches, seed_of  # noqa: E402
from training_samples import weights  # noqa: E402


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The same with five frames."""
    return samples.dataset(tmp_path_factory.mktemp("short"), frames=5)


pytestmark = pytest.mark.usefixtures("few_threads")

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


def test_a_training_that_was_interrupted_ends_with_the_same_bits(
    short, uninterrupted, tmp_path, monkeypatch
):
    """Early, at another place at each run, and late, after ten steps."""
    early = random.Random(os.getpid()).randrange(1, 7)
    settings = samples.config(*MIXED, **OFTEN)
    whole, folder_of_whole = uninterrupted
    step = Optimiser.step

    def interrupted(self, *arguments):
        if not left.pop():
            raise KeyboardInterrupt
        step(self, *arguments)

    for stop, resume in ((early, False), (10 - early // 2 * 2, True)):
        left = [False] + [True] * stop
        with monkeypatch.context() as patch:
            patch.setattr(Optimiser, "step", interrupted)
            with pytest.raises(KeyboardInterrupt):
                trained(settings, short, tmp_path, resume=resume)
    torch.randn(3)  # the program's own random numbers have no say
    parts = trained(settings, short, tmp_path, resume=True)
    assert parts.progress.total == whole.progress.total == 12
    assert torch.equal(weights(parts.corrector), weights(whole.corrector)), f"early = {early}"
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


def test_a_stage_begins_from_the_best_weights(short, tmp_path, monkeypatch):
    settings = samples.config(
        samples.one_step(iterations=3), samples.one_step(iterations=1),
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
    torch.testing.assert_close(found[3], found[1] + 1.0)
    assert torch.equal(weights(training.corrector), found[1])


def test_training_ends_with_an_error_after_many_batches_without_a_gradient(
    folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        OneStepBatches, "loss",
        lambda self, corrector, *_: torch.nan * next(corrector.network.parameters()).sum(),
    )  # fmt: skip
    settings = samples.config(samples.one_step(iterations=30), report_every=2, base="plain")
    training = Training(settings, folder, tmp_path / "out")
    with pytest.raises(ConvergenceError, match="stage 0, iteration 20: 20 "):
        training.run()


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
    assert "1 iterations" in out
    status, _, err = program(*call)
    assert status == 2
    assert "--resume" in err
    status, out, err = program(*call, "--resume", "--evaluate", "validation")
    assert status == 0, err
    summary = json.loads((tmp_path / "out" / "evaluation" / "summary.json").read_text())
    assert summary["data"]["split"] == "validation"
    assert summary["gate"] == Gate().model_dump()
    assert [row["iteration"] for row in rows(tmp_path / "out") if row["loss"]] == ["1", "2", "3"]
    status, out, err = program(*call, "--resume")
    assert status == 0, err
    (tmp_path / "c.toml").write_text(text.replace("batch = 3", "batch = 2"))
    status, _, err = program(*call, "--resume")
    assert status == 2
    assert "batch = 3" in err


# --- several processes -------------------------------------------------------------------


@pytest.mark.slow  # two processes import torch, and join
def test_two_processes_train_like_one_with_both_batches(folder, tmp_path):
    settings = samples.config(
        samples.one_step(iterations=3, batch=2), checkpoint_every={"iterations": 3}
    )
    (tmp_path / "c.toml").write_text(settings.to_toml())
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone",
        "-m", "pdcorrect", "train", tmp_path / "c.toml", "--data", folder, "-o", tmp_path / "out",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(rows(tmp_path / "out")) == 2

    corrector = Training(settings, folder, tmp_path / "one").corrector
    windows, _ = samples.windows(folder, settings)
    stage = settings.stages[0]
    optimiser = Optimiser(corrector, stage, None, ProcessGroup())
    seed = seed_of(settings.seed, 0)
    parts = [OneStepBatches(windows, stage, seed, ProcessGroup(rank, 2)) for rank in (0, 1)]
    for k in range(3):
        loss = sum(part.loss(corrector, k, 1) for part in parts) / 2
        optimiser.step(loss, k / 3)
    found = load_model(tmp_path / "out" / "model").corrector
    torch.testing.assert_close(weights(found), weights(corrector), rtol=1e-4, atol=1e-7)


@pytest.mark.slow  # programs that import torch, four times
def test_a_killed_training_ends_with_the_same_bits(short, uninterrupted, tmp_path):
    settings = samples.config(*MIXED, **OFTEN)
    (tmp_path / "c.toml").write_text(settings.to_toml())
    output = tmp_path / "out"
    call = [
        sys.executable, "-m", "pdcorrect", "train", tmp_path / "c.toml", "--data", short,
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


@pytest.mark.slow  # a training of a minute
def test_one_trajectory_is_learned_by_heart(tmp_path):
    data = samples.dataset(tmp_path / "data", training=(0,), validation=())
    (data / "validation").mkdir(exist_ok=True)
    text = (data / "training" / "mesh-0000.h5").read_bytes()
    (data / "validation" / "mesh-0000.h5").write_bytes(text)
    architecture = {"preset": "compact", "changes": {"layers": 3, "width": 48}}
    settings = samples.config(
        samples.one_step(iterations=500, batch=20, rate={"peak": 4e-3}, noise={"tau": 0.03}),
        samples.unrolled(
            iterations=60, steps=(5, 10, 20), batch=1, through_solver=True,
            rate={"peak": 6e-4},
        ),
        corrector=architecture, validate_every={"iterations": 500}, base="best",
    )  # fmt: skip
    training = trained(settings, data, tmp_path / "out")
    assert training.progress.best >= 99.9

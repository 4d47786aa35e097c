"""`models/make_all.py`: in which order its commands run, and what becomes of those that fail."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from typing import ClassVar

import pytest

pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "models" / "recipes"
sys.path.append(str(ROOT / "models"))  # as where it runs as a program
SPEC = importlib.util.spec_from_file_location("make_models", ROOT / "models" / "make_all.py")
make = importlib.util.module_from_spec(SPEC)
sys.modules["make_models"] = make
SPEC.loader.exec_module(make)

OPTIONS = Namespace(
    device="cpu", generators=1, batch=7, measurers=1, seconds=None, split=["evaluation"]
)


class Told:
    """In the place of a process: it ends at once, with the status that its command names."""

    commands: ClassVar[list] = []

    def __init__(self, command, **others):
        Told.commands.append((command, others))
        self._status = int(command[-1]) if command[-1].isdigit() else 0

    def poll(self):
        return self._status


@pytest.fixture(autouse=True)
def told(monkeypatch, request):
    if "slow" not in request.keywords:
        Told.commands = []
        monkeypatch.setattr(make.subprocess, "Popen", Told)


def job(name, queue="train", status=0, **others):
    return make.Job(name, queue, ["train", str(status)], **others)


def machine(folder, gpus=(), together=2):
    return make.Machine(folder, gpus, {"generate": 1, "train": together, "evaluate": 1})


def test_a_job_waits_for_what_it_needs_and_runs_in_the_folder_of_the_work(tmp_path, capsys):
    first = job("first", "generate")
    second = job("second", needs=[first])
    assert machine(tmp_path).run([second, first])
    told = [line.split(" s  ")[1].split()[0] for line in capsys.readouterr().out.splitlines()]
    assert told == ["first", "first", "second", "second"]
    assert [others["cwd"] for _, others in Told.commands] == [tmp_path] * 2


def test_what_needs_a_failed_job_is_not_run(tmp_path):
    data = job("data", "generate", status=2)
    training = job("training", needs=[data])
    evaluation = job("evaluation", "evaluate", after=[training])
    other = job("other")
    assert not machine(tmp_path).run([data, training, evaluation, other])
    assert data.status == training.status == evaluation.status == 2
    assert (training.process, other.status) == (None, 0)


def test_a_training_whose_time_is_up_is_evaluated_and_nothing_goes_on_with_it(tmp_path):
    training = job("training", status=make.STOPPED)
    further = job("further", needs=[training])
    evaluation = job("evaluation", "evaluate", after=[training, further])
    assert not machine(tmp_path).run([further, training, evaluation])
    assert (further.process, evaluation.status) == (None, 0)


def test_jobs_that_wait_for_each_other_are_refused(tmp_path):
    first, data = job("first"), job("data", "generate")
    first.needs = [job("second", needs=[first])]
    with pytest.raises(SystemExit):
        machine(tmp_path).run([data, first, *first.needs])


def test_trainings_are_spread_over_the_visible_gpus(tmp_path):
    jobs = [job(f"job {k}") for k in range(4)]
    assert machine(tmp_path, ["2", "5"], together=4).run(jobs)
    assert sorted(each.gpu for each in jobs) == ["2", "2", "5", "5"]


def copied(folder):
    """Another recipe for the data of one that there is."""
    other = folder / "recipes" / "torsion-exact" / "other.toml"
    other.parent.mkdir(parents=True)
    other.write_text((RECIPES / "torsion-exact" / "through.toml").read_text())
    return other


def test_the_plan_has_data_trainings_and_an_evaluation_for_each_data_set(tmp_path):
    recipes = [
        RECIPES / "torsion-exact" / "through.toml",
        RECIPES / "torsion-many" / "best-without-ahead.toml",  # starts from the first
        copied(tmp_path),
    ]
    jobs = {each.name: each for each in make.plan(tmp_path, recipes, OPTIONS)}
    assert list(jobs) == [
        "generate-torsion-exact", "generate-torsion-many", "train-torsion-exact-through",
        "train-torsion-many-best-without-ahead", "train-torsion-exact-other",
        "evaluate-torsion-exact-evaluation", "evaluate-torsion-many-evaluation",
    ]  # fmt: skip
    for name in ("generate-torsion-exact", "evaluate-torsion-exact-evaluation"):
        given = jobs[name].arguments
        assert given[given.index("--batch") + 1] == "7"
    needed = {name: [one.name for one in each.needs] for name, each in jobs.items()}
    assert needed["train-torsion-exact-other"] == ["generate-torsion-exact"]
    assert needed["train-torsion-many-best-without-ahead"] == [
        "generate-torsion-many", "train-torsion-exact-through",
    ]  # fmt: skip
    last = jobs["evaluate-torsion-exact-evaluation"]
    assert [model.parent.name for model in last.models] == ["through", "other"]


def test_data_that_are_there_are_not_generated(tmp_path):
    options = Namespace(**{**vars(OPTIONS), "generators": 0})
    jobs = make.plan(tmp_path, [copied(tmp_path)], options)
    assert [each.queue for each in jobs] == ["train", "evaluate"]
    assert list(jobs[0].needs) == []


def test_an_evaluation_takes_the_models_that_are_there(tmp_path):
    there, output = tmp_path / "there", tmp_path / "evaluations"
    for folder in (there, output):
        folder.mkdir()
    evaluation = make.Job(
        "evaluation", "evaluate", ["evaluate", "data"],
        models=[there, tmp_path / "not"], replaces=output,
    )  # fmt: skip
    assert machine(tmp_path).run([evaluation])
    assert Told.commands[0][0][-3:] == ["evaluate", str(there), "data"]
    assert not output.exists()


@pytest.mark.slow
def test_a_recipe_becomes_an_evaluated_model(tmp_path):
    recipe = tmp_path / "recipes" / "tiny" / "short.toml"
    recipe.parent.mkdir(parents=True)
    recipe.write_text(
        'base = "best"\n[[stages]]\nkind = "one-step"\niterations = 3\nbatch = 4\n'
        "[fitting]\nwindows = 20\n"
    )
    shutil.copytree(ROOT / "datasets/tiny", tmp_path / "work/data/tiny")
    (tmp_path / "work/data/tiny/evaluation/mesh-0002.h5").unlink()  # is made again
    call = [sys.executable, ROOT / "models/make_all.py", tmp_path / "work", recipe]
    done = subprocess.run(call, env={**os.environ, "OMP_NUM_THREADS": "1"}, timeout=600)
    assert done.returncode == 0
    summary = json.loads((tmp_path / "work/evaluations/tiny-evaluation/summary.json").read_text())
    assert summary["data"]["trajectories"] == 4
    assert "model" in summary["runs"]

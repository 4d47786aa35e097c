"""`models/make_all.py`: in which order its commands run, and what becomes of those that fail."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from argparse import Namespace
from itertools import pairwise
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "models"))  # as where it runs as a program
SPEC = importlib.util.spec_from_file_location("make_models", ROOT / "models" / "make_all.py")
make = importlib.util.module_from_spec(SPEC)
sys.modules["make_models"] = make
SPEC.loader.exec_module(make)

FINE, REFUSED = ["--help"], ["train", "nowhere.toml"]
OPTIONS = Namespace(
    device="cpu",
    generators=1,
    scheduler=None,
    batch=60,
    measurers=1,
    seconds=None,
    split=["evaluation"],
)


def machine(folder, together=2):
    return make.Machine(folder, [], {"generate": 1, "train": together, "evaluate": 1})


def test_a_job_waits_for_those_it_needs(tmp_path, capsys):
    first = make.Job("first", FINE, [], "generate")
    second = make.Job("second", FINE, [first], "train")
    assert machine(tmp_path).run([second, first])
    told = [line.split(" s  ")[1] for line in capsys.readouterr().out.splitlines()]
    assert told == ["first started", "first ended with 0", "second started", "second ended with 0"]
    assert "Usage" in (tmp_path / "logs/second.log").read_text()


def test_what_needs_a_failed_job_is_not_run(tmp_path, capsys):
    data = make.Job("data", REFUSED, [], "generate")
    training = make.Job("training", FINE, [data], "train")
    evaluation = make.Job("evaluation", FINE, [training], "evaluate")
    other = make.Job("other", FINE, [], "train")
    assert not machine(tmp_path).run([data, training, evaluation, other])
    assert data.status == training.status == evaluation.status == 2
    assert other.status == 0
    assert training.process is None
    told = capsys.readouterr().out
    assert "training started" not in told
    assert "evaluation cannot run: what it needs failed" in told


def test_a_training_whose_time_is_up_is_evaluated_but_not_finished(tmp_path):
    training = make.Job("training", REFUSED, [], "train", status=make.STOPPED)
    evaluation = make.Job("evaluation", FINE, [training], "evaluate")
    assert not machine(tmp_path).run([training, evaluation])
    assert evaluation.status == 0


def test_no_more_trainings_run_than_there_are_places(tmp_path):
    jobs = [make.Job(f"job {k}", FINE, [], "train") for k in range(3)]
    seen = []

    class Watched(make.Machine):
        def _start(self, job, jobs):
            super()._start(job, jobs)
            seen.append(sum(1 for _ in self._running("train", jobs)))

    assert Watched(tmp_path, [], {"train": 2}).run(jobs)
    assert max(seen) == 2


def test_the_plan_has_data_trainings_and_an_evaluation_for_each_data_set(tmp_path):
    recipes = [ROOT / "models/recipes/torsion-exact" / f"{n}.toml" for n in ("force", "plain")]
    recipes.append(ROOT / "models/recipes/torsion-as-published/force.toml")
    jobs = {job.name: job for job in make.plan(tmp_path, recipes, [], OPTIONS)}
    assert len(jobs) == 2 * 2 + 3 + 2
    last = jobs["evaluate-torsion-exact"]
    assert {job.name for job in last.after} == {
        "train-torsion-exact-force", "train-torsion-exact-plain",
        "generate-torsion-exact-evaluation",
    }  # fmt: skip
    assert [job.name for job in jobs["train-torsion-exact-plain"].after] == [
        "generate-torsion-exact-training"
    ]
    assert tmp_path / "trainings/torsion-exact/force/model" in last.models


def test_a_recipe_for_all_motions_waits_for_their_data_and_is_evaluated_on_each(tmp_path):
    recipes = [
        ROOT / "models/recipes" / name
        for name in ("all-as-published/total-mass.toml", "stretch-as-published/total-mass.toml")
    ]
    jobs = {job.name: job for job in make.plan(tmp_path, recipes, [], OPTIONS)}
    sets = ["impulse-as-published", "stretch-as-published", "torsion-as-published"]
    together = jobs["train-all-as-published-total-mass"]
    assert [job.name for job in together.after] == [f"generate-{name}-training" for name in sets]
    given = [str(tmp_path / "data" / name) for name in sets]
    arguments = together.arguments
    assert [b for a, b in pairwise(arguments) if a == "--data"] == given
    own = tmp_path / "trainings/stretch-as-published/total-mass/model"
    model = tmp_path / "trainings/all-as-published/total-mass/model"
    for name in sets:
        job = jobs[f"evaluate-{name}"]
        assert job.models == ([model, own] if name in own.parts else [model])
        assert together in job.after
    assert len(jobs) == 3 * 2 + 2 + 3


def test_a_released_model_of_all_motions_is_evaluated_on_each(tmp_path):
    jobs = make.plan(tmp_path, [], ["all-as-published-total-mass", "torsion-exact"], OPTIONS)
    models = {job.name: [path.name for path in job.models] for job in jobs if job.models}
    each = ["all-as-published-total-mass"]
    assert models == {
        "evaluate-impulse-as-published": each, "evaluate-stretch-as-published": each,
        "evaluate-torsion-as-published": each, "evaluate-torsion-exact": ["torsion-exact"],
    }  # fmt: skip


def test_a_training_waits_for_the_one_whose_model_it_starts_from(tmp_path):
    folder = ROOT / "models/recipes/impulse-as-published"
    recipes = [folder / f"{name}.toml" for name in ("total-mass-kicks", "total-mass", "through")]
    jobs = {job.name: job for job in make.plan(tmp_path, recipes, [], OPTIONS)}
    further, first, other = (jobs[f"train-impulse-as-published-{r.stem}"] for r in recipes)
    assert further.starts_from is first
    assert first.starts_from is other.starts_from is None
    alone = make.plan(tmp_path, recipes[:1], [], OPTIONS)
    assert [job.starts_from for job in alone] == [None] * 4


@pytest.mark.parametrize(("status", "begins"), [(0, True), (make.STOPPED, False), (2, False)])
def test_a_training_begins_with_a_finished_model_only(tmp_path, status, begins):
    first = make.Job("first", FINE, [], "train", status=status)
    further = make.Job("further", FINE, [], "train", starts_from=first)
    evaluation = make.Job("evaluation", FINE, [first, further], "evaluate")
    assert machine(tmp_path).run([further, first, evaluation]) == begins
    assert (further.process is not None) == begins
    assert further.status == status
    assert (evaluation.process is not None) == (status != 2)


def recipe(folder, name, start):
    path = folder / "tiny" / f"{name}.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(
        f'start_from = "trainings/tiny/{start}/model"\n'
        '[[stages]]\nkind = "one-step"\niterations = 3\n'
    )
    return path


def test_recipes_that_start_from_each_other_are_refused(tmp_path):
    recipes = [recipe(tmp_path, *names) for names in (("a", "b"), ("b", "c"), ("c", "b"))]
    with pytest.raises(SystemExit, match="starts from what starts from it"):
        make.plan(tmp_path, recipes, [], OPTIONS)
    with pytest.raises(SystemExit, match="starts from what starts from it"):
        make.plan(tmp_path, [recipe(tmp_path, "own", "own")], [], OPTIONS)


def test_an_evaluation_takes_the_models_that_are_there(tmp_path, monkeypatch):
    called = []

    class Called:
        def __init__(self, command, **others):
            called.append(command)

        def poll(self):
            return 0

    monkeypatch.setattr(make.subprocess, "Popen", Called)
    there, output = tmp_path / "there", tmp_path / "evaluations"
    for folder in (there, output):
        folder.mkdir()
    job = make.Job(
        "evaluation", ["evaluate", "data"], [], "evaluate",
        models=[there, tmp_path / "not"], replaces=output,
    )  # fmt: skip
    assert machine(tmp_path).run([job])
    assert called[0][-3:] == ["evaluate", str(there), "data"]
    assert not output.exists()


def test_commands_run_in_the_folder_of_the_work(tmp_path, monkeypatch):
    started = []

    class Told:
        def __init__(self, *arguments, cwd, **others):
            started.append(cwd)

        def poll(self):
            return 0

    monkeypatch.setattr(make.subprocess, "Popen", Told)
    assert machine(tmp_path).run([make.Job("told", FINE, [], "evaluate")])
    assert started == [tmp_path]


def test_data_that_are_there_are_not_generated(tmp_path):
    recipe = ROOT / "models/recipes/torsion-exact/force.toml"
    jobs = make.plan(tmp_path, [recipe], [], Namespace(**{**vars(OPTIONS), "generators": 0}))
    assert [job.name for job in jobs] == ["train-torsion-exact-force", "evaluate-torsion-exact"]
    assert list(jobs[0].after) == []
    assert jobs[1].after == [jobs[0]]


def test_released_models_are_evaluated_and_nothing_is_trained_for_them(tmp_path):
    recipe = ROOT / "models/recipes/torsion-exact/force.toml"
    released = ["torsion-exact", "torsion-exact-compact", "impulse-exact"]
    options = Namespace(**{**vars(OPTIONS), "split": ["evaluation", "other-family"]})
    jobs = {job.name: job for job in make.plan(tmp_path, [recipe], released, options)}
    assert list(jobs) == [
        "generate-torsion-exact-training", "generate-torsion-exact-evaluation",
        "generate-torsion-exact-other-family", "generate-impulse-exact-evaluation",
        "generate-impulse-exact-other-family", "train-torsion-exact-force",
        "evaluate-torsion-exact", "evaluate-torsion-exact-other-family",
        "evaluate-impulse-exact", "evaluate-impulse-exact-other-family",
    ]  # fmt: skip
    # splits of one data set one after the other, for they share a folder
    chain = [
        jobs[f"generate-torsion-exact-{s}"] for s in ("training", "evaluation", "other-family")
    ]
    assert [list(job.after) for job in chain] == [[], [chain[0]], [chain[1]]]
    last = jobs["evaluate-torsion-exact-other-family"]
    models = [path.parts[-2:] for path in last.models]
    assert models == [("force", "model"), ("models", "torsion-exact"),
                      ("models", "torsion-exact-compact")]  # fmt: skip
    assert list(last.after) == [jobs["train-torsion-exact-force"], chain[2]]
    assert last.arguments[last.arguments.index("--split") + 1] == "other-family"
    assert list(jobs["evaluate-impulse-exact"].after) == [jobs["generate-impulse-exact-evaluation"]]


def test_trainings_are_spread_over_the_gpus_that_are_visible(tmp_path):
    jobs = [make.Job(f"job {k}", FINE, [], "train") for k in range(4)]
    assert make.Machine(tmp_path, ["2", "5"], {"train": 2}).run(jobs)
    assert sorted(job.gpu for job in jobs) == ["2", "2", "5", "5"]


def test_generators_are_sent_away_once_all_data_are_there(tmp_path):
    jobs = [make.Job(f"data {k}", FINE, [], "generate") for k in range(2)]
    jobs.append(make.Job("training", FINE, [jobs[0]], "train"))
    seen = []
    assert machine(tmp_path).run(jobs, lambda: seen.append([job.status for job in jobs[:2]]))
    assert seen == [[0, 0]]
    assert machine(tmp_path).run(jobs[2:3], lambda: seen.append("again"))  # nothing left to run
    assert len(seen) == 1


def test_one_cluster_generates_all_data(tmp_path):
    folder = ROOT / "models/recipes"
    recipes = [folder / name / "through.toml" for name in ("torsion-exact", "impulse-exact")]
    options = Namespace(**{**vars(OPTIONS), "generators": 4, "scheduler": "tcp://here:1"})
    jobs = make.plan(tmp_path, recipes, [], options)
    data = [job for job in jobs if job.queue == "generate"]
    assert len(data) == 4
    for job in data:
        assert ("--scheduler", "tcp://here:1") in pairwise(job.arguments)
        assert "--workers" not in job.arguments
    assert not any("--scheduler" in job.arguments for job in jobs if job not in data)


@pytest.mark.slow
@pytest.mark.parametrize("generators", ["1", "2"])
def test_a_recipe_becomes_an_evaluated_model(tmp_path, generators):
    recipe = tmp_path / "recipes" / "tiny" / "short.toml"
    recipe.parent.mkdir(parents=True)
    recipe.write_text(
        'base = "best"\n[[stages]]\nkind = "one-step"\niterations = 3\nbatch = 4\n'
        "[fitting]\nwindows = 20\n"
    )
    shutil.copytree(ROOT / "datasets/tiny", tmp_path / "work/data/tiny")
    (tmp_path / "work/data/tiny/evaluation/mesh-0002.h5").unlink()  # is made again
    call = [sys.executable, ROOT / "models/make_all.py", tmp_path / "work", recipe]
    call += ["--generators", generators]
    done = subprocess.run(call, env={**os.environ, "OMP_NUM_THREADS": "1"}, timeout=600)
    assert done.returncode == 0
    summary = json.loads((tmp_path / "work/evaluations/tiny/summary.json").read_text())
    assert summary["data"]["trajectories"] == 4
    assert "model" in summary["runs"]

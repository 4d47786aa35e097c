"""Generate data, train recipes on them and evaluate the models; start again to go on.

python models/make_all.py WORK RECIPE ... [--device cuda] [--generators 8] [--together 4]
    [--measurers 16] [--seconds 1000] [--split evaluation ...]

A recipe is ``models/recipes/DATASET/NAME.toml``.  WORK gets

    data/DATASET                 splits as needed, by ``pdcorrect dataset generate``
    trainings/DATASET/NAME       by ``pdcorrect train``
    evaluations/DATASET-SPLIT    all models side by side, by ``pdcorrect evaluate``
    logs/                        what these commands said

Commands run in WORK, several trainings at a time on each GPU.  A training begins as soon as its
data are there and, if it starts from another recipe's model, that one has ended.  Trainings that
still run after ``--seconds`` are stopped; their best models so far are evaluated, and the next
start goes on with them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from program import run_script

from pdcorrect.data.configuration import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.schema import CONFIG
from pdcorrect.data.workers import visible_gpus
from pdcorrect.training.recipe import TrainingConfig
from pdcorrect.training.training import MODEL

DATASETS = Path(__file__).resolve().parents[1] / "datasets"
DONE, STOPPED = 0, 1
"""Exit statuses of commands that ended by themselves and of those whose time was up."""


@dataclass(eq=False)
class Job:
    """A command of ``pdcorrect``.

    Attributes
    ----------
    name : str
        Of its log.
    queue : str
        "generate", "train" or "evaluate"; so many of each run at a time.
    needs, after : sequence of Job
        What has to have succeeded, and what has to have ended, if only because its time was up.
    models : sequence of Path
        To evaluate; those that are there when it starts follow the command's name.
    replaces : Path or None
        Folder that is removed when it starts.
    until : float or None
        `time.time` at which it stops by itself.
    """

    name: str
    queue: str
    arguments: list[str]
    needs: Sequence[Job] = ()
    after: Sequence[Job] = ()
    models: Sequence[Path] = ()
    replaces: Path | None = None
    until: float | None = None
    status: int | None = None
    gpu: str | None = None
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def running(self) -> bool:
        return self.process is not None and self.status is None

    def failed_before(self) -> int | None:
        """Status of what keeps this one from ever starting."""
        bad = [job.status for job in self.needs if job.status not in (None, DONE)]
        bad += [job.status for job in self.after if job.status not in (None, DONE, STOPPED)]
        return bad[0] if bad else None

    def ready(self) -> bool:
        waits = any(job.status is None for job in (*self.needs, *self.after))
        return self.process is None and self.status is None and not waits

    def may_change(self) -> bool:
        return self.ready() or self.failed_before() is not None


class Machine:
    """Runs jobs in a folder, so many at a time of each queue, spread over GPUs."""

    def __init__(self, folder: Path, gpus: Sequence[str], places: dict[str, int]) -> None:
        self._folder, self._gpus, self._places = folder, gpus, places
        self._began = time.monotonic()
        (folder / "logs").mkdir(parents=True, exist_ok=True)

    def run(self, jobs: Sequence[Job]) -> bool:
        """Run all; whether all succeeded."""
        try:
            while any(job.status is None for job in jobs):
                for job in jobs:
                    self._advance(job, jobs)
                left = [job for job in jobs if job.status is None]
                if left and not any(job.running or job.may_change() for job in left):
                    raise SystemExit("These recipes wait for each other: expected a beginning.")
                time.sleep(0.2)
        finally:
            for job in jobs:
                if job.process is not None and job.process.poll() is None:
                    job.process.terminate()
        return all(job.status == DONE for job in jobs)

    def _advance(self, job: Job, jobs: Sequence[Job]) -> None:
        if job.process is not None and job.status is None:
            job.status = job.process.poll()
            if job.status is not None:
                self._tell(job, f"ended with {job.status}")
        elif job.status is None and (status := job.failed_before()) is not None:
            job.status = status
            self._tell(job, "cannot run: what it needs failed")
        elif job.ready():
            busy = [each.gpu for each in jobs if each.running and each.queue == job.queue]
            if len(busy) < self._places[job.queue]:
                self._start(job, [each.gpu for each in jobs if each.running])

    def _start(self, job: Job, busy: list[str | None]) -> None:
        environment = dict(os.environ)
        if self._gpus and job.queue != "generate":
            job.gpu = min(self._gpus, key=busy.count)
            environment["CUDA_VISIBLE_DEVICES"] = job.gpu
        if job.replaces is not None:
            shutil.rmtree(job.replaces, ignore_errors=True)
        name, *options = job.arguments
        if job.until is not None:
            options += ["--seconds", str(max(0.0, job.until - time.time()))]
        models = [str(model) for model in job.models if model.is_dir()]
        with (self._folder / "logs" / f"{job.name}.log").open("ab") as log:
            job.process = subprocess.Popen(
                [sys.executable, "-m", "pdcorrect", name, *models, *options],
                stdout=log, stderr=subprocess.STDOUT, env=environment, cwd=self._folder,
            )  # fmt: skip
        self._tell(job, "started")

    def _tell(self, job: Job, what: str) -> None:
        print(f"{time.monotonic() - self._began:7.1f} s  {job.name} {what}", flush=True)


def plan(work: Path, recipes: Sequence[Path], options: argparse.Namespace) -> list[Job]:
    """All jobs for some recipes."""
    until = None if options.seconds is None else time.time() + options.seconds
    names = list(dict.fromkeys(recipe.parent.name for recipe in recipes))
    data = {name: generation(work, name, options) for name in names if options.generators}
    trainings = {_model(work, recipe): training(work, recipe, options) for recipe in recipes}
    for recipe, job in zip(recipes, trainings.values(), strict=True):
        start = TrainingConfig.load(recipe).start_from
        first = [trainings[work / start]] if start and work / start in trainings else []
        job.needs = [*(data[name] for name in [recipe.parent.name] if name in data), *first]
        job.until = until
    jobs = [*data.values(), *trainings.values()]
    for name in names:
        models = [_model(work, recipe) for recipe in recipes if recipe.parent.name == name]
        for split in options.split:
            job = evaluation(work, name, split, options)
            job.models, job.after = models, [trainings[model] for model in models]
            jobs.append(job)
    return jobs


def generation(work: Path, name: str, options: argparse.Namespace) -> Job:
    splits = [word for s in (TRAINING, VALIDATION, *options.split) for word in ("--split", s)]
    arguments = [
        "dataset", "generate", str(DATASETS / name / CONFIG), "-o", str(work / "data" / name),
        "--workers", str(options.generators), "--device", options.device,
        "--batch", str(options.batch), *splits,
    ]  # fmt: skip
    return Job(f"generate-{name}", "generate", arguments)


def training(work: Path, recipe: Path, options: argparse.Namespace) -> Job:
    name, output = recipe.parent.name, _model(work, recipe).parent
    arguments = [
        "train", str(recipe), "--data", str(work / "data" / name), "-o", str(output),
        "--device", options.device, "--resume",
    ]  # fmt: skip
    return Job(f"train-{name}-{recipe.stem}", "train", arguments)


def evaluation(work: Path, name: str, split: str, options: argparse.Namespace) -> Job:
    label = f"{name}-{split}"
    output = work / "evaluations" / label
    arguments = [
        "evaluate", str(work / "data" / name), "--split", split, "--device", options.device,
        "--batch", str(options.batch), "--workers", str(options.measurers),
        "-o", str(output), "--no-figures",
    ]  # fmt: skip
    return Job(f"evaluate-{label}", "evaluate", arguments, replaces=output)


def _model(work: Path, recipe: Path) -> Path:
    """What a recipe makes."""
    return work / "trainings" / recipe.parent.name / recipe.stem / MODEL


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("recipes", type=Path, nargs="+", metavar="RECIPE")
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--generators", type=int, default=1, help="processes that generate data; 0: it is there"
    )
    parser.add_argument(
        "--batch", type=int, default=60, help="simulations at a time, of each process"
    )
    parser.add_argument("--together", type=int, default=1, help="trainings at a time on a GPU")
    parser.add_argument("--measurers", type=int, default=1, help="processes that measure")
    parser.add_argument("--seconds", type=float, default=None, help="when trainings are stopped")
    parser.add_argument("--split", action="append", help=f"to evaluate on; {EVALUATION} by default")
    options = parser.parse_args()
    options.split = options.split or [EVALUATION]
    gpus = visible_gpus() if options.device == "cuda" else []
    many = max(1, len(gpus))
    places = {"generate": 1, "train": options.together * many, "evaluate": many}
    work = options.work.resolve()
    jobs = plan(work, [recipe.resolve() for recipe in options.recipes], options)
    sys.exit(0 if Machine(work, gpus, places).run(jobs) else 1)


if __name__ == "__main__":
    run_script(main)

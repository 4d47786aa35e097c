"""Generate data, train recipes on them and evaluate the models; start again to go on.

python models/make_all.py WORK [RECIPE | MODEL ...] [--device cuda] [--generators 8]
    [--together 4] [--measurers 16] [--seconds 1000] [--split evaluation ...]

A recipe is ``models/recipes/DATASET/NAME.toml``; all of them by default.  In place of a data set
there may be ``all-as-published``, for the three of that setting together.  MODEL is the name of a
released model, which is evaluated only, beside what is trained for its data sets: on the set that
it is named after, or else on all that it has learned.  WORK gets

    data/DATASET                 splits as needed, by ``pdcorrect dataset generate``
    trainings/DATASET/NAME       by ``pdcorrect train``
    evaluations/DATASET          all models side by side, by ``pdcorrect evaluate``
    evaluations/DATASET-SPLIT    the same of other splits than "evaluation"
    logs/                        what these commands said

Data are generated in the order of the recipes, unless ``--generators 0`` says that they are
there; several generators are started once for all data sets, since each compiles its kernels for
minutes, and leave when all are complete.  Each training begins as soon as its data are there,
several at a time on each GPU, or, if it starts from what another recipe makes
(``start_from = "trainings/DATASET/NAME/model"``), when that has ended by itself; a data set's
models are evaluated when all its trainings have.  Commands run in WORK.  Trainings that are still
running after ``--seconds`` are stopped; their best models so far are evaluated, and the next start
goes on with them.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from program import run_script

from pdcorrect.corrector.model_io import load_model
from pdcorrect.data.config import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.schema import CONFIG
from pdcorrect.data.workers import local_scheduler, visible_gpus
from pdcorrect.training.config import TrainingConfig
from pdcorrect.training.training import MODEL

HERE = Path(__file__).resolve().parent
DATASETS = HERE.parent / "datasets"
LEARNT = (TRAINING, VALIDATION)
SETS_OF = {
    "all-as-published": ["impulse-as-published", "stretch-as-published", "torsion-as-published"],
}
"""Data sets of recipes that learn several, by the recipes' folder."""
STOPPED = 1
"""Exit status of a command whose time was up."""


@dataclass(eq=False)
class Job:
    """A command, on one of the machine's GPUs or on all.

    Attributes
    ----------
    name : str
        Of its log.
    arguments : list of str
        Of ``pdcorrect``.
    after : sequence of Job
        To be finished before.
    queue : str
        Jobs of one queue wait for a place in it.
    until : float or None
        `time.time` at which the command is to stop by itself.
    starts_from : Job or None
        Training whose model it begins with.  It has to have ended, not only stopped: its model
        would change when it goes on.
    models : sequence of Path
        To be evaluated; those that are there when it starts are put after the command's name.
    replaces : Path or None
        Folder that is removed when it starts.
    """

    name: str
    arguments: list[str]
    after: Sequence[Job]
    queue: str
    until: float | None = None
    starts_from: Job | None = None
    models: Sequence[Path] = ()
    replaces: Path | None = None
    status: int | None = None
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)
    gpu: str | None = None


class Machine:
    """Runs jobs, so many at a time of each queue.

    Parameters
    ----------
    folder : path
        Where they run; logs go to ``logs`` in it.
    gpus : sequence of str
        As CUDA_VISIBLE_DEVICES names them; none for a machine whose CPU is used.
    places : dict of str to int
        Of each queue; of "train" for each GPU.
    """

    def __init__(self, folder: Path, gpus: Sequence[str], places: dict[str, int]) -> None:
        self._folder, self._gpus, self._places = folder, gpus, places
        self._logs = folder / "logs"
        self._logs.mkdir(parents=True, exist_ok=True)

    def run(self, jobs: Sequence[Job], generated: Callable[[], None] | None = None) -> bool:
        """Run all; whether all were successful.  ``generated`` is called after the last data."""
        started = time.monotonic()
        told: list[Job] = []
        try:
            while any(job.status is None for job in jobs):
                for job in jobs:
                    if job.process is not None and job.status is None:
                        job.status = job.process.poll()
                        if job.status is not None:
                            self._tell(started, job, f"ended with {job.status}")
                    elif job.status is None and self._may_start(job, jobs):
                        self._start(job, jobs)
                        self._tell(started, job, "started")
                    elif job.process is None and job.status is not None and job not in told:
                        told.append(job)
                        self._tell(started, job, "cannot run: what it needs failed")
                if generated and not any(j.status is None for j in jobs if j.queue == "generate"):
                    generated()
                    generated = None
                time.sleep(0.2)
        finally:
            for job in jobs:
                if job.process is not None and job.process.poll() is None:
                    job.process.terminate()
        return all(job.status == 0 for job in jobs)

    def _may_start(self, job: Job, jobs: Sequence[Job]) -> bool:
        """Whether a waiting job can be started now; one that never can counts as failed."""
        if any(j.status not in (None, 0, STOPPED) for j in job.after):
            job.status = next(j.status for j in job.after if j.status not in (None, 0, STOPPED))
            return False
        if any(j.status is None for j in job.after):
            return False
        if job.starts_from is not None and job.starts_from.status != 0:
            job.status = job.starts_from.status
            return False
        places = self._places[job.queue] * (max(1, len(self._gpus)) if job.queue == "train" else 1)
        return sum(1 for _ in self._running(job.queue, jobs)) < places

    @staticmethod
    def _running(queue: str, jobs: Sequence[Job]) -> Iterator[Job]:
        return (j for j in jobs if j.queue == queue and j.process is not None and j.status is None)

    def _start(self, job: Job, jobs: Sequence[Job]) -> None:
        environment = dict(os.environ)
        if self._gpus and job.queue != "generate":
            busy = [j.gpu for j in jobs if j.process is not None and j.status is None]
            job.gpu = min(self._gpus, key=busy.count)
            environment["CUDA_VISIBLE_DEVICES"] = job.gpu
        limit = [] if job.until is None else ["--seconds", str(max(0.0, job.until - time.time()))]
        if job.replaces is not None:
            shutil.rmtree(job.replaces, ignore_errors=True)
        name, *options = job.arguments
        models = [str(model) for model in job.models if model.is_dir()]
        with (self._logs / f"{job.name}.log").open("ab") as log:
            job.process = subprocess.Popen(
                [sys.executable, "-m", "pdcorrect.cli.main", name, *models, *options, *limit],
                stdout=log, stderr=subprocess.STDOUT, env=environment, cwd=self._folder,
            )  # fmt: skip

    @staticmethod
    def _tell(started: float, job: Job, what: str) -> None:
        print(f"{time.monotonic() - started:7.1f} s  {job.name} {what}", flush=True)


def plan(
    work: Path, recipes: Sequence[Path], released: Sequence[str], options: argparse.Namespace
) -> list[Job]:
    """All jobs for some recipes and released models."""
    until = None if options.seconds is None else time.time() + options.seconds
    starts = {recipe: TrainingConfig.load(recipe).start_from for recipe in recipes}
    _refuse_circles({_output(work, r) / MODEL: work / (starts[r] or "") for r in recipes})
    known = {model: _judged_on(model) for model in released}
    learnt = list(dict.fromkeys(name for recipe in recipes for name in _data_of(recipe)))
    names = list(dict.fromkeys([*learnt, *(name for each in known.values() for name in each)]))
    before: dict[str, list[Job]] = {name: [] for name in names}
    ready: dict[str, list[Job]] = {name: [] for name in names}
    if options.generators:
        for name in learnt:
            ready[name] = before[name] = [_generation(work, name, LEARNT, options, [])]
    jobs = [job for name in names for job in ready[name]]
    judged: dict[tuple[str, str], list[Job]] = {}
    for name in names:  # one after the other: they write to the same folder
        for split in options.split:
            if options.generators:
                before[name] = [_generation(work, name, (split,), options, before[name])]
                jobs += before[name]
            judged[name, split] = before[name]
    trainings = {
        _output(work, recipe) / MODEL: _training(work, recipe, ready, until, options)
        for recipe in recipes
    }
    for job, recipe in zip(trainings.values(), recipes, strict=True):
        job.starts_from = trainings.get(work / (starts[recipe] or ""))
    jobs += trainings.values()
    for name in names:
        own = [_output(work, recipe) / MODEL for recipe in recipes if name in _data_of(recipe)]
        models = own + [HERE / model for model in released if name in known[model]]
        each = [trainings[model] for model in own]
        jobs += [
            _evaluation(work, name, split, models, [*each, *judged[name, split]], options)
            for split in options.split
        ]
    return jobs


def _evaluation(
    work: Path, name: str, split: str, models: Sequence[Path], after: Sequence[Job],
    options: argparse.Namespace,
) -> Job:  # fmt: skip
    label = name if split == EVALUATION else f"{name}-{split}"
    output = work / "evaluations" / label
    arguments = [
        "evaluate", str(work / "data" / name), "--split", split,
        "--device", options.device, "--batch", "100", "--workers", str(options.measurers),
        "-o", str(output), "--no-figures",
    ]  # fmt: skip
    return Job(f"evaluate-{label}", arguments, after, "evaluate", models=models, replaces=output)


def _generation(
    work: Path, name: str, splits: Sequence[str], options: argparse.Namespace, after: Sequence[Job]
) -> Job:
    chosen = [part for split in splits for part in ("--split", split)]
    address = options.scheduler
    workers = ["--scheduler", address] if address else ["--workers", str(options.generators)]
    return Job(
        f"generate-{name}-{splits[0]}",
        ["dataset", "generate", str(DATASETS / name / CONFIG), "-o", str(work / "data" / name),
         *workers, "--device", options.device, "--batch", str(options.batch), *chosen],
        after,
        "generate",
    )  # fmt: skip


def _judged_on(released: str) -> list[str]:
    """The data set that a released model is named after, or else all that it has learned."""
    names = [name for name, _ in load_model(HERE / released).data_sets]
    return [released] if released in names else names


def _data_of(recipe: Path) -> list[str]:
    """Names of the data sets that a recipe learns."""
    name = recipe.parent.name
    return SETS_OF.get(name, [name])


def _output(work: Path, recipe: Path) -> Path:
    """Of a training."""
    return work / "trainings" / recipe.parent.name / recipe.stem


def _training(
    work: Path, recipe: Path, ready: dict[str, list[Job]], until: float | None,
    options: argparse.Namespace,
) -> Job:  # fmt: skip
    names = _data_of(recipe)
    data = [word for name in names for word in ("--data", str(work / "data" / name))]
    arguments = [
        "train", str(recipe), *data, "-o", str(_output(work, recipe)),
        "--device", options.device, "--resume",
    ]  # fmt: skip
    after = [job for name in names for job in ready[name]]
    return Job(f"train-{recipe.parent.name}-{recipe.stem}", arguments, after, "train", until)


def _refuse_circles(starts: dict[Path, Path]) -> None:
    """Refuse recipes that wait for each other; ``starts`` has what each model starts from."""
    for model in starts:
        before, seen = starts[model], {model}
        while before in starts:
            if before in seen:
                raise SystemExit(f"{model}: starts from what starts from it: expected a beginning.")
            seen.add(before)
            before = starts[before]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("sources", nargs="*", metavar="RECIPE | MODEL")
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--generators", type=int, default=1, help="processes that generate data; 0: it is there"
    )
    parser.add_argument("--batch", type=int, default=60, help="simulations that each computes")
    parser.add_argument("--together", type=int, default=1, help="trainings at a time on a GPU")
    parser.add_argument("--measurers", type=int, default=1, help="processes that measure")
    parser.add_argument("--seconds", type=float, default=None, help="when trainings are stopped")
    parser.add_argument("--split", action="append", help=f"to evaluate on; {EVALUATION} by default")
    options = parser.parse_args()
    options.split = options.split or [EVALUATION]
    work = options.work.resolve()
    recipes = [Path(source).resolve() for source in options.sources if source.endswith(".toml")]
    released = [source for source in options.sources if not source.endswith(".toml")]
    if not options.sources:
        recipes = sorted((HERE / "recipes").glob("*/*.toml"))
    gpus = visible_gpus() if options.device == "cuda" else []
    places = {"generate": 1, "train": options.together, "evaluate": max(1, len(gpus))}
    machine = Machine(work, gpus, places)
    with contextlib.ExitStack() as generators:  # to be closed when they have nothing more to do
        options.scheduler = generators.enter_context(local_scheduler(options.generators))
        done = machine.run(plan(work, recipes, released, options), generators.close)
    sys.exit(0 if done else 1)


if __name__ == "__main__":
    run_script(main)

"""`evaluate`: correctors and stored runs of a data set's split against its reference."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.model_io import (
    LoadedModel,
    load_model,
    model_folder,
    unlike_ends,
    weights_digest,
)
from pdcorrect.data.configuration import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.folder import check_whole, missing_files
from pdcorrect.data.schema import PLAIN, REFERENCE
from pdcorrect.errors import InputError
from pdcorrect.evaluation.measures import (
    EvaluationCase,
    MeasuredRollout,
    TrajectoryMeasures,
    measure,
    read_cases,
)
from pdcorrect.evaluation.rollouts import (
    Hybrid,
    Outcome,
    roll_out,
    roll_out_alone,
    single_steps,
    single_steps_alone,
)
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.projective import ProjectiveDynamics

Array = NDArray[np.float64]
DEFAULT_GATE = Gate()
OnCases = Callable[[int, int], None]
"""Called with how many trajectories of how many are done."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A corrector to be evaluated."""

    name: str  # unlike the other candidates' and the stored runs'
    base: str  # run of the coarse model that it corrects: "plain", "best" or "total-mass"
    # from a stepper of that model's problems to their corrected step
    hybrid: Callable[[BatchStepper], Hybrid]
    # from one problem of that model to its corrected step, which a CPU takes in the place of
    # ``hybrid``; None: batches there, too
    alone: Callable[[Problem], HybridStepper] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class SavedCandidate(Candidate):
    """A model of a folder, to be evaluated."""

    folder: Path
    model: LoadedModel
    weights_sha256: str

    def record(self) -> dict[str, Any]:
        """What identifies it, for results."""
        found = self.model.record
        return {
            "folder": str(self.folder),
            "weights_sha256": self.weights_sha256,
            "base": self.base,
            "seed": self.model.configuration.get("seed"),
            "velocity": self.model.velocity,
            "dataset": found.dataset,
            "dataset_hash": found.dataset_hash,
            "code_digest": found.code_digest,
        }

    def warnings(self, dataset: str, config_hash: str, split: str) -> list[str]:
        """What speaks against taking its errors for those on unseen meshes of its own data."""
        name, trained = self.name, repr(self.model.record.dataset)
        known = [x for own, x in self.model.data_sets if own == dataset]
        if not {config_hash, None}.intersection(known):
            other = f"another configuration of {dataset!r}" if known else f"not on {dataset!r}"
            return [f"{name} was trained on {trained}, {other}: it may know meshes of this split."]
        if split == TRAINING:
            return [f"{name} was trained on this split: these are not unseen meshes."]
        if split == VALIDATION:
            return [f"{name}'s weights were chosen by this split: the figures are too good."]
        if len({own for own, _ in self.model.data_sets}) > 1:
            others = f"sets other than {dataset!r} may hold meshes of this split"
            return [f"{name} was trained on {trained}: {others}."]
        return []


def saved_candidates(
    paths: Sequence[str | Path], device: str = "cpu", *, gate: Gate | None = DEFAULT_GATE
) -> list[SavedCandidate]:
    """Models by folder or name; they are called by the ends of their paths that tell them apart.

    Which coarse model one corrects, and how velocities follow, is what its training says; "plain"
    and "recomputed" where it says nothing.  Without a gate only corrections that are not finite
    are refused.
    """
    names = unlike_ends([model_folder(path).resolve() for path in paths])
    return [_saved(path, name, device, gate) for path, name in zip(paths, names, strict=True)]


def _saved(path: str | Path, name: str, device: str, gate: Gate | None) -> SavedCandidate:
    folder = model_folder(path)
    model = load_model(path, device)

    def hybrid(stepper: BatchStepper) -> Hybrid:
        return BatchHybrid(stepper, model.corrector, velocity=model.velocity, gate=gate)

    def alone(problem: Problem) -> HybridStepper:
        coarse = ProjectiveDynamics(problem)
        return HybridStepper(coarse, model.corrector, velocity=model.velocity, gate=gate)

    return SavedCandidate(
        name=name, base=model.base, hybrid=hybrid, alone=alone, folder=folder, model=model,
        weights_sha256=weights_digest(folder),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """One run over the trajectories that have it."""

    name: str
    base: str | None  # of a `Candidate`
    trajectories: tuple[MeasuredRollout, ...]

    def values(self, measure: str) -> tuple[list[float], list[int]]:
        """A measure of the trajectories that have it, and on which mesh each one is."""
        every = [t.measures for t in self.trajectories]
        found = [(getattr(m, measure), m.mesh) for m in every]
        known = [(float(x), mesh) for x, mesh in found if x is not None]
        return [x for x, _ in known], [mesh for _, mesh in known]

    @property
    def reasons(self) -> list[int]:
        """Why a gate left steps of all trajectories uncorrected, see `MeasuredRollout`."""
        return [reason for t in self.trajectories for reason in t.reasons.tolist()]

    def failures(self) -> list[TrajectoryMeasures]:
        """Trajectories that failed."""
        return [t.measures for t in self.trajectories if t.measures.failed is not None]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Runs of a split."""

    dataset: str
    split: str
    setting: str
    config_hash: str
    time_step: float  # s
    # candidates, then stored runs, "reference" last: of the latter only energies are of interest
    runs: Mapping[str, EvaluatedRun]
    shards: Mapping[str, str]  # content hash of each file, by its name
    # files that the data set's configuration asks for and that are not there
    missing: tuple[Path, ...] = ()


def evaluate(
    candidates: Sequence[Candidate],
    folder: str | Path,
    split: str = EVALUATION,
    *,
    device: str = "cpu",
    batch: int = 32,
    workers: int = 1,
    incomplete: bool = False,
    on_cases: OnCases | None = None,
) -> Evaluation:
    """Free rollouts and single steps of candidates, and of the stored runs, measured.

    Every simulation is stepped again from rest, in all of the reference's frames, as the data set's
    coarse runs were; see `measures` for what is measured and `roll_out` for what becomes of
    simulations that fail.

    Parameters
    ----------
    candidates : sequence of Candidate
        None are allowed: then only stored runs are measured.
    folder : path
        Of the data set.
    split, device : str
    batch : int
        Simulations that are stepped together; on a CPU candidates with ``alone`` step one by one.
    workers : int
        Processes that measure; the results do not depend on their number.
    incomplete : bool
        Take the files that are there, if the data set's configuration asks for more.
    on_cases : callable, optional
        For progress.

    Raises
    ------
    InputError
        If names are not unlike, files of the split are missing or of several data sets, or its
        problems, or those of a base, cannot be rebuilt.
    FileFormatError
        If a file is damaged.
    """
    if batch < 1 or workers < 1:
        raise InputError(f"batch = {batch}, workers = {workers}: expected 1 or more.")
    bases = [candidate.base for candidate in candidates]
    missing: tuple[Path, ...] = ()
    if incomplete:
        with contextlib.suppress(InputError):  # of a configuration that cannot be used
            missing = tuple(missing_files(folder, split))
    else:
        check_whole(folder, [split])
    found = read_cases(folder, split, bases)
    missing = tuple(path for path in missing if path.name not in found.shards)
    known = {candidate.name: candidate for candidate in candidates}
    stored = dict.fromkeys(name for case in found.cases for name in _stored(case))
    if len(known) < len(candidates) or known.keys() & {*stored, REFERENCE}:
        raise InputError(
            f"names {', '.join(c.name for c in candidates)}: expected each one once, and none of a "
            f"stored run ({', '.join(stored)})."
        )
    measured: dict[int, dict[str, MeasuredRollout]] = {}
    for number, by_run in _measured(candidates, found.cases, device, batch, workers):
        measured[number] = by_run
        if on_cases:
            on_cases(len(measured), len(found.cases))
    runs = {
        name: EvaluatedRun(
            name,
            known[name].base if name in known else None,
            tuple(measured[i][name] for i in sorted(measured) if name in measured[i]),
        )
        for name in (*known, *stored, REFERENCE)
    }
    about = found.attributes
    return Evaluation(
        str(about["dataset"]), split, str(about["setting"]), str(about["config_hash"]),
        float(about["time_step"]), runs, found.shards, missing,
    )  # fmt: skip


def _measured(
    candidates: Sequence[Candidate],
    cases: Sequence[EvaluationCase],
    device: str,
    batch: int,
    workers: int,
) -> Iterator[tuple[int, dict[str, MeasuredRollout]]]:
    """Numbers of cases and what is measured of their runs, by name."""
    waiting = []
    with _pool(workers) as each:
        for numbers in _batches(cases, [candidate.base for candidate in candidates], batch):
            some = [cases[i] for i in numbers]
            outcomes = [{**_stored(case), REFERENCE: Outcome(case.reference)} for case in some]
            for name, new in _outcomes(candidates, some, device):
                for by_name, outcome in zip(outcomes, new, strict=True):
                    by_name[name] = outcome
            # other processes measure while the next ones are moving
            waiting.append(zip(numbers, each(_measure_all, some, outcomes), strict=True))
            if workers == 1:
                yield from waiting.pop()
        for results in waiting:
            yield from results


def _measure_all(
    case: EvaluationCase, outcomes: Mapping[str, Outcome]
) -> dict[str, MeasuredRollout]:
    return {name: measure(case, outcome) for name, outcome in outcomes.items()}


@contextlib.contextmanager
def _pool(workers: int) -> Iterator[Callable[..., Iterator[dict[str, MeasuredRollout]]]]:
    """A `map` over processes, each of one thread; the built-in one for one process."""
    if workers == 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")  # a GPU's driver does not survive a fork
    with ProcessPoolExecutor(
        workers, context, initializer=numba.set_num_threads, initargs=(1,)
    ) as pool:
        yield pool.map


def _stored(case: EvaluationCase) -> dict[str, Outcome]:
    """Stored runs by name, the plain one first."""
    names = sorted(case.runs.keys() | case.predictions, key=lambda name: (name != PLAIN, name))
    bases = {name: name if name in case.problems else None for name in names}
    return {
        name: Outcome(case.runs.get(name), case.predictions.get(name), base)
        for name, base in bases.items()
    }


def _batches(
    cases: Sequence[EvaluationCase], bases: Sequence[str], size: int
) -> Iterator[list[int]]:
    """Numbers of cases that can be stepped together, of like numbers of nodes."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for i, case in enumerate(cases):
        elements = tuple(case.problems[base].element for base in bases)
        groups.setdefault(elements, []).append(i)
    for group in groups.values():
        group.sort(key=lambda i: cases[i].reference.shape[1])
        yield from (group[first : first + size] for first in range(0, len(group), size))


def _outcomes(
    candidates: Sequence[Candidate], cases: Sequence[EvaluationCase], device: str
) -> Iterator[tuple[str, list[Outcome]]]:
    steppers: dict[str, BatchStepper] = {}
    references = [case.reference for case in cases]
    for candidate in candidates:
        base = candidate.base
        problems = [case.problems[base] for case in cases]
        coarse = [case.predictions.get(base) for case in cases]
        if device == "cpu" and candidate.alone is not None:
            alone = [candidate.alone(problem) for problem in problems]
            runs = [roll_out_alone(x, case.steps) for x, case in zip(alone, cases, strict=True)]
            steps = list(map(single_steps_alone, alone, references, coarse))
        else:
            if base not in steppers:
                steppers[base] = BatchStepper(problems, device=device)
            hybrid = candidate.hybrid(steppers[base])
            runs = roll_out(hybrid, steppers[base], [case.steps for case in cases])
            steps = single_steps(hybrid, steppers[base], references, coarse)
        yield (
            candidate.name,
            [replace(x, predictions=y, base=base) for x, y in zip(runs, steps, strict=True)],
        )

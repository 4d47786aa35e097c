"""Measure what needs no training beside a data set's reference: elements, mass, fitted stiffness.

python models/baselines.py DATA -o OUTPUT [--split evaluation] [--device cuda] [--batch 60]
    [--workers 2] [--fit 40] [--fit-split validation] [--only NAME ...]

The plain coarse mesh is stepped again with other elements, the learned one among them, with the
consistent mass, and, unless ``--fit`` is 0, with Young's modulus times one factor for the whole
data set, which makes the mean Omega of the first ``--fit`` simulations of ``--fit-split`` largest
(by default of the training split, or, with a note, of the split itself where there is none).  They
are measured like correctors, by `pdcorrect.evaluation.evaluate`, beside the stored runs; OUTPUT
gets the same files as by ``pdcorrect evaluate``.  Scenes of mesh files cannot be discretised again
and are refused.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from program import origin, run_script
from scipy.optimize import minimize_scalar
from torch import Tensor

from pdcorrect import metrics
from pdcorrect.batch.states import BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import BatchHybridResult
from pdcorrect.data.configuration import EVALUATION, TRAINING
from pdcorrect.data.schema import PLAIN
from pdcorrect.errors import InputError
from pdcorrect.evaluation.evaluation import Candidate, evaluate
from pdcorrect.evaluation.measures import EvaluationCase, read_cases
from pdcorrect.evaluation.rollouts import roll_out
from pdcorrect.evaluation.tables import markdown, write_evaluation
from pdcorrect.fem.problem import Problem, discretise

ELEMENTS = ("hex8-mean", "hex8-bubble", "hex8-bubble-mean")
"""Of those that batches have; the 27-node element is in `validation/error_time`."""
FACTORS = 0.05, 2.0
"""Between which the stiffness is looked for."""
Change = Callable[[Problem], Problem]


class Uncorrected:
    """The steps of a changed problem, as a `Hybrid` that corrects nothing."""

    def __init__(self, stepper: BatchStepper, change: Change) -> None:
        problems = [change(problem) for problem in stepper.problems]
        self._steps = BatchStepper(problems, device=stepper.device)
        self._nothing = torch.zeros(sum(stepper.node_counts), 3, device=self._steps.device)

    def __call__(self, state: BatchState, previous: Tensor | None = None) -> BatchHybridResult:
        """One step."""
        coarse = self._steps(state)
        none = torch.zeros(len(coarse.statuses), dtype=torch.int64, device=self._nothing.device)
        return BatchHybridResult(coarse, coarse, self._nothing, none)


def with_solver(**options: str) -> Change:
    """The scene discretised with other entries of its ``[solver]``."""

    def change(problem: Problem) -> Problem:
        if getattr(problem.scene.body, "path", None) is not None:
            raise InputError(f"{problem.scene.name}: a body of a mesh file, not discretised again.")
        return discretise(problem.scene.with_changes(solver=options))

    return change


def with_stiffness(factor: float) -> Change:
    """The same problem with Young's modulus times a factor."""

    def change(problem: Problem) -> Problem:
        materials = problem.materials
        return problem.with_material(factor * materials.young, materials.poisson)

    return change


def mean_omega(cases: Sequence[EvaluationCase], change: Change, device: str, batch: int) -> float:
    """Mean Omega, per cent, of rollouts with a change."""
    found = []
    for first in range(0, len(cases), batch):
        some = cases[first : first + batch]
        stepper = BatchStepper([case.problems[PLAIN] for case in some], device=device)
        hybrid = Uncorrected(stepper, change)
        for run, case in zip(roll_out(hybrid, stepper, [c.steps for c in some]), some, strict=True):
            errors = [
                metrics.rms_error(x, case.reference) for x in (run.positions, case.runs[PLAIN])
            ]
            found.append(100.0 * (1.0 - (errors[0] / errors[1]) ** 2))
    return float(np.mean(found))


def fitted(cases: Sequence[EvaluationCase], device: str, batch: int) -> float:
    """The factor on Young's modulus with the largest mean Omega."""

    def loss(logarithm: float) -> float:
        factor = float(np.exp(logarithm))
        omega = mean_omega(cases, with_stiffness(factor), device, batch)
        print(f"stiffness times {factor:.3f}: Omega {omega:.1f}", flush=True)
        return -omega

    bounds = tuple(np.log(FACTORS))
    found = minimize_scalar(loss, bounds=bounds, method="bounded",
                            options={"xatol": 0.02, "maxiter": 14})  # fmt: skip
    return float(np.exp(found.x))


def main() -> None:
    """Fit, step and measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=60)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--fit", type=int, default=40, help="simulations")
    parser.add_argument("--fit-split", default=None, help="of which they are")
    names = (*ELEMENTS, "hex8-learned", "consistent mass")
    parser.add_argument("--only", nargs="+", choices=names)
    options = parser.parse_args()
    split = options.fit_split or TRAINING
    if options.fit_split is None and not (options.data / TRAINING).is_dir():
        split = options.split
    changes = {
        **{name: with_solver(element=name) for name in ELEMENTS},
        "hex8-learned": with_solver(element="hex8-learned", mass="averaged"),
        "consistent mass": with_solver(mass="consistent"),
    }
    if options.only:
        changes = {name: changes[name] for name in options.only}
    notes, more = [], {}
    if options.fit:
        cases = read_cases(options.data, split).cases[: options.fit]
        factor = fitted(cases, options.device, options.batch)
        changes["fitted stiffness"], more["stiffness_factor"] = with_stiffness(factor), factor
        notes.append(
            f"Young's modulus times {factor:.3f}, fitted to {len(cases)} simulations of {split}"
            + (", the split itself: too good" if split == options.split else "")
        )
    candidates = [
        Candidate(name, PLAIN, lambda stepper, change=change: Uncorrected(stepper, change))
        for name, change in changes.items()
    ]
    found = evaluate(
        candidates, options.data, options.split, device=options.device, batch=options.batch,
        workers=options.workers,
    )  # fmt: skip
    print(markdown(found), *notes, sep="\n")
    record = {**origin(), **more, "notes": notes}
    for path in write_evaluation(found, options.output, record, notes):
        print(f"wrote {path}")


if __name__ == "__main__":
    run_script(main)

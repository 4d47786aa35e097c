"""Steppers side by side on one scene: error against run time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pdcorrect import metrics
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.evaluation.comparison_cases import CASE_BASES, Case, cases_for
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.metrics import relative_error
from pdcorrect.scene import Scene
from pdcorrect.solvers.newton import Newton
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import restrict, rollout
from pdcorrect.state import Status, StepResult
from pdcorrect.trajectory import Stepper, Trajectory

_FALLBACKS = [Status.RECOVERED.name, Status.SUBSTEPPED.name]
OnStep = Callable[[str, int, StepResult], None]
"""Called with a case's label, its frame, and the step's result."""


@dataclass(frozen=True)
class Row:
    """One line of the comparison table.

    ``relative_error`` is the one to the converged motion, see `metrics.relative_error`, and
    ``estimated_error`` the same to a finer run; None where that was not computed.  The other
    errors are node distances on the coarse nodes over all frames, against the reference case, in
    metres; ``omega`` is eq. 7-2 with the first case on the coarse mesh as its zero.  Times are
    medians for one frame; ``setup_seconds`` covers meshing, assembly and the first factorisation.
    ``unusual_frames`` converged only by a fallback (see `Status`).  ``refused_frames`` are those
    whose correction a gate refused; None without a corrector.
    """

    label: str
    relative_error: float | None
    estimated_error: float | None
    solver: str
    refine: int
    nodes: int
    cells: int
    rms_error: float
    largest_error: float
    omega: float
    seconds_a_frame: float
    setup_seconds: float
    iterations_a_frame: float
    unusual_frames: int
    refused_frames: int | None = None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Outcome of `compare`."""

    scene: Scene
    rows: tuple[Row, ...]  # in the order coarse to fine, without cases that failed
    # each case on its own mesh, and on the coarse nodes
    runs: dict[str, Trajectory]
    on_coarse: dict[str, Trajectory]
    reference: str  # label of the case that errors are measured against
    # largest node distance between PD and Newton on the coarse mesh, m: they minimise the same
    # energy, so this is solver error, unless the body buckles and they take different branches.
    # None without both, or if a frame needed a fallback
    solver_error: float | None
    cases: tuple[Case, ...]
    # of correctors, by label: model, base, the data set that it was trained on, that one's time
    # integrator, and digest of its weights
    models: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    # of cases that did not come to their end, by label: why
    failures: Mapping[str, str] = field(default_factory=dict)
    # the converged motion, and what errors on the coarse mesh are estimated by, if asked for
    converged: Trajectory | None = None
    finer: Trajectory | None = None

    def errors_over_time(self) -> dict[str, np.ndarray]:
        """RMS node distance in each frame, by label, m: from the converged motion or reference."""
        if self.converged is None:
            truth = self.on_coarse[self.reference]
            labels = [row.label for row in self.rows if row.label != self.reference]
        else:
            truth = self.converged
            labels = [row.label for row in self.rows]
        return {
            label: metrics.error_over_time(restrict(self.on_coarse[label], truth), truth)
            for label in labels
        }


def make_stepper(problem: Problem, solver: str) -> Stepper:
    """A stepper by name, ``"pd"`` or ``"newton"``, factorised and with its kernels compiled."""
    kinds = {"pd": ProjectiveDynamics, "newton": Newton}
    if solver not in kinds:
        raise InputError(f"solver {solver!r}: expected one of {', '.join(kinds)}.")
    return kinds[solver](problem).prepare()


def case_stepper(scene: Scene, case: Case) -> Stepper:
    """What steps a case, factorised and with its kernels compiled."""
    if case.model is None:
        return make_stepper(case.problem(scene), case.solver)
    from pdcorrect.corrector.hybrid import hybrid_of
    from pdcorrect.corrector.model_io import load_model

    base = load_model(case.model).base
    if case != Case(case.label, "pd", 1, base, case.model, case.gate):
        raise InputError(
            f"{case.label}: the corrector {case.model} is run by projective dynamics on the coarse "
            f"model {base!r} that it was trained for: expected that in {case}."
        )
    return hybrid_of(scene, case.model, gate=case.gate).prepare()


def compare(
    scene: Scene,
    frames: int | None = None,
    cases: Sequence[Case] | None = None,
    on_step: OnStep | None = None,
    *,
    converged: Trajectory | None = None,
    finer: Trajectory | None = None,
) -> Comparison:
    """Run a scene with several solvers and measure error and time.

    Parameters
    ----------
    scene : Scene
    frames : int, optional
        The scene's by default.
    cases : sequence of Case, optional
        The first is the reference; those of `cases_for` by default.
    on_step : callable, optional
        For progress.
    converged, finer : Trajectory, optional
        Of `pdcorrect.converged` and `finer_run` for the same frames: relative errors are measured
        from the one, errors on the coarse mesh estimated by the other.

    Raises
    ------
    InputError
        If there are no cases, or two of one label, or a model does not fit the scene, or the
        converged motion or the finer run has other frames.
    ConvergenceError
        If the reference fails.  Other cases that fail are among ``failures``.
    """
    cases = cases_for(scene) if cases is None else tuple(cases)
    if not cases:
        raise InputError("cases is empty: expected at least the reference.")
    labels = [case.label for case in cases]
    if len(set(labels)) < len(labels):
        raise InputError(f"labels {', '.join(labels)}: expected each one once.")
    count = scene.time.frames if frames is None else frames
    for name, other in (("converged", converged), ("finer", finer)):
        if other is not None and len(other) != count:
            raise InputError(f"{name} has {len(other)} frames: expected {count}.")
    coarse = discretise(scene)
    runs, on_coarse, setup, failures = {}, {}, {}, {}
    for case in cases[::-1]:  # the reference, which takes longest, after all that may be refused
        started = time.perf_counter()
        try:
            stepper = case_stepper(scene, case)
            setup[case.label] = time.perf_counter() - started
            run = rollout(stepper, frames, on_step=_counted(on_step, case.label))
        except ConvergenceError as error:
            if case is cases[0]:
                raise
            failures[case.label] = str(error)
            continue
        runs[case.label], on_coarse[case.label] = run, restrict(run, to=coarse)
    truth = on_coarse[cases[0].label]
    complete = tuple(case for case in cases if case.label in runs)
    base = next((on_coarse[c.label] for c in complete[::-1] if c.plain and c.solver == "pd"), None)
    nearer = None if finer is None else restrict(finer, to=coarse)
    rows = []
    for case in sorted(complete, key=_coarse_to_fine):
        run, here = runs[case.label], on_coarse[case.label]
        has_base = base is not None and metrics.mean_squared_error(base, truth) > 0
        rows.append(
            Row(
                label=case.label,
                relative_error=None if converged is None else relative_error(run, converged),
                estimated_error=(
                    None if nearer is None or case.refine > 1 else relative_error(here, nearer)
                ),
                solver="hybrid" if case.model else case.solver,
                refine=case.refine,
                nodes=len(run.points),
                cells=len(run.cells),
                rms_error=metrics.rms_error(here, truth),
                largest_error=metrics.largest_error(here, truth),
                omega=metrics.error_corrected(here, base, truth) if has_base else float("nan"),
                seconds_a_frame=float(np.median(run.stats["seconds"])),
                setup_seconds=setup[case.label],
                iterations_a_frame=float(np.mean(run.stats["iterations"])),
                unusual_frames=int(np.isin(run.stats["status"], _FALLBACKS).sum()),
                refused_frames=int(np.sum(run.stats["refused"])) if case.model else None,
            )
        )
    return Comparison(
        scene, tuple(rows), runs, on_coarse, cases[0].label, _solver_error(complete, runs), cases,
        _models(cases), failures, converged, finer,
    )  # fmt: skip


def _coarse_to_fine(case: Case) -> tuple[int, bool, int, bool]:
    """Order of the rows; elements with more nodes after all that share the coarse nodes."""
    more_nodes = case.element is not None
    return case.refine, more_nodes, CASE_BASES.index(case.base), case.solver != "pd"


def _models(cases: Sequence[Case]) -> dict[str, dict[str, str]]:
    """Which models the correctors are, by label."""
    if not any(case.model for case in cases):
        return {}
    from pdcorrect.corrector.hybrid import about_model

    return {case.label: about_model(case.model) for case in cases if case.model}


def _counted(on_step: OnStep | None, label: str) -> Callable[[StepResult, float], None] | None:
    """Shows each step with its case and frame to who looks on."""
    if on_step is None:
        return None
    frames = itertools.count(1)
    return lambda result, _: on_step(label, next(frames), result)


def _solver_error(cases: tuple[Case, ...], runs: dict[str, Trajectory]) -> float | None:
    coarse = {case.solver: runs[case.label] for case in cases if case.plain}
    if not {"pd", "newton"} <= set(coarse):
        return None
    if any((run.stats["status"] != Status.CONVERGED.name).any() for run in coarse.values()):
        return None
    return metrics.largest_error(coarse["pd"], coarse["newton"])

"""Steppers side by side on one scene: error against run time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdcorrect import metrics
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import discretise
from pdcorrect.scene import Scene
from pdcorrect.solvers.newton import Newton
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import restrict, rollout
from pdcorrect.state import Status, Stepper, StepResult, Trajectory

_FALLBACKS = [Status.RECOVERED.name, Status.SUBSTEPPED.name]
OnStep = Callable[[str, int, StepResult], None]
"""Called with a case's label, its frame, and the step's result."""


@dataclass(frozen=True)
class Case:
    """One solver on one mesh."""

    label: str
    solver: str
    refine: int


CASES = (
    Case("fine PD", "pd", 4),
    Case("intermediate PD", "pd", 2),
    Case("coarse PD", "pd", 1),
    Case("coarse Newton", "newton", 1),
)
"""The default comparison; the first case is the reference of all errors."""


@dataclass(frozen=True)
class Row:
    """One line of the comparison table.

    Errors are node distances on the coarse nodes over all frames, against the
    reference case, in metres; ``omega`` is eq. 7-2 with the first case on the
    coarse mesh as its zero.  Times are medians for one frame; ``setup_seconds``
    covers meshing, assembly and the first factorisation.  ``unusual_frames``
    converged only by a fallback (see `Status`).
    """

    label: str
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


@dataclass(frozen=True, eq=False)
class Comparison:
    """Outcome of `compare`.

    Attributes
    ----------
    rows : tuple of Row
        In the order coarse to fine.
    runs : dict of str to Trajectory
        Each case on its own mesh.
    on_coarse : dict of str to Trajectory
        The same on the coarse nodes.
    reference : str
        Label of the case that errors are measured against.
    solver_error : float or None
        Largest node distance between PD and Newton on the coarse mesh, m: they
        minimise the same energy, so this is solver error, unless the body
        buckles and they take different branches.  None without both, or if a
        frame needed a fallback.
    """

    scene: Scene
    rows: tuple[Row, ...]
    runs: dict[str, Trajectory]
    on_coarse: dict[str, Trajectory]
    reference: str
    solver_error: float | None

    def errors_over_time(self) -> dict[str, np.ndarray]:
        """RMS node distance from the reference in each frame, by label, m."""
        truth = self.on_coarse[self.reference]
        return {
            row.label: metrics.error_over_time(self.on_coarse[row.label], truth)
            for row in self.rows
            if row.label != self.reference
        }


def make_stepper(scene: Scene, solver: str, refine: int) -> Stepper:
    """A stepper by name, ``"pd"`` or ``"newton"``, factorised and with its kernels compiled."""
    kinds = {"pd": ProjectiveDynamics, "newton": Newton}
    if solver not in kinds:
        raise InputError(f"solver {solver!r}: expected one of {', '.join(kinds)}.")
    return kinds[solver](discretise(scene, refine=refine)).prepare()


def compare(
    scene: Scene,
    frames: int | None = None,
    cases: tuple[Case, ...] = CASES,
    on_step: OnStep | None = None,
) -> Comparison:
    """Run a scene with several solvers and measure error and time.

    Parameters
    ----------
    scene : Scene
    frames : int, optional
        The scene's by default.
    cases : tuple of Case
        The first is the reference.
    on_step : callable, optional
        For progress.
    """
    if not cases:
        raise InputError("cases is empty: expected at least the reference.")
    coarse = discretise(scene)
    runs, on_coarse, setup = {}, {}, {}
    for case in cases:
        started = time.perf_counter()
        stepper = make_stepper(scene, case.solver, case.refine)
        setup[case.label] = time.perf_counter() - started
        runs[case.label] = rollout(
            stepper, frames, on_step=_progress(on_step, case.label), on_failure="raise"
        )
        on_coarse[case.label] = restrict(runs[case.label], to=coarse)
    truth = on_coarse[cases[0].label]
    base = next(
        (on_coarse[c.label] for c in cases[::-1] if c.refine == 1 and c.solver == "pd"), None
    )
    rows = []
    for case in sorted(cases, key=lambda c: (c.refine, c.solver != "pd")):
        run, here = runs[case.label], on_coarse[case.label]
        has_base = base is not None and metrics.mean_squared_error(base, truth) > 0
        rows.append(
            Row(
                label=case.label,
                solver=case.solver,
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
            )
        )
    return Comparison(
        scene, tuple(rows), runs, on_coarse, cases[0].label, _solver_error(cases, runs)
    )


def _progress(on_step: OnStep | None, label: str) -> Callable[[StepResult, float], None] | None:
    if on_step is None:
        return None
    frame = 0

    def report(result: StepResult, seconds: float) -> None:
        nonlocal frame
        frame += 1
        on_step(label, frame, result)

    return report


def _solver_error(cases: tuple[Case, ...], runs: dict[str, Trajectory]) -> float | None:
    coarse = {case.solver: runs[case.label] for case in cases if case.refine == 1}
    if not {"pd", "newton"} <= set(coarse):
        return None
    if any((run.stats["status"] != Status.CONVERGED.name).any() for run in coarse.values()):
        return None
    return metrics.largest_error(coarse["pd"], coarse["newton"])

"""Steppers side by side on one scene: solvers on meshes with models of the body; error and time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pdcorrect import metrics
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.metrics import relative_error
from pdcorrect.scene import Scene, best_coarse, check_scene, learned_coarse, trained_coarse
from pdcorrect.solvers.implicit import whole
from pdcorrect.solvers.newton import Newton
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.solvers.rollout import restrict, rollout
from pdcorrect.state import Status, StepResult
from pdcorrect.trajectory import Stepper, Trajectory

CASE_BASES = ("plain", "enhanced", "learned", "best")
"""In the order of rows."""
_27_NODES, _LEARNED = "hex27", "hex8-learned"
_SECOND_ORDER = "generalised-alpha"


@dataclass(frozen=True)
class Case:
    """One solver on one mesh."""

    label: str
    solver: str  # "pd" or "newton"
    refine: int
    # of `CASE_BASES`: element and mass of the scene, or of its `best_coarse`, `learned_coarse` or
    # `trained_coarse`, on which correctors of the base "best" were trained
    base: str = "plain"
    # name or folder of a corrector of the steps: with solver "pd", refine 1 and its own base
    model: str | None = None
    gate: bool = True  # whether a default `Gate` lets the corrector pass
    # in place of the scene's; an element on the scene's cells, of base "plain" only
    element: str | None = None
    integrator: str | None = None

    @property
    def plain(self) -> bool:
        """Whether it is the scene itself on the coarse mesh."""
        changes = self.model, self.element, self.integrator
        return self.refine == 1 and self.base == "plain" and changes == (None, None, None)

    def problem(self, scene: Scene) -> Problem:
        """What is stepped."""
        if self.integrator is not None:
            scene = scene.with_changes(time={"integrator": self.integrator})
        if self.base not in CASE_BASES or (self.base != "plain" and self.element is not None):
            raise InputError(
                f"{self.label}: base {self.base!r} with element {self.element!r}: expected one of "
                f"{', '.join(CASE_BASES)}, and 'plain' for an element."
            )
        if self.base != "plain":
            return discretise(_BETTER[self.base](scene), self.refine)
        # "per-node" is for nodes at corners only
        per_node = self.element is not None and scene.solver.mass == "per-node"
        return discretise(scene, self.refine, "averaged" if per_node else None, self.element)


CASES = (
    Case("fine PD", "pd", 4),
    Case("intermediate PD", "pd", 2),
    Case("coarse PD", "pd", 1),
    Case("coarse Newton", "newton", 1),
)
"""Of a scene as it is; the first case is the reference of all errors."""

HEX27 = Case("coarse PD, hex27", "pd", 1, element=_27_NODES)
"""The scene's cells with 27 nodes each."""
LEARNED = Case("learned coarse PD", "pd", 1, "learned")
"""The coarse model with the learned element."""
_BEST = Case("best coarse PD", "pd", 1, "enhanced")
_FINE_BEST = Case("fine best PD", "pd", 4, "enhanced")
_FINE_TRAINED = Case("fine PD as trained", "pd", 4, "best")
"""The reference that correctors of the base "best" have learned from."""
_TRAINED = Case("coarse PD as trained", "pd", 1, "best")  # the coarse model that those correct


def with_learned(scene: Scene) -> Scene:
    """`learned_coarse` of a scene whose nodes it has."""
    if scene.solver.element == _27_NODES:
        raise InputError(
            "learned: the scene's 27-node elements have nodes where it has none: expected a "
            "scene of another element."
        )
    return learned_coarse(scene)


_BETTER: dict[str, Callable[[Scene], Scene]] = {
    "enhanced": best_coarse, "learned": with_learned, "best": trained_coarse
}  # fmt: skip
"""Element and mass of a base."""


def cases_for(
    scene: Scene,
    models: Sequence[str] = (),
    *,
    gate: bool = True,
    hex27: bool = False,
    learned: bool = False,
    second_order: bool = False,
) -> tuple[Case, ...]:
    """What `compare` runs by default: the scene as it is, and always the best coarse model.

    The reference is the fine mesh with the element of the best coarse model; with correctors, by
    name or folder, it is what they learned from, and the coarse models that they correct are among
    the cases.  A scene of 27-node elements, or of the best coarse model's own, has its own element
    on the fine mesh.  The runs of a scene with the learned element are called so.

    ``gate`` is about correctors.  ``hex27`` and ``learned`` add elements on the coarse mesh;
    ``second_order`` adds the best coarse model and these by generalised-alpha, where the scene has
    another integrator.
    """
    check_scene(scene)
    own = scene.solver.element
    if own == _27_NODES and hex27:
        raise InputError(
            "hex27: the scene's own element is hex27: expected a scene of another element."
        )
    reference, *others = CASES
    if own != _27_NODES and scene.solver != best_coarse(scene).solver:
        reference = _FINE_BEST
        others.append(_BEST)
    if models:
        reference, hybrids = _hybrids(models, gate)
        if own == _27_NODES and reference == _FINE_TRAINED:
            raise InputError(
                f"models {', '.join(models)}: correct a coarse model without nodes where the "
                "scene's 27-node elements have some: expected a scene of another element."
            )
        others += hybrids
    if own == _LEARNED:
        others = [replace(c, label=f"learned {c.label}") if c in CASES else c for c in others]
    elif learned:
        with_learned(scene)  # or a refusal before anything runs
        others.append(LEARNED)
    others += [HEX27] if hex27 else []
    if second_order and scene.time.integrator not in (_SECOND_ORDER, "quasi-static"):
        others += [
            replace(case, label=f"{case.label}, {_SECOND_ORDER}", integrator=_SECOND_ORDER)
            for case in others
            if case.label in (_BEST.label, LEARNED.label, HEX27.label)
        ]
    return (reference, *others)


def _hybrids(models: Sequence[str], gate: bool) -> tuple[Case, list[Case]]:
    """What correctors learned from, the coarse models that they correct, and they themselves."""
    from pdcorrect.corrector.model_io import load_model, model_folder, unlike_ends

    names = unlike_ends([model_folder(model).resolve() for model in models])
    bases = [load_model(model).base for model in models]
    if set(bases) not in ({"best"}, {"plain"}):
        raise InputError(
            f"models {', '.join(names)}: correctors of {', '.join(sorted(set(bases)))}: expected "
            "all of 'best' or all of 'plain', as their references have unlike elements."
        )
    without = "" if gate else ", no gate"
    reference, corrected = (_FINE_TRAINED, [_TRAINED]) if "best" in bases else (CASES[0], [])
    return reference, [
        *corrected,
        *(
            Case(f"hybrid {name}{without}", "pd", 1, base, model, gate)
            for name, base, model in zip(names, bases, models, strict=True)
        ),
    ]


_FALLBACKS = [Status.RECOVERED.name, Status.SUBSTEPPED.name]
OnStep = Callable[[str, int, StepResult], None]
"""Called with a case's label, its frame, and the step's result."""


@dataclass(frozen=True)
class Row:
    """One line of the comparison table.

    ``relative_error`` is the one to the converged motion, see `metrics.relative_error`, and
    ``estimated_error`` the same to a finer run; None where that was not computed.  The other
    errors are node distances on the coarse nodes over all frames, against the reference case, in
    metres; ``omega`` is eq. 7-2, its zero the scene itself by PD on the coarse mesh, or the best
    coarse model where that is a learned one.  Times are medians for one frame; ``setup_seconds``
    covers meshing, assembly and the first factorisation.  ``unusual_frames`` converged only by a
    fallback (see `Status`).  ``refused_frames`` are those whose correction a gate refused; None
    without a corrector.
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
    """Outcome of `compare`.

    Attributes
    ----------
    rows : tuple of Row
        In the order coarse to fine, without cases that failed.
    runs, on_coarse : dict of str to Trajectory
        By the label of the case, on its own mesh and on the coarse nodes.
    reference : str
        Label of the case that errors are measured against.
    solver_error : float or None
        Largest node distance between PD and Newton on the coarse mesh, m: they minimise the same
        energy, so this is solver error, unless the body buckles and they take different branches.
        None without both, or if a frame needed a fallback.
    models : mapping
        Of correctors, by label: model, base, the data set that it was trained on, that one's time
        integrator, and digest of its weights.
    failures : mapping of str to str
        Why cases did not come to their end, by label.
    converged, finer : Trajectory or None
        The converged motion, and what errors on the coarse mesh are estimated by, if asked for.
    """

    scene: Scene
    rows: tuple[Row, ...]
    runs: dict[str, Trajectory]
    on_coarse: dict[str, Trajectory]
    reference: str
    solver_error: float | None
    cases: tuple[Case, ...]
    models: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    failures: Mapping[str, str] = field(default_factory=dict)
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
    count = whole("frames", scene.time.frames if frames is None else frames, 1)
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
    zero = _BEST if scene.solver.element == _LEARNED else CASES[2]
    own = (on_coarse[c.label] for c in complete if replace(c, label=zero.label) == zero)
    base = next(own, None)
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

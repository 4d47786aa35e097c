"""What `compare` runs: solvers on meshes with models of the body, each under its label."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import Scene, best_coarse, check_scene, learned_coarse, trained_coarse

CASE_BASES = ("plain", "enhanced", "learned", "best")
"""In the order of rows."""
_27_NODES = "hex27"
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
_TRAINED = Case("coarse PD as trained", "pd", 1, "best")
"""The coarse model that those correct."""


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
    on the fine mesh.  The coarse run of a scene with the learned element is called so.

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
    if own == "hex8-learned":
        others[others.index(CASES[2])] = replace(CASES[2], label=LEARNED.label)
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

"""`hybrid_of`: a model by its name or folder, stepping a scene."""

from __future__ import annotations

from pathlib import Path

from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.model_io import LoadedModel, load_model, model_folder, weights_digest
from pdcorrect.errors import InputError
from pdcorrect.fem.coarse_models import BASES, coarse_model
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Scene, best_coarse, check_scene
from pdcorrect.solvers.projective import ProjectiveDynamics


def hybrid_of(
    scene: Scene,
    model: str | Path | LoadedModel,
    *,
    gate: bool | Gate | None = True,
    problem: Problem | None = None,
) -> HybridStepper:
    """Projective dynamics on the coarse model that a corrector was trained for, corrected.

    Parameters
    ----------
    scene : Scene
        Another time integrator than that of the model's training is let pass, see
        `pdcorrect.evaluation.run_text.foreign_integrator`, unless it is quasi-static.
    model : str, path or LoadedModel
        Name or folder, see `load_model`, or one that is loaded.
    gate : bool, Gate or None
        True: the default `Gate`; None and False: none.
    problem : Problem, optional
        That coarse model of the scene if it is there already, or with another total mass.

    Raises
    ------
    FileFormatError, InputError
        If there is no such model, it is damaged, it corrects an unknown coarse model or another
        one than ``problem``, it does not fit the scene, the scene is quasi-static and the model's
        training was not, or ``gate`` is something else.
    """
    check_scene(scene)
    loaded = model if isinstance(model, LoadedModel) else load_model(model)
    name = "the model" if isinstance(model, LoadedModel) else model_folder(model).name
    if loaded.base not in BASES:
        raise InputError(f"{name}: corrects {loaded.base!r}: expected one of {', '.join(BASES)}.")
    _check_integrator(scene.time.integrator, loaded.integrator, name)
    chosen: Gate | None = None if gate is False else Gate() if gate is True else gate
    if problem is None:
        problem = coarse_model(scene, loaded.base)
    else:
        _check_problem(problem, scene, loaded.base, name)
    return HybridStepper(
        ProjectiveDynamics(problem),
        loaded.corrector,
        velocity=loaded.velocity,
        gate=chosen,
        origin=None if isinstance(model, LoadedModel) else about_model(model),
    )


def about_model(model: str | Path) -> dict[str, str]:
    """Which model that is.

    Keys are ``model``, its name, ``base``, ``dataset``, ``trained_integrator`` and
    ``weights_sha256``.  Time steps are known by a body's cells: `HybridStepper.trained_step`.
    """
    loaded, folder = load_model(model), model_folder(model)
    return {
        "model": folder.name, "base": loaded.base, "dataset": loaded.record.dataset,
        "trained_integrator": loaded.integrator, "weights_sha256": weights_digest(folder),
    }  # fmt: skip


def _check_integrator(found: str, trained: str, name: str) -> None:
    if found == "quasi-static" != trained:
        raise InputError(
            f"{name}: trained on steps by {trained}, and the scene's time.integrator is "
            f"{found!r}, whose steps have no inertia: expected {trained!r}; set it in the scene, "
            "or leave the model out."
        )


def _check_problem(problem: Problem, scene: Scene, base: str, name: str) -> None:
    """Refuse another mesh, element or mass rule than the coarse model has."""
    solver = (best_coarse(scene) if base == "best" else scene).solver
    found = problem.refine, problem.element, problem.mass_rule
    expected = 1, solver.element, solver.mass
    if found != expected:
        raise InputError(
            f"{name}: problem is refined {found[0]} times with element {found[1]} and mass "
            f"{found[2]}: expected {expected[0]}, {expected[1]} and {expected[2]}, the scene's "
            f"coarse model {base!r}."
        )

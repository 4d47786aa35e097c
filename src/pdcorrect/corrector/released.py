"""`hybrid_of`: a model by its name or folder, stepping a scene."""

from __future__ import annotations

from pathlib import Path

from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.model_io import load_model, model_folder
from pdcorrect.errors import InputError
from pdcorrect.fem.coarse_models import BASES, coarse_model
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Scene
from pdcorrect.solvers.projective import ProjectiveDynamics


def hybrid_of(
    scene: Scene, model: str | Path, *, gate: bool = True, problem: Problem | None = None
) -> HybridStepper:
    """Projective dynamics on the coarse model that a corrector was trained for, corrected.

    Parameters
    ----------
    scene : Scene
    model : str or path
        Name or folder, see `load_model`.
    gate : bool
        Whether a default `Gate` lets the corrector pass.
    problem : Problem, optional
        In place of that coarse model of the scene.

    Raises
    ------
    FileFormatError, InputError
        If there is no such model, it is damaged, it corrects an unknown coarse model, or it does
        not fit the scene.
    """
    loaded = load_model(model)
    if problem is None and loaded.base not in BASES:
        raise InputError(
            f"{model_folder(model).name}: corrects {loaded.base!r}: expected one of "
            f"{', '.join(BASES)}."
        )
    return HybridStepper(
        ProjectiveDynamics(problem or coarse_model(scene, loaded.base)),
        loaded.corrector,
        velocity=loaded.velocity,
        gate=Gate() if gate else None,
    )

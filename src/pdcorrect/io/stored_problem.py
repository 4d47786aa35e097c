"""`problem_of`: what a run that was read from a file has stepped, for its stresses."""

from __future__ import annotations

import numpy as np

from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import Scene
from pdcorrect.solvers.rollout import DENSITY_CHANGED
from pdcorrect.trajectory import Trajectory

_ROUNDING = 1e-9
"""Of a cell size: the same mesh, made on another machine."""


def problem_of(run: Trajectory) -> Problem:
    """The run's own problem, or one made anew from the scene that its file holds.

    Its density is the scene's, also where the run had another one, as of `with_total_mass`:
    Cauchy stress at given positions does not depend on it.

    Raises
    ------
    InputError
        If the file does not say enough: it holds no scene, or only a part of the nodes, or its
        moduli were changed after the scene had been read.
    SceneError, MeshError
        If the scene cannot be read or discretised, as where the file of its mesh is gone.
    """
    if run.problem is not None:
        return run.problem
    if not run.scene_toml:
        raise InputError("it holds no scene: expected a run that pdcorrect has computed.")
    changed = run.attributes.get("material", "the scene's")
    if changed not in ("the scene's", DENSITY_CHANGED):
        raise InputError(
            f"its material was {changed} had been read, and the file does not say to what: "
            "expected a run with the scene's material; simulate --vtu writes the stress of others."
        )
    scene = Scene.from_toml(run.scene_toml, source="its scene")
    problem = discretise(scene, _refinement(run))
    same = problem.cells.shape == run.cells.shape and problem.positions.shape == run.points.shape
    close = _ROUNDING * problem.cell_size
    if (
        not same
        or (problem.cells != run.cells).any()
        or np.abs(problem.positions - run.points).max() > close
    ):
        raise InputError(
            f"its mesh ({len(run.points)} nodes, {len(run.cells)} cells) is not the one that its "
            f"scene has now ({len(problem.positions)} nodes, {len(problem.cells)} cells): expected "
            "all nodes of the run, and the mesh file as it was."
        )
    return problem


def _refinement(run: Trajectory) -> int:
    text = run.attributes.get("refine", "1")
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise InputError(f"its refinement is {text!r}: expected a whole number of at least 1.")
    return int(text)

"""`coarse_model`: the models on the coarse mesh that correctors are trained for."""

from __future__ import annotations

from typing import Literal, get_args

from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import Scene, best_coarse

Base = Literal["plain", "best", "total-mass"]
BASES: tuple[str, ...] = get_args(Base)


def coarse_model(scene: Scene, base: str = "plain", refine: int = 4) -> Problem:
    """A scene on its coarse mesh, by the name that a corrector's training has for it.

    Parameters
    ----------
    scene : Scene
    base : {"plain", "best", "total-mass"}
        As the scene says; with element and masses of `best_coarse`; or with its density scaled so
        that it has the total mass of the scene refined.  The last is for ``mass = "per-node"``, by
        which a mesh is the heavier the coarser it is; with the other rules it changes nothing
        but for regions of another density that end inside of coarse cells.
    refine : int
        Of the mesh with that mass: 4 is what correctors were trained beside.

    Raises
    ------
    InputError
        If the name is unknown.
    SceneError, MeshError
        See `discretise`.
    """
    if base not in BASES:
        raise InputError(f"base {base!r}: expected one of {', '.join(BASES)}.")
    if base == "best":
        return discretise(best_coarse(scene))
    plain = discretise(scene)
    if base == "plain":
        return plain
    return plain.with_total_mass(float(discretise(scene, refine).mass.sum()))

"""Scenes of bodies from mesh files, in files that hold the mesh themselves.

A file of a data set has the coarse mesh in ``mesh/points`` and ``mesh/cells``.  That is what its
scenes are discretised on if their body is a mesh file, which is never looked for: the data
set may be moved to another machine.
"""

from __future__ import annotations

import numpy as np

from pdcorrect.data.schema import Array
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.problem import Problem, discretise
from pdcorrect.scene import MeshFile, Scene


def portable(scene: Scene) -> Scene:
    """The scene as a data set holds it: of the path of a mesh file the name alone."""
    if not isinstance(scene.body, MeshFile):
        return scene
    return scene.with_changes(body={"path": scene.body.path.name})


def discretise_stored(scene: Scene, points: Array, cells: Array, refine: int = 1) -> Problem:
    """A stored scene's problem.

    Parameters
    ----------
    scene : Scene
    points : (N, 3)
        Of the file that holds the scene, m.
    cells : (C, 8)
        Of the same file, VTK order.
    refine : int

    Raises
    ------
    SceneError, MeshError
        As `discretise`.
    """
    if not isinstance(scene.body, MeshFile):
        return discretise(scene, refine)
    return discretise(scene, refine, mesh=HexMesh.create(points, cells.astype(np.int64)))

"""Obstacles in pictures: surfaces at rest, and where they are at a time."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pdcorrect.errors import require_extra
from pdcorrect.fem.obstacles import RigidObstacle
from pdcorrect.scene.obstacles import Cylinder, Obstacle, Plane, Sphere
from pdcorrect.scene.regions import unit_vector
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
_AROUND = 1.5
"""Side of the square that stands for a plane, and length of an endless bar, in body diagonals."""


def obstacles_of(run: Trajectory) -> tuple[RigidObstacle, ...]:
    """Those of the scene that a run holds; none of foreign data."""
    declared = tomllib.loads(run.scene_toml).get("obstacles", [])
    return tuple(map(RigidObstacle, TypeAdapter(list[Obstacle]).validate_python(declared)))


class Surface:
    """The surface of an obstacle near a body; planes and endless bars are cut to its size.

    ``middle`` (3,) and ``size`` are the body's middle and diagonal, m.
    """

    def __init__(self, obstacle: RigidObstacle, middle: Array, size: float) -> None:
        self._obstacle, self._middle = obstacle, middle
        declared, pv = obstacle.declared, require_extra("pyvista", "view")
        self._centre, self._along = np.zeros(3), np.zeros((3, 3))
        self.mesh: Any
        if isinstance(declared, Plane):
            normal, side = unit_vector(declared.normal), _AROUND * size
            self._centre = np.array(declared.point)
            self._along = np.eye(3) - np.outer(normal, normal)
            self.mesh = pv.Plane(
                center=self._centre,
                direction=normal,
                i_size=side,
                j_size=side,
                i_resolution=1,
                j_resolution=1,
            )
        elif isinstance(declared, Sphere):
            self.mesh = pv.Sphere(
                radius=declared.radius,
                center=declared.centre,
                theta_resolution=60,
                phi_resolution=60,
            )
        elif isinstance(declared, Cylinder):
            axis, length = unit_vector(declared.axis), declared.length
            if length is None:
                self._centre, self._along = np.array(declared.centre), np.outer(axis, axis)
            self.mesh = pv.Cylinder(
                center=declared.centre,
                direction=axis,
                radius=declared.radius,
                height=length or _AROUND * size,
                resolution=80,
            )
        else:
            self.mesh = pv.Box(np.transpose(declared.box).ravel())

    @property
    def flat(self) -> bool:
        """Whether its faces are few, so that their edges show its shape."""
        return self.mesh.n_cells <= 6

    def transform(self, time: float) -> Array:
        """The matrix (4, 4) that brings it to its place at a time (s), beside the body."""
        R, b = self._obstacle.frame(time)
        shift = self._along @ ((self._middle - b) @ R - self._centre)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R, R @ shift + b
        return matrix

    def points(self, time: float) -> Array:
        """Its vertices (n, 3) at a time, m."""
        matrix = self.transform(time)
        return np.asarray(self.mesh.points) @ matrix[:3, :3].T + matrix[:3, 3]

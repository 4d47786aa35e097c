"""Obstacles: rigid bodies that the body cannot enter."""

from __future__ import annotations

from typing import Annotated, Literal, Union

from pydantic import Field, model_validator

from pdcorrect._config import Direction, NonNegative, Positive, Strict, Vector
from pdcorrect.scene.clamps import Motion


class _Obstacle(Strict):
    """Common to all obstacles.

    Attributes
    ----------
    friction
        Coefficient of Coulomb's law.
    motion
        As of clamps; obstacles without one rest.
    distance
        m; forces begin at this gap and grow without bound as it closes.  A hundredth of the
        coarse cell size by default.
    stiffness
        Pa, of the pressure at a given share of ``distance``, see `pdcorrect.fem.contact`.  The
        scene's largest Young's modulus by default.
    slip
        m/s; slower sliding counts as sticking, with less friction in proportion.  A hundredth of
        the coarse cell size a second by default.
    """

    friction: NonNegative = 0.0
    motion: Motion | None = None
    distance: Positive | None = None
    stiffness: Positive | None = None
    slip: Positive | None = None


class Plane(_Obstacle):
    """A half space: all points behind ``point``, seen along the outward ``normal``."""

    shape: Literal["plane"]
    point: Vector
    normal: Direction


class Sphere(_Obstacle):
    """A ball; lengths in m."""

    shape: Literal["sphere"]
    centre: Vector
    radius: Positive


class Cylinder(_Obstacle):
    """A round bar along ``axis``; without ``length`` (m) it has no ends."""

    shape: Literal["cylinder"]
    centre: Vector
    axis: Direction
    radius: Positive
    length: Positive | None = None


class Box(_Obstacle):
    """A box along the axes between its lowest and highest corner, m."""

    shape: Literal["box"]
    box: tuple[Vector, Vector]

    @model_validator(mode="after")
    def _has_volume(self) -> Box:
        if not all(low < high for low, high in zip(*self.box, strict=True)):
            raise ValueError("expected box = [lowest corner, highest corner]")
        return self


Obstacle = Annotated[Union[Plane, Sphere, Cylinder, Box], Field(discriminator="shape")]

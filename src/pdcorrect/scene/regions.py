"""`Region`: a set of points of a body."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from pdcorrect._config import Axis, Count, Direction, Number, Positive, Strict, Vector, as_toml
from pdcorrect.errors import SceneError


def unit_vector(direction: Axis | tuple[float, float, float]) -> NDArray[np.float64]:
    """Along an axis by name, or along a vector, (3,)."""
    if isinstance(direction, str):
        return np.eye(3)["xyz".index(direction)]
    vector = np.array(direction)
    return np.asarray(vector / np.linalg.norm(vector))


class Region(Strict):
    """A set of points: exactly one of a plane, a box, a sphere, nodes, a group, everything.

    Attributes
    ----------
    plane, at
        Points at ``at`` (m from the origin, or "min" / "max" of the body) along ``plane``, an axis
        by name or the normal of an oblique plane.
    box
        Lowest and highest corner, m.
    sphere, radius
        Centre and radius, m.
    nodes
        Node numbers of the coarse mesh; a new node of a finer mesh or element belongs if all
        corners do of the cell, face or edge that it lies in.
    group
        Name of a body, or of a group of a mesh file.
    everywhere
        The whole body.
    """

    plane: Axis | Direction | None = None
    at: Annotated[Number | Literal["min", "max"] | None, Field(union_mode="left_to_right")] = None
    box: tuple[Vector, Vector] | None = None
    sphere: Vector | None = None
    radius: Positive | None = None
    nodes: tuple[Count, ...] | None = None
    group: Annotated[str, Field(min_length=1)] | None = None
    everywhere: Literal[True] | None = None

    @field_validator("box")
    @classmethod
    def _in_order(cls, box: tuple[Vector, Vector] | None) -> tuple[Vector, Vector] | None:
        if box is not None and any(low > high for low, high in zip(*box, strict=True)):
            raise ValueError("expected box = [lowest corner, highest corner]")
        return box

    @model_validator(mode="after")
    def _exactly_one(self) -> Region:
        names = ("plane", "box", "sphere", "nodes", "group", "everywhere")
        kinds = [name for name in names if getattr(self, name)]
        if len(kinds) != 1:
            raise ValueError(
                "expected exactly one of plane (with at), box, sphere (with radius), nodes, "
                f"group, everywhere, got {', '.join(kinds) or 'none'}"
            )
        if (self.plane is None) != (self.at is None):
            raise ValueError('expected plane and at together, such as { plane = "x", at = 0.0 }')
        if (self.sphere is None) != (self.radius is None):
            raise ValueError("expected sphere and radius together")
        return self

    def contains(
        self, points: NDArray[np.float64], tolerance: float, body: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Which of ``points`` (n, 3) lie in a geometric region, as (n,) bool.

        ``tolerance`` (m) widens the region; ``body`` (N, 3) are the body's corners, for
        ``at = "min" | "max"``.  Node numbers and groups are resolved by the caller, who knows the
        mesh.
        """
        if self.everywhere:
            return np.ones(len(points), dtype=bool)
        if self.plane is not None and self.at is not None:
            normal, at = unit_vector(self.plane), self.at
            if isinstance(at, str):
                at = float(getattr(np, at)(body @ normal))
            return np.asarray(np.abs(points @ normal - at) <= tolerance)
        if self.box is not None:
            low, high = np.asarray(self.box)
            inside = (points >= low - tolerance) & (points <= high + tolerance)
            return inside.all(axis=1)
        if self.sphere is not None and self.radius is not None:
            distance = np.linalg.norm(points - np.asarray(self.sphere), axis=1)
            return distance <= self.radius + tolerance
        raise SceneError("node numbers and groups have no geometry to test points against")

    def describe(self) -> str:
        """The region as it would stand in the file, for messages."""
        return as_toml({k: v for k, v in self.model_dump().items() if v is not None})

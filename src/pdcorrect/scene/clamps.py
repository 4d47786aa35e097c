"""How the body is held and how it starts: clamps and initial velocities."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdcorrect._config import Axis, Direction, FilePath, Number, Strict, Vector
from pdcorrect.scene.regions import Region

Array = NDArray[np.float64]
_AXES: tuple[Axis, ...] = ("x", "y", "z")
_STILL: Vector = (0.0, 0.0, 0.0)


class Motion(Strict):
    """Prescribed motion of a clamp: piecewise linear tables over time.

    Attributes
    ----------
    times
        Increasing, s.  Before the first and after the last the motion rests.
    displacement
        One vector (m) for each time.
    rotation
        One angle (degrees) for each time, about ``axis`` (by name, or a vector) through ``centre``.
    """

    times: tuple[Number, ...] = Field(min_length=1)
    displacement: tuple[Vector, ...] | None = None
    rotation: tuple[Number, ...] | None = None
    axis: Axis | Direction = "x"
    centre: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _tables_match(self) -> Motion:
        if any(b <= a for a, b in pairwise(self.times)):
            raise ValueError("expected motion.times to increase")
        if self.displacement is None and self.rotation is None:
            raise ValueError("expected motion.displacement or motion.rotation")
        for name in ("displacement", "rotation"):
            table = getattr(self, name)
            if table is not None and len(table) != len(self.times):
                raise ValueError(
                    f"expected motion.{name} to have the {len(self.times)} entries of "
                    f"motion.times, got {len(table)}"
                )
        return self


class Clamp(Strict):
    """Nodes of a region whose named components are held, or moved.

    ``components = ["z"]`` makes a roller, ``normal = [1, 0, 1]`` one along any direction; without
    ``motion`` the nodes are held at their rest positions.
    """

    region: Region
    components: tuple[Axis, ...] = Field(default=("x", "y", "z"), min_length=1)
    normal: Direction | None = None
    motion: Motion | None = None

    @model_validator(mode="after")
    def _components_or_normal(self) -> Clamp:
        if self.normal is not None and len(set(self.components)) < 3:  # files have all defaults
            raise ValueError("expected either components or normal, not both")
        return self

    @property
    def held(self) -> tuple[Axis, ...]:
        """Components that are held as such: none of an oblique clamp."""
        if self.normal is None:
            return self.components
        along = [axis for axis, size in zip(_AXES, self.normal, strict=True) if size]
        return (along[0],) if len(along) == 1 else ()


class Initial(Strict):
    """Velocities at time zero: v + w x (X - c) + G (X - c) at the rest position X.

    Attributes
    ----------
    region
        Whose nodes have these velocities; everywhere by default.
    velocity
        v, m/s.
    angular_velocity
        w, rad/s.
    velocity_gradient
        G, rows of the derivatives of v_x, v_y, v_z by x, y, z, 1/s.
    centre
        c, m; the centre of mass of the region by default.
    run, frame
        A trajectory file, from whose frame (-1 is the last) positions and velocities are taken;
        the velocities above are added.
    """

    region: Region | None = None
    velocity: Vector = _STILL
    angular_velocity: Vector = _STILL
    velocity_gradient: tuple[Vector, Vector, Vector] = (_STILL, _STILL, _STILL)
    centre: Vector | None = None
    run: FilePath | None = None
    frame: int | None = None

    @model_validator(mode="after")
    def _frame_of_a_run(self) -> Initial:
        if self.frame is not None and self.run is None:
            raise ValueError("expected run beside frame")
        return self

    def velocities(self, points: Array, centre_of_mass: Array) -> Array:
        """The field at rest positions (n, 3), m, as (n, 3), m/s."""
        arms = points - (centre_of_mass if self.centre is None else np.array(self.centre))
        spin = np.cross(np.array(self.angular_velocity), arms)
        return np.array(self.velocity) + spin + arms @ np.array(self.velocity_gradient).T

"""Loads and their amplitude over time."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Union

from pydantic import Field, model_validator

from pdcorrect._config import NonNegative, Number, Strict, Vector, as_toml
from pdcorrect.scene.regions import Region


class _Load(Strict):
    """Common to all loads: how strong they are at a time.

    The load's value is multiplied by an amplitude: 1 inside ``window`` (s) and
    0 outside, rising linearly during the first ``ramp`` seconds of the window;
    or given by ``table`` = [[time, amplitude], ...], piecewise linear.  Each time
    step uses the mean amplitude over an interval of its length, so the momentum of an
    impulse does not depend on the step size.
    """

    window: tuple[Number, Number] | None = None
    ramp: NonNegative = 0.0
    table: tuple[tuple[Number, Number], ...] | None = None

    @model_validator(mode="after")
    def _amplitude(self) -> _Load:
        if self.window is not None and not max(self.window[0], 0.0) < self.window[1]:
            raise ValueError(
                "expected window = [start, end] with start < end and an end after time 0, got "
                f"{as_toml(self.window)}"
            )
        if self.table is not None:
            if self.window is not None or self.ramp:
                raise ValueError("expected either table, or window and ramp, not both")
            times = [row[0] for row in self.table]
            if len(times) < 2 or any(b <= a for a, b in pairwise(times)):
                raise ValueError("expected table to have two or more rows with increasing times")
        return self


class Gravity(_Load):
    """Uniform acceleration (m/s2) of the whole body."""

    kind: Literal["gravity"]
    acceleration: Vector


class BodyForce(_Load):
    """Uniform force density (N/m3) in the cells of a region."""

    kind: Literal["body-force"]
    density: Vector
    region: Region = Region(everywhere=True)


class Force(_Load):
    """Total force (N) on a region.

    ``distribution = "consistent"`` spreads it evenly over the boundary faces of
    a plane region, over the cells of any other.  ``"nodal"`` divides it equally
    among the *coarse* nodes of the region, on every mesh: the thesis's loads,
    which have no limit under refinement.
    """

    kind: Literal["force"]
    force: Vector
    region: Region
    distribution: Literal["consistent", "nodal"] = "consistent"


class Traction(_Load):
    """Force for each unit of rest area (Pa) on the boundary faces of a region."""

    kind: Literal["traction"]
    traction: Vector
    region: Region


class Pressure(_Load):
    """Pressure (Pa, positive pushes inwards) on the boundary faces of a region.

    ``follower = true`` uses the faces' current area and normal, where the step's
    equation is; otherwise those at rest.
    """

    kind: Literal["pressure"]
    pressure: Number
    region: Region
    follower: bool = False


class Torsion(_Load):
    """The rotational field of the thesis, eq. 6-1 to 6-3, about an axis along x.

    With y and z measured from ``centre``: f = (stretch, -z - attraction y,
    y - attraction z), normalised to length ``strength`` (0 where f = 0).

    ``distribution = "consistent"``: strength is a force density, N/m3,
    integrated with Gauss points.  ``"nodal"``: strength is the force on each
    coarse node, N.  ``follower = true`` samples the field at the positions where
    the step's equation is instead of at rest.
    """

    kind: Literal["torsion"]
    strength: Number
    attraction: Number = 0.0
    stretch: Number = 0.0
    centre: Vector | None = None
    region: Region = Region(everywhere=True)
    distribution: Literal["consistent", "nodal"] = "consistent"
    follower: bool = False


Load = Annotated[
    Union[Gravity, BodyForce, Force, Traction, Pressure, Torsion], Field(discriminator="kind")
]

"""Actuators: muscle fibres in the body, with the length that they want over time."""

from __future__ import annotations

from itertools import pairwise

from pydantic import Field, field_validator

from pdcorrect._config import Direction, NonNegative, Number, Positive, Strict
from pdcorrect.scene.regions import Region


class Actuator(Strict):
    """Parallel fibres with the energy density w/2 (|F m| - r)^2 (Du et al. 2021, DiffPD).

    F m is the fibre at rest, a unit vector m, after the deformation.

    Attributes
    ----------
    region
        The fibres are in the cells whose centre is in it.
    direction
        Along m.
    stiffness
        w, Pa.
    activation
        ``[[time, r], ...]``, s and dimensionless, piecewise linear, constant before the first
        and after the last: the stretch at which fibres rest.  1 leaves the body as it is, less
        contracts it.
    """

    region: Region = Region(everywhere=True)
    direction: Direction
    stiffness: Positive
    activation: tuple[tuple[Number, NonNegative], ...] = Field(min_length=1)

    @field_validator("activation")
    @classmethod
    def _in_order(cls, table: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        if any(b[0] <= a[0] for a, b in pairwise(table)):
            raise ValueError("expected rows [time, stretch] with increasing times")
        return table

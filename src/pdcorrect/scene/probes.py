"""Probes: places whose motion is recorded."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from pdcorrect._config import Strict, Vector
from pdcorrect.scene.regions import Region


class Probe(Strict):
    """A point that moves with the body, or the mean over a region.

    Attributes
    ----------
    name
        In tables and legends.
    point
        At rest, m; the nearest one of the body if rounding puts it outside.
    region
        Mean over boundary faces for a plane, over nodes for a list of nodes, over cells otherwise.
    """

    name: Annotated[str, Field(min_length=1)]
    point: Vector | None = None
    region: Region | None = None

    @field_validator("name")
    @classmethod
    def _heads_a_column(cls, name: str) -> str:
        if set(name) & set(',"\r\n'):
            raise ValueError("expected a name without commas, quotes and line breaks")
        return name

    @model_validator(mode="after")
    def _one_place(self) -> Probe:
        if (self.point is None) == (self.region is None):
            raise ValueError("expected either point or region")
        return self

"""What a case gives, and what its figures have to be."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError, model_validator

from pdcorrect._config import Strict, explained
from pdcorrect.errors import InputError

Figure = float | str
"""A number, or a status by name."""


@dataclass(frozen=True)
class Table:
    """Rows under headings; tables of several parts with one name are joined."""

    name: str
    headings: tuple[str, ...]
    rows: tuple[tuple[Figure, ...], ...]


@dataclass(frozen=True)
class Outcome:
    """Figures and tables of a case or of a part of it."""

    figures: Mapping[str, Figure]
    tables: tuple[Table, ...] = ()


class Expectation(Strict):
    """What a figure has to be: a value and its tolerance, within bounds, or one of some statuses.

    ``source`` says where that comes from; ``quick``, whether quick runs have the figure too.
    ``known_failure`` says why a figure is not as expected: a run fails only once it is, and this
    entry has to go.
    """

    value: float | None = None
    tolerance: Annotated[float, Field(ge=0.0)] | None = None
    at_least: float | None = None
    at_most: float | None = None
    status: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    source: Annotated[str, Field(min_length=1)]
    quick: bool = False
    known_failure: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Expectation:
        if (self.value is None) != (self.tolerance is None):
            raise ValueError("expected value and tolerance together")
        bounded = self.at_least is not None or self.at_most is not None
        if [self.value is not None, bounded, self.status is not None].count(True) != 1:
            raise ValueError("expected a value, bounds or status")
        if self._bounds[0] > self._bounds[1]:
            raise ValueError("expected at_least below at_most")
        return self

    @property
    def _bounds(self) -> tuple[float, float]:
        low, high = self.at_least, self.at_most
        return -math.inf if low is None else low, math.inf if high is None else high

    def met_by(self, figure: Figure | None) -> bool:
        """Whether a figure is within the tolerance or the bounds, or one of the statuses."""
        if self.status is not None:
            return figure in self.status
        if not isinstance(figure, (int, float)):
            return False
        if self.value is not None and self.tolerance is not None:
            return abs(figure - self.value) <= self.tolerance
        return self._bounds[0] <= figure <= self._bounds[1]

    def describe(self) -> str:
        """What is expected, as text."""
        if self.status is not None:
            return " or ".join(self.status)
        if self.value is not None:
            return f"{self.value:.6g} ± {self.tolerance:.3g}"
        told = {"at least": self.at_least, "at most": self.at_most}
        return ", ".join(f"{how} {x:.6g}" for how, x in told.items() if x is not None)


Expectations = dict[str, Expectation]


def read_expectations(path: Path) -> Expectations:
    """What a case's ``expected.json`` asks for, by figure.

    Raises
    ------
    InputError
        If it cannot be read, or an entry has no meaning.
    """
    try:
        found = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read ({error}).") from None
    out = {}
    for name, entry in found.items():
        try:
            out[name] = Expectation.model_validate(entry)
        except ValidationError as error:
            raise InputError(f"{path}: {name}: {explained(error, Expectation)}") from None
    return out


def outside(
    figures: Mapping[str, Figure | None], expected: Expectations, quick: bool = False
) -> list[str]:
    """Figures that are not as expected, are so in spite of a known failure, or are not there."""
    out = []
    for name, aim in expected.items():
        if name not in figures:
            out += [name] if aim.quick or not quick else []
        elif aim.met_by(figures[name]) != (aim.known_failure is None):
            out.append(name)
    return out

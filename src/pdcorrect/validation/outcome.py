"""What a validation case gives, and how it is judged by the figures expected."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from pdcorrect._config import NonNegative, Number, Strict
from pdcorrect.errors import InputError

Figure = float | str
"""A number, or a status by name."""


@dataclass(frozen=True)
class Table:
    """A table of the report; numbers are shown with four digits.

    Attributes
    ----------
    name : str
        Its title; tables of several parts with one name are joined.
    headings : tuple of str
    rows : tuple of tuples of str or float
    """

    name: str
    headings: tuple[str, ...]
    rows: tuple[tuple[Figure, ...], ...]


@dataclass(frozen=True)
class Picture:
    """A picture of the report.

    Attributes
    ----------
    name : str
        File name without suffix.
    caption : str
    draw : callable
        Writes the PNG file at a path.
    """

    name: str
    caption: str
    draw: Callable[[Path], object]


@dataclass(frozen=True)
class Outcome:
    """Figures, tables and pictures of a case or of a part of it."""

    figures: Mapping[str, Figure]
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = field(default=())


class Expectation(Strict):
    """What a figure has to be: a value and its tolerance, within bounds, or one of some statuses.

    Attributes
    ----------
    value, tolerance
        The figure may differ from the value by the tolerance at most.
    at_least, at_most
        Bounds, either or both.
    status
        Texts of which the figure has to be one.
    source
        Where the expectation comes from.
    quick
        Whether quick runs have the figure too.
    known_failure
        Why the figure is not as expected, where that is known: it is reported, but does not
        make a run fail.  Once the figure is as expected the entry has to go, and the run
        fails until then.
    """

    value: Number | None = None
    tolerance: NonNegative | None = None
    at_least: Number | None = None
    at_most: Number | None = None
    status: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    source: Annotated[str, Field(min_length=1)]
    quick: bool = False
    known_failure: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Expectation:
        if (self.value is None) != (self.tolerance is None):
            raise ValueError("expected value and tolerance together")
        if [self.value is None, self._bounds is None, self.status is None].count(False) != 1:
            raise ValueError(
                "expected value and tolerance, or at_least, at_most or both, or status"
            )
        if self._bounds and self._bounds[0] > self._bounds[1]:
            raise ValueError("expected at_least below at_most")
        return self

    @property
    def _bounds(self) -> tuple[float, float] | None:
        if self.at_least is None and self.at_most is None:
            return None
        return (
            -math.inf if self.at_least is None else self.at_least,
            math.inf if self.at_most is None else self.at_most,
        )

    def met_by(self, figure: Figure | None) -> bool:
        """Whether a figure is within the tolerance or the bounds, or one of the statuses."""
        if self.status is not None:
            return figure in self.status
        if not isinstance(figure, (int, float)):
            return False
        if self._bounds:
            return self._bounds[0] <= figure <= self._bounds[1]
        assert self.value is not None
        assert self.tolerance is not None
        return abs(figure - self.value) <= self.tolerance

    def allows(self, figure: Figure | None) -> bool:
        """Whether a figure is what is known of it: as expected, or failing where that is known."""
        return self.met_by(figure) == (self.known_failure is None)

    def describe(self) -> str:
        """What is expected, as text."""
        if self.status is not None:
            return " or ".join(self.status)
        told = {"at least": self.at_least, "at most": self.at_most}
        if self._bounds:
            return ", ".join(
                f"{how} {bound:.6g}" for how, bound in told.items() if bound is not None
            )
        return f"{self.value:.6g} ± {self.tolerance:.3g}"


Expectations = dict[str, Expectation]
_READER: TypeAdapter[Expectations] = TypeAdapter(Expectations)


def read_expectations(path: Path) -> Expectations:
    """What a case's ``expected.json`` asks for, by figure.

    Raises
    ------
    InputError
        If it cannot be read, or an entry has no meaning.
    """
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))
        return _READER.validate_python(found)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except ValueError as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else None
        where = ".".join(map(str, first["loc"])) + ": " if first else ""
        told = first["msg"].removeprefix("Value error, ") if first else str(error)
        raise InputError(f"{path}: {where}{told}.") from None


def outside(figures: Mapping[str, Figure | None], expected: Expectations) -> list[str]:
    """Names of the figures that are not as expected, or are so in spite of a known failure.

    Those that nothing is known of are fine.
    """
    return [n for n, value in figures.items() if n in expected and not expected[n].allows(value)]


def missing(figures: Iterable[str], expected: Expectations, quick: bool) -> list[str]:
    """Names of the figures that a run, quick or full, ought to have and has not."""
    there = set(figures)
    return [n for n, aim in expected.items() if n not in there and (aim.quick or not quick)]


def finite(value: Figure) -> Figure | None:
    """A figure as JSON can hold it: None for what is no number."""
    return value if isinstance(value, str) or math.isfinite(value) else None

"""Results of cases as JSON files, with what they were made by."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pdcorrect._files import write_text
from pdcorrect.validation.outcome import Figure, Outcome, Table, finite


@dataclass
class PartRecord:
    """Figures, tables and pictures of a part.

    Attributes
    ----------
    digest : str
        Of what it was made by, see `ValidationCase.digest`.
    quick, drawn : bool
        Whether it is of a quick run, and whether its pictures were drawn.
    seconds : float
        Wall clock.
    figures : dict of str to float, str or None
        None for what is no number.
    tables : list of dict
        With ``name``, ``headings`` and ``rows``.
    pictures : dict of str to str
        Captions by file name.
    """

    digest: str
    quick: bool
    drawn: bool
    seconds: float = 0.0
    figures: dict[str, Figure | None] = field(default_factory=dict)
    tables: list[dict[str, Any]] = field(default_factory=list)
    pictures: dict[str, str] = field(default_factory=dict)

    def add(self, outcome: Outcome) -> None:
        """Take over figures and tables; tables of one name are joined."""
        self.figures |= {name: finite(value) for name, value in outcome.figures.items()}
        self.join(
            {"name": t.name, "headings": t.headings, "rows": _rows(t)} for t in outcome.tables
        )

    def join(self, tables: Iterable[dict[str, Any]]) -> None:
        """Add tables, or their rows to those of the same name."""
        known = {table["name"]: table for table in self.tables}
        for table in tables:
            if table["name"] in known:
                known[table["name"]]["rows"] += table["rows"]
            else:
                known[table["name"]] = {**table, "rows": list(table["rows"])}
                self.tables.append(known[table["name"]])


@dataclass
class Record(PartRecord):
    """The result of a case.

    Attributes
    ----------
    command, date
        How and when it was made.
    load : float
        Processes that were running when it began, mean of a minute: timings of a busy
        machine are not to be trusted.
    seed : None
        Cases fix their own seeds.
    outside : list of str
        Figures that are not as expected, or not there.
    error : str
        Why there is no result; such records are not kept.
    environment : dict of str to str
        Hardware, threads, precision, versions.
    inputs : dict of str to str
        SHA-256 of models and data that it read, see `ValidationCase.inputs`.
    """

    command: str = ""
    date: str = ""
    load: float = float("nan")
    seed: None = None
    outside: list[str] = field(default_factory=list)
    error: str = ""
    environment: dict[str, str] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether it has a result with all figures as expected."""
        return not (self.outside or self.error)

    def merge(self, part: PartRecord) -> None:
        """Take over a part."""
        self.figures |= part.figures
        self.pictures |= part.pictures
        self.seconds += part.seconds
        self.join(part.tables)


def save(path: Path, record: PartRecord) -> None:
    """Write a record whole or not at all."""
    content = {name: value for name, value in asdict(record).items() if name != "error"}
    write_text(path, json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


R = TypeVar("R", bound=PartRecord)


def load(path: Path, wanted: R) -> R | None:
    """A record of the same code and mode as another one; None if there is none."""
    try:
        found = type(wanted)(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # not there, or not of this version
        return None
    same = (found.digest, found.quick) == (wanted.digest, wanted.quick)
    return found if same and found.drawn >= wanted.drawn else None


def table_csv(table: dict[str, Any]) -> str:
    """A table as CSV."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(table["headings"])
    writer.writerows(table["rows"])
    return buffer.getvalue()


def _rows(table: Table) -> list[list[Figure | None]]:
    return [[finite(cell) for cell in row] for row in table.rows]

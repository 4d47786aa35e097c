"""Run validation cases, judge their figures by what was written down before, keep the results.

A case is a folder with ``README.md`` (its question), ``run.py`` and ``expected.json``.  ``run.py``
has ``case(quick)``, which gives an `Outcome`, or ``parts(quick)``, which gives functions by name,
each of which gives the outcome of a part; a run that was ended goes on with the first part that
is not done.  It may have ``summary(record)``, the outcome of all parts of a full run together,
``finding(record)``, a sentence, and ``draw(record, path)``.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import io
import json
import math
import os
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from expectations import Expectations, Figure, outside, read_expectations
from expectations import Outcome as Outcome
from expectations import Table as Table

from pdcorrect._environment import code_digest, environment, home_folder
from pdcorrect._files import clear_parts, make_folder, write_text
from pdcorrect.errors import InputError, OutputError

DIGITS = 6
"""Of numbers in records."""


class CaseFilesError(InputError):
    """The files of a case are wrong; other input errors are of what its code computes."""


@dataclass
class Record:
    """The result of a case, or of a part of it; None stands for what is no number.

    ``digest`` is of what it was made by, see `Case.digest`; ``load`` the processes that ran when
    it began; ``outside`` names figures that are not as expected; records with an ``error`` are
    not kept.
    """

    digest: str
    quick: bool
    command: str = ""
    date: str = ""
    note: str = ""
    seconds: float = 0.0
    load: float = 0.0
    outside: list[str] = field(default_factory=list)
    error: str = ""
    environment: dict[str, str] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    figures: dict[str, Figure | None] = field(default_factory=dict)
    tables: list[dict[str, Any]] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether it has a result with all figures as expected."""
        return not (self.outside or self.error)

    def table(self, name: str) -> dict[str, Any]:
        """The table of a name."""
        return next(table for table in self.tables if table["name"] == name)

    def add(
        self, figures: Mapping[str, Figure | None], tables: Iterable[Mapping[str, Any]]
    ) -> None:
        """Take over figures and tables; tables of one name are joined."""
        self.figures |= {name: _finite(value) for name, value in figures.items()}
        known = {table["name"]: table for table in self.tables}
        for table in tables:
            if table["name"] not in known:
                self.tables.append({**table, "headings": list(table["headings"]), "rows": []})
                known[table["name"]] = self.tables[-1]
            rows = [[_finite(cell) for cell in row] for row in table["rows"]]
            known[table["name"]]["rows"] += rows


def _finite(value: Figure | None) -> Figure | None:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def save(path: Path, record: Record, digits: int = 17) -> None:
    """Write a record whole or not at all; each figure and each row of a table is a line."""
    content = asdict(record)
    del content["error"]
    write_text(path, _json(content, digits) + "\n")


def load(path: Path) -> Record | None:
    """A record; None if there is none of this version."""
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _json(value: Any, digits: int) -> str:
    """JSON with numbers of so many digits, and a line for each figure and each row."""
    if isinstance(value, float):
        return repr(float(f"{value:.{digits}g}"))
    if isinstance(value, dict):
        lines = [f"{_json(k, 0)}: {_json(x, digits)}" for k, x in value.items()]
        return "{\n" + ",\n".join(lines) + "\n}" if lines else "{}"
    if isinstance(value, list):
        lines = [_json(x, digits) for x in value]
        flat = not any(isinstance(x, (dict, list)) for x in value)
        return f"[{', '.join(lines)}]" if flat else "[\n" + ",\n".join(lines) + "\n]"
    return json.dumps(value, ensure_ascii=False)


@dataclass(frozen=True)
class Case:
    """A case by its folder."""

    folder: Path

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.folder.name

    @cached_property
    def expected(self) -> Expectations:
        """What its figures have to be."""
        return read_expectations(self.folder / "expected.json")

    @property
    def has_quick_part(self) -> bool:
        """Whether a quick run has figures that are judged."""
        return any(aim.quick for aim in self.expected.values())

    @property
    def title(self) -> str:
        """The first heading of its README."""
        return self._readme(r"^# (.+)$") or self.name

    @property
    def question(self) -> str:
        """The paragraph of its README that begins with **Question.**"""
        return self._readme(r"\*\*Question\.\*\*\s*((?:.+\n?)+)")

    def _readme(self, pattern: str) -> str:
        path = self.folder / "README.md"
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        found = re.search(pattern, text, re.M)
        return " ".join(found.group(1).split()) if found else ""

    @cached_property
    def module(self) -> Any:
        """Its ``run.py``, which can import modules beside it, and those that cases share."""
        sys.path[:0] = [str(f) for f in (self.folder, self.folder.parent) if str(f) not in sys.path]
        name = f"validation_case_{self.name}"
        spec = importlib.util.spec_from_file_location(name, self.folder / "run.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module

    def parts(self, quick: bool) -> Mapping[str, Callable[[], Outcome]]:
        """What there is to run, by name; a case without parts has one without a name.

        Raises
        ------
        CaseFilesError
            If the module has neither function, or two parts' records would be one file.
        """
        place = self.folder / "run.py"
        if not hasattr(self.module, "parts") and not hasattr(self.module, "case"):
            raise CaseFilesError(f"{place}: expected a function case or parts of (quick).")
        if not hasattr(self.module, "parts"):
            return {"": partial(self.module.case, quick)}
        found: dict[str, Callable[[], Outcome]] = self.module.parts(quick)
        if len({slug(name) for name in found}) < len(found):
            told = f"parts whose names differ in signs only: {list(found)}."
            raise CaseFilesError(f"{place}: {told}")
        return found

    def inputs(self) -> dict[str, str]:
        """SHA-256 of the files that ``inputs.txt`` names, one a line, from above the cases' folder.

        Raises
        ------
        InputError
            If one is not there.
        """
        listed, root = self.folder / "inputs.txt", self.folder.parents[1]
        lines = listed.read_text(encoding="utf-8").split() if listed.is_file() else []
        for line in lines:
            if not (root / line).is_file():
                raise InputError(f"{listed}: {line!r} is no file of {root}.")
        return {line: hashlib.sha256((root / line).read_bytes()).hexdigest() for line in lines}

    def digest(self) -> str:
        """SHA-256 of what its result depends on: code, expectations and `inputs`."""
        found = hashlib.sha256(code_digest().encode() + json.dumps(self.inputs()).encode())
        code = {*self.folder.parent.glob("*.py"), *self.folder.rglob("*.py")}
        for path in [*sorted(code), self.folder / "expected.json"]:
            found.update(path.relative_to(self.folder.parent).as_posix().encode())
            found.update(path.read_bytes())
        return found.hexdigest()


def find_cases(names: Sequence[str] = (), folder: str | Path | None = None) -> list[Case]:
    """Cases by name, all by default, in the folder ``validation`` of `home_folder`.

    Raises
    ------
    InputError
        If there is no such folder or case.
    """
    folder = home_folder("validation") if folder is None else Path(folder)
    known = {p.parent.name: p.parent for p in sorted(folder.glob("*/run.py"))}
    if not known:
        raise InputError(f"{folder}: no validation cases: expected folders with run.py.")
    for name in names:
        if name not in known:
            told = ", ".join(known)
            raise InputError(f"validation case {name!r}: not in {folder}: expected one of {told}.")
    return [Case(known[name]) for name in dict.fromkeys(names or known)]


def run_case(
    case: Case, output: str | Path, quick: bool = False, again: bool = False, command: str = ""
) -> Record:
    """Run a case, unless there is a result of the same code and inputs; write its JSON and CSV.

    Returns
    -------
    Record
        With ``error`` if the case ended with an exception.

    Raises
    ------
    InputError
        If the case's files are wrong.
    OutputError
        If a result cannot be written.
    """
    output = make_folder(output)
    record = Record(
        case.digest(), quick, command, time.strftime("%Y-%m-%d"),
        load=round(os.getloadavg()[0], 2), environment=environment(), inputs=case.inputs(),
    )  # fmt: skip
    path, scratch = output / f"{case.name}.json", output / "parts" / case.name
    kept = None if again else _same(path, record)
    if kept:
        return kept
    expected = case.expected
    clear_parts(make_folder(scratch))
    try:
        for name, compute in case.parts(quick).items():
            place = scratch / f"{slug(name)}.json"
            part = (None if again else _same(place, record)) or _run_part(compute, record)
            save(place, part)
            record.seconds = round(record.seconds + part.seconds, 3)
            record.add(part.figures, part.tables)
        if hasattr(case.module, "summary") and not quick:
            summary = case.module.summary(record)
            record.add(summary.figures, [vars(table) for table in summary.tables])
    except (CaseFilesError, OutputError):
        raise
    except Exception:  # of a case's own code
        record.error = traceback.format_exc()
        return record
    record.outside = outside(record.figures, expected, quick)
    write_text(output / f"{case.name}.csv", judged_csv(case, record))
    save(path, record, DIGITS)
    for place in scratch.glob("*.json"):
        place.unlink()
    for folder in (scratch, scratch.parent):
        if not any(folder.iterdir()):
            folder.rmdir()
    return record


def _same(path: Path, record: Record) -> Record | None:
    found = load(path)
    wanted = record.digest, record.quick
    return found if found and (found.digest, found.quick) == wanted else None


def _run_part(compute: Callable[[], Outcome], record: Record) -> Record:
    started = time.perf_counter()
    outcome = compute()
    part = Record(record.digest, record.quick)
    part.add(outcome.figures, [vars(table) for table in outcome.tables])
    part.seconds = round(time.perf_counter() - started, 3)
    return part


def slug(name: str) -> str:
    """A name as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower() or "all"


JUDGED = ("figure", "value", "expected", "source", "verdict")


def judged(case: Case, record: Record) -> list[tuple[str, ...]]:
    """Rows of `JUDGED`, those outside first."""
    rows = []
    for name, aim in case.expected.items():
        if name in record.figures or name in record.outside:
            value = shown(record.figures[name]) if name in record.figures else "missing"
            word = "known failure" if aim.known_failure else "ok"
            word = "outside" if name in record.outside else word
            rows.append((name, value, aim.describe(), aim.source, word))
    return sorted(rows, key=lambda row: ("outside", "known failure", "ok").index(row[-1]))


def judged_csv(case: Case, record: Record) -> str:
    """`judged` as CSV."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([JUDGED, *judged(case, record)])
    return buffer.getvalue()


def shown(value: Figure | None) -> str:
    """A figure as text."""
    return "none" if value is None else value if isinstance(value, str) else f"{value:.{DIGITS}g}"


def verdict(case: Case, record: Record) -> str:
    """In words."""
    if record.error:
        return "fail: the case ended with an error"
    words = [row[-1] for row in judged(case, record)]
    told = {"ok": "hold", "known failure": "known to fail", "outside": "outside"}
    counts = [f"{words.count(word)} {told[word]}" for word in told if word in words]
    return f"{'fail' if record.outside else 'as expected'}: {', '.join(counts)}"


def run(
    cases: Sequence[Case], output: Path, quick: bool, again: bool, command: str,
    tell: Callable[[str], None],
) -> bool:  # fmt: skip
    """Run cases, a line when each begins and ends, and write the report; whether all passed."""
    import report

    sections = []
    for number, case in enumerate(cases, start=1):
        tell(f"{case.name}: begins ({number} of {len(cases)})")
        started = time.perf_counter()
        record = run_case(case, output, quick, again, command)
        sections.append(report.section(case, record, output))
        tell(f"{case.name}: {verdict(case, record)}, {time.perf_counter() - started:.0f} s")
        for name, value, aim, *_ in judged(case, record)[: len(record.outside)]:
            tell(f"  {name}: {value}, expected {aim}")
        if record.error:
            tell(record.error)
    if importlib.util.find_spec("matplotlib") is None:
        tell("no figures: they need the extra 'view'")
    tell(f"report: {report.write(sections, output)}")
    return all(section.record.passed for section in sections)

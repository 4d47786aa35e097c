"""Run cases, part by part, and keep what is done."""

from __future__ import annotations

import os
import re
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from pdcorrect._environment import environment
from pdcorrect._files import clear_parts, make_folder, write_bytes, write_text
from pdcorrect.errors import InputError, PdcorrectError
from pdcorrect.validation.cases import Parts, ValidationCase
from pdcorrect.validation.outcome import Outcome, missing, outside
from pdcorrect.validation.records import PartRecord, Record, load, save, table_csv

OnPart = Callable[[str, int, int], None]
"""Called with a part's name before it runs, and how many are done of how many."""


def record_path(output: Path, case: ValidationCase) -> Path:
    """Where a case's result is."""
    return output / f"{case.name}.json"


def run_case(
    case: ValidationCase,
    output: str | Path,
    *,
    quick: bool = False,
    again: bool = False,
    draw: bool = True,
    command: str = "",
    on_part: OnPart | None = None,
) -> Record:
    """Run a case and write ``<case>.json`` and the folder ``<case>`` with pictures and CSV.

    A result that is there already is kept if code, expectations and mode are those it was
    made with, and so are parts of one that was not finished.

    Parameters
    ----------
    case : ValidationCase
    output : path
        Folder of the results.
    quick : bool
        Only the case's quick part.
    again : bool
        Run it whatever there is.
    draw : bool
        Whether to draw the pictures; they are in no record then.
    command : str
        For the record.
    on_part : callable, optional
        For progress.

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
        case.digest(), quick, draw, command=command, date=time.strftime("%Y-%m-%d"),
        load=round(os.getloadavg()[0], 2), environment=environment(), inputs=case.inputs(),
    )  # fmt: skip
    kept = None if again else load(record_path(output, case), record)
    if kept is not None:
        return kept
    expected = case.expected
    folder = make_folder(output / case.name)
    clear_parts(folder)
    try:
        parts = case.parts(quick)
        _check_names(parts)
        for number, (name, compute) in enumerate(parts.items()):
            if on_part:
                on_part(name, number, len(parts))
            path = folder / f"part-{slug(name)}.json"
            part = PartRecord(record.digest, quick, draw)
            found = None if again else load(path, part)
            record.merge(found or _run_part(compute, folder, part))
            save(path, found or part)
    except PdcorrectError:
        raise
    except Exception:  # of a case's own code
        record.error = traceback.format_exc()
        return record
    record.outside = outside(record.figures, expected)
    record.outside += missing(record.figures, expected, quick)
    for table in record.tables:
        write_text(folder / f"{slug(table['name'])}.csv", table_csv(table))
    save(record_path(output, case), record)
    for path in folder.glob("part-*.json"):
        path.unlink()
    return record


def _run_part(compute: Callable[[], Outcome], folder: Path, part: PartRecord) -> PartRecord:
    started = time.perf_counter()
    outcome = compute()
    part.add(outcome)
    part.seconds = round(time.perf_counter() - started, 3)
    if part.drawn:
        for picture in outcome.pictures:
            with tempfile.TemporaryDirectory() as scratch:  # errors of drawing are the case's
                drawn = Path(scratch) / f"{picture.name}.png"
                picture.draw(drawn)
                write_bytes(folder / drawn.name, drawn.read_bytes())
            part.pictures[f"{folder.name}/{picture.name}.png"] = picture.caption
    return part


def _check_names(parts: Parts) -> None:
    """Refuse parts whose records would be one file.

    Raises
    ------
    InputError
    """
    known: dict[str, str] = {}
    for name in parts:
        if slug(name) in known:
            raise InputError(
                f"parts {known[slug(name)]!r} and {name!r}: expected names that differ in more "
                "than case and signs, by which their records are told apart."
            )
        known[slug(name)] = name


def slug(name: str) -> str:
    """A name as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower() or "all"

"""Tables of the validation cases about time and of the published benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import fmean
from typing import Any

from records import RECORDS, ROOT, Rows, number, read

FREQUENCIES = "Error of the lowest 10 frequencies, %"


def table_of(case: str, name: str) -> tuple[Sequence[str], list[list[Any]]]:
    """Headings and rows of a case's table."""
    record = read(RECORDS / f"{case}.json")
    found = next(table for table in record["tables"] if table["name"] == name)
    return found["headings"], found["rows"]


def as_measured(case: str, name: str, digits: int = 3, columns: slice = slice(None)) -> Rows:
    """A table of a record as it is."""
    heads, rows = table_of(case, name)
    cells = [
        [cell if isinstance(cell, str) else number(cell, digits) for cell in row[columns]]
        for row in rows
    ]
    return heads[columns], cells


def errors() -> Rows:
    """Mean and worst errors of the time step by motion and damping."""
    heads, rows = table_of("time_error", "Errors, % of the RMS displacement")
    cells = []
    for kind, damping in dict.fromkeys((row[0], row[1]) for row in rows):
        columns = zip(*(row[4:] for row in rows if row[:2] == [kind, damping]), strict=True)
        shares = [f"{number(fmean(x), 2)} ({number(max(x), 2)})" for x in columns]
        cells.append([kind, damping, *shares])
    return (*heads[:2], *heads[4:]), cells


def unlike_bodies() -> Rows:
    """Errors of all runs on unlike bodies, and their times; of runs with equal errors the first."""
    heads, rows = table_of("unlike_bodies", "Errors, % of the RMS displacement")
    short = [head.replace(", backward-euler", ", BE").replace(", generalised-alpha", ", gen.-α")
             for head in heads]  # fmt: skip
    rows = [[row[0], *("" if x == "" else number(x, 2) for x in row[2:])] for row in rows]
    errors = [tuple(row[k] for row in rows[:-1]) for k in range(len(rows[0]))]
    kept = [k for k, column in enumerate(errors) if column not in errors[:k]]
    heads = (short[0], *short[2:])
    return tuple(heads[k] for k in kept), [[row[k] for k in kept] for row in rows]


def unlike_families() -> Rows:
    """Errors over the forty scenes, %, and median times, ms, a row a run."""
    heads, rows = table_of("unlike_families", "Errors, % of the RMS displacement")
    times = table_of("unlike_families", "Time a frame, ms")[1][0]
    columns = zip(heads[1:], *(row[1:] for row in rows[-4:]), times[1:], strict=True)
    cells = [[run, *(number(x, 2) for x in row)] for run, *row in columns]
    return ("run, substeps", *(row[0] for row in rows[-4:]), "ms a frame"), cells


def aims(case: str) -> Rows:
    """What was aimed at before a case was first run, and what was reached."""
    figures = read(RECORDS / f"{case}.json")["figures"]
    expected = read(ROOT / "validation" / case / "expected.json")
    cells = []
    for name, wanted in expected.items():
        if wanted["source"].startswith("aim"):
            least = "at_least" in wanted
            bound = wanted["at_least" if least else "at_most"]
            cells.append([name, f"{'≥' if least else '≤'} {bound:g}", number(figures[name], 2)])
    return ("", "aim", "reached"), cells


def tables() -> Iterator[tuple[str, Callable[[], Rows]]]:
    """By name."""
    yield "time-errors", errors
    yield "energy-long", partial(as_measured, "energy", "Energy over that of the start")
    for which, start in (("twist", "Stiff body let go twisted"), ("weight", "Stiff body under")):
        yield f"energy-{which}", partial(starting, "energy", start)
    yield "energy-errors", partial(as_measured, "energy", "Errors, % of the RMS displacement")
    yield "turek-hron-rest", partial(as_measured, "turek_hron", "CSM1", 4)
    yield "turek-hron-swing", partial(as_measured, "turek_hron", "CSM3", 4)
    yield "tapered-membrane", partial(as_measured, "tapered_membrane", "Frequencies", 5)
    yield "unlike-bodies", unlike_bodies
    yield "unlike-families", unlike_families
    yield "aims", partial(aims, "unlike_families")
    yield "frequencies", partial(as_measured, "unlike_families", FREQUENCIES)
    yield "columns", partial(as_measured, "columns", "Columns")
    yield "spinning-cube", partial(as_measured, "columns", "Spinning cube", 2)


def starting(case: str, start: str) -> Rows:
    """The table whose name begins so."""
    record = read(RECORDS / f"{case}.json")
    name = next(t["name"] for t in record["tables"] if t["name"].startswith(start))
    return as_measured(case, name, 2)

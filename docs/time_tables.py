"""Tables of the validation cases about time and of the published benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import fmean, median
from typing import Any

from records import RECORDS, ROOT, Rows, number, read

CHOICE = (
    "plain, BE", "best coarse, BE", "hybrid torsion-exact", "plain, 1", "best coarse, 1",
    "best coarse, 2", "learned, 1", "learned, 2", "hex27, 1", "hex27, 2", "plain on 2x2x2, 1",
    "learned on 2x2x2, 2", "best on 4x4x4, 1",
)  # fmt: skip
"""Of the runs of `validation/error_time`, for the page on choosing a solver."""
SHORT = (
    "best coarse, BE", "hybrid torsion-exact", "best coarse, 1", "learned, 1", "learned, 2",
    "hex27, 1", "best on 4x4x4, 1",
)  # fmt: skip
"""Of the same, for the README."""
OWN = "Errors of the converged motions, %"
FINER = "Errors from the finest mesh, % of the RMS displacement"
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


def error_time(methods: Sequence[str] = ()) -> Rows:
    """Errors over unlike bodies and of the thesis's motions, %, and median times, ms, by method."""
    figures = read(RECORDS / "error_time.json")["figures"]
    heads, rows = table_of("error_time", "Errors, % of the RMS displacement")
    times = table_of("error_time", "Time a frame, ms")[1]
    motions = [row for row in rows if row[0] in ("impulse", "stretch", "torsion")]
    cells = []
    for k, name in enumerate(heads[3:]):
        if methods and name not in methods:
            continue
        spread = [figures[f"{kind}, {name}, %"] for kind in ("mean", "median", "worst")]
        spent = median(row[1 + k] for row in times if row[1 + k] is not None)
        cells.append(
            [name, *(number(x, 2) for x in (*spread, *(r[3 + k] for r in motions), spent))]
        )
    kinds = ("mean", "median", "worst")
    return ("run, steps a frame", *kinds, *(row[0] for row in motions), "ms a frame"), cells


def beside_the_front() -> Rows:
    """Speed-up at equal error and error at equal time, beside what needs no training."""
    figures = read(RECORDS / "error_time.json")["figures"]
    heads, rows = table_of("error_time", "Beside the front of what needs no training")
    kinds = ("median", "worst")
    cells = [
        [
            run,
            *(number(figures[f"{run}, {what}, {kind}"], 2) for what in heads[2:] for kind in kinds),
        ]
        for run in dict.fromkeys(row[1] for row in rows)
    ]
    return ("run", *(f"{what}, {kind}" for what in heads[2:] for kind in kinds)), cells


def converged_errors() -> Rows:
    """The converged motions' own errors, and runs' from them and from 8x8x8 cells, %."""
    heads, rows = table_of("error_time", FINER)
    own = {row[0]: row for row in table_of("error_time", OWN)[1]}
    names, all_rows = table_of("error_time", "Errors, % of the RMS displacement")
    errors = {row[0]: dict(zip(names, row, strict=True)) for row in all_rows}
    cells = []
    for label, itself, *others in rows:
        _, spent, _, mesh, order, _ = own[label]
        pairs = (
            f"{number(errors[label][name], 2)}, {number(x, 2)}"
            for name, x in zip(heads[2:], others, strict=True)
        )
        told = (spent, mesh, order, itself)
        cells.append([label, *(number(x, 2) for x in told), *pairs])
    return ("scene", "time", "mesh", "its order", "from 8×8×8", *heads[2:]), cells


def unlike_families() -> Rows:
    """Errors over the forty scenes, %, and median times, ms, a row a run."""
    heads, rows = table_of("unlike_families", "Errors, % of the RMS displacement")
    times = table_of("unlike_families", "Time a frame, ms")[1][0]
    columns = zip(heads[1:], *(row[1:] for row in rows[-4:]), times[1:], strict=True)
    cells = [[run, *(number(x, 2) for x in row)] for run, *row in columns]
    return ("run, substeps", *(row[0] for row in rows[-4:]), "ms a frame"), cells


def horizons() -> Rows:
    """Errors at the horizon, at five times it, and of the amplitude, %, by scene and run."""
    rows = table_of("stability", "Errors at the horizon and at five times it, %")[1]
    found: dict[str, dict[str, str]] = {}
    for scene, run, _, early, late, _, amplitude in rows:
        column = "corrector" if run.startswith("hybrid") else run
        told = f"{number(early, 2)} → {number(late, 2)} ({amplitude:+.1f})"
        found.setdefault(scene, {})[column] = told
    runs = list(dict.fromkeys(column for row in found.values() for column in row))
    return ("scene", *runs), [
        [scene, *(row.get(r, "") for r in runs)] for scene, row in found.items()
    ]


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
    yield "energy-twist", partial(starting, "energy", "Stiff body let go twisted")
    yield "energy-errors", partial(as_measured, "energy", "Errors, % of the RMS displacement")
    yield "turek-hron-rest", partial(as_measured, "turek_hron", "CSM1", 4)
    yield "turek-hron-swing", partial(as_measured, "turek_hron", "CSM3", 4)
    yield "tapered-membrane", partial(as_measured, "tapered_membrane", "Frequencies", 5)
    yield "error-time-all", error_time
    yield "converged-errors", converged_errors
    yield "error-time", partial(error_time, CHOICE)
    yield "error-time-short", partial(error_time, SHORT)
    yield "beside-the-front", beside_the_front
    yield "unlike-families", unlike_families
    yield "aims", partial(aims, "unlike_families")
    yield "frequencies", partial(as_measured, "unlike_families", FREQUENCIES)
    yield "columns", partial(as_measured, "columns", "Columns")
    yield "stability-outcomes", partial(as_measured, "stability", "Runs by element and integrator")
    yield "stability-horizon", horizons
    long = "Energy of long runs over that of the start"
    yield "stability-long", partial(as_measured, "stability", long, columns=slice(0, 8))
    yield "spinning-cube", partial(as_measured, "columns", "Spinning cube", 2)


def starting(case: str, start: str) -> Rows:
    """The table whose name begins so."""
    record = read(RECORDS / f"{case}.json")
    name = next(t["name"] for t in record["tables"] if t["name"].startswith(start))
    return as_measured(case, name, 2)

"""Tables of other simulators, from ``benchmarks/results``."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import median, median_low
from typing import Any

from records import Rows, number, read

RECORD = "benchmarks/results/rivals-amd-epyc-2cores.json"
BEAM = "weight"
OURS = "ours"
Row = dict[str, Any]
ERROR, TIME = "error_percent", "cpu_ms_a_frame"


def found() -> list[Row]:
    """Runs that came to an end."""
    return [row for row in read(RECORD)["rivals"]["results"] if ERROR in row]


def label(row: Row) -> str:
    mesh = ", 2x2x2" if row["refine"] == 2 else ""
    return f"{row['contestant']}: {row['setting']}{mesh}"


def same(rows: list[Row], row: Row) -> list[Row]:
    """Our runs of the case and law of another."""
    keys = "case", "law"
    return [x for x in rows if x["contestant"] == OURS and all(x[k] == row[k] for k in keys)]


def least(rows: Iterable[Row], row: Row, what: str, other: str) -> float | None:
    """The smallest ``what`` of those with no more of ``other`` than a run; None without any."""
    return min((x[what] for x in rows if x[other] <= row[other]), default=None)


def beside(rows: list[Row], row: Row) -> list[str]:
    """Error and time of a run, our time at that error and our error in that time."""
    ours = same(rows, row)
    shown = row[ERROR], row[TIME], least(ours, row, TIME, ERROR), least(ours, row, ERROR, TIME)
    return [number(x, 2) for x in shown]


HEAD = "error, %", "CPU ms a frame", "ours, ms at that error", "ours, % in that time"


def of_beam() -> Rows:
    """Weight: our runs, and of each contestant the recommended and the nearest ones."""
    rows = [row for row in found() if row["case"] == BEAM]
    near = nearest(rows)
    kept = [
        row
        for row in rows
        if row["contestant"] == OURS
        or (row["recommended"] and row["refine"] == 1)
        or row is near[row["contestant"]]
    ]
    cells = []
    for row in sorted(kept, key=lambda row: float(row[ERROR])):
        own = row["contestant"] == OURS
        shown = [*beside(rows, row)[:2], "", ""] if own else beside(rows, row)
        note = " (recommended)" if row["recommended"] else ""
        cells.append([label(row) + note, *shown, number(row["setup_s"], 2)])
    return ("run", *HEAD, "set-up, s"), cells


def nearest(rows: list[Row]) -> dict[str, Row]:
    """Of each contestant."""
    return {
        name: min((row for row in rows if row["contestant"] == name), key=lambda row: row[ERROR])
        for name in sorted({row["contestant"] for row in rows})
    }


def short() -> Rows:
    """The nearest run of each contestant under weight."""
    rows = nearest([row for row in found() if row["case"] == BEAM]).values()
    return ("run", *HEAD[:2]), [
        [label(row), number(row[ERROR], 2), number(row[TIME], 2)]
        for row in sorted(rows, key=lambda row: float(row[ERROR]))
    ]


def ratios(rows: list[Row], run: list[Row], what: str, other: str) -> str:
    """Low median of a contestant's ``what`` over ours at its ``other``.

    0 where we have none, in so many scenes as the brackets say.
    """
    shares = []
    for row in run:
        own = least(same(rows, row), row, what, other)
        shares.append(0.0 if own is None else row[what] / own)
    lacking = shares.count(0.0)
    return number(median_low(shares) or None, 2) + (f" ({lacking})" if lacking else "")


def of_scenes() -> Rows:
    """Errors and times of each run in the scenes, and beside ours, in the median."""
    rows = [row for row in found() if row["case"] != BEAM]
    cells = []
    runs: dict[str, list[Row]] = {}
    for row in rows:
        runs.setdefault(label(row), []).append(row)
    for run in sorted(runs.values(), key=lambda run: median(row[ERROR] for row in run)):
        beside = ["", ""]
        if run[0]["contestant"] != OURS:
            beside = [ratios(rows, run, TIME, ERROR), ratios(rows, run, ERROR, TIME)]
        errors, times = ([row[key] for row in run] for key in (ERROR, TIME))
        cells.append([
            label(run[0]), str(len(run)), *(number(x, 2) for x in (median(errors), max(errors))),
            number(median(times), 2), *beside,
        ])  # fmt: skip
    head = ("run", "scenes", "error, %: median", "worst", "CPU ms a frame, median",
            "its time over ours at its error", "its error over ours in its time")  # fmt: skip
    return head, cells


def left_out() -> Rows:
    """Scenes that were not run, by contestant and reason."""
    record = read(RECORD)["rivals"]
    reasons: dict[tuple[str, str], list[str]] = {}
    for case, reason in record["refused"].items():
        reasons.setdefault(("all", reason), []).append(case)
    for row in record["results"]:
        if "refused" in row:
            reasons.setdefault((row["contestant"], row["refused"]), []).append(row["case"])
        elif "failed" in row:
            reasons.setdefault((label(row), row["failed"]), []).append(row["case"])
    for row in record["missing"]:
        reasons.setdefault((label(row), "limit of time"), []).append(row["case"])
    return ("contestant", "reason", "scenes"), [
        [*key, ", ".join(dict.fromkeys(cases))] for key, cases in reasons.items()
    ]


def tables() -> Iterable[tuple[str, Any]]:
    """Names of the tables here and what makes them."""
    yield from {
        "rivals-weight": of_beam, "rivals-nearest": short,
        "rivals-scenes": of_scenes, "rivals-left-out": left_out,
    }.items()  # fmt: skip

"""Stability: extreme scenes by the default integrator, five horizons, very many steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import battery
import common
import horizon
import long_runs
import numpy as np
from harness import load, read_expectations

HERE = Path(__file__).parent
COUNTS = "Runs by element and integrator"
QUICK = ("1 cell, generalised-alpha", "1 cell, generalised-alpha, floor")
FEW = 500
"""Steps of a quick run."""


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """A part for each scene of the battery, scene of `horizon` and long run."""
    scenes = battery.scenarios()
    chosen = QUICK if quick else tuple(scenes)
    out = {f"battery, {name}": partial(battery.part, scenes[name]) for name in chosen}
    if quick:
        few = ("twisted", "learned", "generalised-alpha", FEW)
        return out | {"long": partial(long_runs.part, *few)}
    for label in horizon.SCENES:
        out[f"horizon, {label}"] = partial(horizon.part, label)
    return out | {
        f"long, {', '.join(run)}": partial(long_runs.part, *run, steps)
        for run, steps in long_runs.RUNS.items()
    }


def summary(record: common.Record) -> common.Outcome:
    """The outcome of each run of the battery, and their numbers."""
    expected = read_expectations(HERE / "expected.json")
    stress = load(HERE.parent / "results" / "stress.json")
    assert stress is not None
    rows = battery.recorded_rows(stress.figures) + battery.judged_rows(record.figures, expected)
    counts = battery.counts(rows)
    figures = {f"{kind[0]}, {kind[1]}, runs that fail": kind[-1] for kind in counts}
    heads = ("element", "integrator", *battery.OUTCOMES)
    told = tuple((*row[:2], *(f"{x:.0f}" for x in row[2:])) for row in counts)
    tables = (
        common.Table(battery.RUNS, battery.RUN_HEADS, tuple(rows)),
        common.Table(COUNTS, heads, told),
    )
    return common.Outcome(figures, tables)


def finding(record: common.Record) -> str:
    """Outcomes, the growth of errors and the energy."""
    counted = [row for row in record.table(COUNTS)["rows"] if row[1] != "backward-euler"]
    passed, explained, failed = (sum(int(row[k]) for row in counted) for k in (2, 3, 4))
    rows = record.table(horizon.TABLE)["rows"]
    far = ", ".join(
        f"{name} {np.median([row[4] for row in rows if row[1] == name]):.1f}"
        for name in horizon.RUNS
    )
    long = record.table(long_runs.TABLE)["rows"]
    count, most = max(row[3] for row in long), max(row[4] for row in long)
    drifts = [100.0 * row[7] for row in long]
    return (
        f"Of extreme runs by generalised-α {passed} pass, {explained} are explained, {failed} "
        f"fail. Median errors at five horizons, %: {far}. In up to {count:,.0f} undamped "
        f"steps the energy is at most {most:.3f} times the start's; its mean changes by "
        f"{min(drifts):.1f} to {max(drifts):.1f} % of that over the last nine tenths."
    )


def draw(record: common.Record, path: Path) -> None:
    """Runs that pass, are explained or fail, and the energy left after long runs."""
    figure, (runs, energy) = common.panels(12, 3.6, 2)
    rows = record.table(COUNTS)["rows"]
    labels = [f"{element}, {integrator}" for element, integrator, *_ in rows]
    start = np.zeros(len(rows))
    for k, (word, colour) in enumerate(zip(battery.OUTCOMES, common.COLOURS, strict=False)):
        counts = np.array([float(row[2 + k]) for row in rows])
        runs.barh(labels, counts, left=start, color=colour, label=word)
        start += counts
    runs.invert_yaxis()
    runs.set_xlabel("runs")
    long = record.table(long_runs.TABLE)["rows"]
    names = [", ".join(row[:3]) for row in long]
    for k, (column, label) in enumerate(((4, "largest"), (5, "after a tenth"), (6, "last"))):
        energy.plot([row[column] for row in long], names, common.MARKS[k][0],
                    color=common.COLOURS[k], label=label)  # fmt: skip
    energy.invert_yaxis()
    energy.set_xlabel("energy over the start's")
    for axis in (runs, energy):
        common.plain(axis, "x")
        axis.tick_params(labelsize=8)
        axis.legend(fontsize=8)
    common.save(figure, path)

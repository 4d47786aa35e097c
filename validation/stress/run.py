"""Stiff and extreme scenes: what each solver reaches, against what was written down before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

import common
import numpy as np
from crosses import CROSSES
from diagnosis import ENDS, PARTING, minimum, parting
from harness import read_expectations
from scenarios import SCENARIOS, Scenario
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from solvers import (
    ENHANCED,
    KNOWN_SOLVERS,
    LEARNED,
    MODELS,
    SOLVERS,
    Run,
    finer,
    run,
    tight,
)

import pdcorrect as pc

Array = np.ndarray
Row = tuple[float | str, ...]

EXPECTED = read_expectations(Path(__file__).with_name("expected.json"))
BATTERY = (*SCENARIOS, *CROSSES)
MANY = {"Newton": 30}
"""Iterations of a step above which a run that passes is slow; 200 for the others."""
FALLBACKS = (pc.Status.RECOVERED, pc.Status.SUBSTEPPED)
UNDEFINED = 1e9
"""Distance of a run that is no number, cells."""


def distance(scenario: Scenario, found: Run, truth: Run | None) -> float:
    """How far from what has to be reached: see `Scenario`.

    In cells; for "motion" in largest displacements of the reference.
    """
    rest, end = found.problem.positions, found.positions[-1]
    if scenario.goal == "motion":
        assert truth is not None
        return error(found, truth)
    if not np.isfinite(end).all():
        return UNDEFINED
    if scenario.goal == "shape":
        rest = _placed(found.problem, end)
    return float(np.linalg.norm(end - rest, axis=1).max() / found.problem.cell_size)


def error(found: Run, truth: Run) -> float:
    """Largest distance of a node in any frame, in largest displacements of the truth."""
    if not np.isfinite(found.positions).all():
        return UNDEFINED
    return float(np.linalg.norm(found.positions - truth.positions, axis=2).max() / moved(truth))


def moved(found: Run) -> float:
    """Largest displacement of a node in any frame, m."""
    return float(np.linalg.norm(found.positions - found.problem.positions, axis=2).max())


def _placed(problem: pc.Problem, end: Array) -> Array:
    """Rest positions, those of free parts of the body moved rigidly to fit best (Kabsch)."""
    cells, rest, out = problem.cells, problem.positions, problem.positions.copy()
    pairs = np.repeat(cells[:, 0], cells.shape[1]), cells.ravel()
    links = coo_array((np.ones(len(pairs[0])), pairs), (len(rest), len(rest)))
    count, part = connected_components(links, directed=False)
    for nodes in (np.flatnonzero(part == k) for k in range(count)):
        if not problem.free[nodes].all():
            continue
        a, b = rest[nodes] - rest[nodes].mean(axis=0), end[nodes] - end[nodes].mean(axis=0)
        u, _, v = np.linalg.svd(b.T @ a)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        out[nodes] = a @ turn.T + end[nodes].mean(axis=0)
    return out


class Truth:
    """Runs of a scene, each computed once, and those that they are judged by."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.run = cache(partial(run, scenario))
        self.tight = cache(partial(tight, scenario))
        self.finer = cache(partial(finer, scenario))

    def of(self, solver: str) -> Run | None:
        """Of a motion: the steps by the other method, or on a finer mesh if hybrids have one."""
        if self.scenario.goal != "motion":
            return None
        if solver in ("PD", "batch"):
            return self.run("Newton")  # as tight as a reference has to be
        if solver in MODELS:
            return self.finer() if self.scenario.finer else self.tight("PD best")
        return self.tight(solver)

    def figures(self, solver: str) -> common.Figures:
        """What is judged of a solver's run."""
        beside = self.run("PD best") if solver in MODELS and self.scenario.finer else None
        return figures_of(self.scenario, solver, self.run(solver), self.of(solver), beside)


def figures_of(
    scenario: Scenario, solver: str, found: Run, truth: Run | None, beside: Run | None = None
) -> common.Figures:
    """What is judged: how far a run is from what has to be reached comes first.

    Of hybrids that are held against a finer mesh it is how much their error is above that
    of the run ``beside`` them, which they correct.
    """
    name = f"{scenario.name}, {solver}"
    far = {f"{name}, distance": distance(scenario, found, truth)}
    if beside is not None and truth is not None:
        worse = error(found, truth) - error(beside, truth)
        far = {f"{name}, error above PD best's": float(np.maximum(worse, 0.0))}
    figures: common.Figures = {**far, f"{name}, status": found.status.name}
    if scenario.known and solver in MODELS:
        figures[f"{name}, accepted"] = found.accepted
    return figures


def reaches(figures: common.Figures) -> bool:
    """Whether a run is where it has to be, known failure or not."""
    return all(EXPECTED[name].met_by(x) for name, x in figures.items() if name in EXPECTED)


def verdict(solver: str, found: Run, figures: common.Figures) -> str:
    """Pass, slow (many iterations, or a fallback) or fail; the status if nothing is expected."""
    if not any(name in EXPECTED for name in figures):
        return found.status.name.lower()
    if not reaches(figures):
        return "fail"
    unusual = any(status in FALLBACKS for status in found.statuses)
    return "slow" if unusual or max(found.iterations) > MANY.get(solver, 200) else "pass"


def cell(scenario: Scenario, solver: str, found: Run, figures: common.Figures) -> str:
    """What the matrix has of a run."""
    text = f"{verdict(solver, found, figures)} {_first(figures):.1e}"
    if found.least_corner < 0.0:
        text += ", folded corner"
    if scenario.known and solver in MODELS:
        text += f", {found.accepted:.0%} corrected"
    return text


def _first(figures: common.Figures) -> float:
    return float(next(iter(figures.values())))


GOALS = {
    "rest": "comes back to rest",
    "shape": "comes back to its shape",
    "motion": "all frames as by the other method",
}
MATRIX = "Pass, slow or fail, with the distance from what has to be reached"
KNOWN = "The cross that the torsion model knows: the same"
ERRORS = "The cross: error beside a finer mesh"
BESIDE = "The learned element beside the best coarse model"
DETAILS = "Figures"


def part(scenario: Scenario) -> common.Outcome:
    """One row of the matrix."""
    truth, columns = Truth(scenario), KNOWN_SOLVERS if scenario.known else SOLVERS
    chosen = [s for s in columns if not scenario.solvers or s in scenario.solvers]
    found = {solver: truth.figures(solver) for solver in chosen}
    cells = [cell(scenario, s, truth.run(s), found[s]) if s in found else "–" for s in columns]
    row = (scenario.name, scenario.about, GOALS[scenario.goal], *cells)
    headings = ("scene", "what it is", "has to", *columns)
    details = [_detail(scenario, s, truth.run(s)) for s in chosen]
    tables = [common.Table(KNOWN if scenario.known else MATRIX, headings, (row,))]
    if scenario.finer:
        tables.append(common.Table(ERRORS, *errors(truth, chosen)))
    word = beside(found[LEARNED], found[ENHANCED])
    tables.append(common.Table(BESIDE, *learned(truth, found, word)))
    tables.append(common.Table(DETAILS, _HEADINGS, tuple(details)))
    astray = {s: x for s in chosen if 1e-3 < (x := _first(found[s])) < UNDEFINED}
    if astray:
        tables += why(truth, astray)
    figures = {name: x for each in found.values() for name, x in each.items()}
    figures[f"{scenario.name}, {LEARNED}, beside {ENHANCED}"] = word
    return common.Outcome(figures, tuple(tables))


def why(truth: Truth, astray: Mapping[str, float]) -> list[common.Table]:
    """Of runs that are not where they have to be: other equilibria, other answers to a step."""
    scenario = truth.scenario
    if scenario.goal == "rest":
        ends = [(scenario.name, s, far, *minimum(truth.run(s))) for s, far in astray.items()]
        return [common.Table(ELSEWHERE, ("scene", "solver", "distance, cells", *ENDS), tuple(ends))]
    rows: list[Row] = []
    for solver in astray:
        other = truth.of(solver)
        if other is None or solver in MODELS:
            continue
        found = parting(scenario, truth.run(solver), other)
        if found:
            rows.append((scenario.name, solver, *found))
    return [common.Table(PARTINGS, ("scene", "solver", *PARTING), tuple(rows))] if rows else []


def errors(truth: Truth, solvers: Sequence[str]) -> tuple[tuple[str, ...], tuple[Row, ...]]:
    """Headings and the row of a scene: errors beside a finer mesh, %, of what moves most."""
    scenario, fine = truth.scenario, truth.finer()
    headings = ("scene", "cells cut into", "largest displacement, cells", "its status", *solvers)
    size = "×".join(3 * [str(scenario.finer)])
    found = [100.0 * error(truth.run(solver), fine) for solver in solvers]
    far = moved(fine) / fine.problem.cell_size
    return headings, ((scenario.name, size, far, fine.status.name, *found),)


def beside(mine: common.Figures, its: common.Figures) -> str:
    """Which of two runs is where it has to be: both, neither, or a scene won or lost."""
    words = {(True, True): "both", (True, False): "won", (False, True): "lost"}
    return words.get((reaches(mine), reaches(its)), "neither")


def learned(
    truth: Truth, figures: Mapping[str, common.Figures], word: str
) -> tuple[tuple[str, ...], tuple[Row, ...]]:
    """Headings and the row of a scene: both runs, and the share of the cells that are learned."""
    correction = truth.run(LEARNED).problem.correction
    assert correction is not None
    pair = [cell(truth.scenario, s, truth.run(s), figures[s]) for s in (ENHANCED, LEARNED)]
    share = 100.0 * float(correction.learned.mean())
    headings = ("scene", ENHANCED, LEARNED, "reached by", "cells learned, %")
    return headings, ((truth.scenario.name, *pair, word, share),)


ELSEWHERE = "Runs that ended elsewhere than at rest: is it a minimum of the energy?"
PARTINGS = "Runs that part from the other method: has a step two answers?"
_HEADINGS = (
    "scene", "solver", "frames by a fallback", "inverted frames", "iterations, mean",
    "iterations, most", "corrections refused", "least det F at corners",
)  # fmt: skip


def _detail(scenario: Scenario, solver: str, found: Run) -> Row:
    frames = len(found.statuses)
    unusual = sum(status in FALLBACKS for status in found.statuses)
    inverted = found.statuses.count(pc.Status.INVERTED)
    refused = f"{sum(found.refused)} of {frames}" if solver in MODELS else ""
    return (
        scenario.name, solver, unusual, inverted,
        float(np.mean(found.iterations)), max(found.iterations), refused, found.least_corner,
    )  # fmt: skip


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """One part a scene."""
    return {s.name: partial(part, s) for s in BATTERY if s.quick or not quick}


def finding(record: common.Record) -> str:
    """How many runs pass."""
    cells = [cell for n in (MATRIX, KNOWN) for row in record.table(n)["rows"] for cell in row[3:]]
    told = [cell for cell in cells if cell.split()[0] in ("pass", "slow", "fail")]
    fine = sum(not cell.startswith("fail") for cell in told)
    rows = record.table(BESIDE)["rows"]
    lost, won = (
        ", ".join(row[0] for row in rows if row[3] == word) or "none" for word in ("lost", "won")
    )
    return (
        f"{fine} of {len(told)} runs reach what they have to. Flat, mirrored and scattered starts "
        "can settle in another minimum with folded corners; the status does not tell. Beside the "
        f"best coarse model the learned element loses these scenes: {lost}; and wins: {won}."
    )

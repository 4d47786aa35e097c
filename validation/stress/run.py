"""Stiff and extreme scenes: what each solver reaches, against what was written down before."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))
import common
from scenarios import SCENARIOS, Scenario
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from solvers import MODELS, SOLVERS, Run, run, tight

import pdcorrect as pc
from pdcorrect.fem.hexahedron import corner_jacobians
from pdcorrect.validation.cases import ValidationCase

Array = np.ndarray

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
    if not np.isfinite(found.positions).all():
        return UNDEFINED
    if scenario.goal == "motion":
        assert truth is not None
        moved = np.linalg.norm(truth.positions - rest, axis=2).max()
        return float(np.linalg.norm(found.positions - truth.positions, axis=2).max() / moved)
    if scenario.goal == "shape":
        rest = _placed(found.problem, end)
    return float(np.linalg.norm(end - rest, axis=1).max() / found.problem.cell_size)


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


def worst(found: Run) -> pc.Status:
    """The last failure, or the status of the last frame."""
    failed = [status for status in found.statuses if not status.ok]
    return failed[-1] if failed else found.statuses[-1]


def figures_of(scenario: Scenario, solver: str, found: Run, truth: Run | None) -> common.Figures:
    """What is judged."""
    name = f"{scenario.name}, {solver}"
    return {
        f"{name}, distance": distance(scenario, found, truth),
        f"{name}, status": worst(found).name,
    }


def verdict(solver: str, found: Run, figures: common.Figures) -> str:
    """Pass, slow (many iterations, or a fallback) or fail."""
    expected = ValidationCase(Path(__file__).parent).expected
    if any(name in expected and not expected[name].met_by(x) for name, x in figures.items()):
        return "fail"
    unusual = any(status in FALLBACKS for status in found.statuses)
    return "slow" if unusual or max(found.iterations) > MANY.get(solver, 200) else "pass"


GOALS = {
    "rest": "comes back to rest",
    "shape": "comes back to its shape",
    "motion": "all frames as by the other method",
}
MATRIX = "Pass, slow or fail, with the distance from what has to be reached"
DETAILS = "Figures"


def part(scenario: Scenario) -> common.Outcome:
    """One row of the matrix."""
    figures: common.Figures = {}
    cells, details, elsewhere = [], [], []
    solve = cache(partial(run, scenario))
    reference = {
        "PD": partial(solve, "Newton"),  # as tight as a reference has to be
        "batch": partial(solve, "Newton"),
        "PD best": cache(partial(tight, scenario, "PD best")),
        "Newton": partial(tight, scenario, "Newton"),
    }
    reference |= dict.fromkeys(MODELS, reference["PD best"])
    for solver in SOLVERS:
        if scenario.solvers and solver not in scenario.solvers:
            cells.append("–")
            continue
        found = solve(solver)
        truth = reference[solver]() if scenario.goal == "motion" else None
        mine = figures_of(scenario, solver, found, truth)
        figures |= mine
        word, far = verdict(solver, found, mine), float(next(iter(mine.values())))
        cells.append(f"{word} {far:.1e}")
        details.append(_detail(scenario, solver, found, far))
        if scenario.goal == "rest" and far > 1e-3:
            elsewhere.append((scenario.name, solver, far, *minimum(found)))
    headings = ("scene", "what it is", "has to", *SOLVERS)
    row = (scenario.name, scenario.about, GOALS[scenario.goal], *cells)
    picture = common.Picture(
        f"stress-{scenario.name.replace(' ', '-')}",
        f"{scenario.name}: {scenario.about}, by {SOLVERS[0]}",
        partial(draw, scenario, solve(SOLVERS[0])),
    )
    tables = (
        common.Table(MATRIX, headings, (row,)),
        common.Table(DETAILS, _HEADINGS, tuple(details)),
    )
    if elsewhere:
        tables += (common.Table(ELSEWHERE, _ENDS, tuple(elsewhere)),)
    return common.Outcome(figures, tables, (picture,))


def minimum(found: Run) -> tuple[float, float, float, float]:
    """Whether a run ended at a minimum of the elastic energy.

    Largest force out of balance over Young's modulus times a cell's face; smallest eigenvalue
    of the stiffness over that at rest; smallest det F at the quadrature points and, for
    the trilinear map of the nodes, at the corners.
    """
    problem, end = found.problem, found.positions[-1]
    face = problem.scene.material.young * problem.cell_size**2
    force = np.abs(problem.forces(end) * problem.free).max() / face
    free = problem.free.ravel()

    def softest(positions: Array) -> float:
        matrix = problem.stiffness(positions).toarray()[np.ix_(free, free)]
        return float(np.linalg.eigvalsh(matrix)[0])

    corners = [corner_jacobians(p, problem.cells) for p in (end, problem.positions)]
    return (
        float(force), softest(end) / softest(problem.positions),
        float(problem.volume_ratios(end).min()), float((corners[0] / corners[1]).min()),
    )  # fmt: skip


ELSEWHERE = "Runs that ended elsewhere than at rest: is it a minimum of the energy?"
_ENDS = (
    "scene", "solver", "distance, cells", "force out of balance / (E face)",
    "least stiffness / at rest", "least det F at Gauss points", "at corners",
)  # fmt: skip
_HEADINGS = (
    "scene", "solver", "distance", "status", "frames by a fallback", "inverted frames",
    "iterations, mean", "iterations, most", "corrections refused",
)  # fmt: skip


def _detail(scenario: Scenario, solver: str, found: Run, far: float) -> tuple[float | str, ...]:
    frames = len(found.statuses)
    unusual = sum(status in FALLBACKS for status in found.statuses)
    inverted = found.statuses.count(pc.Status.INVERTED)
    refused = f"{sum(found.refused)} of {frames}" if solver in MODELS else ""
    return (
        scenario.name, solver, far, worst(found).name, unusual, inverted,
        float(np.mean(found.iterations)), max(found.iterations), refused,
    )  # fmt: skip


def draw(scenario: Scenario, found: Run, path: Path) -> None:
    """The body at the start, in between and at the end."""
    frames, h = len(found.statuses), found.problem.time_step
    trajectory = pc.Trajectory(
        positions=found.positions,
        velocities=np.zeros_like(found.positions),
        times=h * np.arange(frames + 1),
        stats={},
        points=found.problem.positions,
        cells=found.problem.cells,
    )
    shown = scenario.shown or list(dict.fromkeys([0, min(1, frames), frames // 2, frames]))
    pc.render(trajectory, path, frame=shown, window=1200)


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """One part a scene."""
    return {s.name: partial(part, s) for s in SCENARIOS if s.quick or not quick}


if __name__ == "__main__":
    sys.exit(common.main(__file__))

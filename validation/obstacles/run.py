"""Hard cases of contact: by PD and Newton, no point inside an obstacle, no energy from nowhere."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import common
import numpy as np
from scenes import SCENES, UNDECIDED

import pdcorrect as pc
from pdcorrect.errors import PdcorrectWarning
from pdcorrect.solvers.implicit import ImplicitStepper

MODELS = {"hex8": lambda scene: scene, "best coarse": pc.best_coarse, "learned": pc.learned_coarse}
ENERGIES = "kinetic_energy", "elastic_energy", "contact_energy"
WORKS = "external_work", "obstacle_work", "clamp_work"
TABLE = "Runs"
HEADINGS = (
    "scene", "element", "method", "status", "iterations, mean", "iterations, most",
    "smallest gap, cells", "energy gain", "moved by the other", "distance",
)  # fmt: skip
QUICK = "balls"


def energy_gain(run: pc.Trajectory) -> float:
    """Largest growth of the energy beyond the work of loads and obstacles, over the largest."""
    start = 0.5 * np.vdot(run.velocities[0], run.problem.mass_times(run.velocities[0]))
    energy = np.append(start, sum(run.stats[name] for name in ENERGIES))
    work = sum(run.stats[name] for name in WORKS)
    return float((np.diff(energy) - work).max() / energy.max())


def moved_by(stepper: ImplicitStepper, run: pc.Trajectory) -> float:
    """How far the minimum that a stepper finds from each frame, in its step, is from it, m."""
    out, problem = 0.0, stepper.problem
    for k, x in enumerate(run.positions[1:]):
        objective = stepper.objective(run.state(k), None, stepper.time_step)
        found = stepper.minimum(objective, problem.relaxed(x)).positions[: len(x)]
        out = max(out, float(np.linalg.norm(found - x, axis=1).max()))
    return out


def part(name: str) -> common.Outcome:
    """A scene by all elements and both methods; the distance is in largest displacements."""
    figures: common.Figures = {}
    rows = []
    for element, choose in MODELS.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PdcorrectWarning)
            problem = pc.discretise(choose(SCENES[name]))
        runs = {"PD": pc.rollout(pc.ProjectiveDynamics(problem), on_failure="continue")}
        runs["Newton"] = pc.rollout(pc.Newton(problem), on_failure="continue")
        moved = np.linalg.norm(runs["Newton"].positions - problem.positions, axis=2).max()
        apart = np.linalg.norm(runs["PD"].positions - runs["Newton"].positions, axis=2).max()
        if name not in UNDECIDED:
            figures[f"{name}, {element}, distance"] = apart / moved
        others = {"PD": pc.Newton(problem), "Newton": pc.ProjectiveDynamics(problem)}
        for method, run in runs.items():
            gap = float(run.stats["smallest_gap"].min()) / problem.cell_size
            statuses = run.stats["status"]
            worst = next((s for s in statuses if not pc.Status[s].ok), str(statuses[-1]))
            found = {
                "status": str(worst), "smallest gap": gap, "energy gain": energy_gain(run),
                "moved by the other": moved_by(others[method], run) / moved,
            }  # fmt: skip
            figures |= {f"{name}, {element}, {method}, {key}": x for key, x in found.items()}
            count = run.stats["iterations"]
            rows.append(
                (name, element, method, str(worst), float(count.mean()), int(count.max()), gap,
                 found["energy gain"], found["moved by the other"], apart / moved)
            )  # fmt: skip
    return common.Outcome(figures, (common.Table(TABLE, HEADINGS, tuple(rows)),))


def parts(quick: bool) -> dict[str, Callable[[], common.Outcome]]:
    """One part a scene."""
    return {name: partial(part, name) for name in SCENES if not quick or name == QUICK}


def finding(record: common.Record) -> str:
    """The smallest gap and the most iterations."""
    rows = record.table(TABLE)["rows"]
    gap, most = min(row[6] for row in rows), max(row[5] for row in rows)
    return (
        f"In {len(rows)} runs no gap is below {gap:.2g} cells; steps take up to {most} iterations."
    )

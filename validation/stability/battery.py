"""The scenes of `validation/stress` by generalised-alpha, and above a floor."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from harness import Case

import pdcorrect as pc

Array = np.ndarray
Row = tuple[float | str, ...]
STRESS = Case(Path(__file__).parents[1] / "stress")
battery = STRESS.module
ELEMENTS = {"best coarse": battery.ENHANCED, "learned": battery.LEARNED}
"""Solvers of that case by element."""
ALPHA, FLOOR = "generalised-alpha", "generalised-alpha, floor"
GAP = 0.2
"""Cells between the body at rest and the floor below it."""
SETTLED = 16.0
"""A damped body's amplitude falls to exp(-SETTLED) of that at the start: backward Euler, for which
the scenes' lengths were chosen, damps more than the body's damping alone."""
LEFT_OUT = ("200 000 cells", "cross plane", "cross random 5", "cross twisted", "cross turned")
"""A body with a single step, which is the first of a run, and crosses of 270 nodes that need
minutes where they do not settle in 800 frames: by backward Euler only."""
CROSSES_ABOVE = ("cross ordinary", "cross weight", "cross kick")
"""Of the crosses, which take longest, those above a floor too."""
APART = 1e-2
"""Cells, above which two answers to a step count as two."""
OUTCOMES = ("pass", "explained", "fail")
RUNS = "Runs"
RUN_HEADS = (
    "scene", "element", "integrator", "outcome", "distance", "status", "gap, cells", "reason",
)  # fmt: skip
PARTED = "Runs that part from the other method: are both answers of their steps?"
PARTED_HEADS = (
    "scene", "element", "frame", "apart, cells", "PD's moved by Newton, cells",
    "Newton's moved by PD, cells",
)  # fmt: skip
INVERTED = "Motions that end with cells inverted: by Newton and by radius 0 too?"
INVERTED_HEADS = ("scene", "element", "Newton's status", "status by radius 0")
ENDED = "Runs that ended elsewhere than at rest: is it a minimum of the energy?"
ENDED_HEADS = (
    "scene", "element", "distance, cells", *battery.ENDS, "warned of energy",
    "distance by radius 0, cells",
    *(f"{what}, by radius 0" for what in battery.ENDS[:2]),
)  # fmt: skip


def in_time(scenario: Any) -> Any:
    """The scenario by generalised-alpha; damped ones until they are at rest."""
    scene = scenario.scene
    frames = scene.time.frames
    if scene.damping.mass:
        frames = max(frames, math.ceil(2.0 * SETTLED / (scene.damping.mass * scene.time.step)))
    scene = scene.with_changes(time={"integrator": "generalised-alpha", "frames": frames})
    return replace(scenario, name=f"{scenario.name}, {ALPHA}", scene=scene)


def above_floor(scenario: Any) -> Any | None:
    """The same above a floor; None if it begins below it, or a clamp is moved."""
    if scenario.known and scenario.name not in CROSSES_ABOVE:
        return None
    problem = pc.discretise(scenario.scene)
    height = floor_of(problem)
    lowest = scenario.state(problem).positions[:, 2].min()
    if lowest <= height or any(clamp.motion for clamp in scenario.scene.clamps):
        return None
    floor = {"shape": "plane", "point": [0.0, 0.0, height], "normal": [0.0, 0.0, 1.0]}
    changed = in_time(scenario)
    scene = changed.scene.with_changes(obstacles=[floor])
    return replace(changed, name=f"{scenario.name}, {FLOOR}", scene=scene)


def floor_of(problem: pc.Problem) -> float:
    """Height of the floor, m."""
    return float(problem.positions[:, 2].min() - GAP * problem.cell_size)


def scenarios() -> dict[str, Any]:
    """By name; of those with a floor the name ends so."""
    out = {}
    for scenario in battery.BATTERY:
        if scenario.name not in LEFT_OUT:
            both = in_time(scenario), above_floor(scenario)
            out |= {found.name: found for found in both if found is not None}
    return out


def part(scenario: Any) -> common.Outcome:
    """One scene on both elements."""
    truth = battery.Truth(scenario)
    figures: dict[str, Any] = {}
    parted, ended, inverted = [], [], []
    for element, solver in ELEMENTS.items():
        found = truth.run(solver)
        name = f"{scenario.name}, {element}"
        far = battery.distance(scenario, found, truth.of(solver))
        figures |= {f"{name}, distance": far, f"{name}, status": found.status.name}
        if scenario.scene.obstacles:
            gap = min(found.problem.contact.gaps(x, 0.0).min() for x in found.positions)
            gap /= found.problem.cell_size
            figures[f"{name}, gap"] = float(gap)
        if found.status is pc.Status.INVERTED and scenario.goal == "motion":
            others = truth.of(solver), calmer(scenario, solver)
            inverted.append((scenario.name, element, *(run.status.name for run in others)))
        if far > 1e-3 and scenario.goal == "motion":
            parted += [(scenario.name, element, *row) for row in parting(scenario, found.problem)]
        elif far > 1e-3 and np.isfinite(found.positions[-1]).all():
            ended.append((scenario.name, element, far, *ending(scenario, solver, found)))
    tables = []
    if parted:
        tables.append(common.Table(PARTED, PARTED_HEADS, tuple(parted)))
    if inverted:
        tables.append(common.Table(INVERTED, INVERTED_HEADS, tuple(inverted)))
    if ended:
        tables.append(common.Table(ENDED, ENDED_HEADS, tuple(ended)))
    return common.Outcome(figures, tuple(tables))


def ending(scenario: Any, solver: str, found: Any) -> Row:
    """Where a run ended, whether `pc.rollout` warns of energy, and where radius 0 ends."""
    stepper = pc.ProjectiveDynamics(found.problem)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pc.rollout(stepper, state=scenario.state(found.problem), on_failure="continue")
    warned = any("gained" in str(warning.message) for warning in told)
    other = calmer(scenario, solver)
    return (
        *battery.minimum(found), "yes" if warned else "no",
        battery.distance(scenario, other, None), *battery.minimum(other)[:2],
    )  # fmt: skip


def calmer(scenario: Any, solver: str) -> Any:
    """The run by spectral radius 0."""
    scene = scenario.scene.with_changes(time={"spectral_radius": 0.0})
    return battery.run(replace(scenario, scene=scene), solver)


def parting(scenario: Any, problem: pc.Problem) -> list[tuple[float, ...]]:
    """The first frame that PD and Newton have apart, and how far each moves the other's answer.

    Each begins at the answer of the other, in the other's step: one that stays has found a
    stationary point of the same function too.
    """
    steppers = pc.ProjectiveDynamics(problem), pc.Newton(problem)
    states = [scenario.state(problem), scenario.state(problem)]
    for frame in range(1, problem.scene.time.frames + 1):
        forces = scenario.forces(problem, frame - 1) if scenario.forces else None
        results = [stepper(s, forces) for stepper, s in zip(steppers, states, strict=True)]
        ends = [result.state.positions for result in results]
        apart = float(np.linalg.norm(ends[0] - ends[1], axis=1).max()) / problem.cell_size
        if apart > APART or not np.isfinite(apart):
            moved = [
                _moved(other, state, forces, end)
                for other, state, end in zip(steppers[::-1], states, ends, strict=True)
            ]
            return [(float(frame), apart, *moved)]
        states = [result.state for result in results]
    return []


def _moved(stepper: Any, state: pc.State, forces: Array | None, end: Array) -> float:
    """How far from an end of the step the minimum is that a stepper finds from there, cells."""
    problem = stepper.problem
    objective = stepper.objective(state, forces, problem.time_step)
    found = stepper.minimum(objective, problem.relaxed(end)).positions[: len(end)]
    return float(np.linalg.norm(found - end, axis=1).max()) / problem.cell_size


# --- outcomes --------------------------------------------------------------------------------


def outcome(names: Mapping[str, Any], expected: Mapping[str, Any]) -> tuple[str, str]:
    """Pass, explained or fail, and the reason: of a run's figures by what they have to be."""
    missed = [expected[name] for name, x in names.items() if not expected[name].met_by(x)]
    if not missed:
        return "pass", ""
    if all(aim.known_failure for aim in missed):
        return "explained", "; ".join(dict.fromkeys(str(aim.known_failure) for aim in missed))
    return "fail", ""


def judged_rows(figures: Mapping[str, Any], expected: Mapping[str, Any]) -> list[Row]:
    """Rows of `RUNS` of this case's figures."""
    rows = []
    for scenario in scenarios().values():
        plain, integrator = scenario.name.split(", generalised")[0], ALPHA
        if scenario.scene.obstacles:
            integrator = FLOOR
        for element in ELEMENTS:
            name = f"{scenario.name}, {element}"
            mine = {k: figures[k] for k in expected if k.startswith(f"{name}, ")}
            word, why = outcome(mine, expected)
            gap = figures.get(f"{name}, gap", "")
            rows.append(
                (plain, element, integrator, word, figures[f"{name}, distance"],
                 figures[f"{name}, status"], gap, why)
            )  # fmt: skip
    return rows


def recorded_rows(figures: Mapping[str, Any]) -> list[Row]:
    """Rows of `RUNS` of both elements by backward Euler, as `validation/stress` has them."""
    rows = []
    for scenario in battery.BATTERY:
        for element, solver in ELEMENTS.items():
            keys = [f"{scenario.name}, {solver}, {what}" for what in ("distance", "status")]
            word, why = outcome({k: figures[k] for k in keys}, STRESS.expected)
            told = figures[keys[0]], figures[keys[1]]
            rows.append((scenario.name, element, "backward-euler", word, *told, "", why))
    return rows


def counts(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Runs by element and integrator: passed, explained, failed."""
    kinds = dict.fromkeys((row[1], row[2]) for row in rows)
    out = []
    for kind in kinds:
        words = [row[3] for row in rows if row[1:3] == kind]
        out.append((*kind, *(float(words.count(w)) for w in OUTCOMES)))
    return tuple(out)

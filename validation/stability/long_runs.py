"""Energy of an undamped body over very many steps, free and on a floor."""

from __future__ import annotations

from typing import Any

import common
import numpy as np

import pdcorrect as pc

STEPS = 100_000
CELL, STEP, YOUNG, DENSITY, GRAVITY = 0.05, 0.0025, 1e5, 1e3, 9.81
"""m, s, Pa, kg/m3, m/s2; waves cross half a cell in a step."""
TWIST, DROP = 60.0, 0.1
"""Degrees at the free end; cells above the floor."""
ELEMENTS = {"best coarse": pc.best_coarse, "learned": pc.learned_coarse}
SCHEMES: dict[str, dict[str, Any]] = {
    "generalised-alpha": {"integrator": "generalised-alpha"},
    "generalised-alpha, radius 1": {"integrator": "generalised-alpha", "spectral_radius": 1.0},
    "midpoint": {"integrator": "midpoint"},
}
DEFAULT = "generalised-alpha"
RUNS = {
    **{(case, "learned", scheme): STEPS for case in ("twisted", "dropped") for scheme in SCHEMES},
    **{(case, "best coarse", DEFAULT): STEPS for case in ("twisted", "dropped")},
}
"""Steps by start, element and integrator."""
TABLE = "Energy of long runs over that of the start"
HEADS = (
    "body", "element", "integrator", "steps", "largest", "a tenth", "last", "drift",
    "steps that failed",
)  # fmt: skip
FIELDS = "kinetic_energy", "elastic_energy", "contact_energy"


def problem_of(case: str, element: str, scheme: str) -> pc.Problem:
    """Three cells in a row: held at an end, or free above a floor under their weight."""
    sections: dict[str, Any] = {"clamps": [{"region": {"plane": "x", "at": "min"}}]}
    if case == "dropped":
        floor = {"shape": "plane", "point": [0.0, 0.0, -DROP * CELL], "normal": [0.0, 0.0, 1.0]}
        weight = {"kind": "gravity", "acceleration": [0.0, 0.0, -GRAVITY]}
        sections = {"obstacles": [floor], "loads": [weight]}
    scene = pc.Scene(
        body={"shape": "beam", "cells": [3, 1, 1], "cell_size": CELL},
        material={"young": YOUNG, "poisson": 0.4, "density": DENSITY},
        time={"step": STEP, "frames": 1, **SCHEMES[scheme]},
        **sections,
    )  # fmt: skip
    return pc.discretise(ELEMENTS[element](scene))


def twisted(problem: pc.Problem) -> pc.State:
    """At rest, sections turned about the axis in proportion to the distance from the held end."""
    rest = problem.positions
    angle = np.radians(TWIST) * rest[:, 0] / rest[:, 0].max()
    y, z = (rest[:, 1:] - 0.5 * CELL).T
    turned = [np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z]
    positions = np.column_stack([rest[:, 0], *(x + 0.5 * CELL for x in turned)])
    return pc.State(positions, np.zeros_like(rest))


def energies(case: str, element: str, scheme: str, steps: int) -> tuple[np.ndarray, int]:
    """Of all frames, J, and how many steps failed.

    Of the body above the floor that of its weight is part, from where it would touch.
    """
    problem = problem_of(case, element, scheme)
    stepper = pc.ProjectiveDynamics(problem)
    state = twisted(problem) if case == "twisted" else problem.rest_state()
    weight = GRAVITY * problem.mass if case == "dropped" else 0.0 * problem.mass

    def fall(positions: np.ndarray) -> float:
        return float(weight @ (positions[:, 2] - problem.positions[:, 2] + DROP * CELL))

    failed, out = 0, [problem.energy(state.positions) + fall(state.positions)]
    for _ in range(steps):
        result = stepper(state)
        state = result.state
        failed += not result.status.ok
        stored = sum(result.stats.get(field, 0.0) for field in FIELDS)
        out.append(stored + fall(state.positions))
    return np.array(out), failed


def part(case: str, element: str, scheme: str, steps: int) -> common.Outcome:
    """A run; the drift is the mean of the last tenth less that of the second, over the start."""
    found, failed = energies(case, element, scheme, steps)
    found, tenth = found / found[0], steps // 10
    drift = float(found[-tenth:].mean() - found[tenth : 2 * tenth].mean())
    name = f"{case}, {element}, {scheme}"
    figures = {f"{name}, largest": float(found.max()), f"{name}, drift": drift,
               f"{name}, failed": float(failed)}  # fmt: skip
    row = (case, element, scheme, float(steps), float(found.max()), float(found[tenth]),
           float(found[-1]), drift, float(failed))  # fmt: skip
    return common.Outcome(figures, (common.Table(TABLE, HEADS, (row,)),))

"""How far the error estimate of a step is from its error, on a slender beam, by tolerance.

    python benchmarks/estimates.py

A beam of 100 x 1 x 1 cells of 0.02 m, Poisson's ratio 0.49, held at one end, falling under its
weight by steps of 0.1 s, with ten Young's moduli about 10 MPa, three steps each: estimate over
distance from Newton's answer at 1e-11 cells, and that distance over the tolerance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from machine_file import add

import pdcorrect as pc
from pdcorrect.metrics import largest_error

MODULI = [1e7 * (1.0 + 0.013 * k) for k in range(10)]
"""Pa."""
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)
"""Of the cell size."""


def scene(young: float) -> pc.Scene:
    """The beam."""
    return pc.Scene(
        body={"shape": "beam", "cells": [100, 1, 1], "cell_size": 0.02},
        material={"young": young, "poisson": 0.49, "density": 1e3},
        clamps=[{"region": {"plane": "x", "at": "min"}}],
        loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
        time={"step": 0.1, "frames": 3, "integrator": "backward-euler"},
    )


def measured(young: float) -> list[dict[str, float]]:
    """Three steps, each from Newton's state, at all tolerances."""
    problem = pc.discretise(scene(young))
    state, rows = problem.rest_state(), []
    for _ in range(3):
        exact = pc.Newton(problem, tolerance=1e-11)(state).state
        for tolerance in TOLERANCES:
            result = pc.ProjectiveDynamics(problem, tolerance)(state)
            error = largest_error(result.state.positions[None], exact.positions[None])
            rows.append(
                {
                    "tolerance": tolerance,
                    "estimate_over_error": result.error_estimate / error,
                    "error_over_tolerance": error / (tolerance * problem.cell_size),
                }
            )
        state = exact
    return rows


def summary(rows: list[dict[str, float]]) -> list[dict[str, Any]]:
    """Least, median and largest ratio by tolerance."""
    found = []
    for tolerance in TOLERANCES:
        own = [row for row in rows if row["tolerance"] == tolerance]
        ratios = [row["estimate_over_error"] for row in own]
        found.append(
            {
                "tolerance": tolerance,
                "steps": len(own),
                "least": min(ratios),
                "median": float(np.median(ratios)),
                "largest": max(ratios),
                "largest_error_over_tolerance": max(row["error_over_tolerance"] for row in own),
            }
        )
    return found


def main() -> None:
    """Measure all."""
    add("estimates", summary([row for young in MODULI for row in measured(young)]))


if __name__ == "__main__":
    main()

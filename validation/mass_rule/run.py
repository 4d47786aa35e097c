"""How much of the published coarse error is the mass rule: cell mass on every node."""

from __future__ import annotations

from typing import Any

import common
import numpy as np

import pdcorrect as pc

CELL, FRAMES, FINE = 0.05, 20, 4
BODY = {
    "shape": "cross", "cells": [12, 2, 2], "cell_size": CELL, "arms": 4, "arm_start": 7,
    "arm_width": 2, "arm_length": 3,
}  # fmt: skip
END = {"plane": "x", "at": "max"}
LOADS: dict[str, dict[str, Any]] = {
    "impulse": {
        "kind": "force", "force": [0.0, 150.0, 300.0], "region": END, "window": [0.0, 0.03],
        "distribution": "nodal",
    },
    "torsion": {"kind": "torsion", "strength": 1.25, "distribution": "nodal"},
}  # fmt: skip
"""Forces on the coarse nodes, the same on every mesh: torsion of 1.25 N a node."""


def scene(motion: str, mass: str, density: float = 1e3) -> pc.Scene:
    """The cross under one of the loads."""
    return pc.Scene(
        name=motion, body=BODY, loads=[LOADS[motion]],
        material={"young": 3e5, "poisson": 0.4, "density": density},
        clamps=[{"region": {"plane": "x", "at": "min"}}],
        time={"step": 0.01, "frames": FRAMES, "integrator": "backward-euler"},
        solver={"mass": mass, "tolerance": 1e-5},
    )  # fmt: skip


def run(motion: str, mass: str, refine: int = 1, density: float = 1e3) -> pc.Trajectory:
    """All frames by projective dynamics."""
    return pc.rollout(
        pc.ProjectiveDynamics(pc.discretise(scene(motion, mass, density), refine=refine))
    )


def shares(motion: str) -> common.Figures:
    """Omega with the published mass rule and with the true mass."""
    coarse = run(motion, "per-node")
    fine = run(motion, "per-node", FINE)
    ratio = fine.problem.mass.sum() / coarse.problem.mass.sum()
    runs = {
        "intermediate mesh": run(motion, "per-node", 2),
        "coarse mesh, reference's mass": run(motion, "per-node", density=1e3 * ratio),
    }
    true = run(motion, "lumped"), run(motion, "lumped", 2), run(motion, "lumped", FINE)
    points = pc.discretise(scene(motion, "lumped"))
    truth, right = (pc.restrict(r, to=points) for r in (fine, true[2]))
    plain, other = (pc.metrics.rms_error(r, t) for r, t in ((coarse, truth), (true[0], right)))
    figures: common.Figures = {
        f"{motion}, displacement, m": pc.metrics.largest_displacement(truth),
        f"{motion}, coarse error, mm": 1e3 * plain,
        f"{motion}, coarse error with the true mass, mm": 1e3 * other,
        f"{motion}, share of the squared error, per cent": 100.0 * (1.0 - (other / plain) ** 2),
    }
    for name, found in runs.items():
        there = pc.restrict(found, to=points)
        omega = pc.metrics.error_corrected(there, coarse, truth)
        figures[f"{motion}, {name}, omega"] = omega
    middle = pc.metrics.error_corrected(pc.restrict(true[1], to=points), true[0], right)
    figures[f"{motion}, intermediate mesh, true mass, omega"] = middle
    return figures


def case(quick: bool) -> common.Outcome:
    """All figures; quick runs have the masses only."""
    figures: common.Figures = {}
    volume = float(np.sum(pc.discretise(scene("torsion", "lumped")).mass))
    for refine, name in ((1, "coarse"), (FINE, "fine")):
        mass = pc.discretise(scene("torsion", "per-node"), refine=refine).mass.sum()
        figures[f"mass of the {name} mesh, of the true one"] = float(mass / volume)
    if quick:
        return common.Outcome(figures)
    for motion in LOADS:
        figures |= shares(motion)
    return common.Outcome(figures)


def finding(record: common.Record) -> str:
    """What is left with the true mass."""
    shares = [record.figures[f"{m}, share of the squared error, per cent"] for m in LOADS]
    cured = [record.figures[f"{m}, coarse mesh, reference's mass, omega"] for m in LOADS]
    return (
        f"Of the coarse mesh's squared error {min(shares):.0f} to {max(shares):.0f} % is the mass "
        f"rule; scaling the density removes {min(cured):.0f} to {max(cured):.0f} %."
    )

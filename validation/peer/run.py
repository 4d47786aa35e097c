"""The beam of another code, step by step: DiffPD's trajectory, and what its conventions change."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import common
import numpy as np

import pdcorrect as pc

Array = np.ndarray
DATA = Path(__file__).parents[2] / "tests" / "data" / "diffpd_beam_24x2x2.npz"
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6)


@cache
def peer() -> dict[str, Array]:
    """The other code's arrays."""
    with np.load(DATA, allow_pickle=False) as data:
        return {name: data[name] for name in data}


def scene(
    mass: str = "per-node", weight: str = "published", tolerance: float = 1e-7, cut: int = 1
) -> pc.Scene:
    """Its beam: 24 x 2 x 2 cells of 2 cm, E = 1 MPa, Poisson's ratio 0.45, under gravity.

    Cells ``cut`` times as small are as many times as many along each edge.
    """
    data = peer()
    return pc.Scene(
        name="beam of another code",
        body={
            "shape": "beam",
            "cells": [24 * cut, 2 * cut, 2 * cut],
            "cell_size": float(data["cell_size"]) / cut,
        },
        material={
            "young": float(data["young"]),
            "poisson": float(data["poisson"]),
            "density": float(data["density"]),
            "volume_weight": weight,
        },
        clamps=[{"region": {"plane": "x", "at": 0.0}}],
        loads=[{"kind": "gravity", "acceleration": data["gravity"]}],
        time={
            "step": float(data["time_step"]),
            "frames": len(data["positions"]) - 1,
            "integrator": "backward-euler",
        },
        solver={"mass": mass, "tolerance": tolerance},
    )


def tip(positions: Array) -> Array:
    """Displacement across, (T+1,), mm, of the node that the other code's authors watch."""
    node = int(peer()["tip_node"])
    return 1e3 * (positions[:, node, 2] - positions[0, node, 2])


TIMES = {1: (225, 31.0), 2: (1225, 350.0), 4: (7857, 4320.0)}
"""DiffPD's nodes and ms a step by how often the cells are cut.

Medians with 2 threads on an AMD EPYC (Milan), compiled with -O3 -march=native: its L-BFGS
("pd_eigen", history 10) to its own relative tolerance of 1e-4.  Measured apart, see
``benchmarks/README.md``.
"""


def times() -> tuple[common.Figures, common.Table]:
    """A step here beside one of DiffPD, and the iterations of both kinds."""
    figures: common.Figures = {}
    rows = []
    for cut, (nodes, theirs) in TIMES.items():
        problem = pc.discretise(scene(tolerance=1e-5, cut=cut))
        assert len(problem.positions) == nodes
        run = pc.rollout(pc.ProjectiveDynamics(problem).prepare())
        ours = 1e3 * float(np.median(run.stats["seconds"]))
        figures[f"{nodes} nodes, DiffPD's time over ours"] = theirs / ours
        rows.append((float(nodes), theirs, ours, theirs / ours))
    headings = ("nodes", "DiffPD, ms a step", "here, ms a step", "ratio")
    return figures, common.Table(
        "Times beside DiffPD's, on another processor", headings, tuple(rows)
    )


def case(quick: bool) -> common.Outcome:
    """All figures; it takes seconds."""
    truth = peer()["positions"]
    velocities = np.diff(truth, axis=0) / peer()["time_step"]  # exactly those of DiffPD
    same = pc.discretise(scene())
    by_pd = pc.rollout(pc.ProjectiveDynamics(same))
    by_newton = pc.rollout(pc.Newton(same))
    figures: common.Figures = {
        "displacement, mm": 1e3 * pc.metrics.largest_displacement(truth),
        "PD, distance, um": 1e6 * pc.metrics.largest_error(by_pd.positions, truth),
        "Newton, distance, um": 1e6 * pc.metrics.largest_error(by_newton.positions, truth),
        "PD, velocities, um/s": 1e6 * float(np.abs(by_pd.velocities[1:] - velocities).max()),
    }
    for tolerance in TOLERANCES:
        problem = pc.discretise(scene(tolerance=tolerance))
        run = pc.rollout(pc.ProjectiveDynamics(problem))
        error = 1e3 * float(np.abs(tip(run.positions) - tip(truth)).max())
        figures[f"tip, tolerance {tolerance:g}, um"] = error
        figures[f"iterations, tolerance {tolerance:g}"] = float(run.stats["iterations"].mean())
    lumped = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene("lumped"))))
    honest = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene("lumped", "lame"))))
    figures["mass, of the true one"] = float(same.mass.sum() / honest.problem.mass.sum())
    for name, other in (("mass", lumped), ("mass and weight", honest)):
        figures[f"tip, true {name}, mm"] = float(np.abs(tip(other.positions) - tip(truth)).max())
    if quick:  # times of a busy machine say nothing
        return common.Outcome(figures)
    ratios, beside = times()
    return common.Outcome(figures | ratios, (beside,))


def finding(record: common.Record) -> str:
    """Distance from the other code, and what its mass rule does."""
    apart, moved = record.figures["PD, distance, um"], record.figures["displacement, mm"]
    mass, tip = record.figures["mass, of the true one"], record.figures["tip, true mass, mm"]
    return (
        f"PD is within {apart:.1g} µm of DiffPD at every node, while nodes move {moved:.0f} mm. "
        f"Its mass rule ({mass:.2f} times the true mass) moves the tip by {tip:.0f} mm."
    )

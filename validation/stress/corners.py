"""Folded crosses: what a gate makes of them that refuses bodies folded at a corner.

python validation/stress/corners.py RECORD.json

All crosses of the battery, by the torsion models with the default gate and with one that has
``corners = 0``: how far they end from what has to be reached (in cells), or their error beside the
finer mesh, in largest displacements; the share of corrections that were applied; and in how many
steps a cell is folded at a corner.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import record
from crosses import CROSSES
from run import distance, error
from scenarios import Scenario
from solvers import MODELS, Run, finer, run, steps_of

import pdcorrect as pc

HYBRIDS = ("hybrid torsion", "hybrid compact")
GATES = {"default": pc.Gate(), "corners": pc.Gate(corners=0.0)}


def rows(scenario: Scenario) -> Iterator[dict[str, Any]]:
    """Of the best coarse model alone, and of both models with each gate."""
    truth = finer(scenario) if scenario.finer else None
    best = run(scenario, "PD best")
    yield {"scene": scenario.name, "solver": "PD best", **figures(scenario, best, truth)}
    for name in HYBRIDS:
        model = pc.load_model(MODELS[name])
        for label, gate in GATES.items():
            coarse = pc.ProjectiveDynamics(best.problem)
            hybrid = pc.HybridStepper(coarse, model.corrector, velocity=model.velocity, gate=gate)
            found = steps_of(scenario, hybrid)
            yield {
                "scene": scenario.name, "solver": name, "gate": label,
                **figures(scenario, found, truth), "accepted": found.accepted,
            }  # fmt: skip


def figures(scenario: Scenario, found: Run, truth: Run | None) -> dict[str, Any]:
    """How far off a run is, and how often and how far it is folded."""
    least = [float(found.problem.corner_volume_ratios(x).min()) for x in found.positions[1:]]
    off = {"error": error(found, truth)} if truth else {"cells": distance(scenario, found, None)}
    return {**off, "folded": int(np.sum(np.array(least) <= 0.0)), "least_corner": min(least)}


def main() -> None:
    """Compute all and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("output", type=Path, metavar="RECORD.json")
    output = parser.parse_args().output
    found = []
    for scenario in CROSSES:
        for row in rows(scenario):
            found.append(row)
            print(row, flush=True)
    digests = record.digests({name: MODELS[name] for name in HYBRIDS})
    record.write(output, weights_sha256=digests, rows=found)


if __name__ == "__main__":
    main()

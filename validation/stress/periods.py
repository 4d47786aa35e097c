"""Loads that turn round every so many steps: how far off hybrids are, by their gate's pause.

python validation/stress/periods.py RECORD.json

The cross and the load of *cross reversal 1*, which turns round every 1 to 13 steps; errors beside
PD on the finer mesh, in largest displacements, and the share of corrections that were applied.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import record
from crosses import CROSSES
from run import error, moved
from scenarios import Array, Scenario
from solvers import MODELS, finer, run, steps_of

import pdcorrect as pc

HYBRIDS = ("hybrid torsion", "hybrid compact")
PERIODS = (1, 2, 3, 4, 6, 8, 10, 13)
"""Steps between two turns."""
PAUSES = (0, 1, 2, 3, 4, 5)
"""Of the gates; none of the hybrids without a gate."""


def turning_every(period: int) -> Scenario:
    """*Cross reversal 1* with fewer turns."""

    def forces(problem: pc.Problem, step: int) -> Array:
        times = step * problem.time_step, (step + 1) * problem.time_step
        return -2.0 * (step // period % 2) * problem.external_forces(*times)

    reversal = next(scene for scene in CROSSES if scene.name == "cross reversal 1")
    return replace(reversal, name=f"cross, turns every {period}", forces=forces)


def rows(period: int) -> Iterator[dict[str, Any]]:
    """Of both models with each gate, and of the best coarse model alone."""
    scenario = turning_every(period)
    truth, best = finer(scenario), run(scenario, "PD best")
    common = {"period": period, "moved_cells": moved(truth) / truth.problem.cell_size}
    yield {**common, "solver": "PD best", "error": error(best, truth)}
    for name in HYBRIDS:
        model = pc.load_model(MODELS[name])
        for gate in (None, *(pc.Gate(pause=pause) for pause in PAUSES)):
            coarse = pc.ProjectiveDynamics(best.problem)
            hybrid = pc.HybridStepper(coarse, model.corrector, velocity=model.velocity, gate=gate)
            found = steps_of(scenario, hybrid)
            yield {
                **common, "solver": name, "pause": None if gate is None else gate.pause,
                "error": error(found, truth), "accepted": found.accepted,
            }  # fmt: skip


def main() -> None:
    """Compute all and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("output", type=Path, metavar="RECORD.json")
    output = parser.parse_args().output
    found = []
    for period in PERIODS:
        for row in rows(period):
            found.append(row)
            print(row, flush=True)
    digests = record.digests({name: MODELS[name] for name in HYBRIDS})
    record.write(output, weights_sha256=digests, rows=found)


if __name__ == "__main__":
    main()

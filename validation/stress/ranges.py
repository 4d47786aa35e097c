"""*Cross plane*: is it the gate's ranges or the network's answers that changed with the weights?

python validation/stress/ranges.py BEFORE RECORD.json

BEFORE is a folder with another `torsion-exact`; the one of before it was trained on with more
bodies is in this repository's history (commit 4d4a67a).  All four pairs of network and ranges, with
the default gate: the share of corrections applied, the distance from rest at the end, in cells, the
least det F at a corner there, and how far a node still moves in a step, in cells, over the last 50.
"""

from __future__ import annotations

import copy
import json
import sys
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from crosses import CROSSES
from run import distance
from solvers import MODELS, problem_of, steps_of

import pdcorrect as pc
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.environment import environment
from pdcorrect.replacement import write_text

LAST = 50
"""Steps at the end over which motion is looked at."""


def row(network: LoadedModel, ranges: LoadedModel) -> dict[str, Any]:
    """One run, by the weights of a model and all that another one normalises and tells by."""
    scenario = next(scene for scene in CROSSES if scene.name == "cross plane")
    corrector = copy.deepcopy(network.corrector)
    corrector.normaliser.load_state_dict(ranges.corrector.normaliser.state_dict())
    coarse = pc.ProjectiveDynamics(problem_of(scenario, "PD best"))
    hybrid = pc.HybridStepper(coarse, corrector, velocity=network.velocity, gate=pc.Gate())
    found = steps_of(scenario, hybrid)
    moved = np.abs(np.diff(found.positions[-LAST - 1 :], axis=0)).max()
    return {
        "accepted": found.accepted, "cells": distance(scenario, found, None),
        "least_corner": found.least_corner,
        "moves_cells": float(moved / found.problem.cell_size),
    }  # fmt: skip


def main() -> None:
    """Compute all and write the record."""
    before, output = sys.argv[1:]
    folders = {"before": before, "now": MODELS["hybrid torsion"]}
    models = {name: pc.load_model(folder) for name, folder in folders.items()}
    one, other = (model.corrector.config for model in models.values())
    if one != other:
        raise SystemExit(f"{before}: another architecture than today's model.")
    rows = []
    for network, ranges in product(models, models):
        found = row(models[network], models[ranges])
        rows.append({"network": network, "ranges": ranges, **found})
        print(rows[-1], flush=True)
    content = {
        "date": time.strftime("%Y-%m-%d"),
        "command": f"python validation/stress/ranges.py {before} {output}",
        "environment": environment(),
        "weights_sha256": {
            name: weights_digest(model_folder(folder)) for name, folder in folders.items()
        },
        "rows": rows,
    }
    write_text(Path(output), json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()

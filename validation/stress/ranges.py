"""*Cross plane*: is it the gate's ranges or the network's answers that changed with the weights?

python validation/stress/ranges.py BEFORE RECORD.json

BEFORE is a folder with another `torsion-exact`; the one of before it was trained on with more
bodies is in this repository's history (commit 4d4a67a).  Models of an older version of the format
are brought up to date first, by `models/fit_time_steps.py`.  All four pairs of network and ranges,
with the default gate: the share of corrections applied, the distance from rest at the end, in
cells, the least det F at a corner there, and how far a node still moves in a step, in cells, over
the last 50; and how many steps are refused of bodies that should be known: first loads of
`torsion-exact`'s evaluation split.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import record
from crosses import CROSSES
from run import distance
from solvers import MODELS, problem_of, steps_of

import pdcorrect as pc
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import LoadedModel
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.fem.coarse_models import Base

DATASET = Path(__file__).parents[2] / "datasets" / "torsion-exact" / "config.toml"
LAST = 50
"""Steps at the end over which motion is looked at."""


def row(network: LoadedModel, ranges: LoadedModel) -> dict[str, Any]:
    """One run, by the weights of a model and all that another one normalises and tells by."""
    scenario = next(scene for scene in CROSSES if scene.name == "cross plane")
    corrector = copy.deepcopy(network.corrector)
    corrector.normaliser.load_state_dict(ranges.corrector.normaliser.state_dict())
    found = steps_of(scenario, hybrid(problem_of(scenario, "PD best"), corrector))
    moved = np.abs(np.diff(found.positions[-LAST - 1 :], axis=0)).max()
    return {
        "accepted": found.accepted, "cells": distance(scenario, found, None),
        "least_corner": found.least_corner,
        "moves_cells": float(moved / found.problem.cell_size),
        "refused_of_known": list(refused(corrector, network.base)),
    }  # fmt: skip


def hybrid(problem: pc.Problem, corrector: Corrector) -> pc.HybridStepper:
    """With the default gate."""
    return pc.HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=pc.Gate())


def refused(corrector: Corrector, base: Base) -> Iterator[int]:
    """Steps of each evaluation mesh's first load."""
    config = DatasetConfig.load(DATASET)
    for plan in make_plan(config):
        if plan.split == EVALUATION:
            problem = pc.coarse_model(draw_scene(config, plan, 0), base, plan.refine)
            run = pc.rollout(hybrid(problem, corrector), plan.frames)
            yield int(np.count_nonzero(run.stats["gate"]))


def main() -> None:
    """Compute all and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("before", metavar="BEFORE")
    parser.add_argument("output", type=Path, metavar="RECORD.json")
    options = parser.parse_args()
    before, output = options.before, options.output
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
    record.write(output, weights_sha256=record.digests(folders), rows=rows)


if __name__ == "__main__":
    main()

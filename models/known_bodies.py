"""Count the bodies of a data set's splits that a model's default gate refuses at rest.

python models/known_bodies.py MODEL=DATASET/config.toml ... [-o RECORD.json]

For each split: its meshes, how many are refused, how far the nearest and the farthest of them lies
outside the ranges of the training bodies (`Gate.body`), and by which measure the nearest refused
one lies farthest out.  Nothing is simulated.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from first_steps import scenes_of
from program import pair_of, run_script
from run_record import write_record

import pdcorrect as pc
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.gate import Reason
from pdcorrect.corrector.model_io import model_folder, weights_digest
from pdcorrect.corrector.shapes import SHAPE_MEASURES
from pdcorrect.data.config import EVALUATION, VALIDATION, DatasetConfig


def main() -> None:
    """Count them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pairs", nargs="+", metavar="MODEL=CONFIG")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    rows = []
    for pair in options.pairs:
        name, path = pair_of(pair)
        folder, config = model_folder(name), DatasetConfig.load(path)
        corrector = pc.load_model(folder).corrector
        names = (VALIDATION, EVALUATION, *(extra.name for extra in config.extra))
        rows.append({
            "model": folder.name, "weights_sha256": weights_digest(folder), "dataset": config.name,
            "splits": {split: counted(corrector, config, split) for split in names},
        })  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    if options.output:
        write_record(options.output, gate=pc.Gate().model_dump(), models=rows)


def counted(corrector: Corrector, config: DatasetConfig, split: str) -> dict[str, Any]:
    """Of one split."""
    problems = [pc.discretise(scene) for scene, _ in scenes_of(config, split, loads=1)]
    bodies = BodyGraph.of(problems, dtype=torch.float64)
    each = corrector.normaliser.shape_excess(bodies.shapes)
    refused = pc.Gate().foreign(corrector, bodies) == Reason.BODY
    farthest = each.amax(dim=1)
    found: dict[str, Any] = {
        "meshes": len(problems), "refused": int(refused.sum()),
        "nearest": float(farthest.min()), "farthest": float(farthest.max()),
    }  # fmt: skip
    if refused.any():
        worst = each[refused][int(farthest[refused].argmin())]
        found["measure"] = SHAPE_MEASURES[int(worst.argmax())]
    return found


if __name__ == "__main__":
    run_script(main)

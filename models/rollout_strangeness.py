"""How strange the means over bodies become in a model's own rollouts of scenes that it knows.

python models/rollout_strangeness.py MODEL=DATASET/config.toml ... [--split validation] [--loads 1]
    [-o RECORD.json]

Each scene is rolled out from rest by the corrected coarse model without a gate.  Told is for some
bounds (`Gate.average`) in how many rollouts and steps a mean over the body is beyond, and how many
of the bodies at rest are beyond `Gate.body` and how far the farthest is.  Rollouts that fail are
left out.  That takes no reference.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from first_steps import scenes_of, seen_in_rollouts
from program import pair_of, run_script
from run_record import write_record

import pdcorrect as pc
from pdcorrect.corrector.features import View
from pdcorrect.corrector.model_io import model_folder, weights_digest
from pdcorrect.data.config import VALIDATION, DatasetConfig

BOUNDS = (3.5, 3.7, 4.0, 4.5, 5.0, 6.0)
BATCH = 20


def main() -> None:
    """Measure them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pairs", nargs="+", metavar="MODEL=CONFIG")
    parser.add_argument("--split", default=VALIDATION)
    parser.add_argument("--loads", type=int, default=1, help="of each mesh, at most")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    rows = []
    for pair in options.pairs:
        name, config = pair_of(pair)
        rows.append(strange(name, DatasetConfig.load(config), options.split, options.loads))
        print(rows[-1], flush=True)
        if options.output:
            write_record(options.output, models=rows)


def strange(name: str, config: DatasetConfig, split: str, loads: int) -> dict[str, Any]:
    """Counts for one model."""
    model, scenes = pc.load_model(name), scenes_of(config, split, loads)
    corrector, each, excesses = model.corrector, [], []
    for first in range(0, len(scenes), BATCH):
        some = scenes[first : first + BATCH]
        problems = [pc.coarse_model(scene, model.base, refine) for scene, refine in some]

        def look(view: View) -> tuple[torch.Tensor, torch.Tensor]:
            return corrector.unlike(view), corrector.shape_excess(view.bodies)

        seen, whole = seen_in_rollouts(model, problems, config.frames, "cpu", look)
        each.append(torch.stack([of_step for of_step, _ in seen])[:, whole])
        excesses.append(seen[0][1])
    found, bodies = torch.cat(each, dim=1), torch.cat(excesses)
    folder = model_folder(name)
    return {
        "model": folder.name, "weights_sha256": weights_digest(folder), "dataset": config.name,
        "split": split, "rollouts": found.shape[1], "steps": found.numel(),
        "beyond": {
            str(bound): {
                "rollouts": int((found > bound).any(dim=0).sum()),
                "steps": int((found > bound).sum()),
            }
            for bound in BOUNDS
        },
        "farthest": float(found.max()),
        "bodies_beyond": int((bodies > (pc.Gate().body or torch.inf)).sum()),
        "farthest_body": float(bodies.max()),
    }  # fmt: skip


if __name__ == "__main__":
    run_script(main)

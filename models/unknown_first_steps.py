"""Count the first steps of a split's scenes that models' default gates do not know.

python models/unknown_first_steps.py MODEL=DATASET/config.toml ... [--split evaluation]
    [--loads 2] [-o RECORD.json]

Each scene begins with one coarse step from rest; no correction is computed, nor a reference.  Told
is how many steps' inputs are unknown, by nodes (`Gate.margin`) and by means over bodies
(`Gate.average`).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from first_steps import first_views, scenes_of

import pdcorrect as pc
from pdcorrect.corrector.model_io import model_folder, weights_digest
from pdcorrect.data.config import EVALUATION, DatasetConfig
from pdcorrect.environment import environment
from pdcorrect.replacement import write_text

BATCH = 20


def main() -> None:
    """Count them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pairs", nargs="+", metavar="MODEL=CONFIG")
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--loads", type=int, default=2, help="of each mesh, at most")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    rows = []
    for pair in options.pairs:
        name, _, config = pair.partition("=")
        rows.append(unknown(name, DatasetConfig.load(config), options.split, options.loads))
        print(rows[-1], flush=True)
    if options.output:
        record = {
            "date": time.strftime("%Y-%m-%d"),
            "command": " ".join(["python", "models/unknown_first_steps.py", *sys.argv[1:]]),
            "environment": environment(),
            "models": rows,
        }
        write_text(options.output, json.dumps(record, indent=2) + "\n")


@torch.no_grad()
def unknown(name: str, config: DatasetConfig, split: str, loads: int) -> dict[str, Any]:
    """Counts for one model."""
    model, gate = pc.load_model(name), pc.Gate()
    tests = {
        "unknown": gate,
        "by nodes": gate.model_copy(update={"average": None}),
        "by bodies": gate.model_copy(update={"margin": None}),
    }
    counts = dict.fromkeys(["first steps", *tests], 0)
    for view, good in first_views(model, scenes_of(config, split, loads), "cpu", BATCH):
        counts["first steps"] += int(good.sum())
        for label, test in tests.items():
            counts[label] += int((test.unknown(model.corrector, view) & good).sum())
    folder = model_folder(name)
    return {
        "model": folder.name, "weights_sha256": weights_digest(folder), "dataset": config.name,
        "split": split, **counts,
    }  # fmt: skip


if __name__ == "__main__":
    main()

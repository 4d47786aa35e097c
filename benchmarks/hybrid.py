"""What a corrected step costs beside the coarse and the fine solver's, at equal accuracy.

    python benchmarks/hybrid.py MODEL DATA [--device cuda] [--split evaluation]
        [--batches 1,4,16] [--accuracy 1e-4] [--steps 20] [--quick]

Scenes are the first ones of a data set's split, repeated where a batch is larger; the fine
mesh is that of its reference.  Network and gate count to the corrected step.  Results go to
``results/<machine>-hybrid.json``.  ``--quick`` is one scene and three steps, to see that it
works.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from dataclasses import asdict
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import torch

from pdcorrect.data.folder import shard_paths
from pdcorrect.data.rebuild import rebuilt_problems
from pdcorrect.data.schema import REFERENCE
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.environment import environment
from pdcorrect.evaluation.candidates import saved_candidates
from pdcorrect.evaluation.speed import measure_speed


def options() -> argparse.Namespace:
    """From the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("data")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--split", default="evaluation")
    parser.add_argument("--batches", default="1,4,16", help="numbers of scenes")
    parser.add_argument("--accuracy", type=float, default=1e-4, help="of the coarse cell size")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--quick", action="store_true")
    return parser.parse_args()


def main() -> None:
    """Measure each batch size and write the results."""
    chosen = options()
    batches = [1] if chosen.quick else [int(count) for count in chosen.batches.split(",")]
    steps = 3 if chosen.quick else chosen.steps
    (saved,) = saved_candidates([chosen.model], chosen.device)
    base = saved.candidate.base
    pairs = []
    for path in shard_paths(chosen.data, chosen.split):
        shard = read_shard(path)
        coarse, fine = (rebuilt_problems(shard, path, run) for run in (base, REFERENCE))
        pairs += list(zip(coarse, fine, strict=True))
        if len(pairs) >= max(batches):
            break
    rows: list[dict[str, Any]] = []
    for count in batches:
        scenes = list(islice(cycle(pairs), count))
        found = measure_speed(
            [coarse for coarse, _ in scenes], [fine for _, fine in scenes],
            saved.candidate.hybrid, device=chosen.device, accuracy=chosen.accuracy, steps=steps,
        )  # fmt: skip
        rows.append({
            **asdict(found), "speed_up": found.speed_up, "network_share": found.network_share,
        })  # fmt: skip
        print(json.dumps(rows[-1], indent=1), flush=True)
    machine = environment()
    device = torch.cuda.get_device_name() if chosen.device != "cpu" else machine["processor"]
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "command": " ".join(["python", "benchmarks/hybrid.py", *sys.argv[1:]]),
        "environment": {**machine, "device": device, "torch_threads": torch.get_num_threads()},
        "model": saved.record(),
        "data": chosen.data,
        "results": rows,
    }
    slug = re.sub(r"[^a-z0-9]+", "-", device.lower()).strip("-")
    folder = Path(__file__).parent / "results"
    folder.mkdir(exist_ok=True)
    path = folder / f"{slug}-hybrid.json"
    if chosen.quick:
        print("--quick: no file was written")
        return
    path.write_text(json.dumps(record, indent=2) + "\n")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()

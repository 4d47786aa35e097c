"""How far runs of a data set are from the same runs computed on this machine's CPU.

    python benchmarks/devices.py FILE... [--results devices.json]

FILE are files of data sets that were generated elsewhere, on a GPU for example.  The coarse
rollouts of all simulations and the reference of the first one are computed again, one by one,
from the stored scenes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect.data.engines import Job, OneByOne
from pdcorrect.data.rebuild import rebuilt_problems
from pdcorrect.data.schema import REFERENCE
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.environment import environment
from pdcorrect.fem.coarse_models import BASES


def compare(path: Path) -> list[dict[str, Any]]:
    """Largest distances from a file's runs, m, and sizes to hold them against."""
    shard, rows = read_shard(path), []
    tolerance = float(shard.attributes["tolerance"])
    for name in (*BASES, REFERENCE):
        if name not in shard.simulations[0].runs:
            continue
        problems = rebuilt_problems(shard, path, name)[: 1 if name == REFERENCE else None]
        jobs = [Job(problem, problem.mesh.coarse_nodes) for problem in problems]
        steps = shard.simulations[0].steps
        started = time.perf_counter()
        found = OneByOne("pd", tolerance).rollouts(jobs, steps)
        stored = [s.runs[name].positions for s in shard.simulations[: len(jobs)]]
        away = [
            float(np.linalg.norm(f.positions - s[1:], axis=-1).max())
            for f, s in zip(found, stored, strict=True)
            if s is not None
        ]
        moved = max(float(np.linalg.norm(s - s[0], axis=-1).max()) for s in stored if s is not None)
        row = {
            "dataset": shard.attributes["dataset"],
            "run": name,
            "simulations": len(jobs),
            "steps": steps,
            "nodes": len(problems[0].positions),
            "made_on": shard.provenance.get("device"),
            "largest_distance_m": max(away),
            "largest_displacement_m": moved,
            "failures": [steps.failure for steps in found if steps.failure],
            "seconds": time.perf_counter() - started,
        }
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def main() -> None:
    """Compare and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
    parser.add_argument("--results", type=Path, default=Path("devices.json"))
    options = parser.parse_args()
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "environment": environment(),
        "runs": [row for path in options.files for row in compare(path)],
    }
    options.results.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()

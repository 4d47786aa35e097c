"""Simulations a minute by one worker and by several, once they have started.

    python benchmarks/generation.py CONFIG.toml [--device cuda] [--workers 1 2] [--batch 60]
        [--units 4]

Each number of workers begins with a batch each of other loads and meshes, which does not count:
it loads and compiles what they need.  Then they generate ``units`` batches from training meshes
of the configuration, in a folder that is removed afterwards.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from machine_file import add

from pdcorrect.data.configuration import DatasetConfig, Split
from pdcorrect.data.generate import generate
from pdcorrect.data.workers import Workers, local_cluster


def measure(config: DatasetConfig, workers: Workers, units: int) -> dict[str, Any]:
    """Generate some batches and say how long it took."""
    with local_cluster(workers.count) as cluster:
        busy = Workers(workers.count, cluster.scheduler_address, workers.device, workers.batch)
        warm = time.perf_counter()
        _generate(_part(config, workers.count * workers.batch, config.seed + 1), busy)
        started = time.perf_counter()
        simulations = _generate(_part(config, units * workers.batch, config.seed), busy)
        seconds = time.perf_counter() - started
    row = {
        "workers": workers.count,
        "simulations": simulations,
        "seconds": seconds,
        "simulations_a_minute": 60.0 * simulations / seconds,
        "seconds_to_start": started - warm,
    }
    print(json.dumps(row), flush=True)
    return row


def _part(config: DatasetConfig, simulations: int, seed: int) -> DatasetConfig:
    """The training split alone, with fewer simulations on as many each of fewer meshes."""
    each = config.training.simulations // config.training.meshes
    size = Split(meshes=simulations // each, simulations=simulations)
    return config.model_copy(update={"training": size, "seed": seed, "validation_share": 0.0})


def _generate(config: DatasetConfig, workers: Workers) -> int:
    with tempfile.TemporaryDirectory() as folder:
        whole = generate(config, folder, workers, splits=["training"])
    assert whole, "the split is not complete"
    return config.training.simulations


def _gpus() -> list[str]:
    import torch

    return [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--batch", type=int, default=60)
    parser.add_argument("--units", type=int, default=4)
    options = parser.parse_args()
    config = DatasetConfig.load(options.config)
    rows = [
        measure(config, Workers(n, None, options.device, options.batch), options.units)
        for n in options.workers
    ]
    gpus = _gpus() if options.device == "cuda" else []
    more = {"gpus": gpus, "dataset": config.name, "batch": options.batch}
    add("generation", rows, gpus[0] if gpus else None, **more)


if __name__ == "__main__":
    main()

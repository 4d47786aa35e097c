"""One-step graph samples a second read from a data set, from files and from memory.

    python benchmarks/reading.py

A synthetic data set in a temporary folder: 20 beams of 43 x 2 x 2 cells (396 nodes, 1 830
directed edges), 5 simulations of 60 steps each, in batches of 32.  "files" is the first epoch,
which opens and decodes every file (the system may still hold them in its memory); "memory"
is the best of three epochs after it.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine_file import add

from pdcorrect.data.reader import TrajectoryDataset, TrajectoryLoader
from pdcorrect.data.schema import Run, Shard, Simulation, write_shard
from pdcorrect.fem.mesh import voxel_mesh

MESHES, SIMULATIONS, STEPS, CELLS, BATCH = 20, 5, 60, (43, 2, 2), 32


def shard(number: int) -> Shard:
    """A beam and random waves along it."""
    mesh = voxel_mesh(np.ones(CELLS, dtype=bool), (0, 0, 0), 0.05)
    rng = np.random.default_rng(number)
    points, count = mesh.positions, len(mesh.cells)
    times = 0.01 * np.arange(STEPS + 1)[:, None, None]
    simulations = []
    for _ in range(SIMULATIONS):
        wave, speed = rng.normal(size=(2, 1, 1, 3))
        motion = points + 0.1 * np.sin(speed * times) * np.sin(wave * points[:, :1])
        error = 1e-3 * rng.normal(size=motion.shape)
        plain = Run(motion + error, motion[1:] + error[1:])
        forces = rng.normal(size=motion[1:].shape)
        simulations.append(Simulation(forces, {"reference": Run(motion), "plain": plain}))
    return Shard(
        attributes={
            "dataset": "reading", "split": "training", "number": number, "setting": "exact",
            "config_hash": "", "time_step": 0.01, "tolerance": 1e-5,
        },
        points=points, cells=mesh.cells, free=np.ones(points.shape, dtype=bool),
        mass=np.ones(len(points)), young=np.full(count, 1e5), poisson=np.full(count, 0.4),
        density=np.full(count, 1e3), simulations=tuple(simulations),
    )  # fmt: skip


def epoch(loader: TrajectoryLoader) -> float:
    """Samples a second of one epoch."""
    started = time.perf_counter()
    count = sum(batch.num_graphs for batch in loader)
    return count / (time.perf_counter() - started)


def measure(folder: Path) -> dict[str, Any]:
    """The first epoch and the best of three after it."""
    loader = TrajectoryLoader(TrajectoryDataset(folder, "training"), BATCH)
    first, *rest = (epoch(loader) for _ in range(4))
    return {
        "files_samples_per_second": round(first),
        "memory_samples_per_second": round(max(rest)),
    }


def main() -> None:
    """Write the data set and measure."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(MESHES):
            write_shard(folder / "training" / f"mesh-{number:04d}.h5", shard(number))
        sizes = [path.stat().st_size for path in folder.glob("*/*.h5")]
        row = measure(folder)
    add(
        "reading", [row],
        graphs=MESHES * SIMULATIONS * STEPS, file_megabytes=round(sum(sizes) / 1e6, 1),
    )  # fmt: skip


if __name__ == "__main__":
    main()

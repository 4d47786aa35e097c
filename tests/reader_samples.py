"""Small synthetic data sets: smooth motions of box meshes, without a solver."""

import numpy as np

from conftest import box_mesh
from pdcorrect.data.schema import Run, Shard, Simulation, write_shard

STEP = 0.02


def moved(points, time, strength):
    """Points twisted about x and stretched along it; unmoved at time 0."""
    x, y, z = points.T
    turn = strength * np.sin(6 * time) * x
    return np.stack(
        [
            x * (1 + 0.2 * np.sin(4 * time)),
            np.cos(turn) * y - np.sin(turn) * z,
            np.sin(turn) * y + np.cos(turn) * z,
        ],
        axis=1,
    )


def simulation(points, steps, seed, models=("plain", "best")):
    """A motion, predictions and rollouts that err at random by about a tenth of it."""
    rng = np.random.default_rng(seed)
    strength = rng.uniform(0.5, 2.0)
    times = STEP * np.arange(steps + 1)
    reference = np.stack([moved(points, t, strength) for t in times])
    runs = {"reference": Run(positions=reference)}
    for name in models:
        error = 0.01 * rng.normal(size=reference.shape)
        error[0] = 0
        runs[name] = Run(reference + error, reference[1:] + error[1:])
    return Simulation(rng.normal(size=(steps, *points.shape)), runs)


def shard(number=0, split="training", cells=(3, 2, 1), steps=(7, 5), models=("plain", "best")):
    """One mesh with simulations of the given numbers of steps."""
    mesh = box_mesh(cells, np.multiply(cells, 0.1), 0.0)
    rng = np.random.default_rng((number, len(split)))
    count, nodes = len(mesh.cells), len(mesh.positions)
    free = np.ones((nodes, 3), dtype=bool)
    free[mesh.positions[:, 0] == 0] = False
    free[-1, 2] = False
    return Shard(
        attributes={
            "dataset": "synthetic", "split": split, "number": number, "setting": "exact",
            "config_hash": "c0ffee", "time_step": STEP, "tolerance": 1e-5,
        },
        points=mesh.positions,
        cells=mesh.cells,
        free=free,
        mass=rng.uniform(0.1, 0.2, nodes),
        young=rng.uniform(1e5, 2e5, count),
        poisson=rng.uniform(0.3, 0.45, count),
        density=rng.uniform(900, 1100, count),
        simulations=tuple(
            simulation(mesh.positions, n, (number, k), models) for k, n in enumerate(steps)
        ),
    )  # fmt: skip


SHAPES = ((3, 2, 1), (2, 2, 2), (4, 1, 1), (1, 1, 1))


def write(folder, shards, dtype="float64"):
    """Write shards to their places in a data set's folder."""
    for one in shards:
        name = f"mesh-{one.attributes['number']:04d}.h5"
        write_shard(folder / one.attributes["split"] / name, one, dtype, overwrite=True)
    return folder


def dataset(folder, splits=("training", "validation", "evaluation"), dtype="float64", **changes):
    """Four meshes a split, of four sizes."""
    for split in splits:
        write(folder, [shard(i, split, cells=c, **changes) for i, c in enumerate(SHAPES)], dtype)
    return folder

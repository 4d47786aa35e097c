"""Small data sets made up without a solver: smooth motions, errors of known size."""

from dataclasses import replace

import numpy as np

import pdcorrect as pc
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.data.schema import Run, Shard, Simulation, write_shard
from pdcorrect.data.simulate import arrays_of

CONFIG = {
    "name": "sample",
    "seed": 7,
    "family": "cross",
    "setting": "exact",
    "coarse_nodes": (63, 144),
    "cell_size": 0.05,
    "step": 0.01,
    "frames": 5,
    "material": {"young": (1e5, 1e6), "poisson": (0.3, 0.45), "density": (900.0, 1100.0)},
    "motion": {"kind": "torsion", "strength": (10.0, 20.0)},
    "training": {"meshes": 3, "simulations": 6},
    "evaluation": {"meshes": 1, "simulations": 2},
    "reference": {"refine": 2},
    "validation_share": 0.34,
}
"""Two training meshes, one of validation and one of evaluation, with two simulations each."""


def sample_config(**changes):
    """`CONFIG` with changes."""
    return DatasetConfig(**{**CONFIG, **changes})


def sample_shard(config, mesh):
    """The file of a `MeshPlan`, with the mesh's own streams of random numbers."""
    problem = pc.discretise(draw_scene(config, mesh, 0))
    return Shard(
        attributes={
            "dataset": config.name, "split": mesh.split, "number": mesh.number,
            "setting": config.setting, "config_hash": config.hash(), "time_step": mesh.step,
            "tolerance": config.tolerance,
        },
        **arrays_of(problem),
        simulations=tuple(
            sample_simulation(config, mesh, problem, k) for k in range(mesh.simulations)
        ),
        provenance={"pdcorrect": "0", "date": "2026-01-01"},
    )  # fmt: skip


def sample_simulation(config, mesh, problem, number):
    """A reference, a plain run with half its displacement and a better one with 0.9 of it."""
    rng = np.random.default_rng((*mesh.stream, 99, number))
    motion = smooth_motion(problem, mesh.frames, rng)
    rest = problem.positions
    scene = draw_scene(config, mesh, number, attempt=1)
    loaded, h = problem.with_loads(scene.loads), mesh.step
    return Simulation(
        forces=np.stack([loaded.external_forces(k * h, (k + 1) * h) for k in range(mesh.frames)]),
        runs={
            "reference": sample_run(rest + motion, rng, refine=mesh.refine),
            "plain": sample_run(
                rest + 0.5 * motion, rng, predictions=(rest + 0.8 * motion)[1:], refine=1
            ),
            "best": sample_run(
                rest + 0.9 * motion, rng, predictions=(rest + 0.95 * motion)[1:], refine=1
            ),
        },
        scene_toml=scene.to_toml(),
        attempt=1,
        rejected=("reference, cells inverted at step 3",),
        seconds={"reference": 4.0, "plain": 0.25, "plain steps": 0.5},
    )


def smooth_motion(problem, frames, rng):
    """Displacements (T+1, N, 3), m, from zero on, none of nodes that are held."""
    times = np.arange(frames + 1)[:, None, None] / frames
    x = problem.positions / np.ptp(problem.positions, axis=0)
    waves = np.sin(x @ rng.normal(size=(3, 3)) + rng.uniform(0, 6, 3))
    return 0.02 * np.sin(rng.uniform(1, 3) * times) * (x[:, :1] * waves) * problem.free


def sample_run(positions, rng, predictions=None, **attributes):
    """A run with made-up statistics and attributes."""
    steps = len(positions) - 1
    return Run(
        positions=positions,
        predictions=predictions,
        statistics={
            "iterations": rng.integers(5, 30, steps),
            "error_estimates": rng.uniform(1e-9, 4e-7, steps),
            "smallest_volume_ratios": rng.uniform(0.5, 0.9, steps),
        },
        attributes={"solver": "pd", "time_step": 0.01, **attributes},
    )


def write_dataset(folder, config=None, dtype="float32"):
    """A whole sample data set; returns its configuration."""
    config = config or sample_config()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.toml").write_text(config.to_toml(), encoding="utf-8")
    for mesh in make_plan(config):
        write_shard(folder / f"{mesh.name}.h5", sample_shard(config, mesh), dtype)
    return config


def with_run(shard, number, name, **changes):
    """The shard with changes to one run of one simulation."""
    simulation = shard.simulations[number]
    runs = {**simulation.runs, name: replace(simulation.runs[name], **changes)}
    return with_simulation(shard, number, runs=runs)


def with_simulation(shard, number, **changes):
    """The shard with changes to one simulation."""
    simulations = list(shard.simulations)
    simulations[number] = replace(simulations[number], **changes)
    return replace(shard, simulations=tuple(simulations))

"""A twisting and stretching cross, given by a formula: trajectories without a solver."""

from dataclasses import replace

import numpy as np

from pdcorrect.fem.mesh import refine as cut
from pdcorrect.fem.mesh import voxel_mesh
from pdcorrect.scene import Cross
from pdcorrect.state import Status
from pdcorrect.trajectory import Trajectory


def cross_mesh(refine=1):
    """14 coarse cells, not symmetric in any direction."""
    body = Cross(
        shape="cross", cell_size=0.05, cells=(6, 1, 2), arms=2, arm_start=3, arm_width=1,
        arm_length=2,
    )  # fmt: skip
    return cut(voxel_mesh(*body.occupancy(), 0.05), refine)


def moved(points, time, angle):
    """Points twisted about x by up to ``angle`` (rad) and stretched along it."""
    x, y, z = points.T
    turn = angle * np.sin(6.0 * time) * x / 0.3
    y0, z0 = y - 0.02, z - 0.05
    return np.stack(
        [
            x * (1 + 0.2 * np.sin(4.0 * time)),
            0.02 + np.cos(turn) * y0 - np.sin(turn) * z0,
            0.05 + np.sin(turn) * y0 + np.cos(turn) * z0,
        ],
        axis=1,
    )


def trajectory(frames=6, refine=1, angle=0.9, step=0.02, seed=0):
    """``frames`` steps of the moving cross with made-up statistics."""
    mesh = cross_mesh(refine)
    times = step * np.arange(frames + 1)
    positions = np.stack([moved(mesh.positions, t, angle) for t in times])
    rng = np.random.default_rng(seed)
    stats = {
        "status": rng.choice(list(Status.__members__), size=frames),
        "iterations": rng.integers(1, 90, size=frames),
    }
    numbers = ("residual", "error_estimate", "seconds")
    energies = ("kinetic_energy", "elastic_energy", "external_work")
    stats |= {name: rng.random(frames) for name in numbers + energies}
    return Trajectory(
        positions,
        rng.normal(size=positions.shape),
        times,
        stats,
        mesh.positions,
        mesh.cells,
        scene_toml='name = "moving cross, ν = 0.4"\n',
        attributes={"refine": str(refine), "solver": "formula"},
    )


def remembering(run, first=2):
    """The same run with accelerations from frame ``first`` on."""
    noise = np.random.default_rng(7).normal(size=run.positions.shape)
    noise[:first] = np.nan
    return replace(run, memory={"acceleration": noise})


def assert_same(found, expected, frames=None):
    """Bit-equal arrays; ``frames`` leading ones of ``expected`` (default: all)."""
    frames = len(expected.times) if frames is None else frames
    assert list(found.memory) == list(expected.memory)
    for name, values in expected.memory.items():
        assert found.memory[name].tobytes() == values[:frames].tobytes(), name
    for name in ("positions", "velocities", "times"):
        array, wanted = getattr(found, name), getattr(expected, name)[:frames]
        assert array.dtype == wanted.dtype
        assert array.shape == wanted.shape
        assert array.tobytes() == wanted.tobytes(), name
    assert found.points.tobytes() == expected.points.tobytes()
    np.testing.assert_array_equal(found.cells, expected.cells)
    assert set(found.stats) == set(expected.stats)
    for name, values in expected.stats.items():
        np.testing.assert_array_equal(found.stats[name], values[: frames - 1])
        assert found.stats[name].dtype.kind == values.dtype.kind
    assert found.scene_toml == expected.scene_toml
    assert dict(found.attributes) == dict(expected.attributes)

"""A data set of a body from a mesh file needs neither that file nor its old place."""

import shutil
from dataclasses import replace

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import CLAMPED, GRAVITY, box_mesh
from pdcorrect.data.check import check_dataset
from pdcorrect.data.import_files import shard_from_trajectories
from pdcorrect.data.importing import portable
from pdcorrect.data.schema import read_shard, write_shard
from pdcorrect.data.simulate import discretise_stored, rebuilt_problems
from pdcorrect.errors import InputError, MeshError
from pdcorrect.scene import trained_coarse

SPLITS = {"training": -9.81, "validation": -7.0, "evaluation": -12.0}
"""Gravity, m/s2, of each split's only simulation."""


def scene_of(mesh_file, gravity):
    return pc.Scene(
        name="bracket",
        body={"shape": "file", "path": str(mesh_file), "scale": 1e-3},
        material={"young": 2e5, "poisson": 0.4, "density": 1e3},
        time={"step": 0.01, "frames": 3, "integrator": "backward-euler"},
        clamps=CLAMPED,
        loads=[{**GRAVITY[0], "acceleration": [0.0, 0.0, gravity]}],
    )


def shard_of(mesh_file, split):
    """One simulation of a body whose cells are no grid, all runs but the finest."""
    scene = scene_of(mesh_file, SPLITS[split])
    fine, plain = (
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(each, refine=refine)))
        for each, refine in ((trained_coarse(scene), 2), (scene, 1))
    )
    return shard_from_trajectories(fine, plain, dataset="bracket", split=split, best=True)


@pytest.fixture(scope="module")
def mesh_file(tmp_path_factory):
    mesh = box_mesh((3, 2, 2), (90.0, 50.0, 40.0), distortion=0.2)
    path = tmp_path_factory.mktemp("meshes") / "bracket.vtu"
    meshio.write(path, meshio.Mesh(mesh.positions, [("hexahedron", mesh.cells)]))
    return path


@pytest.fixture(scope="module")
def moved(mesh_file, tmp_path_factory):
    """A data set that was moved, when its mesh file was already gone."""
    root = tmp_path_factory.mktemp("sets")
    copy = root / mesh_file.name
    shutil.copy(mesh_file, copy)
    for split in SPLITS:
        write_shard(root / "made" / split / "mesh-0000.h5", shard_of(copy, split))
    copy.unlink()
    (root / "other").mkdir()
    return (root / "made").rename(root / "other" / "moved")


def test_a_moved_data_set_is_sound_and_does_not_depend_on_where_the_mesh_file_lay(
    mesh_file, moved, tmp_path
):
    assert {finding.severity for finding in check_dataset(moved)} <= {"warning"}
    again = write_shard(tmp_path / "shard.h5", shard_of(mesh_file, "training"))
    shard = read_shard(moved / "training" / "mesh-0000.h5")
    assert write_shard(tmp_path / "again.h5", shard) == again
    text = shard.simulations[0].scene_toml
    assert 'path = "bracket.vtu"' in text
    assert str(moved.parent.parent) not in text
    assert portable(pc.Scene.from_toml(text)).to_toml() == text


@pytest.mark.parametrize("key", ["clamps", "loads", "materials"])
def test_groups_of_the_mesh_file_are_refused(mesh_file, key):
    region = {"group": "foot"}
    part = {
        "clamps": {"region": region},
        "loads": {"kind": "traction", "traction": [1.0, 0, 0], "region": region},
        "materials": {"region": region, "young": 1.0},
    }[key]
    scene = scene_of(mesh_file, -9.81)
    with pytest.raises(InputError, match=rf"{key}\[0\].region.group = 'foot'"):
        portable(scene.with_changes(**{key: [part]}))


@pytest.mark.parametrize("run", ["plain", "best", "reference"])
def test_problems_are_rebuilt_on_the_mesh_of_the_file(mesh_file, moved, run):
    path = moved / "evaluation" / "mesh-0000.h5"
    shard = read_shard(path)
    (problem,) = rebuilt_problems(shard, path, run)
    scene = scene_of(mesh_file, SPLITS["evaluation"])
    expected = pc.discretise(scene if run == "plain" else trained_coarse(scene))
    if run == "reference":  # imported: as fine as nobody says, so on the coarse mesh
        expected = pc.discretise(scene)
    np.testing.assert_array_equal(problem.positions, expected.positions)
    np.testing.assert_array_equal(problem.cells, expected.cells)
    np.testing.assert_array_equal(problem.mass, expected.mass)
    if run != "reference":
        first = pc.ProjectiveDynamics(problem)(problem.rest_state()).state.positions
        stored = shard.simulations[0].runs[run].positions[1]
        np.testing.assert_allclose(first, stored, atol=1e-7)


def test_scenes_with_an_absolute_path_are_read_and_those_taken_out_ask_for_their_mesh(
    moved, tmp_path
):
    path = moved / "training" / "mesh-0000.h5"
    shard = read_shard(path)
    (simulation,) = shard.simulations
    old = simulation.scene_toml.replace("bracket.vtu", "/nowhere/bracket.vtu")
    assert old != simulation.scene_toml
    before = replace(shard, simulations=(replace(simulation, scene_toml=old),))
    (problem,) = rebuilt_problems(before, path)
    np.testing.assert_array_equal(problem.positions, shard.points)

    shard = read_shard(moved / "training" / "mesh-0000.h5")
    scene = pc.Scene.from_toml(shard.simulations[0].scene_toml)
    with pytest.raises(MeshError, match=r"bracket\.vtu"):
        pc.discretise(scene)
    fine = discretise_stored(scene, shard, refine=2)
    assert len(fine.cells) == 8 * len(shard.cells)


def test_a_moved_data_set_is_trained_on_and_judged(moved, tmp_path):
    pytest.importorskip("torch_geometric")
    import training_samples as samples
    from pdcorrect.evaluation.evaluation import evaluate, saved_candidates
    from pdcorrect.training.training import Training

    settings = samples.config(
        samples.one_step(iterations=2), samples.unrolled(iterations=1), base="best"
    )
    training = Training(settings, moved, tmp_path / "out")
    assert training.run()
    assert np.isfinite(training.progress.metrics["omega_mean"])
    (saved,) = saved_candidates([tmp_path / "out" / "model"], gate=None)
    runs = evaluate([saved], moved).runs
    assert len(runs) > 2
    assert all(np.isfinite(run.values("omega")[0]).all() for run in runs.values())

"""`pdcorrect export`: run files for ParaView, with stresses where the file allows them."""

import dataclasses
import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli.common import BAD_INPUT, FAILED
from pdcorrect.errors import InputError, MeshError
from pdcorrect.fem.mesh_files import write_vtu
from pdcorrect.io.trajectory_reader import problem_of
from pdcorrect.io.vtk import write_vtu_series


def stored(tmp_path, scene, refine=1, name="run.h5"):
    """A run in a file, and what it was of."""
    problem = pc.discretise(scene, refine)
    pc.save_trajectory(tmp_path / name, pc.rollout(pc.ProjectiveDynamics(problem)), overwrite=True)
    return tmp_path / name, problem


@pytest.fixture
def short():
    return beam((3, 2, 1), time={"frames": 4})


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean", "hex27"])
def test_a_run_file_becomes_a_series_with_stresses(program, short, tmp_path, element):
    scene = short.with_changes(solver={"element": element})
    path, problem = stored(tmp_path, scene, refine=2)
    folder = tmp_path / "new" / "folder"
    status, out, err = program("export", path, "-o", folder)
    assert (status, err) == (0, "")
    assert f"wrote {folder / 'run.pvd'}" in out
    run = pc.load_trajectory(path)
    for frame, positions in enumerate(run.positions):
        data = meshio.read(folder / f"run_{frame:04d}.vtu")
        np.testing.assert_array_equal(data.points, positions)
        np.testing.assert_array_equal(data.point_data["velocity"], run.velocities[frame])
        found = pc.stress(problem, positions)
        volumes = found.weights[..., None, None]
        mean = (volumes * found.cauchy).sum(axis=1) / volumes.sum(axis=1)
        deviator = mean - np.trace(mean, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        expected = np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2)))
        (cells,) = data.cell_data["cell_von_mises"]
        np.testing.assert_allclose(cells, expected, rtol=1e-9, atol=1e-6)
        (ratios,) = data.cell_data["smallest_volume_ratio"]
        assert ratios.shape == (len(problem.cells),)
        if frame:
            assert ratios.min() == run.stats["smallest_volume_ratio"][frame - 1]
    assert cells.max() > 100.0
    assert np.ptp(ratios) > 1e-6


def test_every_second_frame_and_no_stresses_if_asked(program, short, tmp_path):
    path, _ = stored(tmp_path, short)
    arguments = ("-o", tmp_path / "out", "--every", 2, "--no-stress")
    status, _, _ = program("export", path, *arguments)
    assert status == 0
    entries = ET.parse(tmp_path / "out" / "run.pvd").getroot().findall("Collection/DataSet")
    assert [e.get("file") for e in entries] == [f"run_{k:04d}.vtu" for k in (0, 2, 4)]
    data = meshio.read(tmp_path / "out" / "run_0004.vtu")
    assert set(data.point_data) == {"displacement", "velocity"}
    assert not data.cell_data
    for name in ("a[1].h5", "a1.h5"):  # several runs share a folder
        path, _ = stored(tmp_path, short, name=name)
        assert program("export", path, "-o", tmp_path / "out", "--no-stress")[0] == 0
    again = ("export", tmp_path / "a[1].h5", "-o", tmp_path / "out", "--every", 4)
    assert program(*again)[0] == FAILED
    assert program(*again, "--overwrite")[0] == 0
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert {n for n in names if n.startswith("a[1]_")} == {"a[1]_0000.vtu", "a[1]_0004.vtu"}
    assert sum(n.startswith("a1_") for n in names) == 5


def test_files_that_are_no_runs_and_folders_that_cannot_be_made_are_refused(
    program, short, tmp_path
):
    path, _ = stored(tmp_path, short)
    cut = tmp_path / "cut.h5"
    cut.write_bytes(path.read_bytes()[:-1000])
    (tmp_path / "scene.toml").write_text(short.to_toml())
    for given in (tmp_path / "none.h5", tmp_path / "scene.toml", cut):
        status, out, err = program("export", given, "-o", tmp_path / "out")
        assert status == BAD_INPUT
        assert given.name in err
        assert "Traceback" not in out + err
        assert not (tmp_path / "out").exists()
    assert program("export", path)[0] == BAD_INPUT
    assert program("export", path, "-o", tmp_path / "out", "--every", 0)[0] == BAD_INPUT
    (tmp_path / "file").write_text("")
    for folder in ("file/out", "file"):
        status, _, err = program("export", path, "-o", tmp_path / folder)
        assert status == FAILED
        assert folder in err


def test_what_survives_of_a_file_is_written_if_asked(program, short, tmp_path):
    path, _ = stored(tmp_path, short.with_changes(time={"frames": 60}))
    path.write_bytes(path.read_bytes()[: int(0.7 * path.stat().st_size)])
    status, _, err = program("export", path, "-o", tmp_path / "out")
    assert status == BAD_INPUT
    left = len(pc.load_trajectory(path, salvage=True))
    assert 0 < left < 60
    assert f" {left} steps" in err
    arguments = ("-o", tmp_path / "out", "--salvage", "--no-stress")
    assert program("export", path, *arguments)[0] == 0
    assert len(list((tmp_path / "out").glob("run_*.vtu"))) == left + 1


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_a_run_of_another_total_mass_has_its_stresses(program, short, tmp_path, element):
    scene = short.with_changes(solver={"element": element})
    problem = pc.discretise(scene).with_total_mass(0.1)
    path, run = tmp_path / "run.h5", pc.rollout(pc.ProjectiveDynamics(problem))
    pc.save_trajectory(path, run)
    assert program("export", path, "-o", tmp_path / "out")[0] == 0
    write_vtu_series(run, tmp_path / "own", stress_of=problem)
    read, own = (meshio.read(tmp_path / f / "run_0004.vtu").point_data for f in ("out", "own"))
    np.testing.assert_array_equal(read["stress"], own["stress"])
    assert read["von_mises"].max() > 100.0
    both = problem.with_material(young=2e6, poisson=0.3)
    assert pc.rollout(pc.ProjectiveDynamics(both), 1).attributes["material"].startswith("changed")


def test_what_a_file_does_not_say_is_told(short, tmp_path):
    path, problem = stored(tmp_path, short, refine=2)
    run = pc.load_trajectory(path)
    assert problem_of(run).refine == 2
    for changes, words in (
        ({"scene_toml": ""}, "scene"),
        ({"scene_toml": "[body"}, "scene"),
        ({"attributes": {**run.attributes, "refine": "two"}}, "'two'"),
        ({"attributes": {**run.attributes, "refine": "1"}}, "mesh"),
        ({"points": run.points + 1e-4}, "mesh"),
        ({"cells": run.cells[::-1]}, "mesh"),
    ):
        with pytest.raises(InputError, match=words):
            problem_of(dataclasses.replace(run, **changes))
    part = pc.restrict(run, to=pc.discretise(short))
    with pytest.raises(InputError, match="nodes"):
        problem_of(part)
    fresh = pc.rollout(pc.ProjectiveDynamics(problem), 1)
    assert problem_of(fresh) is problem


def test_runs_whose_mesh_file_is_gone_or_of_another_material_are_written_without_stresses(
    program, short, tmp_path
):
    mesh = pc.discretise(short).mesh
    write_vtu(tmp_path / "mesh.vtu", mesh.positions, mesh.cells)
    body = {"shape": "file", "path": str(tmp_path / "mesh.vtu")}
    scene = pc.Scene(**{**short.model_dump(exclude_none=True, by_alias=True), "body": body})
    path, problem = stored(tmp_path, scene)
    run = pc.load_trajectory(path)
    np.testing.assert_array_equal(problem_of(run).positions, problem.positions)
    (tmp_path / "mesh.vtu").unlink()
    with pytest.raises(MeshError, match="mesh.vtu"):
        problem_of(run)
    status, _, _ = program("export", path, "-o", tmp_path / "out")
    assert status == 0
    assert (tmp_path / "out" / "run_0001.vtu").exists()
    other = pc.discretise(short).with_material(young=2e6, poisson=0.3)
    path = tmp_path / "other.h5"
    pc.save_trajectory(path, pc.rollout(pc.ProjectiveDynamics(other)))
    status, out, _ = program("export", path, "-o", tmp_path / "out")
    assert status == 0
    assert "material" in out
    assert set(meshio.read(tmp_path / "out" / "other_0001.vtu").point_data) == {
        "displacement", "velocity"
    }  # fmt: skip

"""VTU and PVD files for ParaView, and meshes from files."""

import dataclasses
import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from motion import trajectory
from pdcorrect.errors import InputError, MeshError, OutputError
from pdcorrect.fem.mesh_files import read_hex_mesh, write_vtu
from pdcorrect.io.vtk import delete_vtu_series, write_vtu_series


@pytest.fixture(scope="module")
def run():
    return trajectory(frames=5)


def test_paraview_reads_back_every_frame(run, tmp_path):
    pv = pytest.importorskip("pyvista")
    path = write_vtu_series(run, tmp_path / "new" / "folder")
    reader = pv.get_reader(path)
    np.testing.assert_allclose(reader.time_values, run.times, rtol=1e-11)
    for frame, time in enumerate(reader.time_values):
        reader.set_active_time_value(time)
        grid = reader.read()[0]
        np.testing.assert_array_equal(grid.points, run.positions[frame])
        np.testing.assert_array_equal(grid.cells_dict[pv.CellType.HEXAHEDRON], run.cells)
        np.testing.assert_array_equal(grid["displacement"], run.positions[frame] - run.points)
        np.testing.assert_array_equal(grid["velocity"], run.velocities[frame])
        if frame == 0:
            # a wrong node order would show as negative volumes
            volumes = grid.compute_cell_sizes()["Volume"]
            np.testing.assert_allclose(volumes, 0.05**3, rtol=1e-12)


def test_the_collection_names_existing_files_and_times(run, tmp_path):
    path = write_vtu_series(run, tmp_path, every=2, name="cross")
    entries = ET.parse(path).getroot().findall("Collection/DataSet")
    times = [float(e.get("timestep")) for e in entries]
    np.testing.assert_allclose(times, run.times[::2], rtol=1e-11)
    assert [e.get("file") for e in entries] == [f"cross_{k:04d}.vtu" for k in (0, 2, 4)]
    assert {p.name for p in tmp_path.iterdir()} == {"cross.pvd", *(e.get("file") for e in entries)}
    times = 0.1 * np.arange(len(run.times))  # 0.30000000000000004
    path = write_vtu_series(
        dataclasses.replace(run, times=times), tmp_path,
        point_data=lambda frame: {"error": np.full(len(run.points), 1.0 * frame)},
        cell_data=lambda frame: {"number": np.arange(len(run.cells)) + frame},
    )  # fmt: skip
    entries = ET.parse(path).getroot().findall("Collection/DataSet")
    assert [e.get("timestep") for e in entries] == ["0", "0.1", "0.2", "0.3", "0.4", "0.5"]
    mesh = meshio.read(tmp_path / "run_0005.vtu")
    assert (mesh.point_data["error"] == 5.0).all()
    np.testing.assert_array_equal(mesh.cell_data["number"][0], np.arange(len(run.cells)) + 5)


def test_a_series_replaces_no_other_of_a_longer_name(run, tmp_path):
    others = ("run_2026", "run_0001_b", "run_", "a.run")
    for name in ("run", *others):
        write_vtu_series(run, tmp_path, name=name)
    before = {path.name for path in tmp_path.iterdir()}
    write_vtu_series(run, tmp_path, every=5)
    gone = {f"run_{k:04d}.vtu" for k in range(1, 5)}
    assert before - {path.name for path in tmp_path.iterdir()} == gone
    delete_vtu_series(tmp_path, "run")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {n for n in before if n.startswith(tuple(f"{o}_0" for o in others))} | {
        f"{other}.pvd" for other in others
    }


@pytest.mark.parametrize("damage", ["nan", "mesh"])
def test_what_is_refused_leaves_the_old_series(run, tmp_path, damage):
    path = write_vtu_series(run, tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    if damage == "nan":
        positions = run.positions.copy()
        positions[3, 0, 0] = np.nan
        bad, problem, words = dataclasses.replace(run, positions=positions), None, "frame 3"
    else:
        bad, problem, words = run, pc.discretise(beam((2, 1, 1))), ".* 12 nodes"
    with pytest.raises(InputError, match=f"run: {words}"):
        write_vtu_series(bad, path.parent, every=2, stress_of=problem)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    blocked = tmp_path / "file"
    blocked.write_text("")
    for folder in (blocked, blocked / "sub"):
        with pytest.raises(OutputError, match="file"):
            write_vtu_series(run, folder)

    def stops(frame):
        if frame == 2:
            raise KeyboardInterrupt
        return {}

    with pytest.raises(KeyboardInterrupt):  # which leaves no collection
        write_vtu_series(run, tmp_path, point_data=stops)
    assert not list(tmp_path.glob("*.pvd"))
    assert len(list(tmp_path.glob("*.vtu"))) == len(run.times)


@pytest.mark.parametrize("element", ["hex8", "hex27"])
def test_the_stress_of_a_stretched_body_is_written_by_component(element, tmp_path):
    problem = pc.discretise(
        beam((2, 1, 1), clamps=[], loads=[], poisson=0.3, solver={"element": element})
    )
    F = np.eye(3) + 1e-4 * np.array([[1.0, 4.0, 6.0], [4.0, 2.0, 5.0], [6.0, 5.0, 3.0]])
    moved = pc.State(problem.positions @ F.T, np.zeros_like(problem.positions))
    run = pc.rollout(pc.Newton(problem), frames=1, state=moved)
    write_vtu_series(run, tmp_path, stress_of=run.problem)
    data = meshio.read(tmp_path / "run_0000.vtu").point_data
    expected = 2 * problem.materials.mu[0] * 1e-4 * np.array([1, 2, 3, 4, 5, 6])
    expected[:3] += problem.materials.volume_weight[0] / 3 * 6e-4
    np.testing.assert_allclose(data["stress"], np.tile(expected, (len(run.points), 1)), rtol=3e-3)
    shear = expected[:3] - expected[:3].mean()
    invariant = np.sqrt(1.5 * ((shear**2).sum() + 2 * (expected[3:] ** 2).sum()))
    np.testing.assert_allclose(data["von_mises"], invariant, rtol=3e-3)
    write_vtu_series(run, tmp_path)
    assert set(meshio.read(tmp_path / "run_0000.vtu").point_data) == {"displacement", "velocity"}


def test_a_failed_write_leaves_the_old_file(run, tmp_path, monkeypatch):
    path = tmp_path / "a.vtu"
    path.write_text("old")

    def fails(name, *rest, **named):
        with open(name, "w") as file:
            file.write("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(meshio, "write", fails)
    with pytest.raises(OutputError, match="No space left"):
        write_vtu(path, run.points, run.cells)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# --- meshes from files -----------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.vtu", "a.msh", "a.inp", "a.xyz", "noname"])
@pytest.mark.parametrize("text", ["", "nonsense\n1 2 3\n", "*NODE\n1, a, b\n$MeshFormat\n9 9 9\n"])
def test_unreadable_files_are_refused_quietly(tmp_path, capfd, name, text):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(MeshError):
        read_hex_mesh(path)
    with pytest.raises(MeshError):
        read_hex_mesh(tmp_path / ("no" + name))
    assert capfd.readouterr() == ("", "")

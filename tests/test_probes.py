"""Probes and runs that start from another one's frame: places, interpolation, files, bad input."""

import csv
import shutil

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli.program import app
from pdcorrect.errors import PdcorrectWarning, SceneError
from pdcorrect.fem.locate import locate, trilinear
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.probes import probe_weights

PLACES = [
    {"name": "inside", "point": [0.031, 0.007, 0.011]},
    {"name": "corner", "point": [0.06, 0.0, 0.04]},
    {"name": "end", "region": {"plane": "x", "at": "max"}},
    {"name": "half", "region": {"box": [[0, 0, 0], [0.06, 0.02, 0.02]]}},
    {"name": "two", "region": {"nodes": [0, 3]}},
]
SPOTS = [[0.031, 0.007, 0.011], [0.06, 0, 0.04], [0.06, 0.01, 0.02], [0.03, 0.01, 0.01]]


def probed(**changes):
    return beam((3, 1, 2), **{"loads": [], "probes": PLACES, **changes})


@pytest.mark.parametrize("refine", [1, 2])
@pytest.mark.parametrize("element", ["hex8", "hex8-enhanced", "hex27"])
def test_linear_fields_are_met_exactly(element, refine):
    problem = pc.discretise(probed(), refine, element=element, mass="averaged")
    found = probe_weights(problem, problem.scene.probes) @ problem.positions
    np.testing.assert_allclose(found[:4], SPOTS, atol=1e-12)
    two = problem.positions[problem.mesh.coarse_nodes[[0, 3]]].mean(axis=0)
    np.testing.assert_allclose(found[4], two, atol=1e-12)


def test_quadratic_fields_are_met_exactly_by_cells_with_27_nodes():
    problem = pc.discretise(probed(), element="hex27")
    x, y, z = problem.positions.T
    found = probe_weights(problem, problem.scene.probes) @ (x**2 - 3 * y * z)
    a, b, c = SPOTS[0]
    assert found[0] == pytest.approx(a**2 - 3 * b * c, rel=1e-10)
    assert found[2] == pytest.approx(0.06**2 - 3 * 0.01 * 0.02, rel=1e-10)


@pytest.mark.parametrize("shape", ["graded", "tapered", "distorted"])
def test_points_of_cells_of_unlike_sizes_and_shapes_are_found(shape):
    mesh = pc.discretise(beam((4, 4, 4), body={"cell_size": 1.0}, time={"step": 1.0})).mesh
    rng = np.random.default_rng(3)
    x, y, z = mesh.positions.T
    half = 0.5**z
    positions = {
        "graded": np.stack([x, y, z**4], axis=1),
        "tapered": np.stack([x * half, y * half, z], axis=1),
        "distorted": mesh.positions + 0.15 * rng.uniform(-1, 1, mesh.positions.shape),
    }[shape]
    cells, local = rng.integers(len(mesh.cells), size=200), rng.uniform(size=(200, 3))
    points = np.einsum("pk,pki->pi", trilinear(local), positions[mesh.cells[cells]])
    found, places, distances = locate(positions, mesh.cells, points)
    np.testing.assert_array_equal(found, cells)
    np.testing.assert_allclose(places, local, atol=1e-9)
    assert distances.max() < 5e-11
    assert locate(positions, mesh.cells, points[:1] + 500.0)[2][0] > 100.0


def test_simulate_writes_a_table(tmp_path):
    scene = probed(
        time={"step": 0.01, "frames": 2}, loads=[{"kind": "gravity", "acceleration": [0, 0, -9.81]}]
    )
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    done = CliRunner().invoke(
        app, ["simulate", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "run.h5")]
    )
    assert done.exit_code == 0, done.output
    rows = list(csv.DictReader((tmp_path / "run_probes.csv").open()))
    run = pc.load_trajectory(tmp_path / "run.h5")
    moved = pc.metrics.probes(run, pc.discretise(scene))
    assert [float(row["time"]) for row in rows] == run.times.tolist()
    assert [float(row["end.z"]) for row in rows] == moved["end"][:, 2].tolist()
    assert moved["end"][-1, 2] < 0


def test_a_probe_outside_is_told_before_the_run(tmp_path):
    scene = probed(probes=[{"name": "a", "point": [9, 0, 0]}], time={"step": 0.01, "frames": 2})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    output = tmp_path / "run.h5"
    done = CliRunner().invoke(app, ["simulate", str(tmp_path / "scene.toml"), "-o", str(output)])
    assert isinstance(done.exception, SceneError) or done.exit_code == 2
    assert not output.exists()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ([{"name": "a", "point": [9, 0, 0]}], "point"),
        ([{"name": "a"}], "region"),
        ([{"name": "a", "point": [0, 0, 0], "region": {"everywhere": True}}], "point"),
        ([{"name": "a", "point": [0, 0, 0]}] * 2, "name"),
        ([{"name": "a,b", "point": [0, 0, 0]}], "name"),
        ([{"name": "a", "region": {"sphere": [9, 9, 9], "radius": 0.1}}], "region"),
    ],
)
def test_wrong_probes_are_refused(change, key):
    with pytest.raises(SceneError, match=rf"probes.*{key}"):
        pc.discretise(probed(probes=change))


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    """A short run of a beam under its weight, and its file."""
    scene = beam((3, 1, 2), time={"step": 0.01, "frames": 4})
    run = pc.rollout(pc.Newton(pc.discretise(scene)), frames=4)
    path = tmp_path_factory.mktemp("earlier") / "run.h5"
    pc.save_trajectory(path, run)
    return run, path


def test_a_run_goes_on_from_a_frame_of_another(earlier):
    run, path = earlier
    problem = pc.discretise(probed(initial={"run": str(path), "frame": 2, "velocity": [0, 1, 0]}))
    state = problem.initial_state()
    np.testing.assert_array_equal(state.positions, run.positions[2])
    expected = np.where(problem.free, run.velocities[2] + [0, 1, 0], 0)
    np.testing.assert_array_equal(state.velocities, expected)
    assert state.time == 0


@pytest.mark.parametrize(("refine", "element"), [(2, "hex8"), (1, "hex27")])
def test_finer_meshes_start_from_the_interpolated_motion(earlier, refine, element):
    run, path = earlier
    problem = pc.discretise(probed(initial={"run": str(path)}), refine, element=element)
    state, coarse = problem.initial_state(), problem.mesh.coarse_nodes
    np.testing.assert_allclose(state.positions[coarse], run.positions[-1], atol=1e-12)
    middle = state.positions[problem.cells].mean(axis=(0, 1)) - problem.positions[
        problem.cells
    ].mean(axis=(0, 1))
    of_run = (run.positions[-1] - run.points)[run.cells].mean(axis=(0, 1))
    np.testing.assert_allclose(middle, of_run, atol=1e-9)


def test_other_bodies_frames_and_files_are_refused(earlier, tmp_path):
    _, path = earlier
    longer = beam((4, 1, 2), initial={"run": str(path)})
    with pytest.raises(SceneError, match=r"initial\.run.*outside"):
        pc.discretise(longer).initial_state()
    with pytest.raises(SceneError, match=r"initial\.frame = 7.*-5 to 4"):
        pc.discretise(probed(initial={"run": str(path), "frame": 7})).initial_state()
    with pytest.raises(SceneError, match=r"initial\.run.*read"):
        pc.discretise(probed(initial={"run": str(tmp_path / "none.h5")})).initial_state()
    damaged = tmp_path / "damaged.h5"
    shutil.copy(path, damaged)
    with h5py.File(damaged, "r+") as file:
        del file["positions"]
        file["positions"] = np.zeros((5, 2))
    with pytest.raises(SceneError, match=r"initial\.run.*read"):
        pc.discretise(probed(initial={"run": str(damaged)})).initial_state()
    with pytest.raises(SceneError, match="frame"):
        probed(initial={"frame": 1})
    turned = probed(initial={"run": str(path)}, clamps=[{"region": {"plane": "x", "at": "max"}}])
    with pytest.warns(PdcorrectWarning, match="jump"):
        pc.discretise(turned).initial_state()
    with pytest.warns(PdcorrectWarning, match=r"initial\.run.*other clamps \(1, this one 0\)"):
        pc.discretise(probed(initial={"run": str(path)}, clamps=[])).initial_state()


def test_regions_of_oblique_planes_and_turns_about_any_axis():
    third = [1.0, 1.0, 1.0]
    turn = {"times": [0, 1], "rotation": [0, 120], "axis": third, "centre": [0, 0, 0]}
    regions = {"plane": third, "at": "min"}, {"plane": [0, 0, -1], "at": -0.02}
    scene = beam((1, 1, 1), clamps=[{"region": region, "motion": turn} for region in regions])
    problem = pc.discretise(scene)
    assert (~problem.free).all(axis=1).sum() == 5
    there = problem.clamped_positions(1.0)[~problem.free].reshape(-1, 3)
    rest = problem.positions[~problem.free.any(axis=1)]
    np.testing.assert_allclose(there, rest[:, [2, 0, 1]], atol=1e-15)
    side = np.sqrt(3) * 0.02
    far = beam((1, 1, 1), clamps=[{"region": {"plane": third, "at": side}}])
    assert (~pc.discretise(far).free).all(axis=1).sum() == 1


def test_voxels_come_from_numpy_files(tmp_path):
    solid = np.zeros((3, 2, 2), dtype=np.uint8)
    solid[:, 0] = 7
    np.save(tmp_path / "body.npy", solid)
    body = {"shape": "voxels", "occupancy": "body.npy", "cell_size": 0.1}
    scene = beam().model_dump(mode="python", exclude_unset=True, by_alias=True) | {"body": body}
    text = pc.Scene(**scene).to_toml()
    (tmp_path / "scene.toml").write_text(text)
    mesh = pc.discretise(pc.Scene.load(tmp_path / "scene.toml")).mesh
    assert isinstance(mesh, HexMesh)
    assert len(mesh.cells) == 6
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [0.3, 0.1, 0.2]])
    for name, array in (
        ("float", np.ones((1, 1, 1))),
        ("flat", np.ones((2, 2), int)),
        ("none", 0 * solid),
    ):
        np.save(tmp_path / f"{name}.npy", array)
        with pytest.raises(SceneError, match=r"body\.occupancy"):
            pc.discretise(
                pc.Scene(**scene | {"body": {**body, "occupancy": str(tmp_path / f"{name}.npy")}})
            )
    for content in (b"no array", b"\x93NUMPY\x01\x00\x05\x00{{{{\n"):
        (tmp_path / "text.npy").write_bytes(content)
        with pytest.raises(SceneError, match=r"body\.occupancy.*read"):
            pc.discretise(
                pc.Scene(**scene | {"body": {**body, "occupancy": str(tmp_path / "text.npy")}})
            )

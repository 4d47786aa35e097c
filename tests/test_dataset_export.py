"""Data sets leave for other programs: MeshGraphNet and ParaView."""

import json
import shutil
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ET
from dataclasses import replace

import h5py
import meshio
import numpy as np
import pytest

import pdcorrect as pc
import reader_samples as samples
from conftest import beam, box_mesh
from dataset_samples import sample_config, write_dataset
from pdcorrect.data.export import export_meshgraphnet, export_vtu
from pdcorrect.errors import FileFormatError, InputError, OutputError
from pdcorrect.fem.graph import node_means, tetrahedra


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = samples.dataset(tmp_path_factory.mktemp("set"), steps=(4, 4))
    return samples.write(root, [samples.shard(0, "longer", steps=(6,))])


@pytest.fixture(scope="module")
def exported(folder, tmp_path_factory):
    target = tmp_path_factory.mktemp("exported")
    return export_meshgraphnet(folder, target), target


# --- MeshGraphNet ----------------------------------------------------------------------


def test_each_split_becomes_a_file_under_its_usual_name_read_without_this_package(exported):
    written, target = exported
    names = {"train.h5", "valid.h5", "test.h5", "longer.h5", "meta.json", "meta-longer.json"}
    assert {path.name for path in written} == {path.name for path in target.iterdir()} == names

    script = f"""
        import sys
        sys.modules["pdcorrect"] = None
        import h5py, json, numpy
        meta = json.load(open({str(exported[1] / "meta.json")!r}))
        file = h5py.File({str(exported[1] / "train.h5")!r})
        frame = {{k: file["0"][k][2] for k in meta["field_names"]}}
        print(frame["world_pos"].shape, frame["cells"].max())
    """
    out = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True
    )
    assert out.stdout == "(24, 3) 23\n"


@pytest.mark.parametrize(("name", "meta"), [("train", "meta"), ("longer", "meta-longer")])
def test_fields_are_those_that_the_description_promises(exported, name, meta):
    meta = json.loads((exported[1] / f"{meta}.json").read_text())
    assert meta["field_names"] == list(meta["features"])
    assert meta["simulator"] == "pdcorrect"
    with h5py.File(exported[1] / f"{name}.h5") as file:
        assert list(file) == [str(i) for i in range(len(file))]
        for group in file.values():
            assert set(group) == set(meta["field_names"])
            for field, feature in meta["features"].items():
                frames, rows, width = group[field].shape
                assert frames == meta["trajectory_length"]
                assert group[field].dtype == feature["dtype"]
                assert feature["shape"][1:] == [-1, width]
                assert feature["shape"][0] == (frames if feature["type"] == "dynamic" else 1)
                if feature["type"] == "static":
                    assert (group[field][:] == group[field][:1]).all()
                if "pos" in field:
                    assert rows == group["node_type"].shape[1]


def test_values_are_those_of_the_data_set(exported):
    shard = samples.shard(1, "evaluation", cells=samples.SHAPES[1], steps=(4, 4))
    simulation = shard.simulations[1]
    truth, plain = simulation.runs["reference"].positions, simulation.runs["plain"]
    with h5py.File(exported[1] / "test.h5") as file:
        group = {name: values[()] for name, values in file["3"].items()}
    for name, expected in {
        "world_pos": truth,
        "mesh_pos": np.broadcast_to(shard.points, truth.shape),
        "base_pos": np.concatenate([plain.predictions, truth[-1:]]),
        "forces": np.concatenate([simulation.forces, 0 * truth[:1]]),
    }.items():
        np.testing.assert_array_equal(group[name], expected.astype(np.float32))
    young = node_means(shard.young, shard.cells, len(shard.points))
    np.testing.assert_allclose(group["young"][0, :, 0], young, rtol=1e-6)
    held = ~shard.free.any(axis=1)
    assert held.any()
    assert (group["node_type"][0, :, 0] == np.where(held, 3, 0)).all()
    assert (group["free"][0] == shard.free).all()
    assert (group["hexahedra"][0] == shard.cells).all()
    assert (group["cells"][0] == tetrahedra(shard.cells)).all()


@pytest.mark.parametrize("seed", range(4))
def test_tetrahedra_fill_the_cells_and_meet_face_to_face(seed):
    mesh = box_mesh((3, 2, 2), (0.3, 0.2, 0.2), 0.1, seed)
    order = np.random.default_rng(seed).permutation(len(mesh.positions))
    points, cells = mesh.positions[np.argsort(order)], order[mesh.cells]
    found = tetrahedra(cells)
    a, b, c, d = np.moveaxis(points[found], 1, 0)
    volumes = np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) / 6
    assert (volumes > 0).all()
    np.testing.assert_allclose(volumes.sum(), 0.3 * 0.2 * 0.2)
    corners = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    triangles = np.sort(found[:, corners].reshape(-1, 3), axis=1)
    _, counts = np.unique(triangles, axis=0, return_counts=True)
    assert set(counts) == {1, 2}
    assert (counts == 1).sum() == 2 * 2 * (3 * 2 + 3 * 2 + 2 * 2)  # two on each outer face


def test_what_cannot_be_exported_is_refused_and_leaves_no_file(folder, tmp_path):
    samples.write(tmp_path / "set", [samples.shard(steps=(3, 4))])
    samples.write(tmp_path / "bare", [samples.shard(steps=(4,), models=())])
    for source, options, words in (
        (folder, {"base": "fine"}, "'fine'"),
        (folder, {"split": "test"}, "'test'"),
        (tmp_path / "set", {}, "simulation 1: 4 steps"),
        (tmp_path / "bare", {}, "'plain'"),
        (tmp_path, {}, tmp_path.name),
    ):
        with pytest.raises(InputError, match=words):
            export_meshgraphnet(source, tmp_path / "out", **options)
    for source, arguments, words in (
        (folder, ("evaluation", 2, 2), "simulation = 2"),
        (folder, ("evaluation", 7, 0), r"mesh-0007\.h5"),
        (folder, ("test", 0, 0), "'test'"),
        (folder, ("evaluation", 0, 0, ["fine"]), "'fine'"),
        (tmp_path / "bare", ("training", 0, 0, ["plain"]), "'plain'"),
    ):
        with pytest.raises(InputError, match=words):
            export_vtu(source, tmp_path / "out", *arguments)
    assert not (tmp_path / "out").exists()
    (written,) = export_vtu(tmp_path / "bare", tmp_path / "vtu", "training", 0, 0)
    assert written.name == "training-0000-0-reference.pvd"
    assert len(list((tmp_path / "vtu").iterdir())) == 1 + 5


# --- ParaView --------------------------------------------------------------------------


def test_vtu_series_hold_motion_error_and_forces(folder, tmp_path):
    written = export_vtu(folder, tmp_path, "evaluation", 2, 1, ["best", "plain"])
    prefix = "evaluation-0002-1"
    assert [path.name for path in written] == [
        f"{prefix}-{name}.pvd" for name in ("reference", "best", "plain")
    ]
    assert {path.name[: len(prefix) + 1] for path in tmp_path.iterdir()} == {f"{prefix}-"}
    shard = samples.shard(2, "evaluation", cells=samples.SHAPES[2], steps=(4, 4))
    simulation = shard.simulations[1]
    truth = simulation.runs["reference"].positions
    for name in ("reference", "best"):
        frames = ET.parse(tmp_path / f"{prefix}-{name}.pvd").getroot().findall(".//DataSet")
        assert [float(f.get("timestep")) for f in frames] == [0.02 * t for t in range(5)]
        positions = simulation.runs[name].positions
        for t in (0, 3):
            mesh = meshio.read(tmp_path / frames[t].get("file"))
            np.testing.assert_allclose(mesh.points, positions[t], atol=1e-15)
            assert (mesh.cells[0].data == shard.cells).all()
            data = mesh.point_data
            np.testing.assert_allclose(data["displacement"], positions[t] - shard.points)
            np.testing.assert_allclose(data["force"], simulation.forces[t - 1] if t else 0)
            assert ("error" in data) == (name == "best")
            if name == "best":
                np.testing.assert_allclose(data["error"], positions[t] - truth[t])
            np.testing.assert_allclose(mesh.cell_data["young"][0], shard.young)


# --- the folder of an export -------------------------------------------------------------


def test_files_of_the_same_names_are_replaced_only_when_asked(folder, tmp_path):
    target = tmp_path / "target"
    export_vtu(folder, target, "evaluation", 2, 1)
    export_vtu(folder, target, "evaluation", 1, 1)  # beside it
    (target / "meta.json").write_text("mine")
    before = {path.name: path.read_bytes() for path in target.iterdir()}
    for again in (
        lambda **options: export_meshgraphnet(folder, target, split="longer", **options),
        lambda **options: export_vtu(folder, target, "evaluation", 2, 1, **options),
    ):
        with pytest.raises(OutputError, match="--overwrite"):
            again()
        assert {path.name: path.read_bytes() for path in target.iterdir()} == before
    written = export_meshgraphnet(folder, target, split="longer", overwrite=True)
    assert {path.name for path in target.iterdir()} == {*before, *(path.name for path in written)}
    assert (target / "meta.json").read_text() != "mine"


def test_files_of_another_export_are_not_mixed_with_new_ones(folder, tmp_path):
    export_meshgraphnet(folder, tmp_path / "target")
    with pytest.raises(OutputError, match="another export"):
        export_meshgraphnet(folder, tmp_path / "target", split="longer", overwrite=True)


def test_an_export_that_fails_leaves_the_earlier_one(folder, tmp_path):
    target = tmp_path / "target"
    written = export_meshgraphnet(folder, target, split="longer")
    assert [path.name for path in written] == ["longer.h5", "meta.json"]
    assert json.loads((target / "meta.json").read_text())["trajectory_length"] == 7
    before = {path.name: path.read_bytes() for path in target.iterdir()}
    root = samples.write(
        tmp_path / "set", [samples.shard(steps=(4,)), samples.shard(1, steps=(4,))]
    )
    damaged = root / "training/mesh-0001.h5"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    for place in (target, tmp_path / "new"):
        with pytest.raises(FileFormatError, match=r"mesh-0001\.h5"):
            export_meshgraphnet(root, place, overwrite=True)
    assert {path.name: path.read_bytes() for path in target.iterdir()} == before
    assert not (tmp_path / "new").exists()


# --- the program -----------------------------------------------------------------------


def test_the_program_imports_and_exports(program, tmp_path):
    scene = beam(cells=(3, 1, 1), time={"frames": 4, "integrator": "backward-euler"})
    for name, refine in (("fine", 2), ("coarse", 1)):
        run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine=refine)))
        pc.save_trajectory(tmp_path / f"{name}.h5", replace(run, scene_toml=scene.to_toml()))
    root, fine = tmp_path / "set", tmp_path / "fine.h5"
    more = ("--coarse", tmp_path / "coarse.h5", "--best")
    assert program("dataset", "import", fine, *more, "-o", root)[0] == 0
    status, _, err = program("dataset", "import", fine, "-o", root, "--split", "train")
    assert status == 0
    assert "'train'" in err  # which training does not read
    shutil.rmtree(root / "train")
    export = ("dataset", "export", root)
    assert program(*export, tmp_path / "mgn")[0] == 0
    assert (tmp_path / "mgn" / "train.h5").exists()
    chosen = ("--to", "vtu", "--split", "training", "--run", "plain")
    assert program(*export, tmp_path / "vtu", *chosen)[0] == 0
    assert len(list((tmp_path / "vtu").glob("*.vtu"))) == 10
    again = (*export, tmp_path / "mgn", "--split", "training")
    assert program(*again)[0] == 1
    assert program(*again, "--overwrite")[0] == 0
    for call in (
        ("export", tmp_path, tmp_path / "out"),
        ("import", tmp_path / "none.npz", "-o", tmp_path / "out"),
        ("import", tmp_path / "none.h5", "-o", tmp_path / "out"),
        ("import", tmp_path / "none.npz", "-o", tmp_path / "out", "--split", "../x"),
    ):
        status, _, err = program("dataset", *call)
        assert status == 2
        assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("layout", "option"),
    [
        ("meshgraphnet", ("--mesh", 0)), ("meshgraphnet", ("--simulation", 1)),
        ("meshgraphnet", ("--run", "plain")), ("vtu", ("--base", "plain")),
    ],
)  # fmt: skip
def test_options_without_use_in_a_layout_are_refused(program, folder, tmp_path, layout, option):
    target = tmp_path / "out"
    status, _, err = program("dataset", "export", folder, target, "--to", layout, *option)
    assert status == 2
    assert option[0] in err
    assert not target.exists()


def test_the_export_of_an_incomplete_data_set_warns(program, tmp_path):
    root = tmp_path / "set"
    write_dataset(root, sample_config())
    status, _, err = program("dataset", "export", root, tmp_path / "whole")
    assert (status, err) == (0, "")
    (root / "training/mesh-0001.h5").unlink()
    status, _, err = program("dataset", "export", root, tmp_path / "part")
    assert status == 0
    assert "lacks 1 files" in err
    status, _, err = program("dataset", "export", root, tmp_path / "one", "--split", "evaluation")
    assert (status, err) == (0, "")

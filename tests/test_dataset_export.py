"""Data sets leave for other programs, and come in from other solvers."""

import json
import re
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
from pdcorrect.data.check import check_dataset
from pdcorrect.data.export import export_meshgraphnet, export_vtu
from pdcorrect.fem.graph import node_means, tetrahedra
from pdcorrect.data.import_files import import_trajectories, shard_from_trajectories
from pdcorrect.data.importing import Motion, shard_from_arrays
from pdcorrect.data.schema import write_shard
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.errors import FileFormatError, InputError, MeshError, OutputError
from pdcorrect.solvers.rollout import restrict


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = samples.dataset(tmp_path_factory.mktemp("set"), steps=(4, 4))
    return samples.write(root, [samples.shard(0, "longer", steps=(6,))])


@pytest.fixture(scope="module")
def exported(folder, tmp_path_factory):
    target = tmp_path_factory.mktemp("exported")
    return export_meshgraphnet(folder, target), target


# --- MeshGraphNet ----------------------------------------------------------------------


def test_each_split_becomes_a_file_under_the_usual_name(exported):
    written, target = exported
    names = {"train.h5", "valid.h5", "test.h5", "longer.h5", "meta.json", "meta-longer.json"}
    assert {path.name for path in written} == {path.name for path in target.iterdir()} == names


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


def test_exports_are_read_without_this_package(exported):
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


def test_what_cannot_be_exported_is_refused_and_leaves_no_file(folder, tmp_path):
    with pytest.raises(
        InputError, match="no predictions of run 'fine': expected one of best, plai"
    ):
        export_meshgraphnet(folder, tmp_path / "a", base="fine")
    assert not (tmp_path / "a").exists()
    samples.write(tmp_path / "set", [samples.shard(steps=(3, 4))])
    with pytest.raises(InputError, match="simulation 1: 4 steps of 0.02 s, unlike the first"):
        export_meshgraphnet(tmp_path / "set", tmp_path / "b")
    with pytest.raises(InputError, match="no data set"):
        export_meshgraphnet(tmp_path / "b", tmp_path / "c")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


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


def test_simulations_that_are_not_there_are_named(folder, tmp_path):
    for arguments, words in (
        (("evaluation", 2, 2), "simulation = 2: mesh 2 of evaluation has 2: expected 0 to 1"),
        (("evaluation", 7, 0), r"evaluation has no mesh-0007\.h5"),
        (("test", 0, 0), "no split 'test'"),
        (("evaluation", 0, 0, ["fine"]), "no positions of run 'fine': expected one of best, plain"),
    ):
        with pytest.raises(InputError, match=words):
            export_vtu(folder, tmp_path / "vtu", *arguments)
    assert not (tmp_path / "vtu").exists()


def test_a_simulation_without_rollouts_gives_its_reference_alone(tmp_path):
    one = samples.shard(steps=(4,), models=())
    root = samples.write(tmp_path / "set", [one])
    (written,) = export_vtu(root, tmp_path / "vtu", "training", 0, 0)
    assert written.name == "training-0000-0-reference.pvd"
    assert len(list((tmp_path / "vtu").iterdir())) == 1 + 5
    with pytest.raises(InputError, match="no positions of run 'plain': expected one of reference"):
        export_vtu(root, tmp_path / "other", "training", 0, 0, ["plain"])
    with pytest.raises(InputError, match="no predictions of run 'plain': the simulation has none"):
        export_meshgraphnet(root, tmp_path / "other")


# --- the folder of an export -------------------------------------------------------------


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_one_split_may_be_exported_alone(folder, tmp_path):
    written = export_meshgraphnet(folder, tmp_path / "one", split="longer")
    assert [path.name for path in written] == ["longer.h5", "meta.json"]
    assert json.loads((tmp_path / "one/meta.json").read_text())["trajectory_length"] == 7
    with pytest.raises(InputError, match="no split 'test': expected one of training"):
        export_meshgraphnet(folder, tmp_path / "other", split="test")


def test_an_export_does_not_mix_with_another(folder, exported, tmp_path):
    target = tmp_path / "target"
    export_meshgraphnet(folder, target)
    (target / "notes.json").write_text('{"mine": 1}')
    (target / "mine.vtu").write_text("mine")
    shutil.copy(folder / "training/mesh-0000.h5", target / "mine.h5")
    mine = {"notes.json", "mine.vtu", "mine.h5"}
    for again in (
        lambda **options: export_meshgraphnet(folder, target, split="longer", **options),
        lambda **options: export_vtu(folder, target, "evaluation", 2, 1, **options),
        lambda **options: export_vtu(folder, target, "evaluation", 1, 1, **options),
    ):
        before = names(target)
        with pytest.raises(OutputError, match="holds files of an export already.*--overwrite"):
            again()
        assert names(target) == before
        written = again(overwrite=True)
        assert names(target) - mine - {path.name for path in written} == {
            f"{path.stem}_{frame:04d}.vtu"
            for path in written
            if path.suffix == ".pvd"
            for frame in range(5)
        }
        assert mine < names(target)


def test_a_file_of_another_origin_is_not_replaced(folder, tmp_path):
    (tmp_path / "train.h5").write_text("mine")
    with pytest.raises(OutputError, match=r"train\.h5: exists already, not from an export"):
        export_meshgraphnet(folder, tmp_path, overwrite=True)
    assert names(tmp_path) == {"train.h5"}
    assert (tmp_path / "train.h5").read_text() == "mine"


def test_an_export_that_fails_leaves_the_earlier_one(folder, tmp_path):
    target = tmp_path / "target"
    export_meshgraphnet(folder, target, split="longer")
    before = {path.name: path.read_bytes() for path in target.iterdir()}
    root = samples.write(
        tmp_path / "set", [samples.shard(steps=(4,)), samples.shard(1, steps=(4,))]
    )
    damaged = root / "training/mesh-0001.h5"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    for place in (target, tmp_path / "new"):
        with pytest.raises(FileFormatError, match="truncated"):
            export_meshgraphnet(root, place, overwrite=True)
    assert {path.name: path.read_bytes() for path in target.iterdir()} == before
    assert not (tmp_path / "new").exists()


# --- import of arrays ------------------------------------------------------------------


def arguments(**changes):
    """What another solver would give, from a synthetic file."""
    shard = samples.shard(steps=(4, 3))

    def held(positions):
        return np.where(shard.free, positions, shard.points)

    motions = [
        Motion(
            held(one.runs["reference"].positions),
            one.forces,
            held(one.runs["plain"].positions),
            held(one.runs["plain"].predictions),
        )
        for one in shard.simulations
    ]
    return {
        "points": shard.points, "cells": shard.cells, "motions": motions, "free": shard.free,
        "young": shard.young, "poisson": 0.4, "density": shard.density, "time_step": 0.02,
        **changes,
    }  # fmt: skip


def test_imported_arrays_are_a_file_of_a_data_set(tmp_path):
    given = arguments()
    shard = shard_from_arrays(**given)
    path = tmp_path / "training" / "mesh-0000.h5"
    write_shard(path, shard, "float64")
    found = read_shard(path)
    assert (found.points == given["points"]).all()
    assert (found.young == given["young"]).all()
    assert (found.poisson == 0.4).all()
    assert found.attributes["setting"] == "imported"
    volume = 0.1**3 * len(found.cells)
    np.testing.assert_allclose(found.mass.sum(), given["density"].mean() * volume)
    for one, motion in zip(found.simulations, given["motions"], strict=True):
        assert (one.runs["reference"].positions == motion.reference).all()
        assert (one.runs["plain"].positions == motion.coarse).all()
        assert (one.runs["plain"].predictions == motion.predictions).all()
        assert (one.forces == motion.forces).all()


def test_a_reference_alone_is_enough():
    motion = Motion(arguments()["motions"][0].reference)
    (found,) = shard_from_arrays(**arguments(motions=[motion])).simulations
    assert set(found.runs) == {"reference"}
    assert found.forces.shape == (4, 24, 3)
    assert not found.forces.any()


def motion_with(**changes):
    return [replace(arguments()["motions"][0], **changes)]


def with_entry(values, place, value):
    changed = np.array(values)
    changed[place] = value
    return changed


REFERENCE = arguments()["motions"][0].reference


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"points": np.zeros((24, 2))}, r"nodes \(24, 2\)"),
        ({"free": np.ones((24, 3))}, r"free: float64 of shape \(24, 3\): expected bool"),
        ({"young": np.ones(5)}, r"young: shape \(5,\): expected \(6,\)"),
        ({"young": 0.0}, "young: 0: expected more than 0"),
        ({"poisson": 0.5}, "poisson: expected 0 or more and less than 0.5"),
        ({"density": np.full(6, np.nan)}, r"density: not finite at \[0\]"),
        ({"time_step": 0.0}, "time_step = 0.0"),
        ({"mass": np.zeros(24)}, "mass: expected more than 0"),
        ({"motions": []}, "no simulations"),
        (
            {"motions": motion_with(reference=REFERENCE[:, :20])},
            r"simulation 0, reference: shape \(5, 20, 3\): expected \(5, 24, 3\)",
        ),
        ({"motions": motion_with(reference=REFERENCE[:1])}, "reference: 1 frames"),
        (
            {"motions": motion_with(reference=with_entry(REFERENCE, (2, 3, 1), np.nan))},
            r"reference: not finite at \[2, 3, 1\]",
        ),
        (
            {"motions": motion_with(reference=REFERENCE + 0.01)},
            "reference: in frame 0 node .* away from its rest position",
        ),
        (
            {"motions": motion_with(coarse=REFERENCE + 0.01)},
            "coarse: in frame 0 node .* away from its rest position",
        ),
        (
            {"motions": motion_with(reference=with_entry(REFERENCE, (3, -1), 0))},
            "reference: in frame 3 cell 5 is inverted",
        ),
        (
            {"motions": motion_with(reference=3.0)},
            r"reference: shape \(\): expected \(T \+ 1, N, 3\)",
        ),
        ({"motions": [REFERENCE]}, "simulation 0: ndarray: expected Motion"),
        (
            {"motions": motion_with(reference=with_entry(REFERENCE, (3, 0, 1), 0.01))},
            r"simulation 0, reference\[3\]: node 0 is held in y and 0.01 m away.*not supported",
        ),
        (
            {"motions": motion_with(coarse=with_entry(REFERENCE, (2, 0, 0), 0.01))},
            r"coarse\[2\]: node 0 is held in x",
        ),
        (
            {"motions": motion_with(predictions=with_entry(REFERENCE[1:], (0, -1, 2), 0.0))},
            r"predictions\[0\]: node 23 is held in z",
        ),
        (
            {"motions": motion_with(forces=1j * np.zeros((4, 24, 3)))},
            "forces: complex128: expected",
        ),
        ({"motions": motion_with(reference=REFERENCE.astype(str))}, "reference: <U.*expected real"),
        ({"points": 1j * np.zeros((24, 3))}, "points: complex128: expected real numbers"),
        (
            {"cells": arguments()["cells"] + 0.5},
            r"cells: .*\.5 at \[0, 0\]: expected whole numbers",
        ),
        ({"cells": [[0, 1], [0]]}, "cells: expected an array of real numbers"),
        ({"free": 2 * np.ones((24, 3), int)}, r"free: int64 of shape \(24, 3\): expected bool, or"),
        ({"time_step": "0.02"}, "time_step: <U4: expected real numbers"),
        ({"motions": motion_with(forces=np.zeros((5, 24, 3)))}, r"forces: shape \(5, 24, 3\)"),
        ({"motions": motion_with(predictions=REFERENCE)}, r"predictions: shape \(5, 24, 3\)"),
    ],
)
def test_wrong_arrays_are_refused_with_the_place(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        shard_from_arrays(**arguments(**changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["coarse", "predictions"])
def test_simulations_of_a_mesh_have_the_same_runs(name):
    first, second = arguments()["motions"]
    words = f"simulation 1 has no {name}, unlike simulation 0: expected {name} of all"
    with pytest.raises(InputError, match=words):
        shard_from_arrays(**arguments(motions=[first, replace(second, **{name: None})]))


def test_an_inverted_mesh_is_refused():
    cells = arguments()["cells"].copy()
    cells[2] = cells[2][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match="cell 2 .* is inverted"):
        shard_from_arrays(**arguments(cells=cells))


def test_what_is_imported_is_what_the_check_accepts(tmp_path):
    """Frame 0 and held nodes come as float32, far from the origin, and are stored as at rest."""
    given = arguments()
    away = np.array([30.0, -20.0, 10.0])
    motions = [
        Motion(*(
            np.float32(x + away) if name != "forces" else x for name, x in vars(one).items()
        ))
        for one in given["motions"]
    ]  # fmt: skip
    shard = shard_from_arrays(**{**given, "points": given["points"] + away, "motions": motions})
    for dtype in ("float32", "float64"):
        root = tmp_path / dtype
        write_shard(root / "training/mesh-0000.h5", shard, dtype)
        assert check_dataset(root) == []


def test_numbers_of_other_types_mean_the_same():
    given = arguments()
    shard = shard_from_arrays(
        **{**given, "cells": given["cells"].astype(float), "free": given["free"].astype(np.int8)}
    )
    assert (shard.cells == given["cells"]).all()
    assert (shard.free == given["free"]).all()
    assert shard.free.dtype == bool


def test_a_motion_may_stand_alone():
    motion = arguments()["motions"][0]
    (found,) = shard_from_arrays(**arguments(motions=motion)).simulations
    assert (found.runs["reference"].positions == motion.reference).all()


def scene_arguments(**changes):
    """A scene and what another solver would give on its mesh."""
    scene = beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 3}, **changes)
    problem = pc.discretise(beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 3}))
    materials = problem.materials
    reference = pc.rollout(pc.ProjectiveDynamics(problem)).positions
    return {
        "points": problem.positions, "cells": problem.cells, "motions": Motion(reference),
        "free": problem.free, "young": materials.young, "poisson": materials.poisson,
        "density": materials.density, "time_step": 0.01, "scene": scene,
    }  # fmt: skip


def test_a_time_step_that_is_nearly_the_scenes_is_the_scenes():
    given = scene_arguments()
    for step, expected in ((0.009999999999999998, 0.01), (0.0125, 0.0125)):
        shard = shard_from_arrays(**{**given, "time_step": step})
        assert shard.attributes["time_step"] == expected
        assert pc.Scene.from_toml(shard.simulations[0].scene_toml).time.step == expected


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"body": {"cells": [2, 1, 1]}}, "scene: its coarse mesh is not the one given"),
        ({"material": {"young": 2e6}}, "scene: its young is not the one given"),
        ({"clamps": []}, "scene: its free is not the one given"),
        ({"time": {"step": 0.01, "frames": 3, "integrator": "bdf2"}}, "integrator is 'bdf2'"),
        (
            {"solver": {"element": "hex27"}},
            "scene: its solver.element is 'hex27', .* one of hex8, hex8-mean, hex8-bubble, "
            "hex8-bubble-mean",
        ),
        (
            {"clamps": [{"region": {"plane": "x", "at": 0.0},
                         "motion": {"times": [0.0, 1.0],
                                    "displacement": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]}}]},
            r"predictions\[2\]: node 0 is held in z and .* clamps that move are not supported",
        ),
    ],
)  # fmt: skip
def test_a_scene_of_something_else_is_refused(changes, words):
    given = scene_arguments()
    given["scene"] = given["scene"].with_changes(**changes)
    with pytest.raises(InputError, match=words):
        shard_from_arrays(**given)


# --- import of files -------------------------------------------------------------------


def saved_arrays(path, **changes):
    given = arguments()
    first, second = given.pop("motions")
    arrays = {
        **given, "reference_0": first.reference, "forces_0": first.forces,
        "predictions_0": first.predictions, "reference_1": second.reference,
        "predictions_1": second.predictions, **changes,
    }  # fmt: skip
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})
    return path


def test_an_npz_file_is_imported(tmp_path):
    source = saved_arrays(tmp_path / "run.npz")
    path = import_trajectories([source], tmp_path / "set", split="validation", number=3)
    assert path == tmp_path / "set" / "validation" / "mesh-0003.h5"
    one, other = read_shard(path).simulations
    assert set(one.runs) == set(other.runs) == {"reference", "plain"}
    assert one.runs["plain"].predictions.shape == (4, 24, 3)
    assert other.runs["plain"].predictions.shape == (3, 24, 3)
    assert one.runs["plain"].positions is None
    assert one.forces.any()
    assert not other.forces.any()
    with pytest.raises(InputError, match="exists already"):
        import_trajectories([source], tmp_path / "set", split="validation", number=3)


def test_an_imported_set_without_forces_passes_the_check(tmp_path):
    moved = np.asarray(arguments()["motions"][0].reference).copy()
    moved[1:] += 0.01 * (moved[1:] - moved[0])
    still = np.zeros((len(moved) - 1, *moved.shape[1:]))
    first = arguments()["motions"][0].reference
    free = np.ones_like(arguments()["free"])
    motions = [Motion(first, forces=still), Motion(moved, forces=still)]
    path = tmp_path / "set" / "training" / "mesh-0000.h5"
    write_shard(path, shard_from_arrays(**arguments(motions=motions, free=free)))
    assert check_dataset(tmp_path / "set") == []
    twice = [Motion(first, forces=still)] * 2
    write_shard(path, shard_from_arrays(**arguments(motions=twice, free=free)), overwrite=True)
    (finding,) = check_dataset(tmp_path / "set")
    assert "simulation 0001 has the mesh and the forces of simulation 0000" in finding.message


def test_wrong_npz_files_are_refused_by_name(tmp_path):
    (tmp_path / "text.npz").write_text("text")
    with (tmp_path / "npy.npz").open("wb") as file:
        np.save(file, REFERENCE)
    for source, kind, words in (
        (tmp_path / "none.npz", FileFormatError, "none.npz: cannot be read"),
        (tmp_path / "text.npz", FileFormatError, "text.npz: cannot be read"),
        (tmp_path / "npy.npz", FileFormatError, "npy.npz: a single array, as .npy: expected an"),
        (saved_arrays(tmp_path / "a.npz", free=None), InputError, "a.npz: no array 'free'"),
        (saved_arrays(tmp_path / "b.npz", young=[1.0]), InputError, "b.npz: young: shape"),
        (saved_arrays(tmp_path / "c.npz", reference_0=None), InputError, "c.npz: no array 'ref"),
        (
            saved_arrays(tmp_path / "d.npz", reference_1=3.0),
            InputError,
            r"1, reference: shape \(\)",
        ),
    ):
        with pytest.raises(kind, match=words) as caught:
            import_trajectories([source], tmp_path / "set")
        assert str(caught.value).count(source.name) == 1
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"predicions_0": REFERENCE[1:]}, "'predicions_0': unknown; did you mean 'predictions_0'?"),
        ({"colour": [1.0]}, "'colour': unknown: remove or rename it"),
        ({"predictions": REFERENCE[1:]}, "'predictions': expected it with numbers, as"),
        ({"reference": REFERENCE}, "arrays 'reference' and 'reference_0': expected one of them"),
        (
            {"reference_3": REFERENCE},
            "'reference_3': the references end with 'reference_1': expected numbers 0, 1, 2",
        ),
        ({"forces_2": REFERENCE[1:]}, "'forces_2': the references end with 'reference_1'"),
        (
            {"reference": REFERENCE, "reference_0": None, "reference_1": None},
            "'forces_0': expected it without number, as 'reference'",
        ),
        (
            {
                "reference": REFERENCE, "reference_0": None, "reference_1": None,
                "forces_0": None, "predictions_0": None, "predictions_1": None,
                "force": REFERENCE[1:],
            },
            "'force': unknown; did you mean 'forces'?",
        ),
    ],
)  # fmt: skip
def test_arrays_that_would_be_left_out_are_refused(tmp_path, changes, words):
    source = saved_arrays(tmp_path / "run.npz", **changes)
    with pytest.raises(InputError, match=re.escape(words)):
        import_trajectories([source], tmp_path / "set")


def test_damaged_npz_files_are_refused_in_one_paragraph(tmp_path):
    given = arguments()
    arrays = {**given, "reference": given.pop("motions")[0].reference}
    arrays.pop("motions")
    source = tmp_path / "run.npz"
    np.savez_compressed(source, **arrays)
    whole = source.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for trial in range(150):
        data = bytearray(whole)
        if trial % 3 == 0:
            data = data[: rng.integers(len(data))]
        else:
            place = rng.integers(len(data))
            data[place : place + 4] = rng.bytes(4)
        source.write_bytes(data)
        shutil.rmtree(tmp_path / "set", ignore_errors=True)
        try:
            import_trajectories([source], tmp_path / "set")
        except InputError as error:
            assert str(error).startswith(f"{source}: ")
            assert "\n" not in str(error)
            refused += 1
    assert refused > 100


def test_nothing_is_imported_into_a_generated_data_set(tmp_path):
    source = saved_arrays(tmp_path / "run.npz")
    (tmp_path / "config.toml").write_text("")
    with pytest.raises(InputError, match=r"holds config.toml, as a generated data set"):
        import_trajectories([source], tmp_path, split="extra")
    assert not (tmp_path / "extra").exists()


def test_a_file_of_a_data_set_is_no_trajectory(tmp_path):
    root = samples.write(tmp_path / "set", [samples.shard(steps=(3,))])
    with pytest.raises(FileFormatError, match=r"mesh-0000.h5: a file of a data set already"):
        import_trajectories([root / "training/mesh-0000.h5"], tmp_path / "other")


@pytest.fixture(scope="module")
def runs():
    """A fine and a coarse run of a beam."""
    scene = beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 4})
    found = [
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine=refine))) for refine in (2, 1)
    ]
    return [replace(run, scene_toml=scene.to_toml()) for run in found]


def test_runs_of_simulate_become_a_file_with_predictions(runs):
    fine, coarse = runs
    shard = shard_from_trajectories(fine, coarse)
    problem = pc.discretise(beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 4}))
    truth = restrict(fine, problem)
    (found,) = shard.simulations
    np.testing.assert_array_equal(found.runs["reference"].positions, truth.positions)
    np.testing.assert_array_equal(found.runs["plain"].positions, coarse.positions)
    np.testing.assert_allclose(shard.mass, problem.mass)
    assert (shard.free == problem.free).all()
    np.testing.assert_allclose(found.forces[2], problem.external_forces(0.02, 0.03))
    # From rest, one step of the coarse model is the first of its own run.
    step = found.runs["plain"].predictions
    np.testing.assert_allclose(step[0], coarse.positions[1], atol=1e-7)
    velocity = (truth.positions[2] - truth.positions[1]) / 0.01
    expected = pc.ProjectiveDynamics(problem)(pc.State(truth.positions[2], velocity, 0.02))
    np.testing.assert_allclose(step[2], expected.state.positions, atol=1e-7)


def test_runs_that_do_not_belong_together_are_refused(runs):
    fine, coarse = runs
    softer = beam(cells=(3, 1, 1), material={"young": 9e5}).to_toml()
    for references, rollouts, words in (
        ([fine, fine], [coarse], "2 references and 1 coarse runs"),
        ([replace(fine, scene_toml="")], [], "has no scene"),
        ([fine, replace(fine, scene_toml=softer)], [], "simulations 0 and 1 differ in young"),
        ([], [], "at least one reference"),
    ):
        with pytest.raises(InputError, match=words):
            shard_from_trajectories(references, rollouts)


def rerun(run, **changes):
    """A run by whose file its scene is another."""
    return replace(
        run, scene_toml=pc.Scene.from_toml(run.scene_toml).with_changes(**changes).to_toml()
    )


def with_attributes(run, **attributes):
    return replace(run, attributes={**run.attributes, **attributes})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda run: rerun(run, material={"young": 2e6}), "coarse run differ in material:"),
        (lambda run: rerun(run, loads=[]), "coarse run differ in loads:"),
        (lambda run: rerun(run, clamps=[]), "coarse run differ in clamps:"),
        (lambda run: rerun(run, body={"cells": [3, 2, 1]}), "coarse run differ in body:"),
        (lambda run: rerun(run, damping={"mass": 1.0}), "coarse run differ in damping:"),
        (
            lambda run: replace(run, times=2 * run.times),
            "frame 1 of the coarse run is at 0.02 s, that of the reference at 0.01 s",
        ),
        (
            lambda run: replace(run, times=run.times[:-1], positions=run.positions[:-1]),
            "the coarse run has 3 steps, the reference 4",
        ),
        (lambda run: replace(run, scene_toml=""), "the coarse run has no scene"),
        (
            lambda run: with_attributes(run, material="changed after the scene"),
            "the coarse run has another material than its scene.*use shard_from_arrays",
        ),
        (
            lambda run: with_attributes(run, integrator="midpoint"),
            "the coarse run has the integrator 'midpoint': expected 'backward-euler'",
        ),
    ],
)
def test_a_coarse_run_of_another_simulation_is_refused(runs, change, words):
    fine, coarse = runs
    with pytest.raises(InputError, match=words):
        shard_from_trajectories(fine, change(coarse))


def test_a_fine_run_is_not_taken_for_the_coarse_one(runs):
    with pytest.raises(InputError, match="has 63 nodes, the coarse mesh of its scene 16"):
        shard_from_trajectories(*runs[::-1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda run: with_attributes(run, material="changed after the scene"),
            "the reference has another material than its scene.*use shard_from_arrays",
        ),
        (
            lambda run: with_attributes(run, integrator="bdf2"),
            "the reference has the integrator 'bdf2': expected 'backward-euler', for the velo",
        ),
        (
            lambda run: rerun(run, time={"step": 0.01, "frames": 4, "integrator": "quasi-static"}),
            "the reference has the integrator 'quasi-static'",
        ),
        (lambda run: replace(run, times=run.times + 1.0), "the reference starts at 1 s with"),
        (
            lambda run: replace(run, velocities=run.velocities + 0.5),
            "the reference starts at 0 s with velocities up to 0.5 m/s: expected",
        ),
    ],
)
def test_a_reference_that_its_scene_does_not_describe_is_refused(runs, change, words):
    with pytest.raises(InputError, match=words):
        shard_from_trajectories(change(runs[0]))


def quadratic_run(refine):
    scene = beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 4}, solver={"element": "hex27"})
    return pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine=refine)))


def test_a_coarse_model_with_nodes_between_the_corners_is_refused(runs):
    quadratic = quadratic_run(1)
    for given, words in (
        ((quadratic,), "the reference, without a coarse run: its solver.element is 'hex27'"),
        ((runs[0], quadratic), "the coarse run: its solver.element is 'hex27'.*one of hex8, "),
    ):
        with pytest.raises(InputError, match=words):
            shard_from_trajectories(*given)


@pytest.mark.parametrize("refine", [1, 2])
def test_a_reference_may_have_nodes_between_the_corners(runs, refine):
    reference, coarse = quadratic_run(refine), runs[1]
    (found,) = shard_from_trajectories(reference, coarse).simulations
    problem = pc.discretise(beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 4}))
    positions = found.runs["reference"].positions
    np.testing.assert_array_equal(positions, restrict(reference, problem).positions)
    np.testing.assert_array_equal(positions[0], problem.positions)


def test_the_coarse_runs_scene_is_the_coarse_models(runs):
    fine, coarse = runs
    other = rerun(coarse, solver={"element": "hex8-mean", "mass": "averaged"})
    shard = shard_from_trajectories(fine, other)
    (found,) = shard.simulations
    assert found.scene_toml == other.scene_toml
    problem = pc.discretise(pc.Scene.from_toml(other.scene_toml))
    expected = pc.ProjectiveDynamics(problem)(problem.rest_state()).state.positions
    np.testing.assert_allclose(found.runs["plain"].predictions[0], expected, atol=1e-12)
    assert np.abs(expected - coarse.positions[1]).max() > 1e-6


def test_the_best_coarse_models_run_is_computed_if_wanted(runs):
    fine, coarse = runs
    shard = shard_from_trajectories(fine, coarse, best=True)
    (found,) = shard.simulations
    scene = pc.best_coarse(pc.Scene.from_toml(coarse.scene_toml))
    stepper = pc.ProjectiveDynamics(pc.discretise(scene))
    run = found.runs["best"]
    np.testing.assert_allclose(run.positions, pc.rollout(stepper).positions, atol=1e-12)
    np.testing.assert_allclose(run.predictions[0], run.positions[1], atol=1e-7)
    assert np.abs(run.positions - found.runs["plain"].positions).max() > 1e-6
    better = rerun(coarse, solver={"element": "hex8-bubble", "mass": "averaged"})
    with pytest.raises(InputError, match="the best coarse model's element 'hex8-bubble' already"):
        shard_from_trajectories(fine, better, best=True)
    with pytest.raises(InputError, match="without a scene"):
        shard_from_arrays(**arguments(), best=True)


def test_models_of_the_best_coarse_model_are_trained_and_judged_on_an_import(runs, tmp_path):
    pytest.importorskip("torch")
    from pdcorrect.evaluation.evaluation import evaluate
    from pdcorrect.training.recordings import load_recordings, make_problems

    path = tmp_path / "evaluation" / "mesh-0000.h5"
    write_shard(path, shard_from_trajectories(*runs, split="evaluation", best=True))
    (recording,) = load_recordings(tmp_path, "evaluation", "best")
    (problem,) = make_problems([recording], "best")
    assert problem.element == "hex8-bubble"
    values, _ = evaluate([], tmp_path).runs["best"].values("omega")
    assert np.isfinite(values).all()


def test_an_imported_mesh_in_two_splits_is_a_warning(runs, tmp_path):
    fine, coarse = runs
    write_shard(tmp_path / "training" / "mesh-0000.h5", shard_from_trajectories(fine, coarse))
    stronger = [
        rerun(run, loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -4.0]}]) for run in runs
    ]
    path = tmp_path / "evaluation" / "mesh-0000.h5"
    write_shard(path, shard_from_trajectories(*stronger, split="evaluation"))
    (found,) = check_dataset(tmp_path)
    assert found.severity == "warning"
    assert "of one body under other loads, not of unseen bodies" in found.message
    path.unlink()
    write_shard(path, shard_from_trajectories(fine, coarse, split="evaluation"))
    assert "error" in {finding.severity for finding in check_dataset(tmp_path)}


def test_a_moving_clamp_is_refused():
    motion = {"times": [0.0, 1.0], "displacement": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]}
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": motion}]
    scene = beam(cells=(3, 1, 1), time={"step": 0.01, "frames": 2}, clamps=clamps)
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
    with pytest.raises(InputError, match=r"reference\[2\]: .* clamps that move are not supported"):
        shard_from_trajectories(run)


# --- the program -----------------------------------------------------------------------


def test_the_program_imports_and_exports(program, runs, tmp_path):
    for name, run in zip(("fine", "coarse"), runs, strict=True):
        pc.save_trajectory(tmp_path / f"{name}.h5", run)
    root = tmp_path / "set"
    status, out, err = program(
        "dataset", "import", tmp_path / "fine.h5", "--coarse", tmp_path / "coarse.h5", "-o", root,
        "--best",
    )  # fmt: skip
    assert (status, err) == (0, "")
    assert "mesh-0000.h5" in out.replace("\n", "")
    status, _, err = program(
        "dataset", "import", tmp_path / "fine.h5", "-o", root, "--split", "train"
    )
    assert status == 0
    assert err.startswith("note: split 'train' is one of your own; training reads 'training' and")
    shutil.rmtree(root / "train")
    status, out, _ = program("dataset", "export", root, tmp_path / "mgn")
    assert status == 0
    assert (tmp_path / "mgn" / "train.h5").exists()
    status, out, _ = program(
        "dataset", "export", root, tmp_path / "vtu", "--to", "vtu", "--split", "training",
        "--run", "plain",
    )  # fmt: skip
    assert status == 0
    assert len(list((tmp_path / "vtu").glob("*.vtu"))) == 10
    again = ("dataset", "export", root, tmp_path / "mgn", "--split", "training")
    status, _, err = program(*again)
    assert status == 1
    assert "holds files of an export already" in err
    assert program(*again, "--overwrite")[0] == 0


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
    assert f"{option[0]} with --to {layout}: it has no use there" in err.replace("\n", " ")
    assert not target.exists()


def test_the_export_of_an_incomplete_data_set_warns(program, tmp_path):
    root = tmp_path / "set"
    write_dataset(root, sample_config())
    status, _, err = program("dataset", "export", root, tmp_path / "whole")
    assert (status, err) == (0, "")
    (root / "training/mesh-0001.h5").unlink()
    status, _, err = program("dataset", "export", root, tmp_path / "part")
    assert status == 0
    assert "warning: the data set is incomplete: 1 of the files" in err.replace("\n", " ")
    status, _, err = program("dataset", "export", root, tmp_path / "one", "--split", "evaluation")
    assert (status, err) == (0, "")


def test_the_program_refuses_bad_input_in_one_paragraph(program, tmp_path):
    for call in (
        ("export", tmp_path, tmp_path / "out"),
        ("import", tmp_path / "none.npz", "-o", tmp_path / "set"),
        ("import", tmp_path / "none.h5", "-o", tmp_path / "set"),
        ("import", tmp_path / "none.npz", "-o", tmp_path / "set", "--split", "../x"),
    ):
        status, _, err = program("dataset", *call)
        assert status == 2
        assert err.startswith("error: ")
        assert err.count("\n") == 1

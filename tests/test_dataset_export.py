"""Data sets leave for other programs, and come in from other solvers."""

import json
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
from pdcorrect.data.check import check_dataset
from pdcorrect.data.export import export_meshgraphnet, export_vtu
from pdcorrect.data.graph import node_means, tetrahedra
from pdcorrect.data.import_files import import_trajectories, shard_from_trajectories
from pdcorrect.data.importing import Motion, shard_from_arrays
from pdcorrect.data.schema import write_shard
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.errors import FileFormatError, InputError, MeshError
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
    assert not list((tmp_path / "a").iterdir())
    samples.write(tmp_path / "set", [samples.shard(steps=(3, 4))])
    with pytest.raises(InputError, match="simulation 1: 4 steps of 0.02 s, unlike the first"):
        export_meshgraphnet(tmp_path / "set", tmp_path / "b")
    with pytest.raises(InputError, match="no data set"):
        export_meshgraphnet(tmp_path / "b", tmp_path / "c")


# --- ParaView --------------------------------------------------------------------------


def test_vtu_series_hold_motion_error_and_forces(folder, tmp_path):
    written = export_vtu(folder, tmp_path, "evaluation", 2, 1, ["best", "plain"])
    assert [path.name for path in written] == ["reference.pvd", "best.pvd", "plain.pvd"]
    shard = samples.shard(2, "evaluation", cells=samples.SHAPES[2], steps=(4, 4))
    simulation = shard.simulations[1]
    truth = simulation.runs["reference"].positions
    for name in ("reference", "best"):
        frames = ET.parse(tmp_path / f"{name}.pvd").getroot().findall(".//DataSet")
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


# --- import of arrays ------------------------------------------------------------------


def arguments(**changes):
    """What another solver would give, from a synthetic file."""
    shard = samples.shard(steps=(4, 3))
    motions = [
        Motion(
            one.runs["reference"].positions,
            one.forces,
            one.runs["plain"].positions,
            one.runs["plain"].predictions,
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
        ({"motions": motion_with(forces=np.zeros((5, 24, 3)))}, r"forces: shape \(5, 24, 3\)"),
        ({"motions": motion_with(predictions=REFERENCE)}, r"predictions: shape \(5, 24, 3\)"),
    ],
)
def test_wrong_arrays_are_refused_with_the_place(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        shard_from_arrays(**arguments(**changes))
    assert "\n" not in str(caught.value)


def test_an_inverted_mesh_is_refused():
    cells = arguments()["cells"].copy()
    cells[2] = cells[2][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match="cell 2 .* is inverted"):
        shard_from_arrays(**arguments(cells=cells))


def test_a_motion_that_starts_elsewhere_is_taken_when_stated():
    motions = [Motion(REFERENCE[1:])]
    shard = shard_from_arrays(**arguments(motions=motions, starts_at_rest=False))
    assert (shard.simulations[0].runs["reference"].positions == REFERENCE[1:]).all()


# --- import of files -------------------------------------------------------------------


def saved_arrays(path, **changes):
    given = arguments()
    first, second = given.pop("motions")
    arrays = {
        **given, "reference_0": first.reference, "forces_0": first.forces,
        "reference_1": second.reference, "predictions_1": second.predictions, **changes,
    }  # fmt: skip
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})
    return path


def test_an_npz_file_is_imported(tmp_path):
    source = saved_arrays(tmp_path / "run.npz")
    path = import_trajectories([source], tmp_path / "set", split="validation", number=3)
    assert path == tmp_path / "set" / "validation" / "mesh-0003.h5"
    one, other = read_shard(path).simulations
    assert set(one.runs) == {"reference"}
    assert other.runs["plain"].predictions.shape == (3, 24, 3)
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
    write_shard(path, shard_from_arrays(**arguments(motions=twice, free=free)))
    (finding,) = check_dataset(tmp_path / "set")
    assert "simulation 0001 has the mesh and the forces of simulation 0000" in finding.message


def test_wrong_npz_files_are_refused_by_name(tmp_path):
    (tmp_path / "text.npz").write_text("text")
    for source, kind, words in (
        (tmp_path / "none.npz", FileFormatError, "none.npz: cannot be read"),
        (tmp_path / "text.npz", FileFormatError, "text.npz: cannot be read"),
        (saved_arrays(tmp_path / "a.npz", free=None), InputError, "a.npz: no array 'free'"),
        (saved_arrays(tmp_path / "b.npz", young=[1.0]), InputError, "b.npz: young: shape"),
        (saved_arrays(tmp_path / "c.npz", reference_0=None), InputError, "c.npz: no array 'ref"),
    ):
        with pytest.raises(kind, match=words):
            import_trajectories([source], tmp_path / "set")
    assert not (tmp_path / "set").exists()


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


# --- the program -----------------------------------------------------------------------


def test_the_program_imports_and_exports(program, runs, tmp_path):
    for name, run in zip(("fine", "coarse"), runs, strict=True):
        pc.save_trajectory(tmp_path / f"{name}.h5", run)
    root = tmp_path / "set"
    status, out, err = program(
        "dataset", "import", tmp_path / "fine.h5", "--coarse", tmp_path / "coarse.h5", "-o", root
    )
    assert (status, err) == (0, "")
    assert "mesh-0000.h5" in out.replace("\n", "")
    status, out, _ = program("dataset", "export", root, tmp_path / "mgn")
    assert status == 0
    assert (tmp_path / "mgn" / "train.h5").exists()
    status, out, _ = program(
        "dataset", "export", root, tmp_path / "vtu", "--to", "vtu", "--split", "training",
        "--run", "plain",
    )  # fmt: skip
    assert status == 0
    assert len(list((tmp_path / "vtu").glob("*.vtu"))) == 10


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

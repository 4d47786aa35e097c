"""Data sets of other solvers' results: arrays, files of arrays, and files of runs."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

import pdcorrect as pc
import reader_samples as samples
from conftest import beam
from pdcorrect.data.check import check_dataset
from pdcorrect.data.import_files import import_trajectories, shard_from_trajectories
from pdcorrect.data.importing import ImportedMotion, shard_from_arrays
from pdcorrect.data.schema import read_shard, write_shard
from pdcorrect.errors import FileFormatError, InputError, MeshError, PdcorrectWarning
from pdcorrect.fem.hexahedron import gauss_points, jacobians
from pdcorrect.scene import trained_coarse
from pdcorrect.solvers.rollout import restrict

# --- arrays ----------------------------------------------------------------------------


def stepped(frames):
    """A scene's time; what is imported has to be of backward Euler."""
    return {"step": 0.01, "frames": frames, "integrator": "backward-euler"}


def arguments(**changes):
    """What another solver would give, from a synthetic file."""
    shard = samples.shard(steps=(4, 3))

    def held(positions):
        return np.where(shard.free, positions, shard.points)

    motions = [
        ImportedMotion(
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
    alone = given["motions"][0]
    (one,) = shard_from_arrays(**arguments(motions=alone)).simulations
    assert (one.runs["reference"].positions == alone.reference).all()
    (one,) = shard_from_arrays(**arguments(motions=[ImportedMotion(alone.reference)])).simulations
    assert set(one.runs) == {"reference"}  # which is enough
    assert one.forces.shape == (4, 24, 3)
    assert not one.forces.any()


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
        ({"points": np.zeros((24, 2))}, r"points: .* \(24, 2\)"),
        ({"free": np.ones((24, 2))}, r"free: float64 of shape \(24, 2\)"),
        ({"young": np.ones(5)}, r"young: .* shape \(5,\)"),
        ({"young": 0.0}, "young is 0"),
        ({"poisson": 0.5}, "poisson"),
        ({"density": np.full(6, np.nan)}, r"density: nan at \[0\]"),
        ({"time_step": 0.0}, "time_step is 0"),
        ({"mass": np.zeros(24)}, "mass"),
        ({"motions": []}, "simulations"),
        (
            {"motions": motion_with(reference=REFERENCE[:, :20])},
            r"simulation 0, reference: .* shape \(5, 20, 3\)",
        ),
        ({"motions": motion_with(reference=REFERENCE[:1])}, "reference: 1 frames"),
        (
            {"motions": motion_with(reference=with_entry(REFERENCE, (2, 3, 1), np.nan))},
            r"reference: nan at \[2, 3, 1\]",
        ),
        (
            {"motions": motion_with(reference=REFERENCE + 0.01)},
            "simulation 0000: reference: frame 0 is 0.01 m",
        ),
        (
            {"motions": motion_with(coarse=REFERENCE + 0.01)},
            "simulation 0000: plain: frame 0 is 0.01 m",
        ),
        (
            {"motions": motion_with(reference=with_entry(REFERENCE, (3, -1), 0))},
            "reference: .*row 3 of its positions",
        ),
        (
            {"motions": motion_with(reference=3.0)},
            r"reference: .* shape \(\)",
        ),
        (
            {"motions": motion_with(reference=with_entry(REFERENCE, (3, 0, 1), 0.01))},
            r"simulation 0000: reference: node 0 .* y .*0\.01 m .* row 3",
        ),
        (
            {"motions": motion_with(coarse=with_entry(REFERENCE, (2, 0, 0), 0.01))},
            "plain: node 0 .* x .* row 2 of its positions",
        ),
        (
            {"motions": motion_with(predictions=with_entry(REFERENCE[1:], (0, -1, 2), 0.0))},
            "plain: node 23 .* z .* row 0 of its predictions",
        ),
        (
            {"motions": motion_with(forces=1j * np.zeros((4, 24, 3)))},
            "forces: complex128",
        ),
        ({"motions": motion_with(reference=REFERENCE.astype(str))}, "reference: <U.*"),
        ({"points": 1j * np.zeros((24, 3))}, "points: complex128"),
        (
            {"cells": arguments()["cells"] + 0.5},
            r"cells: .*\.5 at \[0, 0\]",
        ),
        ({"cells": [[0, 1], [0]]}, "cells"),
        ({"free": 2 * np.ones((24, 3), int)}, r"free: 2 at \[0, 0\]"),
        ({"time_step": "0.02"}, "time_step: <U4"),
        ({"motions": motion_with(forces=np.zeros((5, 24, 3)))}, r"forces: .* shape \(5, 24, 3\)"),
        ({"motions": motion_with(predictions=REFERENCE)}, r"predictions: .* shape \(5, 24, 3\)"),
    ],
)
def test_wrong_arrays_are_refused_with_the_place(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        shard_from_arrays(**arguments(**changes))
    assert "\n" not in str(caught.value)


def test_a_reference_with_one_corner_folded_is_refused():
    shard = samples.shard(steps=(4,))
    cell, points = shard.cells[-1], shard.points
    corner = (np.bincount(shard.cells.ravel())[cell] == 1).argmax()  # of this cell alone
    inwards = points[cell].mean(axis=0) - points[cell[corner]]
    folded = with_entry(REFERENCE, (2, cell[corner]), points[cell[corner]] + 1.6 * inwards)
    (found,) = jacobians(folded[2], cell[None], gauss_points(2))
    (centre,) = jacobians(folded[2], cell[None], np.full((1, 3), 0.5))
    assert (found < 0).sum() == 1
    assert centre > 0
    with pytest.raises(InputError, match=f"reference: cell {len(shard.cells) - 1} .* row 2"):
        shard_from_arrays(**arguments(motions=motion_with(reference=folded)))


def test_wrong_meshes_are_refused():
    cells = arguments()["cells"].copy()
    cells[2] = cells[2][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match="cell 2 "):
        shard_from_arrays(**arguments(cells=cells))


def test_what_is_imported_is_what_the_check_accepts(tmp_path):
    """Frame 0 and held nodes come as float32, far from the origin, and are stored as at rest."""
    given = arguments()
    away = np.array([30.0, -20.0, 10.0])
    motions = [
        ImportedMotion(*(
            np.float32(x + away) if name != "forces" else x for name, x in vars(one).items()
        ))
        for one in given["motions"]
    ]  # fmt: skip
    shard = shard_from_arrays(**{**given, "points": given["points"] + away, "motions": motions})
    for dtype in ("float32", "float64"):
        root = tmp_path / dtype
        write_shard(root / "training/mesh-0000.h5", shard, dtype)
        assert check_dataset(root) == []

    moved = np.asarray(arguments()["motions"][0].reference).copy()
    moved[1:] += 0.01 * (moved[1:] - moved[0])
    still = np.zeros((len(moved) - 1, *moved.shape[1:]))
    first = arguments()["motions"][0].reference
    free = np.ones_like(arguments()["free"])
    motions = [ImportedMotion(first, forces=still), ImportedMotion(moved, forces=still)]
    path = tmp_path / "set" / "training" / "mesh-0000.h5"
    write_shard(path, shard_from_arrays(**arguments(motions=motions, free=free)))
    assert check_dataset(tmp_path / "set") == []
    twice = [ImportedMotion(first, forces=still)] * 2
    write_shard(path, shard_from_arrays(**arguments(motions=twice, free=free)), overwrite=True)
    (finding,) = check_dataset(tmp_path / "set")
    assert "simulation 0001" in finding.message
    assert "simulation 0000" in finding.message


def test_numbers_of_other_types_or_nearly_the_scenes_mean_the_same():
    given = arguments()
    shard = shard_from_arrays(
        **{**given, "cells": given["cells"].astype(float), "free": given["free"].astype(np.int8)}
    )
    assert (shard.cells == given["cells"]).all()
    assert (shard.free == given["free"]).all()
    assert shard.free.dtype == bool

    given = scene_arguments()
    for step, expected in ((0.009999999999999998, 0.01), (0.0125, 0.0125)):
        shard = shard_from_arrays(**{**given, "time_step": step})
        assert shard.attributes["time_step"] == expected
        assert pc.Scene.from_toml(shard.simulations[0].scene_toml).time.step == expected


def scene_arguments(**changes):
    """A scene and what another solver would give on its mesh."""
    scene = beam(cells=(3, 1, 1), time=stepped(3), **changes)
    problem = pc.discretise(beam(cells=(3, 1, 1), time=stepped(3)))
    materials = problem.materials
    reference = pc.rollout(pc.ProjectiveDynamics(problem)).positions
    return {
        "points": problem.positions, "cells": problem.cells, "motions": ImportedMotion(reference),
        "free": problem.free, "young": materials.young, "poisson": materials.poisson,
        "density": materials.density, "time_step": 0.01, "scene": scene,
    }  # fmt: skip


def test_follower_loads_of_the_scene_are_those_where_a_step_ends():
    pressure = {
        "kind": "pressure", "pressure": 2e3, "follower": True,
        "region": {"plane": "z", "at": "max"},
    }  # fmt: skip
    given = scene_arguments(loads=[pressure])
    (found,) = shard_from_arrays(**given, best=True).simulations
    x = given["motions"].reference
    state = pc.State(x[2], (x[2] - x[1]) / 0.01, 0.02)
    plain, best = (
        pc.ProjectiveDynamics(pc.discretise(scene))
        for scene in (given["scene"], trained_coarse(given["scene"]))
    )
    for name, stepper in (("plain", plain), ("best", best)):
        expected = stepper(state).state.positions
        np.testing.assert_array_equal(found.runs[name].predictions[2], expected)
    np.testing.assert_array_equal(found.runs["best"].positions, pc.rollout(best).positions)
    loads = plain.problem.external_forces(0.02, 0.03, x[2])
    np.testing.assert_array_equal(found.forces[2], loads)


def test_a_mass_may_be_another_than_the_scene_s():
    given = scene_arguments()
    mass = 2.0 * pc.discretise(given["scene"]).mass
    np.testing.assert_array_equal(shard_from_arrays(**given, mass=mass).mass, mass)


def test_steps_of_the_coarse_model_may_invert_cells():
    time = {"step": 1e-5, "frames": 2, "integrator": "backward-euler"}
    scene = beam(cells=(2, 1, 1), poisson=0.0, clamps=[], loads=[], time=time)
    problem = pc.discretise(scene)
    rest = problem.positions
    flat = rest * [1.0, 1.0, 0.4]  # and on in the same way
    given = {
        "points": rest, "cells": problem.cells, "free": problem.free, "young": 1e6,
        "poisson": 0.0, "density": 1e3, "time_step": 1e-5,
    }  # fmt: skip
    motion = ImportedMotion(np.stack([rest, flat, flat]))
    (found,) = shard_from_arrays(**given, motions=motion, scene=scene).simulations
    predictions = found.runs["plain"].predictions
    assert problem.volume_ratios(predictions[1]).max() < 0
    again = replace(motion, predictions=predictions)
    (same,) = shard_from_arrays(**given, motions=again).simulations
    np.testing.assert_array_equal(same.runs["plain"].predictions, predictions)


MOVING = {"times": [0.0, 1.0], "displacement": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"body": {"cells": [2, 1, 1]}}, "points"),
        ({"material": {"young": 2e6}}, "young"),
        ({"clamps": []}, "free"),
        ({"time": {"integrator": "bdf2"}}, "'bdf2'"),
        ({"time": {"integrator": "generalised-alpha"}}, "'generalised-alpha'"),
        ({"solver": {"element": "hex27"}}, "'hex27'"),
        (
            {"clamps": [{"region": {"plane": "x", "at": 0.0}, "motion": MOVING}]},
            "node 0 .* z .* row 2 of its predictions",
        ),
    ],
)
def test_a_scene_of_something_else_is_refused(changes, words):
    given = scene_arguments()
    given["scene"] = given["scene"].with_changes(**changes)
    with pytest.raises(InputError, match=words):
        shard_from_arrays(**given)


# --- files of arrays -------------------------------------------------------------------


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
    with pytest.raises(InputError, match=r"mesh-0003\.h5"):
        import_trajectories([source], tmp_path / "set", split="validation", number=3)


def test_wrong_npz_files_are_refused_by_name(tmp_path):
    (tmp_path / "text.npz").write_text("text")
    with (tmp_path / "npy.npz").open("wb") as file:
        np.save(file, REFERENCE)
    for source, kind, words in (
        (tmp_path / "none.npz", FileFormatError, "none.npz"),
        (tmp_path / "text.npz", FileFormatError, "text.npz"),
        (tmp_path / "npy.npz", FileFormatError, "npy.npz"),
        (saved_arrays(tmp_path / "a.npz", free=None), InputError, "a.npz: .*free"),
        (saved_arrays(tmp_path / "b.npz", young=[1.0]), InputError, "b.npz: young"),
        (saved_arrays(tmp_path / "c.npz", reference_0=None), InputError, "c.npz: .*'reference"),
        (
            saved_arrays(tmp_path / "d.npz", reference_1=3.0),
            InputError,
            r"1, reference: .* shape \(\)",
        ),
    ):
        with pytest.raises(kind, match=words) as caught:
            import_trajectories([source], tmp_path / "set")
        assert str(caught.value).count(source.name) == 1
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "set").exists()


NONE = {"reference_0": None, "reference_1": None}
ALONE = {"reference": REFERENCE, **NONE}


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"colour": [1.0]}, "'colour'"),
        ({"predictions": REFERENCE[1:]}, "'predictions'"),
        ({"reference": REFERENCE}, "'reference'"),
        ({"reference_3": REFERENCE}, "'reference_3'"),
        ({"forces_2": REFERENCE[1:]}, "'forces_2'"),
        (ALONE, "'forces_0'"),
    ],
)
def test_arrays_that_would_be_left_out_are_refused(tmp_path, changes, word):
    source = saved_arrays(tmp_path / "run.npz", **changes)
    with pytest.raises(InputError, match=word):
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


def test_data_sets_neither_take_imports_nor_are_imported(tmp_path):
    source = saved_arrays(tmp_path / "run.npz")
    (tmp_path / "config.toml").write_text("")
    with pytest.raises(InputError, match=r"config\.toml"):
        import_trajectories([source], tmp_path, split="extra")
    assert not (tmp_path / "extra").exists()
    for split in ("", "..", "a/b"):
        with pytest.raises(InputError, match="split"):
            import_trajectories([source], tmp_path / "new", split=split)
    with pytest.warns(PdcorrectWarning, match="split 'own'"):
        import_trajectories([source], tmp_path / "new", split="own")
    root = samples.write(tmp_path / "set", [samples.shard(steps=(3,))])
    with pytest.raises(FileFormatError, match=r"mesh-0000\.h5"):
        import_trajectories([root / "training/mesh-0000.h5"], tmp_path / "other")


# --- files of runs ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs():
    """A fine and a coarse run of a beam."""
    scene = beam(cells=(3, 1, 1), time=stepped(4))
    found = [
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine=refine))) for refine in (2, 1)
    ]
    return [replace(run, scene_toml=scene.to_toml()) for run in found]


def test_runs_of_simulate_become_a_file_with_predictions(runs):
    fine, coarse = runs
    shard = shard_from_trajectories(fine, coarse)
    problem = pc.discretise(beam(cells=(3, 1, 1), time=stepped(4)))
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
        (lambda run: rerun(run, material={"young": 2e6}), "material"),
        (lambda run: rerun(run, loads=[]), "loads"),
        (lambda run: rerun(run, clamps=[]), "clamps"),
        (lambda run: rerun(run, body={"cells": [3, 2, 1]}), "body"),
        (lambda run: rerun(run, damping={"mass": 1.0}), "damping"),
        (lambda run: replace(run, times=2 * run.times), "0.08 s.*0.04 s"),
        (
            lambda run: replace(run, times=run.times[:-1], positions=run.positions[:-1]),
            "coarse run .* 3 steps.* 4 up",
        ),
        (lambda run: replace(run, scene_toml=""), "coarse run"),
        (
            lambda run: with_attributes(run, material="changed after the scene"),
            "coarse run .* material",
        ),
        (lambda run: with_attributes(run, integrator="midpoint"), "coarse run .*'midpoint'"),
    ],
)
def test_a_coarse_run_of_another_simulation_is_refused(runs, change, words):
    fine, coarse = runs
    with pytest.raises(InputError, match=words):
        shard_from_trajectories(fine, change(coarse))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda run: with_attributes(run, material="changed after the scene"),
            "reference .* material",
        ),
        (lambda run: with_attributes(run, integrator="bdf2"), "reference .*'bdf2'"),
        (
            lambda run: rerun(run, time={"step": 0.01, "frames": 4, "integrator": "quasi-static"}),
            "reference .*'quasi-static'",
        ),
        (lambda run: replace(run, times=run.times + 1.0), "reference .* 1 s"),
        (lambda run: replace(run, velocities=run.velocities + 0.5), r"reference .* 0\.5 m/s"),
    ],
)
def test_a_reference_that_its_scene_does_not_describe_is_refused(runs, change, words):
    with pytest.raises(InputError, match=words):
        shard_from_trajectories(change(runs[0]))


def quadratic_run(refine):
    scene = beam(cells=(3, 1, 1), time=stepped(4), solver={"element": "hex27"})
    return pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine=refine)))


def test_runs_that_do_not_belong_together_are_refused(runs):
    fine, coarse = runs
    quadratic = quadratic_run(1)
    softer = beam(cells=(3, 1, 1), material={"young": 9e5}, time=stepped(4)).to_toml()
    motion = {"times": [0.0, 1.0], "displacement": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]}
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": motion}]
    scene = beam(cells=(3, 1, 1), time=stepped(2), clamps=clamps)
    moving = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
    for references, rollouts, words in (
        ([fine, fine], [coarse], "2 references and 1 "),
        ([replace(fine, scene_toml="")], [], "scene"),
        ([fine, replace(fine, scene_toml=softer)], [], "simulations 0 and 1 .* material"),
        ([], [], "reference"),
        (coarse, fine, "63 nodes.* 16"),
        (quadratic, [], "reference.*'hex27'"),  # as the coarse model
        (fine, quadratic, "coarse run.*'hex27'"),
        (moving, [], "reference: node .* row 2"),
    ):
        with pytest.raises(InputError, match=words):
            shard_from_trajectories(references, rollouts)


@pytest.mark.parametrize("refine", [1, 2])
def test_a_reference_may_have_nodes_between_the_corners(runs, refine):
    reference, coarse = quadratic_run(refine), runs[1]
    (found,) = shard_from_trajectories(reference, coarse).simulations
    problem = pc.discretise(beam(cells=(3, 1, 1), time=stepped(4)))
    positions = found.runs["reference"].positions
    np.testing.assert_array_equal(positions, restrict(reference, problem).positions)
    np.testing.assert_array_equal(positions[0], problem.positions)


def test_the_coarse_and_the_best_coarse_model_are_those_of_the_scene(runs):
    fine, coarse = runs
    other = rerun(coarse, solver={"element": "hex8-mean", "mass": "averaged"})
    shard = shard_from_trajectories(fine, other)
    (found,) = shard.simulations
    assert found.scene_toml == other.scene_toml
    problem = pc.discretise(pc.Scene.from_toml(other.scene_toml))
    expected = pc.ProjectiveDynamics(problem)(problem.rest_state()).state.positions
    np.testing.assert_allclose(found.runs["plain"].predictions[0], expected, atol=1e-12)
    assert np.abs(expected - coarse.positions[1]).max() > 1e-6

    fine, coarse = runs
    shard = shard_from_trajectories(fine, coarse, best=True)
    (found,) = shard.simulations
    scene = trained_coarse(pc.Scene.from_toml(coarse.scene_toml))
    stepper = pc.ProjectiveDynamics(pc.discretise(scene))
    run = found.runs["best"]
    np.testing.assert_allclose(run.positions, pc.rollout(stepper).positions, atol=1e-12)
    np.testing.assert_allclose(run.predictions[0], run.positions[1], atol=1e-7)
    assert np.abs(run.positions - found.runs["plain"].positions).max() > 1e-6
    better = rerun(coarse, solver={"element": "hex8-bubble", "mass": "averaged"})
    with pytest.raises(InputError, match="'hex8-bubble'"):
        shard_from_trajectories(fine, better, best=True)
    with pytest.raises(InputError, match="scene"):
        shard_from_arrays(**arguments(), best=True)


def test_models_of_the_best_coarse_model_are_trained_and_judged_on_an_import(runs, tmp_path):
    pytest.importorskip("torch")
    from pdcorrect.evaluation.evaluation import evaluate
    from pdcorrect.training.scenes import load_recordings, make_problems

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
    path.unlink()
    write_shard(path, shard_from_trajectories(fine, coarse, split="evaluation"))
    assert "error" in {finding.severity for finding in check_dataset(tmp_path)}

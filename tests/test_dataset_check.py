"""What a check of a data set finds in files, between files and beside them."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from dataset_samples import sample_config, sample_shard, with_run, with_simulation, write_dataset
from pdcorrect.data.check import check_dataset
from pdcorrect.data.check_file import same_scene
from pdcorrect.data.folder import all_shards, manifest_content
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import Run, read_header, read_shard, write_shard
from pdcorrect.errors import InputError

FIRST = "training/mesh-0000.h5"
NO_MANIFEST = "no manifest.json"
PLAN = re.compile(r"(that|what) config.toml draws|has no run '\w+'$")
"""What `check_dataset` says of files that differ from what the configuration draws."""


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("original")
    write_dataset(folder)
    return folder


@pytest.fixture
def dataset(original, tmp_path):
    """A data set to spoil: two training meshes, one of validation and one of evaluation."""
    return shutil.copytree(original, tmp_path / "sample")


def changed(path, change):
    """Rewrite a file with ``change`` made to its shard."""
    write_shard(path, change(read_shard(path)), overwrite=True)


def findings(folder, severity="error"):
    """(path in the folder, message) of each finding, all of them of one severity.

    Besides that samples have no manifest.
    """
    found = [f for f in check_dataset(folder, repeat=0) if not f.message.startswith(NO_MANIFEST)]
    assert all(f.severity == severity for f in found)
    return [(f.path.relative_to(folder).as_posix(), f.message) for f in found]


def one(folder, path=FIRST, severity="error"):
    """The message of the only finding, besides that the file is not the plan's."""
    found = findings(folder, severity)
    ((where, message),) = [row for row in found if not PLAN.search(row[1])] or found
    assert where == path
    return message


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_sound_data_set_has_no_findings(tmp_path, dtype):
    write_dataset(tmp_path, dtype=dtype)
    seen = []
    (finding,) = check_dataset(tmp_path, seen.append, 0)
    assert (finding.severity, finding.path) == ("warning", tmp_path)
    assert "manifest.json" in finding.message
    assert [path.relative_to(tmp_path).as_posix() for path in seen] == [
        "training/mesh-0000.h5", "training/mesh-0001.h5", "validation/mesh-0000.h5",
        "evaluation/mesh-0000.h5",
    ]  # fmt: skip


def test_a_corrupt_file_is_named_and_the_others_are_read(dataset):
    data = bytearray((dataset / FIRST).read_bytes())
    data[9000] ^= 1
    (dataset / FIRST).write_bytes(data)
    second = dataset / "training/mesh-0001.h5"
    changed(second, without_run(0, "plain"))
    found = findings(dataset)
    assert list(dict.fromkeys(path for path, _ in found)) == [FIRST, "training/mesh-0001.h5"]
    assert "checksum" in found[0][1]


def test_a_missing_folder_and_a_bad_configuration_are_named(dataset):
    with pytest.raises(InputError, match="none"):
        check_dataset(dataset / "none")
    (dataset / "config.toml").write_text("family = ")
    assert [path for path, _ in findings(dataset)] == ["config.toml"]


# --- one file --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("split", "validation"), ("number", 1), ("config_hash", "0" * 64),
    ],
)  # fmt: skip
def test_attributes_are_compared_with_the_configuration(dataset, name, value):
    changed(
        dataset / FIRST,
        lambda s: dataclasses.replace(s, attributes={**s.attributes, name: value}),
    )
    assert f"its {name} is {value!r}" in one(dataset)


def test_files_of_another_data_set_are_one_error(dataset):
    mesh = make_plan(sample_config())[0]
    write_shard(dataset / FIRST, sample_shard(sample_config(seed=8), mesh), overwrite=True)
    assert "config_hash" in one(dataset)
    imported = {"dataset": "mine", "setting": "imported", "config_hash": "", "tolerance": 0.0}
    changed(
        dataset / FIRST,
        lambda s: dataclasses.replace(s, attributes={**s.attributes, **imported}, mass=-s.mass),
    )
    assert "its config_hash is ''" in one(dataset)


def statistic(number, run, name, values):
    """A change of what a run says of its steps."""

    def change(shard):
        old = shard.simulations[number].runs[run].statistics
        return with_run(shard, number, run, statistics={**old, name: np.array(values)})

    return change


def without_run(number, name):
    def change(shard):
        runs = {own: run for own, run in shard.simulations[number].runs.items() if own != name}
        return with_simulation(shard, number, runs=runs)

    return change


def off_the_rest(shard):
    positions = shard.simulations[0].runs["best"].positions.copy()
    positions[0, 40, 2] += 1e-5
    return with_run(shard, 0, "best", positions=positions)


def moved_at_a_clamp(name):
    def change(shard):
        node = np.flatnonzero(~shard.free.any(axis=1))[0]
        values = getattr(shard.simulations[1].runs["plain"], name).copy()
        values[2, node, 1] += 2e-5
        return with_run(shard, 1, "plain", **{name: values})

    return change


def cut(shard):
    """The second simulation with three of its five frames."""

    def shorter(run):
        predictions = None if run.predictions is None else run.predictions[:3]
        statistics = {name: values[:3] for name, values in run.statistics.items()}
        return Run(run.positions[:4], predictions, statistics, run.attributes)

    old = shard.simulations[1]
    runs = {name: shorter(run) for name, run in old.runs.items()}
    return with_simulation(shard, 1, forces=old.forces[:3], runs=runs)


ESTIMATES = [1e-8, 1e-8, 1e-8, 5.02e-7, 1e-8]  # m; the tolerance is 1e-5 of cells of 0.05 m


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            statistic(1, "reference", "smallest_volume_ratios", [0.5, 0.4, -0.2, 0.3, 0.1]),
            ("simulation 0001", "reference", "-0.2", "step 3"),
        ),
        (statistic(0, "plain", "error_estimates", ESTIMATES), ("plain", "5.02e-07", "step 4")),
        (without_run(1, "reference"), ("simulation 0001", "'reference'")),
        (without_run(0, "best"), ("simulation 0000", "'best'")),
        (off_the_rest, ("best", "frame 0", "1e-05 m")),
        (moved_at_a_clamp("positions"), ("simulation 0001", "plain", "2e-05 m", "positions")),
        (moved_at_a_clamp("predictions"), ("simulation 0001", "plain", "2e-05 m", "predictions")),
        (
            lambda s: with_simulation(s, 1, forces=s.simulations[0].forces),
            ("simulation 0001", "simulation 0000 of training/mesh-0000.h5"),
        ),
        (lambda s: dataclasses.replace(s, simulations=s.simulations[:1]), ("1 simulations",)),
        (cut, ("simulation 0001", "3 frames")),
        (lambda s: dataclasses.replace(s, cells=np.roll(s.cells, 4, axis=1)), ("mesh",)),
        (
            lambda s: dataclasses.replace(s, density=s.density - s.density.max()),
            ("density is 0",),
        ),
        (lambda s: dataclasses.replace(s, young=7 * s.young), ("young", "config.toml")),
        (lambda s: dataclasses.replace(s, mass=3 * s.mass), ("mass", "config.toml")),
        (
            lambda s: with_simulation(s, 1, scene_toml="nonsense"),
            ("simulation 0001", "scene", "config.toml"),
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_found_and_named(dataset, change, named):
    changed(dataset / FIRST, change)
    found = findings(dataset)
    assert {path for path, _ in found} == {FIRST}
    assert any(all(word in message for word in named) for _, message in found), found


def test_a_tolerance_that_is_just_kept_is_sound(dataset):
    estimates = [1e-8, 1e-8, 1e-8, 4.99e-7, 1e-8]
    changed(dataset / FIRST, statistic(0, "plain", "error_estimates", estimates))
    assert findings(dataset) == []


@pytest.mark.parametrize(
    ("young", "same"),
    [
        ("100000.00000000001", True),  # the last digit, in which processors differ
        ("100000.00000001", False),
        ("true", False),
        ("nonsense", False),
    ],
)
def test_scenes_are_compared_to_the_last_digits_only(young, same):
    scene = beam(material={"young": 1e5})
    text = scene.to_toml()
    assert same_scene(text, scene)
    assert same_scene(text.replace("young = 100000.0", f"young = {young}"), scene) == same
    assert not same_scene(text.replace("-9.81", "9.81"), scene)
    assert not same_scene(text.replace("gravity", "force"), scene)


def test_a_scene_of_an_earlier_version_is_read_with_the_defaults_of_new_keys():
    text = beam().to_toml()
    assert "viscosity = 0.0\n" in text
    assert same_scene(text.replace("viscosity = 0.0\n", ""), beam())
    assert not same_scene(text.replace("viscosity = 0.0\n", "viscosity = 0.1\n"), beam())


def test_the_committed_data_set_is_sound_and_of_backward_euler():
    tiny = Path(__file__).parent.parent / "datasets" / "tiny"
    assert check_dataset(tiny) == []
    for path in all_shards(tiny):
        for simulation in read_shard(path).simulations:
            assert pc.Scene.from_toml(simulation.scene_toml).time.integrator == "backward-euler"


# --- several files ---------------------------------------------------------------------------


def renumbered(shard):
    """The same body and motions with nodes and cells in another order, elsewhere in space."""
    order = np.random.default_rng(3).permutation(len(shard.points))
    place = np.argsort(order)
    cells = place[shard.cells][::-1]
    away = np.array([3.0, -2.0, 0.7])

    def moved(run):
        predictions = None if run.predictions is None else run.predictions[:, order] + away
        return dataclasses.replace(
            run, positions=run.positions[:, order] + away, predictions=predictions
        )

    return dataclasses.replace(
        shard, points=shard.points[order] + away, cells=cells, free=shard.free[order],
        mass=shard.mass[order], young=shard.young[::-1],
        simulations=tuple(
            dataclasses.replace(
                s, forces=s.forces[:, order], runs={n: moved(r) for n, r in s.runs.items()}
            )
            for s in shard.simulations
        ),
    )  # fmt: skip


def body_of(shard, other):
    """``shard``'s mesh and simulations under the attributes of ``other``."""
    return dataclasses.replace(shard, attributes=other.attributes)


def test_equal_bodies_are_found(dataset):
    second = dataset / "training/mesh-0001.h5"
    twin = renumbered(read_shard(dataset / FIRST))
    changed(second, lambda s: body_of(twin, s))
    assert FIRST in one(dataset, "training/mesh-0001.h5")
    softer = dataclasses.replace(twin, young=0.5 * twin.young)
    changed(second, lambda s: body_of(softer, s))
    assert not any(FIRST in message for _, message in findings(dataset))


def test_equal_simulations_of_two_files_are_found(dataset):
    second = dataset / "training/mesh-0001.h5"
    twin = read_shard(dataset / FIRST)
    changed(second, lambda s: body_of(twin, s))
    messages = [message for _, message in findings(dataset)]
    for k in (0, 1):
        named = f"simulation {k:04d} has the mesh and the forces of simulation {k:04d} of {FIRST}"
        assert named in messages


@pytest.mark.parametrize("split", ["validation", "evaluation"])
def test_a_mesh_in_two_splits_is_found(dataset, split):
    twin = renumbered(read_shard(dataset / FIRST))
    softer = dataclasses.replace(twin, young=0.5 * twin.young)
    changed(dataset / split / "mesh-0000.h5", lambda s: body_of(softer, s))
    message = one(dataset, f"{split}/mesh-0000.h5")
    assert message.startswith("leakage")
    assert FIRST in message


def test_a_mesh_in_an_extra_split_and_another_is_found(tmp_path):
    extra = ({"name": "softer", "meshes": 1, "simulations": 1, "young": (1e4, 2e4)},)
    write_dataset(tmp_path, sample_config(extra=extra))
    assert findings(tmp_path) == []
    source = read_shard(tmp_path / "evaluation/mesh-0000.h5")
    source = dataclasses.replace(source, simulations=source.simulations[:1])
    source = with_simulation(source, 0, forces=2 * source.simulations[0].forces)
    changed(tmp_path / "softer/mesh-0000.h5", lambda s: body_of(source, s))
    assert "leakage" in one(tmp_path, "softer/mesh-0000.h5")


def test_missing_unexpected_and_left_over_files_are_found(dataset):
    (dataset / "training/mesh-0001.h5.part").write_bytes(b"half")
    one(dataset, "training/mesh-0001.h5.part", "warning")
    (dataset / "training/mesh-0001.h5.part").rename(dataset / "notes.txt")
    one(dataset, "notes.txt", "warning")
    (dataset / "notes.txt").unlink()
    (dataset / "training/mesh-0001.h5").rename(dataset / "training/mesh-0002.h5")
    found = [path for path, _ in findings(dataset)]
    assert found == ["training/mesh-0001.h5", *["training/mesh-0002.h5"] * 2]
    (dataset / "training/mesh-0002.h5").unlink()
    (finding,) = check_dataset(dataset, repeat=0)  # and no word of a manifest
    assert finding.path == dataset / "training/mesh-0001.h5"


@pytest.mark.parametrize(
    ("what", "values"), [("code", ("a" * 64, "b" * 64)), ("device", ("cpu", "NVIDIA H100"))]
)
def test_files_of_different_code_or_devices_are_pointed_out(dataset, what, values):
    paths = all_shards(dataset)
    for path, value in zip(paths, np.repeat(values, 2).tolist(), strict=True):
        changed(path, lambda s, value=value: dataclasses.replace(s, provenance={what: value}))
    ((path, message),) = findings(dataset, "warning")
    assert path == paths[2].relative_to(dataset).as_posix()
    assert str(paths[0].relative_to(dataset)) in message
    assert values[1][:12] in message


def test_a_content_other_than_the_manifest_has_is_found(dataset):
    names = [plan.name for plan in make_plan(sample_config())]
    hashes = {name: read_header(dataset / f"{name}.h5").content_hash for name in names}
    content = manifest_content(sample_config(), hashes)
    (dataset / "manifest.json").write_text(json.dumps(content))
    assert findings(dataset) == []
    changed(dataset / FIRST, lambda s: with_simulation(s, 1, scene_toml="another"))
    assert "manifest.json" in one(dataset)
    for text in ('{"files": 3}', "[]", "{}", "{", "[" * 100000):
        (dataset / "manifest.json").write_text(text)
        one(dataset, "manifest.json")


def test_the_command_ends_with_1_if_there_are_errors(program, dataset):
    check = ("dataset", "check", "--repeat", 0)  # their motions are made up
    status, out, _ = program(*check, dataset)
    assert status == 0
    assert "4 files, 0 errors, 1 warnings" in out
    (dataset / FIRST).write_bytes(b"")
    status, out, _ = program(*check, dataset)
    assert status == 1
    assert f"error: {dataset / FIRST}: " in out
    assert "4 files, 1 errors, 1 warnings" in out
    status, out, err = program("dataset", "check", dataset / "none")
    assert (status, out) == (2, "")
    assert str(dataset / "none") in err

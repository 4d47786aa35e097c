"""Files of data sets: round trips, damage, what a check finds, what a summary says."""

import dataclasses
import json
import os
import random
import re
import shutil
import time

import h5py
import numpy as np
import pytest

from dataset_samples import sample_config, sample_shard, with_run, with_simulation, write_dataset
from motion import trajectory
from pdcorrect.data import seal
from pdcorrect.data.check import check_dataset
from pdcorrect.data.check_file import same_scene
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.folder import all_shards
from pdcorrect.data.info import dataset_info
from pdcorrect.data.folder import manifest_content
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import (
    MESH,
    Run,
    Shard,
    Simulation,
    content_hash,
    content_of,
    write_shard,
)
from pdcorrect.data.shard_arrays import read_arrays, read_header
from pdcorrect.data.shard_reader import read_shard, stored_hashes
from pdcorrect.errors import FileFormatError, InputError, OutputError
from pdcorrect.io.trajectory import save_trajectory


@pytest.fixture(scope="module")
def shard():
    config = sample_config()
    return sample_shard(config, make_plan(config)[0])


@pytest.fixture(scope="module")
def saved(shard, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "shard.h5"
    write_shard(path, shard)
    return path


def assert_same(found, expected, dtype, runs=None):
    """All that a shard holds, its floats rounded to ``dtype``."""
    assert dict(found.attributes) == dict(expected.attributes)
    assert dict(found.provenance) == dict(expected.provenance)
    for name, (_, kind, _) in MESH.items():
        assert getattr(found, name).dtype == kind
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert len(found.simulations) == len(expected.simulations)
    for mine, wanted in zip(found.simulations, expected.simulations, strict=True):
        assert mine.forces.dtype == dtype
        np.testing.assert_array_equal(mine.forces, wanted.forces.astype(dtype))
        for name in ("scene_toml", "attempt", "rejected", "seconds"):
            assert getattr(mine, name) == getattr(wanted, name)
        assert sorted(mine.runs) == sorted(runs or wanted.runs)
        for name, run in mine.runs.items():
            assert_same_run(run, wanted.runs[name], dtype)


def assert_same_run(found, expected, dtype):
    assert dict(found.attributes) == dict(expected.attributes)
    for name in ("positions", "predictions"):
        mine, wanted = getattr(found, name), getattr(expected, name)
        assert (mine is None) == (wanted is None)
        if mine is not None:
            assert mine.dtype == dtype
            np.testing.assert_array_equal(mine, wanted.astype(dtype))
    assert set(found.statistics) == set(expected.statistics)
    for name, values in found.statistics.items():
        np.testing.assert_array_equal(values, expected.statistics[name].astype(values.dtype))


# --- round trips -------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("verify", [True, False])
def test_what_is_written_is_read(shard, tmp_path, dtype, verify):
    write_shard(tmp_path / "new" / "shard.h5", shard, dtype)
    assert_same(read_shard(tmp_path / "new" / "shard.h5", verify=verify), shard, dtype)
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("verify", [True, False])
def test_simulations_and_runs_are_read_alone(shard, saved, verify):
    found = read_shard(saved, simulations=[1], runs=["reference", "plain"], verify=verify)
    expected = dataclasses.replace(shard, simulations=shard.simulations[1:])
    assert_same(found, expected, "float32", ["plain", "reference"])
    assert [len(s.runs) for s in read_shard(saved, runs=(), verify=verify).simulations] == [0, 0]
    assert not read_shard(saved, simulations=(), verify=verify).simulations


def test_a_simulation_or_run_that_is_not_there_is_refused(saved):
    for arguments, words in (
        ({"simulations": [2]}, "no simulation 2: expected 0 to 1"),
        ({"simulations": [-1]}, "no simulation -1"),
        ({"runs": ["worst"]}, "runs of simulation 0000 has no 'worst': expected one of best, "),
    ):
        with pytest.raises(FileFormatError, match=words) as caught:
            read_shard(saved, **arguments)
        assert str(saved) in str(caught.value)


def test_texts_of_any_length_and_no_rejected_draws(shard, tmp_path):
    plain = with_simulation(
        shard, 0, attempt=0, rejected=(), scene_toml="# ä\n" * 50000, seconds={}
    )
    bare = dataclasses.replace(plain, provenance={}, simulations=plain.simulations[:1])
    write_shard(tmp_path / "shard.h5", bare)
    assert_same(read_shard(tmp_path / "shard.h5"), bare, "float32")


def test_other_programs_read_the_file(shard, saved):
    with h5py.File(saved) as file:
        assert file.attrs["format"] == "pdcorrect-dataset"
        assert file.attrs["version"] == 1
        assert file.userblock_size == seal.USER_BLOCK
        np.testing.assert_array_equal(file["mesh/points"][()], shard.points)
        run = file["simulations/0001/runs/plain"]
        np.testing.assert_array_equal(
            run["predictions"][()], shard.simulations[1].runs["plain"].predictions.astype("f4")
        )
    lines = saved.read_bytes()[: seal.USER_BLOCK].rstrip(b"\0").decode().splitlines()
    assert lines[:2] == ["pdcorrect-dataset 1", f"bytes {saved.stat().st_size}"]
    assert lines[2].startswith("sha256 ")


def test_the_hash_is_of_the_content_without_provenance_and_cost(shard, saved, tmp_path):
    def written(changed, dtype="float32"):
        return write_shard(tmp_path / "other.h5", changed, dtype, overwrite=True)

    expected = written(shard)
    with h5py.File(saved) as file:
        assert expected == file.attrs["content_hash"] == content_hash(content_of(file))
    for same in (
        dataclasses.replace(shard, provenance={"date": "other"}),
        with_simulation(shard, 1, seconds={"reference": 17.0}),
    ):
        assert written(same) == expected
    run = shard.simulations[0].runs["best"]
    moved = run.positions.copy()
    moved[2, 3, 1] += 1e-3
    for other in (
        dataclasses.replace(shard, young=1.001 * shard.young),
        dataclasses.replace(shard, attributes={**shard.attributes, "number": 3}),
        with_run(shard, 0, "best", positions=moved),
        with_run(shard, 0, "best", attributes={**run.attributes, "refine": 2}),
        with_simulation(shard, 1, scene_toml="other"),
        with_simulation(shard, 1, rejected=("another reason",)),
        dataclasses.replace(shard, simulations=shard.simulations[::-1]),
    ):
        assert written(other) != expected
    assert written(shard, "float64") != expected


def test_a_file_that_cannot_be_written_is_named(shard, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file/shard.h5: cannot be written"):
        write_shard(tmp_path / "file" / "shard.h5", shard)


def test_an_existing_file_is_replaced_only_when_asked(shard, tmp_path):
    path = str(tmp_path / "shard.h5")
    first = write_shard(path, shard)
    with pytest.raises(OutputError, match=r"shard\.h5: exists already; .* overwrite=True"):
        write_shard(path, shard, "float64")
    assert stored_hashes(tmp_path / "shard.h5")[1] == first
    assert write_shard(path, shard, "float64", overwrite=True) != first


@pytest.mark.parametrize("dtype", ["float16", "int32", "double", "f4", "text"])
def test_numbers_are_stored_in_one_of_two_types(shard, tmp_path, dtype):
    with pytest.raises(InputError, match=f"dtype = '{dtype}': expected 'float32' or 'float64'"):
        write_shard(tmp_path / "shard.h5", shard, dtype)
    assert not (tmp_path / "shard.h5").exists()


# --- damage ------------------------------------------------------------------------------


def refusal(path, **options):
    """Why a file is refused; fails if it is not, or in any other way."""
    with pytest.raises(FileFormatError) as caught:
        read_shard(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message) > len(str(path)) + 15
    assert message.endswith(".")
    assert len(message.splitlines()) == 1
    return message


def test_every_flipped_bit_is_found(saved, tmp_path):
    data, path = saved.read_bytes(), tmp_path / "shard.h5"
    rng = random.Random(1)
    places = [*range(0, 200, 7), 300, 511, 512, 520, 600, len(data) - 1]
    places += [rng.randrange(len(data)) for _ in range(150)]
    for place in places:
        changed = bytearray(data)
        changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        refusal(path)


def test_every_truncation_is_found(saved, tmp_path):
    data, path = saved.read_bytes(), tmp_path / "shard.h5"
    rng = random.Random(2)
    for length in [1, 10, 30, 511, 512, 513, len(data) - 1, *rng.sample(range(len(data)), 50)]:
        path.write_bytes(data[:length])
        for verify in (True, False):
            assert "truncated" in refusal(path, verify=verify)
    path.write_bytes(data + b"\0")
    assert f"expected {len(data)} bytes, got {len(data) + 1}" in refusal(path)


def test_blocks_that_are_zeroed_swapped_or_overwritten_are_found(saved, tmp_path):
    data, path = saved.read_bytes(), tmp_path / "shard.h5"
    rng = random.Random(3)
    for kind in range(60):
        size = rng.randrange(16, 4096)
        one, other = (rng.randrange(len(data) - size) for _ in range(2))
        changed = bytearray(data)
        changed[one : one + size] = (
            bytes(size), rng.randbytes(size), data[other : other + size]
        )[kind % 3]  # fmt: skip
        if changed != data:
            path.write_bytes(changed)
            refusal(path)


def test_files_of_other_formats_are_refused(tmp_path):
    path = tmp_path / "shard.h5"

    def plain_hdf5():
        with h5py.File(path, "w", userblock_size=1024) as file:
            file["mesh/points"] = np.zeros((3, 3))

    def archive():
        with path.open("wb") as file:
            np.savez(file, a=np.arange(9))

    writers = {
        "empty": lambda: path.write_bytes(b""),
        "lacks the checksum": lambda: save_trajectory(path, trajectory(frames=2)),
        "does not begin with": plain_hdf5,
        "not a file of a data set": archive,
        "not a file of a data": lambda: path.write_text('name = "a scene"\n'),
        "not a file of": lambda: path.write_bytes(random.Random(4).randbytes(5000)),
        "damaged: its first": lambda: path.write_bytes(b"pdcorrect-dataset 1\n".ljust(900, b"x")),
    }
    for words, write in writers.items():
        path.unlink(missing_ok=True)
        write()
        for verify in (True, False):
            assert words in refusal(path, verify=verify)


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.h5").mkdir()
    (tmp_path / "loop.h5").symlink_to(tmp_path / "loop.h5")
    os.mkfifo(tmp_path / "pipe.h5")
    assert "No such file" in refusal(tmp_path / "none.h5")
    assert "not a regular file" in refusal(tmp_path / "folder.h5")
    assert "not a regular file" in refusal(tmp_path / "pipe.h5")
    assert "cannot be read" in refusal(tmp_path / "loop.h5")


def test_a_newer_version_is_named(saved, tmp_path, monkeypatch):
    path = tmp_path / "shard.h5"
    monkeypatch.setattr(seal, "VERSION", 2)
    resealed(path, saved.read_bytes())
    monkeypatch.setattr(seal, "VERSION", 1)
    for verify in (True, False):
        words = refusal(path, verify=verify)
        assert "newer pdcorrect, in format version 2; this one reads version 1" in words
    monkeypatch.setattr(seal, "VERSION", 3)
    assert "format version 2: expected 3" in refusal(path)


def resealed(path, data):
    """Write bytes with a seal that fits them."""
    image = bytearray(data)
    seal.seal(memoryview(image))
    path.write_bytes(image)


def edited(saved, path, edit):
    """A copy whose HDF5 content ``edit`` has changed, with a seal that fits."""
    shutil.copy(saved, path)
    with h5py.File(path, "r+") as file:
        edit(file)
    resealed(path, path.read_bytes())


def replaced(place, values):
    def edit(file):
        del file[place]
        file[place] = values

    return edit


def everything(saved):
    """Places of all datasets and groups, and arrays of the former."""
    arrays, groups = {}, []
    with h5py.File(saved) as file:
        file.visititems(
            lambda name, item: (
                arrays.update({name: item[()]})
                if isinstance(item, h5py.Dataset)
                else groups.append(name)
            )
        )
    return arrays, groups


OPTIONAL = {
    "iterations", "error_estimates", "smallest_volume_ratios", "predictions", "best", "plain",
    "reference",
}  # fmt: skip
"""What a simulation may lack."""


def test_every_missing_part_is_named(saved, tmp_path):
    path = tmp_path / "shard.h5"
    arrays, groups = everything(saved)
    for place in [*arrays, *groups]:
        edited(saved, path, lambda file, place=place: file.__delitem__(place))
        last = place.split("/")[-1]
        if last in OPTIONAL or place.endswith(("plain/positions", "best/positions")):
            assert "not that of its attribute 'content_hash'" in refusal(path)
        else:
            assert last in refusal(path)


def test_every_wrong_shape_type_and_value_is_named(saved, tmp_path):
    path = tmp_path / "shard.h5"
    arrays, _ = everything(saved)
    for place, values in arrays.items():
        name = place.split("/")[-1]
        wrong = {"shape": values[..., None], "type": values.astype(np.complex128)}
        if place != "mesh/points" and place != "mesh/cells" and name != "forces":
            wrong["shape "] = values[:-1]
        if values.ndim > 1:
            wrong[" shape"] = values[:, :-1]
        if values.dtype.kind == "f":
            bad = values.copy()
            bad[tuple(n // 2 for n in bad.shape)] = np.nan if len(place) % 2 else np.inf
            wrong["infinite or NaN"] = bad
        for words, array in wrong.items():
            edited(saved, path, replaced(place, array))
            message = refusal(path)
            assert words.strip() in message
            assert name in message
            if place.startswith("simulations/0001"):
                assert "of simulation 0001" in message
    edited(saved, path, replaced("simulations/0001/runs/best/positions", np.zeros((6, 4, 3), "f4")))
    assert refusal(path).endswith(
        "shard.h5: runs/best/positions of simulation 0001 has shape (6, 4, 3): "
        "expected (T+1, N, 3) = (6, 63, 3)."
    )


def test_wrong_attributes_are_named(saved, tmp_path):
    path = tmp_path / "shard.h5"
    with h5py.File(saved) as file:
        names = list(file.attrs)
    for name in names:
        edited(saved, path, lambda file, name=name: file.attrs.__delitem__(name))
        assert name in refusal(path)
        edited(saved, path, lambda file, name=name: file.attrs.create(name, np.arange(3)))
        assert name in refusal(path)
    simulation = "simulations/0000"
    for place, name, value in (
        ("/", "number", "seven"), ("/", "time_step", np.nan), ("/", "time_step", "0.1"),
        ("/", "dataset", 3), ("/", "format", "other"), ("/", "version", 2),
        (simulation, "attempt", 0.5), (simulation, "scene", 4), (simulation, "rejected", 5),
        (simulation, "rejected", np.arange(4)), ("cost/0001", "plain", "long"),
        (f"{simulation}/runs/plain", "refine", np.zeros(2)),
    ):  # fmt: skip
        edited(saved, path, lambda f, p=place, n=name, v=value: f[p].attrs.__setitem__(n, v))
        assert name in refusal(path)


def test_contradictions_within_a_file_are_named(shard, saved, tmp_path):
    path = tmp_path / "shard.h5"
    cells = shard.cells.astype(np.int32)
    first = "simulations/0000"

    def huge(file, place, shape, **options):
        del file[place]
        file.create_dataset(place, shape, "f4" if "sim" in place else "f8", **options)

    def elsewhere(file):
        layout = h5py.VirtualLayout((len(shard.points), 3), "f8")
        layout[:] = h5py.VirtualSource(saved, "mesh/points", (len(shard.points), 3))
        del file["mesh/points"]
        file.create_virtual_dataset("mesh/points", layout)

    def raw(file):
        del file["mesh/mass"]
        bytes_of = [(str(saved), 0, 8 * len(shard.points))]
        file.create_dataset("mesh/mass", (len(shard.points),), "f8", external=bytes_of)

    def changed(file):
        file["mesh/points"][3] += 1e-3

    def no_cells(file):
        for place in ("mesh/cells", "material/young", "material/poisson", "material/density"):
            replaced(place, file[place][:0])(file)

    def loop(file):
        file[f"{first}/runs/again"] = file[first]

    for edit, words in (
        (replaced("mesh/cells", np.where(cells == 5, len(shard.points), cells)), "nodes 0 to 63"),
        (replaced("mesh/cells", cells - 1), "nodes -1 to "),
        (no_cells, "empty"),
        (replaced(f"{first}/forces", np.zeros((0, 63, 3), "f4")), "no step"),
        (replaced(f"{first}/forces", np.zeros((4, 63, 3), "f4")), "has shape"),
        (lambda file: huge(file, "mesh/points", (10**12, 3)), "of which 0 are stored"),
        (lambda f: huge(f, f"{first}/forces", (10**9, 63, 3), chunks=(1, 63, 3)), "are stored"),
        (
            lambda f: huge(f, f"{first}/forces", (9**9, 63, 3), chunks=(1, 63, 3), compression=4),
            "are stored",
        ),
        (elsewhere, "stored in this file"),
        (raw, "stored in this file"),
        (changed, "content_hash"),
        (loop, "runs/again/forces of simulation 0000 is unknown"),
        (lambda file: file.__setitem__("mesh/colour", np.zeros(3)), "mesh/colour is unknown"),
        (lambda file: file.move("simulations/0001", "simulations/0002"), "0001 is missing"),
        (lambda file: file.move("cost/0001", "cost/0005"), "cost/0001 is missing"),
        (lambda file: file.__setitem__("extra", np.zeros(3)), "extra is unknown"),
        (replaced("mesh", np.zeros(3)), "mesh is not a group"),
        (
            lambda f: replaced("mesh/mass", h5py.SoftLink("/nowhere"))(f),
            "the link mesh/mass leads nowhere",
        ),
    ):
        edited(saved, path, edit)
        assert words in refusal(path), words


def referring(place, dangling):
    """A dataset becomes object references, to the mesh or to what is no longer there."""

    def edit(file):
        shape, target = file[place].shape, file.create_group("gone")
        reference = (target if dangling else file["mesh"]).ref
        del file[place]
        file.create_dataset(place, shape, h5py.ref_dtype)[...] = reference
        del file["gone"]

    return edit


def regions(place):
    def edit(file):
        shape, reference = file[place].shape, file[place].regionref[...]
        del file[place]
        file.create_dataset(place, shape, h5py.regionref_dtype)[...] = reference

    return edit


def of_dtype(place, dtype, shape=None):
    def edit(file):
        found = file[place].shape if shape is None else shape
        del file[place]
        file.create_dataset(place, found, dtype)

    return edit


def attribute(place, name, value, dtype=None):
    return lambda file: file[place].attrs.create(name, value, dtype=dtype)


def references_in(place, name):
    """An attribute becomes three dangling references, which NumPy shows on several lines."""

    def edit(file):
        gone = file.create_group("gone").ref
        values = np.array([gone] * 3, dtype=h5py.ref_dtype)
        file[place].attrs.create(name, values, dtype=h5py.ref_dtype)
        del file["gone"]

    return edit


def nameless(place):
    """A name that is not UTF-8, of a group in a group."""
    return lambda file: h5py.h5g.create(file[place].id, b"\xff\xfe")


def nameless_attribute(place):
    def edit(file):
        space = h5py.h5s.create(h5py.h5s.SCALAR)
        h5py.h5a.create(file[place].id, b"\xff\xfe", h5py.h5t.NATIVE_INT32, space).write(
            np.array(3, dtype="i4")
        )

    return edit


def every(*edits):
    def edit(file):
        for one in edits:
            one(file)

    return edit


FORCES, FORCES_TOLD = "simulations/0000/forces", "forces of simulation 0000"
RUN = "simulations/0000/runs/reference"
ODD = {
    "dangling references": (
        referring(FORCES, dangling=True), f"{FORCES_TOLD} has type reference: expected float32"
    ),
    "references": (
        referring("mesh/cells", dangling=False), "mesh/cells has type reference: expected int32"
    ),
    "regions": (regions("mesh/points"), "mesh/points has type reference: expected float64"),
    "several dangling references": (
        every(*(referring(f"mesh/{name}", dangling=True) for name in ("points", "cells", "mass"))),
        "mesh/points has type reference",
    ),
    "a dangling link": (
        replaced(FORCES, h5py.SoftLink("/nowhere/x")), f"the link {FORCES_TOLD} leads nowhere"
    ),
    "several dangling links": (
        every(
            replaced("mesh/points", h5py.SoftLink("/nowhere/x")),
            replaced(f"{RUN}/positions", h5py.SoftLink("/nowhere/y")),
            replaced("cost", h5py.SoftLink("/nowhere/z")),
        ),
        "links lead nowhere: cost, mesh/points, runs/reference/positions of simulation 0000.",
    ),
    "very many dangling links": (
        lambda file: [
            replaced(place, h5py.SoftLink("/nowhere"))(file) for place, _, _ in MESH.values()
        ],
        "material/poisson, material/young, mesh/cells, mesh/free and 2 more.",
    ),
    "a link to itself": (
        replaced("mesh", h5py.SoftLink("/mesh")), "the link mesh leads nowhere"
    ),
    "a link to another file": (
        replaced(RUN, h5py.ExternalLink("other.h5", "/run")),
        "runs/reference of simulation 0000 is a link to another file, 'other.h5': expected all",
    ),
    "a type in place of an array": (
        replaced(FORCES, np.dtype("f4")), f"{FORCES_TOLD} is not a dataset"
    ),
    "a type in place of a group": (
        replaced(RUN, np.dtype("f4")), "runs/reference of simulation 0000 is not a group"
    ),
    "nothing": (replaced("mesh/points", h5py.Empty("f8")), "mesh/points has shape None: expected"),
    "texts": (
        of_dtype("mesh/points", h5py.string_dtype()), "mesh/points has type text: expected float64"
    ),
    "rows": (
        of_dtype("mesh/points", h5py.vlen_dtype("f8")), "mesh/points has type rows of any length"
    ),
    "records": (
        of_dtype("mesh/cells", [("a", "f4"), ("b", "f4")]), "mesh/cells has type [('a', '<f4'), ("
    ),
    "a reference among attributes": (
        references_in("/", "number"),
        "number of the file is array([<HDF5 object reference>, <HDF5 object reference>",
    ),
    "references among texts": (
        references_in("simulations/0000", "rejected"),
        "rejected of simulation 0000 is array([<HDF5 object reference>",
    ),
    "an empty attribute": (
        attribute("/", "time_step", h5py.Empty("f4")), "time_step of the file is Empty("
    ),
    "no reasons": (
        lambda file: file["simulations/0001"].attrs.__delitem__("rejected"),
        "the attribute rejected of simulation 0001 is missing",
    ),
    "bytes": (
        attribute("/", "dataset", np.bytes_(b"set")), "dataset of the file is np.bytes_(b'set')"
    ),
    "a name of two lines": (
        lambda file: file.create_group("mesh/a\nb"), "mesh/a b is unknown in version 1"
    ),
    "a group without a name": (
        nameless("simulations/0000/runs"),
        "runs of simulation 0000 holds the name b'\\xff\\xfe', which is no text",
    ),
    "an attribute without a name": (
        nameless_attribute("simulations/0000"),
        "simulation 0000 has the name b'\\xff\\xfe', which is no text",
    ),
    "a group among costs": (
        lambda file: file.create_group("cost/0001/more"), "cost/0001/more is unknown"
    ),
    "a group in the provenance": (
        lambda file: file.create_group("provenance/more"), "provenance/more is unknown"
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", ODD)
def test_what_hdf5_may_hold_instead_is_named_with_its_place(saved, tmp_path, kind):
    edit, words = ODD[kind]
    path = tmp_path / "training" / "mesh-0000.h5"
    path.parent.mkdir()
    edited(saved, path, edit)
    for verify in (True, False):
        assert words in refusal(path, verify=verify)
    (found,) = check_dataset(tmp_path)[1:]  # the first says that there is no configuration
    assert found.path == path
    assert words.removesuffix(".") in found.message
    assert len(str(found).splitlines()) == 1


@pytest.mark.parametrize("kind", ODD)
def test_readers_of_parts_say_the_same_where_they_fail(saved, tmp_path, kind):
    edit, words = ODD[kind]
    path = tmp_path / "shard.h5"
    edited(saved, path, edit)
    for read in (read_header, lambda path: read_arrays(path, ("plain",), ("plain",))):
        try:
            read(path)
        except FileFormatError as error:
            assert str(error).startswith(f"{path}: ")
            assert words in str(error)


def test_a_run_that_is_not_there_is_named_by_the_reader_of_arrays(saved, tmp_path):
    path = tmp_path / "shard.h5"
    edited(saved, path, lambda file: file.move(RUN, f"{RUN}s"))
    with pytest.raises(
        FileFormatError, match="runs/reference/positions of simulation 0000 is missing"
    ):
        read_arrays(path)


def test_damaged_chunks_are_named_without_the_checksum(shard, saved, tmp_path):
    path, place = tmp_path / "shard.h5", "simulations/0001/runs/plain/predictions"
    with h5py.File(saved) as file:
        chunk = file[place].id.get_chunk_info(0)
    data = bytearray(saved.read_bytes())
    data[seal.USER_BLOCK + chunk.byte_offset + chunk.size // 2] ^= 4
    path.write_bytes(data)
    assert "checksum (SHA-256)" in refusal(path)
    message = refusal(path, verify=False)
    assert "runs/plain/predictions of simulation 0001 is damaged" in message
    read_shard(path, simulations=[0], verify=False)


def test_reading_is_fast(tmp_path):
    """Ten megabytes of noise, with generous room for a busy machine."""
    rng = np.random.default_rng(0)
    config = sample_config(coarse_nodes=None, frames=100)
    mesh = make_plan(config)[1]
    whole = sample_shard(config, mesh)
    noisy = whole
    for k, simulation in enumerate(whole.simulations):
        for name, run in simulation.runs.items():
            noise = rng.normal(size=run.positions.shape)
            noisy = with_run(noisy, k, name, positions=run.positions + noise)
    write_shard(tmp_path / "shard.h5", noisy)
    assert (tmp_path / "shard.h5").stat().st_size > 4e6
    seconds = []
    for _ in range(3):
        start = time.process_time()
        read_shard(tmp_path / "shard.h5")
        seconds.append(time.process_time() - start)
    assert min(seconds) < 0.4


# --- check -------------------------------------------------------------------------------


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


NO_MANIFEST = "no manifest.json: start generate again to write it"


def findings(folder, severity="error"):
    """(path in the folder, message) of each finding, all of them of one severity.

    Besides that samples have no manifest.
    """
    found = [f for f in check_dataset(folder, repeat=0) if f.message != NO_MANIFEST]
    assert all(f.severity == severity for f in found)
    return [(f.path.relative_to(folder).as_posix(), f.message) for f in found]


FIRST = "training/mesh-0000.h5"


PLAN = re.compile(r"(that|what) config.toml draws|has no run '\w+'$")
"""What `check_dataset` says of files that differ from what the configuration draws."""


def one(folder, path=FIRST, severity="error"):
    """The message of the only finding, besides that the file is not the plan's."""
    found = findings(folder, severity)
    ((where, message),) = [row for row in found if not PLAN.search(row[1])] or found
    assert where == path
    return message


def test_a_sound_data_set_has_no_findings(original):
    seen = []
    (finding,) = check_dataset(original, seen.append, 0)
    assert str(finding) == f"warning: {original}: {NO_MANIFEST}"
    names = [path.relative_to(original).as_posix() for path in seen]
    assert names == [
        "training/mesh-0000.h5", "training/mesh-0001.h5", "validation/mesh-0000.h5",
        "evaluation/mesh-0000.h5",
    ]  # fmt: skip


def test_double_precision_is_sound_too(tmp_path):
    write_dataset(tmp_path / "sample", dtype="float64")
    assert findings(tmp_path / "sample") == []


def test_a_corrupt_file_is_named_and_the_others_are_read(dataset):
    data = bytearray((dataset / FIRST).read_bytes())
    data[9000] ^= 1
    (dataset / FIRST).write_bytes(data)
    second = dataset / "training/mesh-0001.h5"
    changed(second, lambda s: with_simulation(s, 0, attempt=5))
    found = findings(dataset)
    assert list(dict.fromkeys(path for path, _ in found)) == [FIRST, "training/mesh-0001.h5"]
    assert found[0][1].startswith("damaged: its checksum")


def test_a_missing_folder_and_a_bad_configuration_are_named(dataset):
    with pytest.raises(InputError, match="not a folder"):
        check_dataset(dataset / "none")
    (dataset / "config.toml").write_text("family = ")
    (dataset / "training/mesh-0000.h5").unlink()
    found = findings(dataset)
    assert found[0][0] == "config.toml"
    assert "not valid TOML" in found[0][1]
    assert found[1:] == [(FIRST, "missing: later numbers are there")]


def test_files_of_another_configuration_are_found(dataset):
    other = sample_config(seed=8)
    mesh = make_plan(sample_config())[0]
    shard = sample_shard(other, mesh)
    write_shard(dataset / FIRST, shard, overwrite=True)
    assert "config_hash" in one(dataset)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dataset", "other"), ("split", "validation"), ("number", 1), ("setting", "as-published"),
        ("time_step", 0.02), ("tolerance", 2e-5), ("config_hash", "0" * 64),
    ],
)  # fmt: skip
def test_attributes_are_compared_with_the_configuration(dataset, name, value):
    changed(
        dataset / FIRST,
        lambda s: dataclasses.replace(s, attributes={**s.attributes, name: value}),
    )
    assert f"its {name} is {value!r}: expected " in one(dataset)


def test_a_file_from_elsewhere_is_one_error(dataset):
    imported = {"dataset": "mine", "setting": "imported", "config_hash": "", "tolerance": 0.0}

    def foreign(shard):
        return dataclasses.replace(
            shard, attributes={**shard.attributes, **imported}, mass=-shard.mass
        )

    changed(dataset / FIRST, foreign)
    assert "of another data set: its config_hash is '': expected " in one(dataset)


def test_an_inverted_reference_is_found(dataset):
    ratios = np.array([0.5, 0.4, -0.2, 0.3, 0.1])

    def spoil(shard):
        old = shard.simulations[1].runs["reference"].statistics
        return with_run(shard, 1, "reference", statistics={**old, "smallest_volume_ratios": ratios})

    changed(dataset / FIRST, spoil)
    assert one(dataset) == "simulation 0001: reference: det F is -0.2 after step 3"


def test_a_missing_reference_is_found(dataset):
    def spoil(shard):
        runs = dict(shard.simulations[1].runs)
        del runs["reference"]
        return with_simulation(shard, 1, runs=runs)

    changed(dataset / FIRST, spoil)
    assert [message for _, message in findings(dataset)] == [
        "simulation 0001: there is no rollout 'reference'",
        "simulation 0001 has no run 'reference'",
    ]


def test_a_missing_run_is_found(dataset):
    def spoil(shard):
        runs = dict(shard.simulations[0].runs)
        del runs["best"]
        return with_simulation(shard, 0, runs=runs)

    changed(dataset / FIRST, spoil)
    assert one(dataset) == "simulation 0000 has no run 'best', unlike others"


def test_a_missed_tolerance_is_found(dataset):
    """1e-5 of cells of 0.05 m."""
    for value, sound in ((4.99e-7, True), (5.02e-7, False)):

        def spoil(shard, value=value):
            old = shard.simulations[0].runs["plain"].statistics
            estimates = np.full(5, 1e-8)
            estimates[3] = value
            return with_run(shard, 0, "plain", statistics={**old, "error_estimates": estimates})

        changed(dataset / FIRST, spoil)
        if sound:
            assert findings(dataset) == []
        else:
            message = one(dataset)
    assert "plain: the solver's error estimate is 5.02e-07 m after step 4" in message
    assert "at most 5e-07 m" in message


def test_a_first_frame_that_is_not_the_rest_shape_is_found(dataset):
    def spoil(shard):
        positions = shard.simulations[0].runs["best"].positions.copy()
        positions[0, 40, 2] += 1e-5
        return with_run(shard, 0, "best", positions=positions)

    changed(dataset / FIRST, spoil)
    assert "best: frame 0 is 1e-05 m off the rest shape" in one(dataset)


@pytest.mark.parametrize("name", ["positions", "predictions"])
def test_held_nodes_that_move_are_found(dataset, name):
    def spoil(shard):
        node = np.flatnonzero(~shard.free.any(axis=1))[0]
        values = getattr(shard.simulations[1].runs["plain"], name).copy()
        values[2, node, 1] += 2e-5
        return with_run(shard, 1, "plain", **{name: values})

    changed(dataset / FIRST, spoil)
    message = one(dataset)
    assert message.startswith("simulation 0001: plain: held nodes are up to 2e-05 m off")
    assert message.endswith(name)


def test_equal_loads_on_a_mesh_are_found(dataset):
    changed(dataset / FIRST, lambda s: with_simulation(s, 1, forces=s.simulations[0].forces))
    assert one(dataset) == (
        "simulation 0001 has the mesh and the forces of simulation 0000 of training/mesh-0000.h5"
    )


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


@pytest.mark.parametrize(
    ("young", "same"),
    [
        ("1.0000000000000002e5", True),  # the last digit, in which processors differ
        ("1.0000000000001e5", False),
        ("true", False),
        ("nonsense", False),
    ],
)
def test_scenes_are_compared_to_the_last_digits_only(young, same):
    text = '[material]\nyoung = {}\n[[loads]]\nkind = "gravity"\nacceleration = [0.0, 0.0, 1.0]\n'
    assert same_scene(text.format(young), text.format("1.0e5")) == same
    assert not same_scene(text.format("1.0e5").replace("0.0, 1.0]", "1.0]"), text.format("1.0e5"))
    assert not same_scene(text.format("1.0e5").replace("gravity", "force"), text.format("1.0e5"))


def body_of(shard, other):
    """``shard``'s mesh and simulations under the attributes of ``other``."""
    return dataclasses.replace(shard, attributes=other.attributes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda s: dataclasses.replace(s, young=7 * s.young),
            "its young is not what config",
        ),
        (
            lambda s: dataclasses.replace(s, mass=3 * s.mass),
            "its mass is not what config",
        ),
        (
            lambda s: with_simulation(s, 1, scene_toml="nonsense"),
            "simulation 0001: its scene is not the one that config.toml draws",
        ),
        (
            lambda s: dataclasses.replace(
                s,
                simulations=tuple(
                    dataclasses.replace(k, runs={n: r for n, r in k.runs.items() if n != "plain"})
                    for k in s.simulations
                ),
            ),
            "simulation 0000 has no run 'plain'",
        ),
    ],
)
def test_what_the_configuration_did_not_draw_is_found(dataset, change, message):
    changed(dataset / FIRST, change)
    assert findings(dataset)[0][1].startswith(message)


def test_equal_bodies_are_found(dataset):
    second = dataset / "training/mesh-0001.h5"
    twin = renumbered(read_shard(dataset / FIRST))
    changed(second, lambda s: body_of(twin, s))
    assert one(dataset, "training/mesh-0001.h5") == (
        "its mesh and material are those of training/mesh-0000.h5"
    )
    softer = dataclasses.replace(twin, young=0.5 * twin.young)
    changed(second, lambda s: body_of(softer, s))
    assert not any("mesh and material are those" in message for _, message in findings(dataset))


@pytest.mark.parametrize("split", ["validation", "evaluation"])
def test_a_mesh_in_two_splits_is_found(dataset, split):
    twin = renumbered(read_shard(dataset / FIRST))
    softer = dataclasses.replace(twin, young=0.5 * twin.young)
    changed(dataset / split / "mesh-0000.h5", lambda s: body_of(softer, s))
    assert one(dataset, f"{split}/mesh-0000.h5") == (
        "leakage: its mesh is that of training/mesh-0000.h5, in another split"
    )


def test_a_mesh_in_an_extra_split_and_another_is_found(tmp_path):
    extra = ({"name": "softer", "meshes": 1, "simulations": 1, "young": (1e4, 2e4)},)
    config = write_dataset(tmp_path, sample_config(extra=extra))
    assert findings(tmp_path) == []
    assert isinstance(config, DatasetConfig)
    source = read_shard(tmp_path / "evaluation/mesh-0000.h5")
    source = dataclasses.replace(source, simulations=source.simulations[:1])
    source = with_simulation(source, 0, forces=2 * source.simulations[0].forces)
    changed(tmp_path / "softer/mesh-0000.h5", lambda s: body_of(source, s))
    assert "leakage" in one(tmp_path, "softer/mesh-0000.h5")


def test_an_incomplete_data_set_needs_no_manifest(dataset):
    (dataset / "training/mesh-0001.h5").unlink()
    (finding,) = check_dataset(dataset, repeat=0)
    assert finding.message == "missing: config.toml asks for it"


def test_missing_and_unexpected_files_are_found(dataset):
    (dataset / "training/mesh-0001.h5").rename(dataset / "training/mesh-0002.h5")
    found = dict(findings(dataset))
    assert found["training/mesh-0001.h5"] == "missing: config.toml asks for it"
    assert list(found) == ["training/mesh-0001.h5", "training/mesh-0002.h5"]
    messages = [message for path, message in findings(dataset) if path.endswith("0002.h5")]
    assert messages == ["its number is 1: expected 2", "config.toml does not ask for it"]


def test_left_over_and_foreign_files_are_warned_of(dataset):
    (dataset / "training/mesh-0001.h5.part").write_bytes(b"half")
    assert "left over" in one(dataset, "training/mesh-0001.h5.part", "warning")
    (dataset / "training/mesh-0001.h5.part").rename(dataset / "notes.txt")
    assert one(dataset, "notes.txt", "warning") == "not part of the data set"


def test_wrong_numbers_of_simulations_and_frames_are_found(dataset):
    changed(dataset / FIRST, lambda s: dataclasses.replace(s, simulations=s.simulations[:1]))
    assert one(dataset) == "1 simulations: expected 2"


def test_a_short_simulation_is_found(dataset):
    def cut(run):
        predictions = None if run.predictions is None else run.predictions[:3]
        statistics = {name: values[:3] for name, values in run.statistics.items()}
        return Run(run.positions[:4], predictions, statistics, run.attributes)

    def spoil(shard):
        old = shard.simulations[1]
        runs = {name: cut(run) for name, run in old.runs.items()}
        return with_simulation(shard, 1, forces=old.forces[:3], runs=runs)

    changed(dataset / FIRST, spoil)
    assert one(dataset) == "simulation 0001 has 3 frames: expected 5"


@pytest.mark.parametrize(
    ("what", "values", "told"),
    [
        ("code", ("a" * 64, "b" * 64), "made by other code than {} (SHA-256 bbbbbbbbbbbb)"),
        ("device", ("cpu", "NVIDIA H100"), "computed on another device than {}: NVIDIA H100"),
    ],
)
def test_files_of_different_code_or_devices_are_pointed_out(dataset, what, values, told):
    paths = all_shards(dataset)
    for path, value in zip(paths, np.repeat(values, 2).tolist(), strict=True):
        changed(path, lambda s, value=value: dataclasses.replace(s, provenance={what: value}))
    assert findings(dataset, "warning") == [
        (paths[2].relative_to(dataset).as_posix(), told.format(paths[0].relative_to(dataset)))
    ]


def test_a_content_other_than_the_manifest_has_is_found(dataset):
    names = [plan.name for plan in make_plan(sample_config())]
    hashes = {name: stored_hashes(dataset / f"{name}.h5")[1] for name in names}
    content = manifest_content(sample_config(), hashes)
    (dataset / "manifest.json").write_text(json.dumps(content))
    assert findings(dataset) == []
    changed(dataset / FIRST, lambda s: with_simulation(s, 1, scene_toml="another"))
    assert one(dataset) == "its content is not that of which manifest.json has the hash"
    for text in ('{"files": 3}', "[]", "{}", "{", "[" * 100000):
        (dataset / "manifest.json").write_text(text)
        assert "expected the hashes of all files" in one(dataset, "manifest.json")


def test_reasons_and_attempts_that_differ_are_found(dataset):
    changed(dataset / FIRST, lambda s: with_simulation(s, 1, attempt=2))
    assert "attempt is 2, with 1 reasons" in one(dataset)


def test_an_unusable_mesh_and_material_are_found(dataset):
    changed(dataset / FIRST, lambda s: dataclasses.replace(s, cells=np.roll(s.cells, 4, axis=1)))
    assert "its mesh cannot be used: " in one(dataset)
    shutil.copy(dataset / "training/mesh-0001.h5", dataset / FIRST)
    changed(
        dataset / "training/mesh-0001.h5",
        lambda s: dataclasses.replace(s, density=s.density - s.density.max()),
    )
    messages = [m for path, m in findings(dataset) if path == "training/mesh-0001.h5"]
    assert messages[0] == "density is 0 somewhere: expected more than 0"


# --- info --------------------------------------------------------------------------------


def counted_shard(split, number, size):
    """One cube of side 1; node 6 of the reference moves by 3 and 4 ``size`` in two steps."""
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    points = np.array(corners + [[x, y, 1] for x, y, _ in corners], dtype=float)

    def run(factor, steps, **predictions):
        positions = np.repeat(points[None], 3, axis=0)
        positions[1, 6, 0] += factor * 3 * size
        positions[2, 6, 0] += factor * 3 * size
        positions[2, 6, 1] += factor * 4 * size
        return Run(positions, **predictions, statistics={"iterations": np.array(steps)})

    one_step = run(1.0, [0, 0]).positions[1:].copy()
    one_step[:, 0, 2] += 0.2 * size
    forces = np.zeros((2, 8, 3))
    forces[1, 2] = [0.0, 6.0 * size, 8.0 * size]
    runs = {
        "reference": run(1.0, [10, 20]),
        "plain": run(0.5, [2, 4], predictions=one_step),
        "best": run(0.75, [5, 5 + number]),
    }
    seconds = {"reference": 8.0, "plain": 1.5}
    simulation = Simulation(
        forces, runs, attempt=number, rejected=("no",) * number, seconds=seconds
    )
    return Shard(
        attributes={
            "dataset": "counted", "split": split, "number": number, "setting": "exact",
            "config_hash": "0", "time_step": 0.5, "tolerance": 1e-5,
        },
        points=points, cells=np.arange(8)[None], free=np.ones((8, 3), bool), mass=np.ones(8),
        young=np.array([1e5 * (1 + number)]), poisson=np.array([0.3]), density=np.array([1e3]),
        simulations=(simulation,),
    )  # fmt: skip


def test_the_summary_has_the_numbers_of_hand(tmp_path):
    """Displacements 5 s, speeds 4 s / 0.5, forces 10 s with s = 1, 2, 4."""
    for split, number, size in (("training", 0, 1.0), ("training", 1, 2.0), ("evaluation", 0, 4.0)):
        write_shard(
            tmp_path / split / f"mesh-{number:04d}.h5",
            counted_shard(split, number, size),
            "float64",
        )
    info = dataset_info(tmp_path)
    assert list(info.splits) == ["training", "evaluation"]
    whole, training = info.whole, info.splits["training"]
    assert (whole.meshes, whole.simulations, whole.frames) == (3, 3, 6)
    assert (training.meshes, training.simulations, training.frames) == (2, 2, 4)
    assert whole.bytes == sum(path.stat().st_size for path in tmp_path.glob("*/*.h5"))
    assert whole.nodes == (8, 8)
    assert whole.cells == (1, 1)
    assert whole.young == (1e5, 2e5)
    assert info.splits["evaluation"].young == (1e5, 1e5)
    for name, factor in (("displacement", 5.0), ("speed", 8.0), ("force", 10.0)):
        spread = getattr(whole, name)
        assert spread.mean == pytest.approx(factor * 7 / 3)
        assert spread.smallest == pytest.approx(factor)
        assert spread.median == pytest.approx(2 * factor)
        assert spread.largest == pytest.approx(4 * factor)
        assert spread.q05 == pytest.approx(1.1 * factor)
        assert spread.q95 == pytest.approx(3.8 * factor)
    assert (training.rejected, training.rejection_rate) == (1, pytest.approx(1 / 3))
    assert training.seconds == {"reference": 16.0, "plain": 3.0, "total": 19.0}
    assert whole.seconds["total"] == 28.5
    assert list(whole.runs) == ["reference", "plain", "best"]
    reference, plain, best = whole.runs.values()
    assert (reference.iterations, reference.most_iterations) == (15, 20)
    assert (best.iterations, best.most_iterations) == (pytest.approx(31 / 6), 6)
    assert reference.rms_error is reference.omega is plain.omega is None
    # squared distances (1.5 s)^2 and (2.5 s)^2 of one node of 8, over two frames
    assert plain.rms_error == pytest.approx(np.sqrt((1.5**2 + 2.5**2) / 16) * 7 / 3)
    assert best.rms_error == pytest.approx(0.5 * plain.rms_error)
    assert plain.step_error == pytest.approx(0.2 / np.sqrt(8) * 7 / 3)
    assert best.step_error is None
    for value in dataclasses.asdict(best.omega).values():
        assert value == pytest.approx(75.0)


def test_omega_spreads_over_simulations(tmp_path):
    """Displacements off by shares e of the plain run's error: Omega 100 (1 - e^2)."""
    shard = counted_shard("training", 0, 1.0)
    simulation = shard.simulations[0]
    reference, plain = (simulation.runs[name].positions for name in ("reference", "plain"))
    many = []
    for share in (0.0, 0.5, 2.0):
        best = Run(reference + share * (plain - reference))
        many.append(dataclasses.replace(simulation, runs={**simulation.runs, "best": best}))
    still = {**simulation.runs, "plain": simulation.runs["reference"]}
    many.append(dataclasses.replace(simulation, runs=still))  # no error to correct
    shard = dataclasses.replace(shard, simulations=tuple(many))
    write_shard(tmp_path / "training/mesh-0000.h5", shard, "float64")
    best = dataset_info(tmp_path).whole.runs["best"]
    assert best.simulations == 4
    assert best.omega.mean == pytest.approx((100 + 75 - 300) / 3)
    assert best.omega.median == pytest.approx(75)
    assert best.omega.smallest == pytest.approx(-300)
    assert best.omega.q05 == pytest.approx(-300 + 0.1 * 375)


def test_a_summary_of_nothing_or_of_a_damaged_file_is_refused(dataset, tmp_path):
    with pytest.raises(InputError, match="holds no files of a data set"):
        dataset_info(tmp_path / "none")
    (dataset / FIRST).write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"mesh-0000\.h5: the file is empty"):
        dataset_info(dataset)


# --- pictures ----------------------------------------------------------------------------


def drawn(path):
    iio = pytest.importorskip("imageio.v3")
    return iio.imread(path)[..., :3].astype(int)


@pytest.fixture(scope="module")
def view():
    pytest.importorskip("pyvista")
    return pytest.importorskip("pdcorrect.data.pictures")


def coloured(image):
    """Whether each pixel is coloured, as bodies are and text is not."""
    return np.ptp(image, axis=-1) > 25


@pytest.mark.parametrize("count", [1, 3, 6])
def test_thumbnails_show_a_body_in_every_panel(view, original, tmp_path, count):
    path = view.thumbnails(original, tmp_path / "a.png", count)
    image = drawn(path)
    columns = min(4, count)
    assert image.shape[1] == columns * view._WIDTH
    rows = -(-count // 4)
    panels = image[: image.shape[0] - round(4.2 * view._FONT)]
    height = panels.shape[0] / rows
    for k in range(columns * rows):
        top, left = round(k // columns * height), k % columns * view._WIDTH
        panel = panels[top : top + round(height), left : left + view._WIDTH]
        assert (coloured(panel).mean() > 0.02) == (k < count)
        assert not coloured(panel[:, [0, -1]]).any()


def test_there_are_not_more_thumbnails_than_simulations(view, original):
    files = sorted(original.glob("*/*.h5"))
    assert len(view._choice(files, 20)) == 8
    assert len(set(view._choice(files, 7))) == 7
    assert [path for path, _ in view._choice(files, 2)] == [files[0], files[2]]


def test_labels_of_stiffness_have_no_powers_of_ten(view):
    found = [view._kilo(young) for young in (1.0, 1234.0, 99_960.0, 1_004_000.0, 2e8)]
    assert found == ["0.001", "1.23", "100", "1004", "200000"]


def test_bad_pictures_are_refused(view, original, tmp_path):
    for path, count in ((tmp_path / "a.jpg", 8), (tmp_path / "a.png", 0)):
        with pytest.raises(InputError, match="count"):
            view.thumbnails(original, path, count)
    with pytest.raises(InputError, match="expected a name ending"):
        view.histograms(original, tmp_path / "a.txt2")
    with pytest.raises(OutputError, match="no folder"):
        view.histograms(original, tmp_path / "none" / "a.png")


def test_histograms_count_every_simulation(view, original, tmp_path, monkeypatch):
    heights = []
    real = view._histogram

    def spy(axis, label, values):
        real(axis, label, values)
        heights.append([patch.get_xy()[:, 1].max() for patch in axis.patches])
        totals = {split: len(own) for split, own in values.items()}
        assert totals == {"training": 4, "validation": 2, "evaluation": 2}, label

    monkeypatch.setattr(view, "_histogram", spy)
    image = drawn(view.histograms(original, tmp_path / "a.png"))
    assert coloured(image).mean() > 0.001
    assert len(heights) == 8
    assert all(len(own) == 3 for own in heights)


# --- the program -------------------------------------------------------------------------


def test_check_ends_with_1_if_there_are_errors(program, dataset):
    check = ("dataset", "check", "--repeat", 0)  # their motions are made up
    status, out, _ = program(*check, dataset)
    assert (status, out) == (
        0, f"warning: {dataset}: {NO_MANIFEST}\n4 files, 0 errors, 1 warnings\n"
    )  # fmt: skip
    (dataset / "notes.txt").write_text("")
    status, out, _ = program(*check, dataset)
    assert status == 0
    assert "4 files, 0 errors, 2 warnings" in out
    (dataset / FIRST).write_bytes(b"")
    status, out, _ = program(*check, dataset)
    assert status == 1
    assert f"error: {dataset / FIRST}: the file is empty" in out
    assert "4 files, 1 errors, 2 warnings" in out
    status, out, err = program("dataset", "check", dataset / "none")
    assert (status, out) == (2, "")
    assert err == (f"error: {dataset / 'none'}: not a folder: expected that of a data set.\n")


def test_info_prints_tables_and_writes_json(program, dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    status, out, _ = program("dataset", "info", dataset, "--json", tmp_path / "info.json")
    assert status == 0
    for word in ("training", "evaluation", "Omega", "displacement, mm", "plain steps", "rejected"):
        assert word in out
    record = json.loads((tmp_path / "info.json").read_text())
    assert record["whole"]["simulations"] == 8
    assert record["splits"]["training"]["runs"]["best"]["omega"]["mean"] == pytest.approx(
        96, abs=0.1
    )
    again = tmp_path / "no" / "info.json"
    assert program("dataset", "info", dataset, "--json", again)[0] == 0
    assert json.loads(again.read_text()) == record
    status, _, err = program("dataset", "info", dataset, "--json", again / "info.json")
    assert status == 1
    assert "is a file: expected a folder" in err


def test_tables_without_rows_are_left_out(program, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    shard = counted_shard("training", 0, 1.0)
    simulation = shard.simulations[0]
    bare = {"reference": dataclasses.replace(simulation.runs["reference"], statistics={})}
    one = dataclasses.replace(simulation, runs=bare, seconds={})
    write_shard(tmp_path / "training/mesh-0000.h5", dataclasses.replace(shard, simulations=(one,)))
    status, out, _ = program("dataset", "info", tmp_path)
    assert status == 0
    assert "largest values of each simulation" in out
    for title in ("mean distance from the reference", "solver iterations", "cost"):
        assert title not in out


def test_info_draws_figures(program, view, dataset, tmp_path):
    status, out, _ = program("dataset", "info", dataset, "--figures", tmp_path / "new")
    assert status == 0
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "histograms.png", "samples.png",
    ]  # fmt: skip
    assert "samples.png" in out

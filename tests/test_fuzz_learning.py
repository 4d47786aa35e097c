"""Random damage to files of data sets, settings and models: read as they were, or refused.

Slow tests take 5500 inputs, the others 415; see test_fuzz.py.
"""

import hashlib
import json
import pickle
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w
from hypothesis import strategies as st

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")
pytest.importorskip("safetensors")

from fuzzing import (  # noqa: E402
    altered,
    counts,
    damaged,
    for_all,
    renumbered,
)
from pdcorrect.cli.common import BAD_INPUT  # noqa: E402
from pdcorrect.corrector.model_io import (  # noqa: E402
    DESCRIPTION,
    WEIGHTS,
    content_digest,
    load_model,
)
from pdcorrect.data.check import check_dataset  # noqa: E402
from pdcorrect.data.configuration import DatasetConfig  # noqa: E402
from pdcorrect.data.folder import all_shards  # noqa: E402
from pdcorrect.data.schema import read_shard  # noqa: E402
from pdcorrect.errors import FileFormatError, InputError  # noqa: E402
from pdcorrect.training.recipe import TrainingConfig  # noqa: E402
from test_corrector_model import assert_same_corrector  # noqa: E402
from test_dataset_files import assert_same  # noqa: E402

ROOT = Path(__file__).parent.parent
DATASET, MODEL = ROOT / "datasets" / "tiny", ROOT / "models" / "tiny"
SHARD = DATASET / "training" / "mesh-0000.h5"

value = (
    st.none()
    | st.booleans()
    | st.integers(-3, 9)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(
        [10**9, -(10**30), 1e308, "float32", "\ud800", "a\0b", [], {}, [[[1]]], [0.5, 0.5, 0.5]]
    )
)

LEVELS = "[" * 100_000
SNIPPETS = (b'"', b"{", b"}", b"[", b"]", b":", b",", b"NaN", b"1e999", b"\xff", LEVELS.encode())


# --- files of data sets ------------------------------------------------------------------


@pytest.fixture(scope="module")
def shard():
    return read_shard(SHARD)


def assert_same_content(found, expected):
    """All but provenance and cost, which the hash of the content leaves out."""
    one, other = (
        replace(
            shard,
            provenance={},
            simulations=tuple(replace(each, seconds={}) for each in shard.simulations),
        )
        for shard in (found, expected)
    )
    assert_same(one, other, one.simulations[0].forces.dtype)


@counts(100, 1000)
def test_damaged_files_of_data_sets_are_refused_by_name(tmp_path, shard, count):
    path, whole = tmp_path / "shard.h5", SHARD.read_bytes()

    def check(data):
        path.write_bytes(data)
        try:
            found = read_shard(path)
        except FileFormatError as error:
            assert str(error).startswith(f"{path}: ")
        else:
            assert_same_content(found, shard)

    heads = damaged(whole[:512]).map(lambda head: head + whole[512:])
    for_all(damaged(whole) | heads, check, count)


# --- settings ----------------------------------------------------------------------------


@counts(60, 1000)
def test_settings_are_read_or_refused_by_name(tmp_path, count):
    files = [(DatasetConfig, p) for p in sorted((ROOT / "examples" / "datasets").glob("*.toml"))]
    files += [(TrainingConfig, p) for p in sorted((ROOT / "examples" / "training").glob("*.toml"))]
    path = tmp_path / "settings.toml"

    def changed(file):
        kind, text = file[0], file[1].read_bytes()
        tree = tomllib.loads(text.decode())
        texts = damaged(text, (*SNIPPETS, b"9" * 5000, b"a." * 5000)) | renumbered(text)
        texts |= altered(tree, value.filter(lambda v: v is not None)).map(as_toml)
        return st.tuples(st.just(kind), texts)

    def check(one):
        path.write_bytes(one[1])
        try:
            one[0].load(path)
        except InputError as error:
            assert str(path) in str(error)

    for_all(st.sampled_from(files).flatmap(changed), check, count)


def as_toml(tree):
    return tomli_w.dumps(tree).encode("utf-8", errors="replace")


@counts(15, 200)
def test_other_files_of_data_sets_are_read_or_refused_by_name(tmp_path, count):
    folder = tmp_path / "tiny"
    shutil.copytree(DATASET, folder)
    for path in all_shards(folder)[1:]:
        path.unlink()
    names = ("manifest.json", "config.toml")
    whole = {name: (folder / name).read_bytes() for name in names}

    def changed(name):
        texts = damaged(whole[name], SNIPPETS) | renumbered(whole[name])
        if name.endswith("json"):
            tree = json.loads(whole[name])
            texts |= altered(tree, value).map(lambda tree: json.dumps(tree).encode())
        return st.tuples(st.just(name), texts)

    def check(one):
        name, data = one
        (folder / name).write_bytes(data)
        try:
            assert all(finding.message for finding in check_dataset(folder))
        except InputError as error:
            assert str(folder) in str(error)
        (folder / name).write_bytes(whole[name])

    for_all(st.sampled_from(names).flatmap(changed), check, count)


# --- models ------------------------------------------------------------------------------


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A copy of the model, and no way to unpickle anything."""

    def refuse(*_, **__):
        raise AssertionError("something was unpickled")

    for place, name in (
        (pickle, "load"),
        (pickle, "loads"),
        (pickle, "Unpickler"),
        (torch, "load"),
    ):
        monkeypatch.setattr(place, name, refuse)
    return Path(shutil.copytree(MODEL, tmp_path / "model"))


def check_model(folder, original=None):
    try:
        found = load_model(folder)
    except FileFormatError as error:
        assert str(folder) in str(error)
    else:
        if original is not None:
            assert_same_corrector(found.corrector, original.corrector)
            assert found.record == original.record


@counts(60, 800)
def test_damaged_models_are_refused_by_name(model, count):
    original = load_model(model)
    whole = {name: (model / name).read_bytes() for name in (WEIGHTS, DESCRIPTION)}

    def check(one):
        name, data = one
        (model / name).write_bytes(data)
        check_model(model, original)
        (model / name).write_bytes(whole[name])

    inputs = st.sampled_from(list(whole)).flatmap(
        lambda name: st.tuples(st.just(name), damaged(whole[name], SNIPPETS))
    )
    for_all(inputs, check, count)


@counts(60, 800)
def test_models_with_altered_descriptions_are_refused_by_name(model, count):
    tree = json.loads((model / DESCRIPTION).read_text())
    del tree["checksum"]

    def check(content):
        try:
            checksum = content_digest(content)
        except ValueError:  # NaN and infinite numbers have none
            checksum = ""
        (model / DESCRIPTION).write_text(json.dumps({**content, "checksum": checksum}))
        check_model(model)

    for_all(altered(tree, value), check, count)


@counts(60, 800)
def test_models_with_altered_weights_are_refused_by_name(model, count):
    """Also where the checksums are those of the damaged file."""
    tree, whole = json.loads((model / DESCRIPTION).read_text()), (model / WEIGHTS).read_bytes()
    del tree["checksum"]
    end = 8 + int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8:end])

    def with_header(tree):
        text = json.dumps(tree).encode()
        return len(text).to_bytes(8, "little") + text + whole[end:]

    def check(data):
        (model / WEIGHTS).write_bytes(data)
        content = {**tree, "weights_sha256": hashlib.sha256(data).hexdigest()}
        text = json.dumps({**content, "checksum": content_digest(content)})
        (model / DESCRIPTION).write_text(text)
        check_model(model)

    heads = damaged(whole[:end], SNIPPETS).map(lambda head: head + whole[end:])
    types = value | st.sampled_from(["F64", "BF16", "F8_E4M3", "I64", "BOOL", "F16", "U8"])
    for_all(heads | damaged(whole) | altered(header, types).map(with_header), check, count)


# --- the command line --------------------------------------------------------------------


@counts(10, 200)
def test_damaged_files_leave_no_traceback_and_no_output(program, tmp_path, count):
    data, model, output = tmp_path / "tiny", tmp_path / "model", tmp_path / "output"
    shutil.copytree(DATASET, data)
    shutil.copytree(MODEL, model)
    for path in all_shards(data)[1:]:
        path.unlink()
    (shard,) = all_shards(data)
    settings = shutil.copy(ROOT / "examples" / "training" / "tiny.toml", tmp_path)
    calls = {
        ("dataset", "info", data, "--json", output): [shard],
        ("dataset", "export", data, output): [shard],
        ("dataset", "generate", data / "config.toml", "-o", output): [data / "config.toml"],
        ("train", settings, "--data", data, "-o", output): [Path(settings)],
        ("evaluate", model, data, "--split", "training", "-o", output, "--no-figures"): [
            model / WEIGHTS
        ],
    }

    def changed(call):
        path = st.sampled_from(calls[call])
        return path.flatmap(
            lambda path: st.tuples(st.just(call), st.just(path), damaged(path.read_bytes()))
        )

    def check(one):
        call, path, content = one
        whole = path.read_bytes()
        unreadable = b"\xff" if path.suffix in (".toml", ".json") else b"\0"
        path.write_bytes(content + unreadable)
        status, out, err = program(*call)
        path.write_bytes(whole)
        assert status == BAD_INPUT, (out, err)
        assert path.name in err
        assert "Traceback" not in out + err
        assert not output.exists()

    for_all(st.sampled_from(list(calls)).flatmap(changed), check, count)

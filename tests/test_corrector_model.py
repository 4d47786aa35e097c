"""Models on disk: round trip, names, and everything that is to be refused."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")
pytest.importorskip("safetensors")

from safetensors import torch as safetensors  # noqa: E402

import network_samples as samples  # noqa: E402
import pdcorrect as pc  # noqa: E402
from pdcorrect.corrector import model_io  # noqa: E402
from pdcorrect.corrector.config import preset  # noqa: E402
from pdcorrect.corrector.corrector import Corrector  # noqa: E402
from pdcorrect.corrector.model_io import ModelRecord, load_model, save_model  # noqa: E402
from pdcorrect._environment import code_digest  # noqa: E402
from pdcorrect.errors import (  # noqa: E402
    FileFormatError,
    FileVersionError,
    InputError,
    OutputError,
)

WEIGHTS, JSON = model_io.WEIGHTS, model_io.DESCRIPTION

RECORD = ModelRecord(
    dataset="tiny", dataset_hash="c0ffee", training={"rate": 1e-3, "noise": None, "steps": [1, 2]},
    metrics={"omega": 12.5},
)  # fmt: skip


def made(**changes):
    return samples.corrector(dtype=torch.float32, **{"layers": 1, "width": 8, **changes})


def saved(folder, **changes):
    return save_model(made(**changes), folder, record=RECORD)


@pytest.fixture
def model(tmp_path):
    return saved(tmp_path / "model")


def rewrite_weights(folder, change):
    """Change the tensors, and tell model.json so."""
    state = safetensors.load((folder / WEIGHTS).read_bytes())
    data = change(state)
    data = data if isinstance(data, bytes) else safetensors.save(state)
    (folder / WEIGHTS).write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    rewrite_json(folder, lambda content: content.update(weights_sha256=digest))


def rewrite_json(folder, change, seal=True):
    """Change the content, and its checksum with it."""
    content = json.loads((folder / JSON).read_text())
    checksum = content.pop("checksum")
    change(content)
    checksum = model_io.content_digest(content) if seal else checksum
    (folder / JSON).write_text(json.dumps({**content, "checksum": checksum}))


def assert_same_corrector(one, other):
    assert one.config == other.config
    a, b = one.state_dict(), other.state_dict()
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        assert torch.equal(a[name], b[name]), name


# --- round trip ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["thesis", "equivariant", "compact"])
def test_a_loaded_model_corrects_as_the_saved_one(tmp_path, name):
    original = samples.corrector(name, dtype=torch.float32)
    save_model(original, tmp_path / "model", record=RECORD)
    found = load_model(tmp_path / "model")
    assert_same_corrector(found.corrector, original)
    assert found.record == RECORD
    assert not found.corrector.training
    assert all(p.requires_grad for p in found.corrector.parameters())
    bodies = samples.body()
    step = samples.moving(bodies)
    correction = found.corrector(bodies, step)
    assert correction.abs().max() > 1e-4 * samples.SIZE
    assert torch.equal(correction, original(bodies, step))


def test_a_model_tells_what_made_it(model):
    record = load_model(model).record
    assert (record.code_version, record.code_digest) == (pc.__version__, code_digest())
    content = json.loads((model / JSON).read_text())
    assert content["record"]["dataset"] == "tiny"
    assert content["record"]["training"] == RECORD.training
    assert content["architecture"] == made().config.model_dump(mode="json")
    assert content["parameters"] == sum(p.numel() for p in made().parameters())
    assert content["normalisation"]["output_scale"] == pytest.approx(np.sqrt(0.05))
    assert content["dtype"] == "float32"
    data = (model / WEIGHTS).read_bytes()
    assert content["weights_sha256"] == hashlib.sha256(data).hexdigest()


def test_equal_models_are_equal_files(tmp_path, model):
    again = saved(tmp_path / "again")
    for name in (WEIGHTS, JSON):
        assert (again / name).read_bytes() == (model / name).read_bytes()
    assert sorted(os.listdir(model)) == [JSON, WEIGHTS]


def test_loading_leaves_random_numbers_alone(model):
    torch.manual_seed(4)
    expected = torch.rand(3)
    torch.manual_seed(4)
    load_model(model)
    assert torch.equal(torch.rand(3), expected)


def test_the_package_offers_models_by_its_own_name(model):
    assert pc.Corrector is Corrector
    assert pc.load_model is load_model
    assert pc.save_model is save_model


# --- names -----------------------------------------------------------------------------


def test_a_bare_name_is_looked_up_in_the_home_folder(tmp_path, monkeypatch):
    saved(tmp_path / "models" / "small")
    monkeypatch.setenv("PDCORRECT_HOME", str(tmp_path))
    assert load_model("small").record == RECORD
    with pytest.raises(InputError, match=r"'large': not in .*models: expected one of small, or"):
        load_model("large")
    monkeypatch.chdir(tmp_path / "models")
    assert load_model("./small").record == RECORD
    assert load_model(Path("small")).record == RECORD
    with pytest.raises(InputError, match=r"^none: not there: .* a released model: small\.$"):
        load_model(Path("none"))


def told(path):
    """Why a model is refused."""
    with pytest.raises(InputError) as refusal:
        load_model(path)
    return str(refusal.value)


def test_a_place_without_a_model_is_told_from_one_that_is_not_there(tmp_path, monkeypatch):
    expected = f"expected a folder with {JSON} and {WEIGHTS}"
    home = tmp_path / "home"
    for name in ("small", "large"):
        saved(home / "models" / name)
    (home / "models" / "recipes").mkdir()
    monkeypatch.setenv("PDCORRECT_HOME", str(home))
    empty, missing, file = (tmp_path / name for name in ("empty", "missing", "file"))
    empty.mkdir()
    file.write_text("")
    names = "or the name of a released model: large, small."
    assert told(empty) == f"{empty}: holds no model: {expected}."
    assert told(missing) == f"{missing}: not there: {expected}, {names}"
    assert told(file) == f"{file}: a file: {expected}, {names}"
    models = home / "models"
    assert told(models) == f"{models}: holds no model: {expected}, such as {models / 'large'}."
    with monkeypatch.context() as patch:
        patch.chdir(models)
        assert told(".").endswith(", such as ./large.")  # with a slash, for it is no name
    assert "'recipes': not in" in told("recipes")
    assert ": expected one of large, small, or a path such as ./recipes." in told("recipes")
    monkeypatch.delenv("PDCORRECT_HOME")
    monkeypatch.setattr(pc, "__file__", str(tmp_path / "lib" / "pdcorrect" / "__init__.py"))
    assert told(missing) == f"{missing}: not there: {expected}."  # no names where there are none


def test_without_a_home_folder_names_are_those_of_the_checkout(monkeypatch):
    monkeypatch.delenv("PDCORRECT_HOME", raising=False)
    assert model_io.models_folder() == Path(__file__).resolve().parents[1] / "models"


def test_installed_code_needs_to_be_told_where_models_are(monkeypatch, tmp_path):
    monkeypatch.delenv("PDCORRECT_HOME", raising=False)
    monkeypatch.setattr(pc, "__file__", str(tmp_path / "lib" / "pdcorrect" / "__init__.py"))
    with pytest.raises(InputError, match="PDCORRECT_HOME"):
        load_model("small")


def test_a_device_that_is_not_there_is_named(model):
    with pytest.raises(InputError, match="device 'nothing'"):
        load_model(model, device="nothing")


# --- whole or not at all ---------------------------------------------------------------


@pytest.mark.parametrize("broken", [WEIGHTS, JSON])
def test_after_an_error_while_writing_the_old_model_is_there(model, monkeypatch, broken):
    before = {name: (model / name).read_bytes() for name in (WEIGHTS, JSON)}

    def full(path, *args, **kwargs):
        if path.name.startswith(broken):
            raise OSError(28, "No space left on device")
        return write(path, *args, **kwargs)

    method = "write_bytes" if broken == WEIGHTS else "write_text"
    write = getattr(Path, method)
    monkeypatch.setattr(Path, method, full)
    with pytest.raises(OutputError, match="No space left"):
        saved(model, seed=1)
    assert {p.name: p.read_bytes() for p in model.iterdir()} == before


def test_a_kill_between_the_two_files_is_told(tmp_path, model):
    script = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from test_corrector_model import saved\n"
        "replace = Path.replace\n"
        "def killed(part, path):\n"
        "    replace(part, path)\n"
        "    os._exit(9)\n"
        "Path.replace = killed\n"
        f"saved(Path({str(model)!r}), seed=1)\n"
    )
    here = str(Path(__file__).parent)
    paths = os.pathsep.join([here, str(Path(pc.__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", script], env=environment, check=False)
    assert done.returncode == 9
    with pytest.raises(FileFormatError, match=rf"{WEIGHTS}: its checksum.*ended half-way"):
        load_model(model)
    saved(model, seed=1)
    assert_same_corrector(load_model(model).corrector, made(seed=1))


# --- refused on saving -----------------------------------------------------------------


def test_what_cannot_be_used_is_not_saved(tmp_path):
    fresh = Corrector(made().config)
    broken = made()
    with torch.no_grad():
        broken.network.decoder[0].weight[0, 0] = torch.nan
    for corrector, words in (
        (fresh, "not been fitted"),
        (broken, "decoder.0.weight has values that are infinite or not a number"),
        (made().double(), "expected torch.float32"),
        (made().to(torch.float32), "normaliser.* has type torch.float32: expected torch.float64"),
    ):
        with pytest.raises(InputError, match=words):
            save_model(corrector, tmp_path / "model", record=RECORD)
    endless = RECORD.model_copy(update={"metrics": {"omega": float("inf")}})
    with pytest.raises(InputError, match="record of the model"):
        save_model(made(), tmp_path / "model", record=endless)
    assert not (tmp_path / "model").exists()


# --- refused on loading ----------------------------------------------------------------


def test_any_changed_byte_is_found(model):
    rng = np.random.default_rng(0)
    for name in (WEIGHTS, JSON):
        path = model / name
        whole = path.read_bytes()
        content = json.loads(whole) if name == JSON else None
        harmless = 0
        for place in rng.choice(len(whole), 100, replace=False):
            changed = bytearray(whole)
            changed[place] ^= int(rng.integers(1, 256))
            path.write_bytes(changed)
            try:
                found = load_model(model)
            except FileFormatError as error:
                assert name in str(error)
            else:
                assert name == JSON
                assert json.loads(bytes(changed)) == content
                assert found.record == RECORD
                harmless += 1
        path.write_bytes(whole)
        assert harmless <= 20
    load_model(model)


@pytest.mark.parametrize("name", [WEIGHTS, JSON])
def test_truncated_and_missing_files_are_refused(model, name):
    path = model / name
    whole = path.read_bytes()
    for length in (0, 1, 7, 8, 100, len(whole) // 2, len(whole) - 2):
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError, match=name):
            load_model(model)
    path.write_bytes(whole + b"x")
    with pytest.raises(FileFormatError, match=name):
        load_model(model)
    path.unlink()
    with pytest.raises(FileFormatError, match=rf"{name}: cannot be read \(No such file"):
        load_model(model)


def drop(name):
    return lambda state: state.__delitem__(name)


def put(name, change):
    return lambda state: state.update({name: change(state.get(name))})


SCALE, MEAN, LAST = "normaliser.output_scale", "normaliser.strain__mean", "network.decoder.2.bias"


def with_value(value):
    return lambda tensor: torch.full_like(tensor, value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (drop(MEAN), f"missing tensor {MEAN}:"),
        (drop(SCALE), f"missing tensor {SCALE}"),
        (drop(LAST), f"missing tensor {LAST}"),
        (put("network.more", lambda _: torch.zeros(2)), "unexpected tensor network.more:"),
        (put(LAST, lambda b: b[:2]), r"decoder.2.bias has shape \(2,\): expected \(3,\)"),
        (put(MEAN, lambda b: b[:2]), r"strain__mean has shape \(2,\): expected \(6,\)"),
        (put(LAST, lambda b: b.double()), "decoder.2.bias has type torch.float64"),
        (put(MEAN, lambda b: b.float()), "strain__mean has type torch.float32"),
        (put(LAST, with_value(torch.nan)), "decoder.2.bias has values that are infinite or not"),
        (put(LAST, with_value(-torch.inf)), "decoder.2.bias has values that are infinite or not"),
        (drop("normaliser.time_step_low"), "missing tensor normaliser.time_step_low"),
        (put("normaliser.time_step_high", with_value(torch.nan)), "time_step_high has values"),
        (put(MEAN, with_value(torch.nan)), "strain__mean has values that are infinite or not"),
        (put("normaliser.strain__deviation", with_value(0.0)), "deviation .*not positive"),
        (put(SCALE, with_value(0.0)), "has not been fitted"),
        (lambda state: b"\x80\x04K\x01.", "not a file of tensors"),
        (lambda state: b"", "not a file of tensors"),
        (lambda state: (2**60).to_bytes(8, "little") + b"{}", "not a file of tensors"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name(model, change, words):
    rewrite_weights(model, change)
    with pytest.raises(FileFormatError, match=rf"{WEIGHTS}: .*{words}"):
        load_model(model)


def put_json(*place, value):
    def change(content):
        for key in place[:-1]:
            content = content[key]
        content[place[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put_json("more", value=1), "more: Extra inputs"),
        (put_json("architecture", "depth", value=1), "architecture.depth: Extra inputs"),
        (put_json("record", "author", value="x"), "record.author: Extra inputs"),
        (put_json("architecture", "layers", value=0), "architecture.layers"),
        (put_json("architecture", "node_features", value=["colour"]), "'colour': expected one of"),
        (put_json("architecture", "edge_features", value=["turn"] * 2), "expected each one once"),
        (put_json("dtype", value="float16"), "dtype"),
        (put_json("weights_sha256", value=3), "weights_sha256"),
        (lambda content: content.pop("architecture"), "architecture: Field required"),
        (put_json("format", value="something"), "expected format 'pdcorrect-model'"),
        (put_json("normalisation", "output_scale", value=3.0), "normalisation is not that of"),
    ],
)
def test_descriptions_that_do_not_fit_are_refused_by_name(model, change, words):
    rewrite_json(model, change)
    with pytest.raises(FileFormatError, match=rf"{JSON}: .*{words}"):
        load_model(model)


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 9}, {"layers": 2}, {"layers": 10**9}, {"mlp_layers": 3}, {"norm": "none"},
        {"norm": "all"}, {"node_features": ["strain"]}, {"edge_features": ["stretch", "turn"]},
        {"edge_features": ["rest-position", "stretch", "motion", "turn"]},
    ],
    ids=str,
)  # fmt: skip
def test_weights_of_another_architecture_are_refused(model, changes):
    rewrite_json(model, lambda content: content["architecture"].update(changes))
    with pytest.raises(FileFormatError, match=rf"{WEIGHTS}: .*{JSON}"):
        load_model(model)


@pytest.mark.parametrize("text", ["", "{", "[]", "1", "null", '"x"', "[" * 10**5, "\x00", "{}"])
def test_other_texts_are_refused(model, text):
    (model / JSON).write_text(text)
    with pytest.raises(FileFormatError, match=JSON):
        load_model(model)


def test_numbers_that_are_not_finite_are_refused(model):
    text = (model / JSON).read_text()
    for number in ("NaN", "Infinity", "1e999"):
        assert "12.5" in text
        (model / JSON).write_text(text.replace("12.5", number))
        with pytest.raises(FileFormatError, match="damaged"):
            load_model(model)


def refused_version(model, **changes):
    """What is told of a model of another version."""
    rewrite_json(model, lambda content: content.update(changes))
    with pytest.raises(FileVersionError) as refusal:
        load_model(model)
    return str(refusal.value).removeprefix(f"{model / JSON}: ")


def test_other_versions_are_told_from_damage(model):
    assert refused_version(model, version=6) == (
        "format version 6: expected 5: written by a newer pdcorrect: update pdcorrect."
    )
    rewrite_json(model, put_json("version", value=7), seal=False)
    with pytest.raises(FileVersionError) as refusal:  # by its own checksum, or altered
        load_model(model)
    assert str(refusal.value) == (
        f"{model / JSON}: format version 7: expected 5: its checksum is not that of its content, "
        "as this pdcorrect computes it: written by a newer one or damaged: update pdcorrect, or "
        "copy the model again."
    )
    rewrite_json(model, lambda content: content.pop("version"))
    with pytest.raises(FileVersionError, match=rf"{JSON}: version is None: expected 5: damaged"):
        load_model(model)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_an_older_version_is_told_with_the_script_that_brings_it_up_to_date(model, version):
    script = "fit_shapes.py" if version == 2 else "fit_time_steps.py"
    assert (Path(__file__).parents[1] / "models" / script).is_file()
    assert refused_version(model, version=version) == (
        f"format version {version}: expected 5: written by an older pdcorrect: bring it up to date "
        f"by `python models/{script} {model} DATASET/config.toml ...` with the configurations that "
        "docs/files.md tells of, or train it anew if its data sets have none."
    )


def test_the_first_version_is_told_to_be_trained_anew(model):
    assert refused_version(model, version=1) == (
        "format version 1: expected 5: written by an older pdcorrect: nothing brings it up to "
        "date: train the model anew."
    )


@pytest.mark.parametrize("version", [1, 4, 0, -1, "6", 6.0, True, None])
def test_an_altered_version_is_told_as_damage_and_not_as_another_version(model, version):
    rewrite_json(model, put_json("version", value=version), seal=False)
    with pytest.raises(FileFormatError, match=rf"{JSON}: damaged: its checksum") as refusal:
        load_model(model)
    assert not isinstance(refusal.value, FileVersionError)


@pytest.mark.parametrize("version", [0, -1, "6", 5.0, True])
def test_what_is_no_version_is_refused(model, version):
    told = refused_version(model, version=version)
    assert told == f"version is {version!r}: expected 5: damaged."


@pytest.mark.parametrize("nothing", ["", "  ", None, 3, b"tiny"])
def test_what_is_no_name_and_no_path_is_refused(nothing):
    with pytest.raises(InputError, match="expected the name of a model or the path of its folder"):
        load_model(nothing)


def test_a_folder_here_is_hinted_at(model, monkeypatch):
    monkeypatch.chdir(model.parent)
    with pytest.raises(InputError, match=rf"such as ./{model.name}, which is a folder here"):
        load_model(model.name)


def test_a_changed_entry_is_found_by_the_checksum(model):
    rewrite_json(model, put_json("record", "metrics", "omega", value=99.0), seal=False)
    with pytest.raises(FileFormatError, match=rf"{JSON}: damaged: its checksum"):
        load_model(model)
    rewrite_json(model, lambda content: content.clear() or content.update(format="x"), seal=False)
    with pytest.raises(FileFormatError, match="expected format"):
        load_model(model)


def test_presets_of_the_thesis_survive_with_all_their_settings(tmp_path):
    config = preset("thesis", layers=2, width=8, norm="all", shared=True, placement="force")
    original = samples.fit(Corrector(config), samples.View(*sample()))
    save_model(original, tmp_path / "model", record=RECORD)
    assert_same_corrector(load_model(tmp_path / "model").corrector, original)


def test_a_network_that_the_configuration_does_not_describe_is_not_saved(tmp_path):
    corrector = made()
    corrector.network.decoder = torch.nn.Sequential(torch.nn.Linear(8, 3))
    with pytest.raises(InputError, match="MeshGraphNetwork with other weights"):
        save_model(corrector, tmp_path / "model", record=RECORD)
    assert not (tmp_path / "model").exists()


def sample():
    bodies = samples.body()
    return bodies, samples.moving(bodies)

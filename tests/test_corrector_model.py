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
from pdcorrect import _environment  # noqa: E402
from pdcorrect._environment import code_digest  # noqa: E402
from pdcorrect.corrector import model_io  # noqa: E402
from pdcorrect.corrector.corrector import Corrector, preset  # noqa: E402
from pdcorrect.corrector.model_io import (  # noqa: E402
    ModelRecord,
    content_digest,
    load_model,
    save_model,
)
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


def rewrite_json(folder, change, fits=True):
    """Change the content, and its checksum with it unless it is not to fit."""
    content = json.loads((folder / JSON).read_text())
    checksum = content.pop("checksum")
    change(content)
    checksum = content_digest(content) if fits else checksum
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


def test_settings_beside_those_of_a_preset_survive(tmp_path):
    config = preset("thesis", layers=2, width=8, momentum_neutral=True)
    original = samples.fit(Corrector(config), samples.FeatureView(*sample()))
    save_model(original, tmp_path / "model", record=RECORD)
    assert_same_corrector(load_model(tmp_path / "model").corrector, original)


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


def test_equal_models_are_equal_files_and_loading_leaves_random_numbers_alone(tmp_path, model):
    again = saved(tmp_path / "again")
    for name in (WEIGHTS, JSON):
        assert (again / name).read_bytes() == (model / name).read_bytes()
    assert sorted(os.listdir(model)) == [JSON, WEIGHTS]
    torch.manual_seed(4)
    expected = torch.rand(3)
    torch.manual_seed(4)
    load_model(model)
    assert torch.equal(torch.rand(3), expected)


# --- names -----------------------------------------------------------------------------


def test_a_bare_name_is_looked_up_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("PDCORRECT_HOME", raising=False)
    assert model_io.models_folder() == Path(__file__).resolve().parents[1] / "models"
    saved(tmp_path / "models" / "small")
    monkeypatch.setenv("PDCORRECT_HOME", str(tmp_path))
    assert load_model("small").record == RECORD
    monkeypatch.chdir(tmp_path / "models")
    assert load_model("./small").record == RECORD
    assert load_model(Path("small")).record == RECORD
    monkeypatch.delenv("PDCORRECT_HOME")
    monkeypatch.setattr(_environment, "__file__", str(tmp_path / "lib" / "pdcorrect" / "one.py"))
    with pytest.raises(InputError, match="PDCORRECT_HOME"):
        load_model("small")


def test_places_without_a_model_are_named(tmp_path, monkeypatch):
    saved(tmp_path / "models" / "small")
    (tmp_path / "models" / "recipes").mkdir()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PDCORRECT_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path / "models")
    for place, named in (
        ("large", "'large'.*small"),
        ("recipes", r"'recipes'.*\./recipes"),
        (Path("none"), "^none: "),
        (tmp_path / "file", f"^{tmp_path / 'file'}: "),
        (tmp_path / "models", f"^{tmp_path / 'models'}: "),
        (".", r"^\.: "),
        ("", "model ''"),
        ("  ", "model '  '"),
        (None, "model None"),
        (3, "model 3"),
        (b"tiny", "model b'tiny'"),
    ):
        with pytest.raises(InputError, match=named):
            load_model(place)
    with pytest.raises(InputError, match="device 'nothing'"):
        load_model("small", device="nothing")


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
    with pytest.raises(FileFormatError, match=rf"{WEIGHTS}: its checksum"):
        load_model(model)
    saved(model, seed=1)
    assert_same_corrector(load_model(model).corrector, made(seed=1))


# --- refused on saving -----------------------------------------------------------------


def test_what_cannot_be_used_is_not_saved(tmp_path):
    fresh = Corrector(made().config)
    broken = made()
    with torch.no_grad():
        broken.network.decoder[0].weight[0, 0] = torch.nan
    for corrector, told in (
        (fresh, "normaliser"),
        (broken, r"decoder\.0\.weight"),
        (made().double(), r"torch\.float64: .*torch\.float32"),
        (made().to(torch.float32), r"normaliser.* torch\.float32: .*torch\.float64"),
    ):
        with pytest.raises(InputError, match=told):
            save_model(corrector, tmp_path / "model", record=RECORD)
    other = made()
    other.network.decoder = torch.nn.Sequential(torch.nn.Linear(8, 3))
    with pytest.raises(InputError, match="MeshGraphNetwork"):
        save_model(other, tmp_path / "model", record=RECORD)
    endless = RECORD.model_copy(update={"metrics": {"omega": float("inf")}})
    with pytest.raises(InputError, match="record"):
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
    with pytest.raises(FileFormatError, match=rf"{name}: cannot be read"):
        load_model(model)


def drop(name):
    return lambda state: state.__delitem__(name)


def put(name, change):
    return lambda state: state.update({name: change(state.get(name))})


SCALE, MEAN, LAST = "normaliser.output_scale", "normaliser.strain__mean", "network.decoder.2.bias"


def with_value(value):
    return lambda tensor: torch.full_like(tensor, value)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (drop(MEAN), MEAN),
        (drop(SCALE), SCALE),
        (drop(LAST), LAST),
        (put("network.more", lambda _: torch.zeros(2)), "network.more"),
        (put(LAST, lambda b: b[:2]), "decoder.2.bias"),
        (put(MEAN, lambda b: b[:2]), "strain__mean"),
        (put(LAST, lambda b: b.double()), "decoder.2.bias .*torch.float64"),
        (put(MEAN, lambda b: b.float()), "strain__mean .*torch.float32"),
        (put(LAST, with_value(torch.nan)), "decoder.2.bias"),
        (put(LAST, with_value(-torch.inf)), "decoder.2.bias"),
        (drop("normaliser.time_step_low"), "normaliser.time_step_low"),
        (put("normaliser.time_step_high", with_value(torch.nan)), "time_step_high"),
        (put(MEAN, with_value(torch.nan)), "strain__mean"),
        (put("normaliser.strain__deviation", with_value(0.0)), "deviation"),
        (put(SCALE, with_value(0.0)), "normaliser"),
        (lambda state: b"\x80\x04K\x01.", ""),
        (lambda state: b"", ""),
        (lambda state: (2**60).to_bytes(8, "little") + b"{}", ""),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name(model, change, named):
    rewrite_weights(model, change)
    with pytest.raises(FileFormatError, match=rf"{WEIGHTS}: .*{named}"):
        load_model(model)


def put_json(*place, value):
    def change(content):
        for key in place[:-1]:
            content = content[key]
        content[place[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (put_json("more", value=1), "more: "),
        (put_json("architecture", "depth", value=1), "architecture.depth: "),
        (put_json("record", "author", value="x"), "record.author: "),
        (put_json("architecture", "layers", value=0), "architecture.layers"),
        (put_json("architecture", "node_features", value=["colour"]), "'colour'"),
        (put_json("architecture", "edge_features", value=["turn"] * 2), "turn, turn"),
        (put_json("dtype", value="float16"), "dtype"),
        (put_json("weights_sha256", value=3), "weights_sha256"),
        (lambda content: content.pop("architecture"), "architecture: "),
        (put_json("format", value="something"), "format"),
        (put_json("normalisation", "output_scale", value=3.0), "normalisation"),
    ],
)
def test_descriptions_that_do_not_fit_are_refused_by_name(model, change, named):
    rewrite_json(model, change)
    with pytest.raises(FileFormatError, match=rf"{JSON}: .*{named}"):
        load_model(model)


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 9}, {"layers": 2}, {"layers": 10**9}, {"mlp_layers": 3},
        {"node_features": ["strain"]}, {"edge_features": ["stretch", "turn"]},
        {"edge_features": ["rest-position", "stretch", "motion", "turn"]},
    ],
    ids=str,
)  # fmt: skip
def test_weights_of_another_architecture_are_refused(model, changes):
    rewrite_json(model, lambda content: content["architecture"].update(changes))
    with pytest.raises(FileFormatError, match=rf"{WEIGHTS}: .*{JSON}"):
        load_model(model)


@pytest.mark.parametrize("text", ["", "{", "[]", "1", "null", '"x"', "[" * 10**5, "\x00", "{}"])
def test_other_texts_and_numbers_that_are_not_finite_are_refused(model, text):
    whole = (model / JSON).read_text()
    assert "12.5" in whole
    for other in (text, *(whole.replace("12.5", n) for n in ("NaN", "Infinity", "1e999"))):
        (model / JSON).write_text(other)
        with pytest.raises(FileFormatError, match=JSON):
            load_model(model)


@pytest.mark.parametrize(
    ("version", "shown"),
    [
        (2, "2"),
        (0, "0"),
        (-1, "-1"),
        ("2", "'2'"),
        (None, "None"),
    ],
)
def test_other_versions_are_refused_with_both_versions(model, version, shown):
    rewrite_json(model, put_json("version", value=version))
    with pytest.raises(FileVersionError, match=rf"{JSON}: .*version.* {shown}: expected 1"):
        load_model(model)


@pytest.mark.parametrize("version", [0, -1, "2", 2.0, True, None])
def test_an_altered_version_is_damage_and_no_other_version(model, version):
    """A newer version alone may have another checksum."""
    rewrite_json(model, put_json("version", value=version), fits=False)
    with pytest.raises(FileFormatError, match=JSON) as refusal:
        load_model(model)
    assert not isinstance(refusal.value, FileVersionError)
    rewrite_json(model, put_json("version", value=7), fits=False)
    with pytest.raises(FileVersionError, match="7: expected 1"):
        load_model(model)


def test_a_changed_entry_is_found_by_the_checksum(model):
    rewrite_json(model, put_json("record", "metrics", "omega", value=99.0), fits=False)
    with pytest.raises(FileFormatError, match=rf"{JSON}: damaged: its checksum"):
        load_model(model)
    rewrite_json(model, lambda content: content.clear() or content.update(format="x"), fits=False)
    with pytest.raises(FileFormatError, match="expected format"):
        load_model(model)


def sample():
    bodies = samples.body()
    return bodies, samples.moving(bodies)

"""Scenes and configurations given in place of each other, as folders, or with wrong values."""

import itertools
import re
import shutil
import tomllib
from pathlib import Path

import pytest

import pdcorrect as pc
from pdcorrect.cli import main as cli
from pdcorrect.data.config import DatasetConfig
from pdcorrect.errors import InputError, SceneError
from pdcorrect._config import WORDS
from pdcorrect.known_keys import tables_of
from pdcorrect.toml_files import looks_like

pytest.importorskip("torch")

from pdcorrect.training.config import Rate, Stage, TrainingConfig

ROOT = Path(__file__).parent.parent
FILES = {
    pc.Scene: ROOT / "examples" / "gravity_beam.toml",
    TrainingConfig: ROOT / "examples" / "training" / "tiny.toml",
    DatasetConfig: ROOT / "datasets" / "tiny" / "config.toml",
}
NAMES = {
    pc.Scene: "a scene",
    TrainingConfig: "the configuration of a training",
    DatasetConfig: "the configuration of a data set",
}


def refusal(call, *arguments, **named):
    with pytest.raises(InputError) as caught:
        call(*arguments, **named)
    return str(caught.value)


# --- files -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "other"), list(itertools.permutations(FILES, 2)), ids=lambda kind: kind.__name__
)
def test_a_file_of_another_kind_is_told_by_what_it_looks_like(kind, other):
    path = FILES[other]
    expected = f"looks like {NAMES[other]}; expected {NAMES[kind]}."
    assert refusal(kind.load, path) == f"{path}: {expected}"
    assert refusal(kind.from_toml, path.read_text()).endswith(expected)


def test_every_scene_and_configuration_looks_like_what_it_is():
    scenes, trainings = (ROOT / "examples").glob("*.toml"), (ROOT / "models").rglob("*/*.toml")
    data_sets = (ROOT / "datasets").glob("*/config.toml")
    for kind, paths in {
        pc.Scene: scenes,
        TrainingConfig: trainings,
        DatasetConfig: data_sets,
    }.items():
        found = {looks_like(tomllib.loads(path.read_text())) for path in paths}
        assert found == {NAMES[kind]}
    assert looks_like({"tool": {}}) is None


def test_a_file_with_marks_of_two_kinds_is_told_by_its_keys():
    text = 'body = 3\ntime = 3\nclamps = 3\n[[stages]]\nkind = "one-step"\niterations = 1\n'
    assert "body: unknown key" in refusal(TrainingConfig.from_toml, text)


@pytest.mark.parametrize("kind", FILES, ids=lambda kind: kind.__name__)
def test_a_folder_is_told_as_one_with_the_file_that_may_be_meant(tmp_path, kind):
    told = f"{tmp_path}: is a folder: expected {NAMES[kind]} in a TOML file"
    assert refusal(kind.load, tmp_path) == f"{told}; none is in it."
    for number, path in enumerate(FILES.values()):
        shutil.copy(path, tmp_path / f"{number}.toml")
    (tmp_path / "a.toml").write_bytes(b"\xff")
    (tmp_path / "b.toml").write_text("a = [")
    (tmp_path / "c.toml").mkdir()
    own = tmp_path / f"{list(FILES).index(kind)}.toml"
    assert refusal(kind.load, tmp_path) == f"{told}; did you mean {own}?"
    shutil.copy(own, tmp_path / "0a.toml")
    own.rename(tmp_path / "x.toml")
    assert refusal(kind.load, tmp_path) == f"{told}, such as {tmp_path / '0a.toml'}."


@pytest.mark.parametrize("kind", FILES, ids=lambda kind: kind.__name__)
def test_what_is_no_path_is_refused(kind):
    assert "from_toml takes texts" in refusal(kind.load, FILES[kind].read_text())
    assert refusal(kind.load, {}) == "path is a dict: expected that of a TOML file."


def test_the_program_tells_files_of_another_kind_and_folders(program, tmp_path):
    scene, training, data = FILES.values()
    for arguments, words in (
        (("simulate", training, "-o", tmp_path / "x.h5"), "looks like the configuration of a tr"),
        (("compare", data, "-o", tmp_path / "x"), "looks like the configuration of a data set"),
        (("train", scene, "--data", data.parent, "-o", tmp_path / "x"), "looks like a scene"),
        (("dataset", "generate", scene, "-o", tmp_path / "x"), "looks like a scene"),
        (("dataset", "generate", data.parent, "-o", tmp_path / "x"), f"did you mean {data}?"),
    ):
        status, _, err = program(*arguments)
        assert status == cli.BAD_INPUT
        assert err.startswith("error: ")
        assert words in err
    assert not any(tmp_path.iterdir())


# --- scenes ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "call"),
    [
        ("beam.toml", "Scene.load('beam.toml')"),
        (Path("beam.toml"), "Scene.load('beam.toml')"),
        ("name = 'x'", "Scene.from_toml(scene)"),
        ("[body]\n[time]\n", "Scene.from_toml(scene)"),
        ({"body": {}}, "Scene(**scene)"),
        (3, "Scene.load(path)"),
    ],
)
@pytest.mark.parametrize("takes", [pc.discretise, pc.best_coarse, pc.coarse_model, pc.compare])
def test_what_is_no_scene_is_refused_with_the_call_that_makes_one(takes, given, call):
    kind = type(given).__name__
    assert refusal(takes, given) == f"scene is a {kind}: expected a Scene, as of {call}."


def test_a_path_where_a_model_steps_a_scene_is_refused_with_the_call():
    assert "Scene.load('beam.toml')" in refusal(pc.hybrid_of, "beam.toml", "tiny")


# --- values ------------------------------------------------------------------------------


def test_configurations_made_in_python_are_refused_as_those_of_files():
    assert refusal(TrainingConfig, stages=[]).startswith("configuration: stages = []: expected a")
    assert "frames = 0: expected at least 1." in refusal(DatasetConfig, frames=0)
    assert "seeds: unknown key; did you mean seed?" in refusal(DatasetConfig, seeds=0)
    stage = Stage(kind="one-step", iterations=1, rate=Rate(peak=0.5))
    assert TrainingConfig(stages=[stage]).stages == (stage,)
    assert "clip = { peak = 0.5, last = 1e-05, warmup = 0.02 }: expected a number." in refusal(
        TrainingConfig, stages=[{**stage.model_dump(), "clip": stage.rate}]
    )


def test_the_source_of_a_configuration_stands_for_its_name():
    told = refusal(DatasetConfig.from_toml, "family = 'configuration'", "mine.toml")
    assert told.startswith("mine.toml: ")
    assert 'family = "configuration": expected' in told


def test_long_values_are_cut():
    told = refusal(pc.Scene, name=list(range(1000)))
    assert "name = [0, 1, 2, 3," in told
    assert "...: expected a string." in told
    assert len(told) < 300


def test_a_list_is_not_too_short_by_entries_that_are_wrong():
    wrong = {"kind": "one-step", "iterations": 0}
    told = refusal(TrainingConfig, stages=[wrong])
    assert told == "configuration: stages.0.iterations = 0: expected at least 1."


def places(node, place=()):
    """Where values are, at any depth."""
    yield place
    parts = enumerate(node) if isinstance(node, list) else ()
    for key, part in node.items() if isinstance(node, dict) else parts:
        yield from places(part, (*place, key))


@pytest.mark.parametrize("kind", FILES, ids=lambda kind: kind.__name__)
def test_wrong_values_anywhere_are_told_in_our_words(kind):
    text = FILES[kind].read_text()
    counted = 0
    for *above, last in (place for place in places(tomllib.loads(text)) if place):
        for value in (-1, 1e300, float("nan"), "?", "", True, [], {}, [1] * 9, {"?": 1}, [{}]):
            data = tomllib.loads(text)
            node = data
            for key in above:
                node = node[key]
            node[last] = value
            try:
                kind(**data)
            except InputError as error:
                told = str(error)
                counted += 1
                assert (kind is pc.Scene) == isinstance(error, SceneError)
                assert not re.search(r"\b([Ii]nput|should|a valid|True|tuple)\b", told), told
                assert "expected" in told or "unknown key" in told or "missing" in told, told
    assert counted > 100


def test_all_words_are_halves_of_sentences():
    assert all(words.startswith("expected ") for words in WORDS.values())


def test_tables_of_a_model_have_their_headers():
    found = {table.header: table.keys for table in tables_of(TrainingConfig)}
    assert found["[stages.rate]"] == {"peak", "last", "warmup"}
    assert {"", "[[stages]]", "[validate_every]", "[corrector.changes]"} < found.keys()
    kinds = {table.choice for table in tables_of(pc.Scene) if table.header == "[[loads]]"}
    assert {'kind = "gravity"', 'kind = "torsion"'} < kinds

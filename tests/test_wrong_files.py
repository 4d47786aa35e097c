"""Scenes and configurations given in place of each other, or with wrong values."""

import itertools
import re
import tomllib
from pathlib import Path

import pytest

import pdcorrect as pc
from pdcorrect.cli.common import BAD_INPUT
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.errors import InputError, SceneError

pytest.importorskip("torch")

from pdcorrect.training.recipe import Rate, Stage, TrainingConfig

ROOT = Path(__file__).parent.parent
FILES = {
    pc.Scene: ROOT / "examples" / "gravity_beam.toml",
    TrainingConfig: ROOT / "examples" / "training" / "tiny.toml",
    DatasetConfig: ROOT / "datasets" / "tiny" / "config.toml",
}


@pytest.mark.parametrize(
    ("kind", "other"), list(itertools.permutations(FILES, 2)), ids=lambda kind: kind.__name__
)
def test_a_file_of_another_kind_is_refused_by_name_and_key(kind, other):
    path = FILES[other]
    for source, load in (
        (path, kind.load),
        ("own", lambda p: kind.from_toml(p.read_text(), "own")),
    ):
        key = next(k for k in tomllib.loads(path.read_text()) if k not in kind.model_fields)
        with pytest.raises(kind.error, match=rf"^{source}: .*\b{key}\b"):
            load(path)


@pytest.mark.parametrize("kind", FILES, ids=lambda kind: kind.__name__)
def test_what_is_no_path_of_a_file_is_refused(kind, tmp_path):
    for path in ({}, None, FILES[kind].read_text()):
        with pytest.raises(kind.error, match="^path is"):
            kind.load(path)
    with pytest.raises(kind.error, match=f"^{tmp_path}: cannot be read"):
        kind.load(tmp_path)


def test_the_program_names_files_of_another_kind_and_folders(program, tmp_path):
    scene, training, data = FILES.values()
    output = tmp_path / "x"
    for arguments, named in (
        (("simulate", training, "-o", tmp_path / "x.h5"), training),
        (("compare", data, "-o", output), data),
        (("train", scene, "--data", data.parent, "-o", output), scene),
        (("dataset", "generate", scene, "-o", output), scene),
        (("dataset", "generate", data.parent, "-o", output), data.parent),
    ):
        status, _, err = program(*arguments)
        assert status == BAD_INPUT
        assert err.startswith(f"error: {named}: ")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("given", ["beam.toml", Path("beam.toml"), "name = 'x'", {"body": {}}, 3])
@pytest.mark.parametrize("takes", [pc.discretise, pc.best_coarse, pc.compare, pc.hybrid_of])
def test_what_is_no_scene_is_refused(takes, given):
    more = ("tiny",) if takes is pc.hybrid_of else ()
    with pytest.raises(InputError, match=f"^scene is a {type(given).__name__}: "):
        takes(given, *more)


STAGE = Stage(kind="one-step", iterations=1, rate=Rate(peak=0.5))


@pytest.mark.parametrize(
    ("kind", "changes", "told"),
    [
        (TrainingConfig, {"stages": []}, "stages = []"),
        (DatasetConfig, {"frames": 0}, "frames = 0"),
        (DatasetConfig, {"seeds": 0}, "seeds: unknown key"),
        (
            TrainingConfig,
            {"stages": [{**STAGE.model_dump(), "ema": STAGE.rate}]},
            "stages[0].ema = { peak = 0.5, ",
        ),
        (
            TrainingConfig,
            {"stages": [{"kind": "one-step", "iterations": 0}]},
            "stages[0].iterations = 0",
        ),
    ],
)
def test_wrong_configurations_made_in_python_are_refused_by_key_and_value(kind, changes, told):
    with pytest.raises(InputError, match=f"^configuration: .*{re.escape(told)}"):
        kind(**changes)
    assert TrainingConfig(stages=[STAGE]).stages == (STAGE,)


def test_long_values_are_cut():
    with pytest.raises(SceneError, match=r"name = \[0, 1, 2, 3,") as refused:
        pc.Scene(name=list(range(1000)))
    assert len(str(refused.value)) < 300


def places(node, place=()):
    """Where values are, at any depth."""
    yield place
    parts = enumerate(node) if isinstance(node, list) else ()
    for key, part in node.items() if isinstance(node, dict) else parts:
        yield from places(part, (*place, key))


@pytest.mark.parametrize("kind", FILES, ids=lambda kind: kind.__name__)
def test_wrong_values_anywhere_are_refused_by_their_section(kind):
    text = FILES[kind].read_text()
    refused = 0
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
                refused += 1
                assert isinstance(error, kind.error)
                assert str([*above, last][0]) in str(error)
                assert "\n" not in str(error)
    assert refused > 100

"""One training on several data sets, whose meshes have the same numbers and are others."""

import csv
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import pdcorrect as pc  # noqa: E402
import training_samples as samples  # noqa: E402
from pdcorrect.corrector.model_io import load_model  # noqa: E402
from pdcorrect.data.configuration import DatasetConfig  # noqa: E402
from pdcorrect.data.plan import make_plan  # noqa: E402
from pdcorrect.data.reader import TrajectoryDataset  # noqa: E402
from pdcorrect.data.schema import write_shard  # noqa: E402
from pdcorrect.data.shard_reader import read_header, read_shard  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from pdcorrect.evaluation.candidates import saved_candidates  # noqa: E402
from pdcorrect.training.batch_losses import OneStepBatches  # noqa: E402
from pdcorrect.training.distributed import ProcessGroup  # noqa: E402
from pdcorrect.training.recipe import TrainingConfig  # noqa: E402
from pdcorrect.training.recordings import load_recordings, make_problems  # noqa: E402
from pdcorrect.training.scenes import SceneGroup, grouped  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402
from pdcorrect.training.validation import Validation  # noqa: E402
from pdcorrect.training.windows import StepWindows  # noqa: E402

ONE, OTHER = (0,), (3, 1)
MODELS = Path(__file__).parents[1] / "models"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two data sets of tiny's meshes: one of five frames, one of eight; both have mesh 0."""
    one = samples.dataset(tmp_path_factory.mktemp("one"), training=ONE, frames=5)
    other = samples.dataset(tmp_path_factory.mktemp("other"), OTHER, validation=(0,), frames=8)
    for split in ("training", "validation"):
        for number, path in enumerate(sorted((other / split).iterdir(), reverse=True)):
            shard = read_shard(path)
            named = {"dataset": "other", "number": number, "config_hash": "0" * 64}
            path.unlink()
            write_shard(
                other / split / f"mesh-{number:04d}.h5",
                replace(shard, attributes={**shard.attributes, **named}), "float32",
            )  # fmt: skip
    return one, other


def settings(*stages, **changes):
    return samples.config(*stages, **changes)


def test_windows_of_several_data_sets_follow_one_another(folders):
    both = TrajectoryDataset(folders, "training", window=2)
    each = [TrajectoryDataset(folder, "training", window=2) for folder in folders]
    assert len(both) == sum(map(len, each))
    assert [h.path.parent.parent for h in both.headers] == [folders[0], folders[1], folders[1]]
    assert [h.number for h in both.headers] == [0, 0, 1]
    first, last = both[len(each[0])], both[len(both) - 1]
    assert [int(x.file) for x in (both[0], first, last)] == [0, 1, 2]
    assert [int(x.mesh) for x in (both[0], first, last)] == [0, 0, 1]
    for found, expected in ((first, each[1][0]), (last, each[1][len(each[1]) - 1])):
        assert torch.equal(found.targets, expected.targets)
        assert torch.equal(found.cells, expected.cells)
    together, recordings = samples.windows(folders, settings(samples.one_step()))
    owners = {r.one_step: r.dataset for r in recordings}
    stage = samples.one_step(batch=12)
    batch = OneStepBatches(together, stage, 0, ProcessGroup()).batch(0)  # mixes them
    assert {owners[scale] for scale in batch.scale.tolist()} == {"tiny", "other"}


@pytest.mark.parametrize("remembers", [False, True])
def test_steps_of_several_data_sets_are_those_of_each(folders, remembers):
    changes = {"changes": {"node_features": ("previous-correction",)}} if remembers else {}
    config = settings(samples.one_step(), corrector={**samples.SMALL, **changes})
    together, recordings = samples.windows(folders, config)
    assert len(recordings) == 5
    begin = 0
    for folder in folders:
        alone, _ = samples.windows(folder, config)
        chosen = [0, len(alone.dataset) - 1, len(alone.dataset) // 2]
        found = together.batch([begin + i for i in chosen])
        expected = alone.batch(chosen)
        assert torch.equal(found.target, expected.target)
        assert torch.equal(found.scale, expected.scale)
        for name in ("mass", "density", "young", "cells", "edge_index", "time_step"):
            assert torch.equal(getattr(found.bodies, name), getattr(expected.bodies, name)), name
        assert torch.equal(found.bodies.shapes, expected.bodies.shapes)
        begin += len(alone.dataset)


def test_recordings_of_several_data_sets_have_their_own_bodies_and_ranks_share_them(folders):
    recordings = load_recordings(folders, "training", "plain")
    assert [r.dataset for r in recordings] == ["tiny"] + ["other"] * 4
    assert recordings[0].name == "tiny, training/mesh-0000/0"
    assert recordings[1].name == "other, training/mesh-0000/0"
    for problem, recording in zip(make_problems(recordings, "plain"), recordings, strict=True):
        assert problem.positions.shape == recording.reference.shape[1:]
    group = SceneGroup(recordings, "plain", "cpu")
    ends = group.truth(group.steps)
    assert group.steps.tolist() == [5, 8, 8, 8, 8]
    for end, recording in zip(ends.numpy(), recordings, strict=True):
        truth = recording.reference[-1]
        np.testing.assert_array_equal(end[: len(truth)], truth)

    recordings = load_recordings(folders, "training", "plain")
    of_ranks = [grouped(recordings, 2, seed=0, rank=rank, world_size=2) for rank in (0, 1)]
    names = sorted(r.name for groups in of_ranks for group in groups for r in group)
    assert names == sorted(r.name for r in recordings)
    assert len(set(names)) == 5


def test_rollouts_of_unlike_lengths_have_the_omegas_that_they_have_alone(folders):
    corrector = samples.fitted(folders, settings(samples.one_step()))
    with torch.no_grad():
        corrector.network.decoder[-1].weight.mul_(0.1)
    together, *alone = (
        Validation(load_recordings(data, "validation", "plain"), "plain")(corrector).omegas
        for data in (folders, *folders)
    )
    np.testing.assert_allclose(together, np.concatenate(alone), atol=1e-6)


STAGES = (
    samples.one_step(iterations=6, batch=6),
    samples.unrolled(iterations=4, steps=(2,), start="pool", batch=3, loss={"ahead": 1.0}),
)


def test_a_training_learns_several_data_sets_and_goes_on_bit_by_bit(folders, tmp_path, few_threads):
    often = {"checkpoint_every": {"iterations": 1}, "validate_every": {"iterations": 4}}
    config = settings(*STAGES, **often)
    Training(config, folders, tmp_path / "whole").run()
    broken = Training(config, folders, tmp_path / "broken")
    assert not broken.run(seconds=0.0)
    for _ in range(20):
        if Training(config, folders, tmp_path / "broken", resume=True).run(seconds=0.0):
            break
    else:
        pytest.fail("the training did not come to its end")
    one, other = (load_model(tmp_path / name / "model") for name in ("whole", "broken"))
    for name, x in one.corrector.state_dict().items():
        assert torch.equal(x, other.corrector.state_dict()[name]), name
    record = one.record
    digest = hashlib.sha256()  # of the files in their order
    for split in ("training", "validation"):
        for path in (p for folder in folders for p in sorted((folder / split).iterdir())):
            digest.update(f"{split}/{path.name} {read_header(path).content_hash}\n".encode())
    assert record.dataset_hash == digest.hexdigest()
    assert record.dataset == "tiny+other"
    own = load_recordings(folders[0], "training", "plain")[0].config_hash
    assert one.data_sets == [("tiny", own), ("other", "0" * 64)]
    with pytest.raises(InputError, match="data = "):
        Training(config, folders[:1], tmp_path / "whole", resume=True)


LEFT_OUT = ("training/mesh-0003", "validation/mesh-0000")


@pytest.fixture
def several(tmp_path):
    """A data set of two training and two validation meshes."""
    return samples.dataset(tmp_path / "several", training=(0, 3), validation=(0, 1), frames=5)


def test_what_is_left_out_might_as_well_not_be_there(several, tmp_path, few_threads):
    whole = settings(*STAGES, validate_every={"iterations": 4})
    config = whole.model_copy(update={"without": LEFT_OUT})
    Training(config, several, tmp_path / "left out").run()
    for name in LEFT_OUT:
        (several / f"{name}.h5").rename(tmp_path / name.replace("/", "-"))
    Training(whole, several, tmp_path / "removed", incomplete=True).run()
    one, other = (load_model(tmp_path / name / "model") for name in ("left out", "removed"))
    for name, x in one.corrector.state_dict().items():
        assert torch.equal(x, other.corrector.state_dict()[name]), name
    assert one.record.dataset_hash == other.record.dataset_hash
    assert _omegas(tmp_path / "left out") == _omegas(tmp_path / "removed")
    with pytest.raises(InputError, match=r"config\.without"):
        Training(whole, several, tmp_path / "left out", incomplete=True, resume=True)
    assert TrainingConfig.load(tmp_path / "left out" / "config.toml").without == LEFT_OUT


def _omegas(folder):
    """What a training's models had on its validation split."""
    with (folder / "history.csv").open(newline="", encoding="utf-8") as file:
        found = [row["omega_mean"] for row in csv.DictReader(file) if row["omega_mean"]]
    assert found
    return found


def test_readers_leave_out_files_by_name_and_of_several_sets_by_the_folders(several, tmp_path):
    other = tmp_path / "other set"
    shutil.copytree(several, other)
    for split, name in (("training", LEFT_OUT[0]), ("validation", LEFT_OUT[1])):
        found = TrajectoryDataset(several, split, without=LEFT_OUT)
        recordings = load_recordings(several, split, "plain", without=LEFT_OUT)
        (kept,) = {header.path for header in found.headers}
        assert {recording.path for recording in recordings} == {kept}
        assert kept != several / f"{name}.h5"
        with pytest.raises(InputError, match=split):
            TrajectoryDataset(several, split, without=[name, f"{split}/{kept.stem}"])
        found = TrajectoryDataset([several, other], split, without=[f"other set/{name}"])
        left = {header.path for header in found.headers}
        assert len(left) == 3
        assert other / f"{name}.h5" not in left
        headers = TrajectoryDataset(several, split, without=[f"{several.name}/{name}"]).headers
        assert several / f"{name}.h5" not in {header.path for header in headers}


def test_files_that_cannot_be_left_out_are_refused(folders, several, tmp_path):
    one, other = (folder.name for folder in folders)
    alike = [several, tmp_path / "elsewhere" / several.name]
    shutil.copytree(*alike)
    plain = settings(*STAGES)
    for data, names, words in (
        (folders, ("training/mesh-0000",), f"2 files of .*{one}.*{other}"),
        (folders, ("third/training/mesh-0003",), f"third.* 0 files of .*{one}.*{other}"),
        (folders, (f"{other}/training/mesh-0042",), f"{other}/training/mesh-0042.* 0 files"),
        (alike, (f"{several.name}/training/mesh-0003",), "2 files"),
        (several, ("training/mesh-0042",), "training/mesh-0042"),
    ):
        config = plain.model_copy(update={"without": names})
        with pytest.raises(InputError, match=words):
            Training(config, data, tmp_path / "out", incomplete=True)
    for names in (
        ["mesh-0042"], ["evaluation/mesh-0042"], ["training/mesh-0042.h5"],
        ["training/mesh-0042"] * 2,
    ):  # fmt: skip
        with pytest.raises(InputError, match=names[0]):
            settings(*STAGES, without=names)


@pytest.fixture(scope="module")
def trained(folders, tmp_path_factory):
    output = tmp_path_factory.mktemp("trained")
    Training(settings(samples.one_step(iterations=2)), folders, output).run()
    return output / "model"


def test_such_a_model_knows_each_of_its_data_sets(folders, trained):
    (found,) = saved_candidates([trained])
    known = [r.config_hash for r in load_recordings(folders, "training", "plain")]
    for name, config_hash in (
        ("tiny", known[0]), ("other", known[-1]), ("other", "1" * 64), ("other", known[0]),
        ("third", known[0]),
    ):  # fmt: skip
        (told,) = found.warnings(name, config_hash, "evaluation")
        assert "'tiny+other'" in told
        assert f"'{name}'" in told
    (told,) = found.warnings("other", known[-1], "training")
    assert "'tiny+other'" not in told
    sets = found.model.record.training["data_sets"]
    sets[1] = {**sets[1], "config_hash": None}
    (told,) = found.warnings("other", "1" * 64, "evaluation")
    assert "'other'" in told


def test_the_command_takes_several_data_sets_and_judges_each(folders, program, tmp_path):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(settings(samples.one_step(iterations=2)).to_toml())
    data = [word for folder in folders for word in ("--data", folder)]
    status, _, err = program(
        "train", recipe, *data, "-o", tmp_path / "out", "--evaluate", "validation"
    )
    assert status == 0, err
    for folder in folders:
        (path,) = (tmp_path / "out" / "evaluation" / folder.name).glob("*.json")
        name = "other" if folder == folders[1] else "tiny"
        assert json.loads(path.read_text())["data"]["name"] == name


def test_sets_that_do_not_go_together_are_refused(folders, program, tmp_path):
    recipe = tmp_path / "recipe.toml"
    config = settings(samples.one_step(iterations=2))
    recipe.write_text(config.to_toml())
    data = [word for folder in (*folders, folders[0]) for word in ("--data", folder)]
    status, _, err = program("train", recipe, *data, "-o", tmp_path / "out")
    assert status == 2
    assert str(folders[0]) in err  # which comes twice
    with pytest.raises(InputError):
        TrajectoryDataset([], "training")
    without = samples.dataset(tmp_path / "without", training=(2,), validation=(), frames=5)
    (without / "validation").rmdir()
    with pytest.raises(InputError, match="without: .*'validation'"):
        Training(config, (folders[0], without), tmp_path / "out")
    recordings = load_recordings(folders[1], "training", "plain")
    others = load_recordings(folders[0], "training", "plain")
    for wrong in (recordings[1:], others, [recordings[0], *recordings[:-1]]):
        with pytest.raises(InputError, match="4 simulations"):
            StepWindows(folders[1], wrong, config.architecture(), "plain")

    other = tmp_path / "other"
    (other / "training").mkdir(parents=True)
    shard = read_shard(folders[1] / "training" / "mesh-0000.h5")
    step = 2.0 * shard.attributes["time_step"]
    simulations = tuple(
        replace(s, scene_toml=doubled(s.scene_toml, step)) for s in shard.simulations
    )
    write_shard(
        other / "training" / "mesh-0000.h5",
        replace(shard, simulations=simulations, attributes={**shard.attributes, "time_step": step}),
        "float32",
    )
    without = tmp_path / "another step" / "training"
    without.mkdir(parents=True)
    shutil.copy(folders[0] / "training" / "mesh-0000.h5", without)
    config = settings(samples.one_step(iterations=2))
    told = r"mesh-0000\.h5: time_step 0\.02, .*0\.01 of .*mesh-0000\.h5"
    with pytest.raises(InputError, match=told):
        Training(config, (without.parent, other), tmp_path / "out")
    recordings = load_recordings((without.parent, other), "training", "plain")
    with pytest.raises(InputError, match=r"time\.step"):
        SceneGroup(recordings, "plain", "cpu")


def doubled(text, step):
    return pc.Scene.from_toml(text).with_changes(time={"step": step}).to_toml()


RECIPES = MODELS / "recipes"
LEAVING_OUT = sorted(
    path.relative_to(RECIPES).with_suffix("").as_posix()
    for path in RECIPES.rglob("*.toml")
    if TrainingConfig.load(path).without
)
EVALUATION_ONLY = ("torsion-many",)
"""Sets whose recipes do not leave out bodies of the other set's extra splits."""


@pytest.mark.parametrize("recipe", LEAVING_OUT)
def test_a_recipe_leaves_out_the_bodies_that_another_set_keeps_for_evaluation(recipe):
    folder, own = MODELS.parent / "datasets", recipe.partition("/")[0]
    config = DatasetConfig.load(folder / own / "config.toml")
    other = f"{own.partition('-')[0]}-{config.setting}"
    kept = {
        plan.design.key()
        for plan in make_plan(DatasetConfig.load(folder / other / "config.toml"))
        if plan.split not in ("training", "validation")
        and (plan.split == "evaluation" or own not in EVALUATION_ONLY)
    }
    found = [
        plan.name
        for plan in make_plan(config)
        if plan.split in ("training", "validation") and plan.design.key() in kept
    ]
    assert found
    assert list(TrainingConfig.load(RECIPES / f"{recipe}.toml").without) == found


RELEASED = sorted(path.parent.name for path in MODELS.glob("*/model.json"))
SEVERAL = {
    "impulse-as-published": ["impulse-as-published", "impulse-more"],
    "stretch-as-published": ["stretch-as-published", "stretch-more"],
    "torsion-exact": ["torsion-exact", "torsion-many", "torsion-more"],
}  # fmt: skip
"""Data sets of the released models that have several; others are called after their one."""
FEWER_RUNS = {"impulse-exact": {"converged_steps": 0, "finest_meshes": 0}}
"""Models of data that were generated without some runs that the configuration asks for."""


@pytest.mark.parametrize("name", RELEASED)
def test_a_released_model_names_the_data_sets_of_all_its_trainings(name):
    found = load_model(name).data_sets
    assert [dataset for dataset, _ in found] == SEVERAL.get(name, [name])
    for dataset, config_hash in found:
        config = DatasetConfig.load(MODELS.parent / "datasets" / dataset / "config.toml")
        assert config_hash == config.model_copy(update=FEWER_RUNS.get(name, {})).hash()

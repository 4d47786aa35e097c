"""Files that a training leaves out, simulations of unlike lengths, and where models come from."""

import csv
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.corrector.model_io import load_model  # noqa: E402
from pdcorrect.data.configuration import DatasetConfig  # noqa: E402
from pdcorrect.data.plan import make_plan  # noqa: E402
from pdcorrect.data.reader import TrajectoryDataset  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from pdcorrect.training.recipe import TrainingConfig  # noqa: E402
from pdcorrect.training.scenes import SceneGroup, load_recordings  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402
from pdcorrect.training.validation import Validation  # noqa: E402

MODELS = Path(__file__).parents[1] / "models"


def test_simulations_of_unlike_lengths_are_stepped_together_as_alone(tmp_path):
    folders = [
        samples.dataset(tmp_path / str(frames), training, validation=(0,), frames=frames)
        for training, frames in (((0,), 5), ((3, 1), 8))
    ]
    parts = [load_recordings(folder, "validation", "plain") for folder in folders]
    group = SceneGroup([r for part in parts for r in part], "plain", "cpu")
    assert group.steps.tolist() == [5, 5, 8, 8]
    for end, recording in zip(group.truth(group.steps).numpy(), group.recordings, strict=True):
        truth = recording.reference[-1]
        np.testing.assert_array_equal(end[: len(truth)], truth)
    corrector = samples.fitted(folders[1], samples.config(samples.one_step()))
    with torch.no_grad():
        corrector.network.decoder[-1].weight.mul_(0.1)
    together, *alone = (
        Validation(recordings, "plain")(corrector).omegas
        for recordings in (group.recordings, *parts)
    )
    np.testing.assert_allclose(together, np.concatenate(alone), atol=1e-6)


STAGES = (
    samples.one_step(iterations=3, batch=6),
    samples.unrolled(iterations=2, steps=(2,), start="pool", batch=3, loss={"ahead": 1.0}),
)


LEFT_OUT = ("training/mesh-0003", "validation/mesh-0000")


@pytest.fixture
def several(tmp_path):
    """A data set of two training and two validation meshes."""
    return samples.dataset(tmp_path / "several", training=(0, 3), validation=(0, 1), frames=5)


def test_what_is_left_out_might_as_well_not_be_there(several, tmp_path, few_threads):
    whole = samples.config(*STAGES, validate_every={"iterations": 3})
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


def test_readers_leave_out_files_by_name(several):
    for split, name in (("training", LEFT_OUT[0]), ("validation", LEFT_OUT[1])):
        found = TrajectoryDataset(several, split, without=LEFT_OUT)
        recordings = load_recordings(several, split, "plain", without=LEFT_OUT)
        (kept,) = {header.path for header in found.headers}
        assert {recording.path for recording in recordings} == {kept}
        assert kept != several / f"{name}.h5"
        every = TrajectoryDataset(several, split, without=[f"{several.name}/{name}"])
        assert len(every.headers) == 2  # no file's name
        with pytest.raises(InputError, match=split):
            TrajectoryDataset(several, split, without=[name, f"{split}/{kept.stem}"])


@pytest.mark.parametrize("name", ["mesh-0042", "evaluation/mesh-0042", "training/mesh-0042.h5"])
def test_names_of_no_file_to_learn_from_are_refused(name):
    with pytest.raises(InputError, match=name):
        samples.config(*STAGES, without=[name])


def test_files_that_cannot_be_left_out_are_refused(several, tmp_path):
    config = samples.config(*STAGES, without=["training/mesh-0042"])
    with pytest.raises(InputError, match="training/mesh-0042"):
        Training(config, several, tmp_path / "out", incomplete=True)


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

"""What a training needs of a data set: where that is missing, one sentence names file and lack."""

import re
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from dataset_samples import with_run, with_simulation  # noqa: E402
from pdcorrect.data.schema import write_shard  # noqa: E402
from pdcorrect.data.shard_reader import read_shard  # noqa: E402


def without(name):
    """A change that takes a run away from the first simulation."""

    def change(shard):
        runs = {own: run for own, run in shard.simulations[0].runs.items() if own != name}
        return with_simulation(shard, 0, runs=runs)

    return change


def without_scene(shard):
    return with_simulation(shard, 0, scene_toml="")


def imported(shard):
    """As arrays of another solver without anything that may be left out."""
    return with_simulation(without("best")(without("plain")(shard)), 0, scene_toml="")


@pytest.fixture
def train(program, tmp_path):
    """Call the program with one file of tiny changed; returns (status, standard error)."""

    def call(split, change, *stages, **settings):
        folder = samples.dataset(tmp_path / "set", training=(0,), frames=2)
        (path,) = (folder / split).iterdir()
        write_shard(path, change(read_shard(path)), overwrite=True)
        recipe = tmp_path / "recipe.toml"
        recipe.write_text(samples.config(*stages, **settings).to_toml())
        output = tmp_path / "out"
        status, _, err = program("train", recipe, "--data", folder, "-o", output)
        assert status == 0 or not output.exists()
        return status, err.replace(f"{path}: ", "PATH: ")

    return call


@pytest.mark.parametrize("split", ["training", "validation"])
@pytest.mark.parametrize(
    ("change", "base", "lack"),
    [
        (without_scene, "plain", "no scene"),
        (without("plain"), "plain", "no rollout of run 'plain', no single steps of run 'plain'"),
        (without("plain"), "best", "no rollout of run 'plain'"),
        (without("best"), "best", "no rollout of run 'best', no single steps of run 'best'"),
        (without("reference"), "plain", "no rollout of run 'reference'"),
        (lambda s: with_run(s, 0, "plain", positions=None), "plain", "no rollout of run 'plain'"),
        (
            lambda s: with_run(s, 0, "best", predictions=None),
            "best",
            "no single steps of run 'best'",
        ),
        (
            imported,
            "plain",
            "no scene, no rollout of run 'plain', no single steps of run 'plain'",
        ),
    ],
)
def test_a_file_without_what_training_needs_is_named_with_all_that_it_lacks(
    train, split, change, base, lack
):
    status, err = train(split, change, samples.unrolled(iterations=1), base=base)
    assert status == 2
    needs = "'plain'" if base == "plain" else "'plain' and 'best'"
    assert err == (
        f"error: PATH: simulation 0 has {lack}: a training with base = '{base}' needs simulations "
        f"with rollouts of 'reference' and {needs}, single steps of '{base}', and scenes for "
        "stepping them again.\n"
    )


def test_single_steps_need_no_scene_for_they_are_stored(train):
    status, err = train("training", without_scene, samples.one_step(iterations=1))
    assert status == 0, err


def test_imported_trajectories_alone_are_no_data_to_train_on(train):
    stage = samples.one_step(iterations=1)
    status, err = train("training", lambda s: replace(imported(s), provenance={}), stage)
    assert status == 2
    assert re.fullmatch(r"error: PATH: simulation 0 has no rollout of run 'plain', no .*\.\n", err)

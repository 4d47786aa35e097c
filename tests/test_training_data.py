"""What a training needs of a data set: where that is missing, file and lack are named."""

import re

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from dataset_samples import with_run, with_simulation  # noqa: E402
from pdcorrect.data.schema import read_shard, write_shard  # noqa: E402


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


def rollout(name):
    return f"rollout of run '{name}'"


def steps(name):
    return f"single steps of run '{name}'"


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
        (without_scene, "plain", ["scene"]),
        (without("plain"), "plain", [rollout("plain"), steps("plain")]),
        (without("plain"), "best", [rollout("plain")]),
        (without("best"), "best", [rollout("best"), steps("best")]),
        (without("reference"), "plain", [rollout("reference")]),
        (lambda s: with_run(s, 0, "plain", positions=None), "plain", [rollout("plain")]),
        (lambda s: with_run(s, 0, "best", predictions=None), "best", [steps("best")]),
        (imported, "plain", ["scene", rollout("plain"), steps("plain")]),
    ],
)
def test_a_file_without_what_training_needs_is_named_with_all_that_it_lacks(
    train, split, change, base, lack
):
    status, err = train(split, change, samples.unrolled(iterations=1), base=base)
    assert status == 2
    found = err.partition("PATH: ")[2].partition(": ")[0]
    assert "simulation 0" in found
    assert re.findall(r"scene|rollout of run '\w+'|single steps of run '\w+'", found) == lack


def test_single_steps_need_no_scene_for_they_are_stored(train):
    status, err = train("training", without_scene, samples.one_step(iterations=1))
    assert status == 0, err

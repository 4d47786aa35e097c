"""Cards of data sets, and counts of rejected loads."""

import importlib
from pathlib import Path

import pytest

from dataset_samples import sample_shard, with_simulation, write_dataset
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import write_shard
from pdcorrect.data.summary import dataset_info

DATASETS = Path(__file__).parents[1] / "datasets"
TINY = DATASETS / "tiny"


@pytest.fixture
def card(monkeypatch):
    """The module that writes cards."""
    monkeypatch.syspath_prepend(DATASETS)
    return importlib.import_module("card")


def test_the_card_of_the_tiny_set_is_that_of_its_files(card):
    info = dataset_info(TINY)
    assert card.dataset_card(TINY, info) == (TINY / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", sorted(DATASETS.glob("*/README.md")), ids=lambda p: p.parent.name)
def test_every_card_says_what_its_configuration_asks_for(card, path):
    own = set(path.read_text(encoding="utf-8").splitlines())
    config = DatasetConfig.load(path.with_name("config.toml"))
    assert {f"- {line}" for line in card._what(config)} <= own


def test_rejected_loads_are_counted_by_split_run_and_reason(card, program, tmp_path):
    config = write_dataset(tmp_path / "set")
    for mesh in make_plan(config):
        shard = sample_shard(config, mesh)
        for k in range(len(shard.simulations)):
            run = "intermediate" if mesh.split == "evaluation" else "reference"
            shard = with_simulation(
                shard, k, rejected=(f"{run}, step {k + 1}: a cell is inverted",)
            )
        write_shard(tmp_path / "set" / f"{mesh.name}.h5", shard, overwrite=True)
    info = dataset_info(tmp_path / "set")
    assert info.splits["training"].rejections == {"reference, a cell is inverted": 4}
    assert info.splits["evaluation"].rejections == {"intermediate, a cell is inverted": 2}
    assert sum(info.whole.rejections.values()) == 8
    assert config.name in card.card_text(config, info, {}, "0")
    assert program("dataset", "info", tmp_path / "set")[0] == 0

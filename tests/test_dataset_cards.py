"""Cards of data sets, and counts of rejected loads."""

from pathlib import Path

from dataset_samples import sample_shard, with_simulation, write_dataset
from pdcorrect.data.card import card_text, dataset_card
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import write_shard
from pdcorrect.data.summary import dataset_info

TINY = Path(__file__).parents[1] / "datasets" / "tiny"


def test_the_card_of_the_tiny_set_is_that_of_its_files():
    info = dataset_info(TINY)
    assert dataset_card(TINY, info) == (TINY / "README.md").read_text(encoding="utf-8")


def test_rejected_loads_are_counted_by_split_run_and_reason(program, tmp_path):
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
    assert sum(info.whole.rejections.values()) == info.whole.rejected == 8
    assert config.name in card_text(config, info, {}, "0")
    assert program("dataset", "info", tmp_path / "set")[0] == 0

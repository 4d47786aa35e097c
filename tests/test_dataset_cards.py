"""The committed cards are what the code would write of the committed numbers."""

import json
import re
from pathlib import Path

import pytest

from dataset_samples import sample_shard, with_simulation, write_dataset
from pdcorrect.data.card import card_text, dataset_card
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.info import DatasetInfo, RunInfo, dataset_info
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import write_shard

ROOT = Path(__file__).parents[1] / "datasets"
NAMES = sorted(path.parent.name for path in ROOT.glob("*/info.json"))


def of_numbers(folder):
    """The card of a committed set whose files are not here, and the committed card."""
    committed = (folder / "README.md").read_text(encoding="utf-8")
    made = re.search(r"begun on (\S+) with pdcorrect (\S+) on (.+)\.\n", committed).groups()
    provenance = dict(zip(("date", "pdcorrect", "device"), made, strict=True))
    config = DatasetConfig.load(folder / "config.toml")
    info = DatasetInfo.from_json((folder / "info.json").read_text(encoding="utf-8"))
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    return card_text(config, info, provenance, manifest["content_hash"]), committed


@pytest.mark.parametrize("name", NAMES)
def test_a_committed_card_is_that_of_the_committed_numbers(name):
    written, committed = of_numbers(ROOT / name)
    assert written == committed


def test_all_six_sets_have_numbers():
    assert len(NAMES) == 6


def test_the_card_of_the_tiny_set_is_that_of_its_files():
    folder = ROOT / "tiny"
    info = dataset_info(folder)
    assert dataset_card(folder, info) == (folder / "README.md").read_text(encoding="utf-8")
    assert DatasetInfo.from_json(info.to_json()) == info


def test_a_card_tells_no_quantile_of_few_simulations():
    card, _ = of_numbers(ROOT / "torsion-exact")
    (long,) = re.findall(r"\| long \| `best` \|.*", card)
    (half,) = re.findall(r"\| half-step \| `best` \|.*", card)
    assert long.split(" | ")[6] == "–"
    assert float(half.split(" | ")[6]) < 50.0


def test_a_card_measures_the_error_of_the_time_step_where_a_run_does():
    exact, _ = of_numbers(ROOT / "torsion-exact")
    assert "is 78.8 mm RMS from the reference, and the `plain` run 11.4 mm." in exact
    published, _ = of_numbers(ROOT / "torsion-as-published")
    assert "no run here measures it" in published


def test_rejected_loads_are_counted_by_split_run_and_reason(program, tmp_path, monkeypatch):
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
    assert DatasetInfo.from_json(info.to_json()) == info
    card = card_text(config, info, {}, "0")
    assert "| training | `reference` | a cell is inverted | 4 |" in card
    assert "| evaluation | `intermediate` | a cell is inverted | 2 |" in card
    monkeypatch.setenv("COLUMNS", "100")
    status, out, _ = program("dataset", "info", tmp_path / "set")
    assert status == 0
    assert re.search(r"evaluation +intermediate +a cell is inverted +2 *\n", out)


def test_numbers_survive_json():
    for name in NAMES:
        text = (ROOT / name / "info.json").read_text(encoding="utf-8")
        info = DatasetInfo.from_json(text)
        assert isinstance(info.whole.runs["plain"], RunInfo)
        again = DatasetInfo.from_json(info.to_json())
        assert again == info

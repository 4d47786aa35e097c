"""Data sets with damaged files: named, and on demand left out of what is read."""

import json
import shutil

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import reader_samples as samples  # noqa: E402
from pdcorrect.data.folder import read_files, shard_paths  # noqa: E402
from pdcorrect.data.reader import TrajectoryDataset  # noqa: E402
from pdcorrect.data.summary import dataset_info  # noqa: E402
from pdcorrect.errors import FileFormatError, FileVersionError  # noqa: E402


def change_a_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


@pytest.fixture(params=[change_a_byte, truncate])
def damaged(request, tmp_path):
    """A data set whose second training file is damaged, and one where it is not there."""
    folder = samples.dataset(tmp_path / "whole", splits=("training", "evaluation"))
    without = tmp_path / "without"
    shutil.copytree(folder, without)
    (without / "training" / "mesh-0001.h5").unlink()
    request.param(folder / "training" / "mesh-0001.h5")
    return folder, without


def names(found):
    return [path.name for path in found]


def test_windows_of_whole_files_are_read_without_the_damaged_one(damaged):
    folder, without = damaged
    dataset = TrajectoryDataset(folder, "training", skip_damaged=True)
    expected = TrajectoryDataset(without, "training")
    assert names(dataset.damaged) == ["mesh-0001.h5"]
    assert "mesh-0001.h5" in next(iter(dataset.damaged.values()))
    assert len(dataset) == len(expected)
    for index in range(len(expected)):
        one, other = dataset[index], expected[index]
        assert torch.equal(one.positions, other.positions)
        assert int(one.mesh) == int(other.mesh)
    assert not TrajectoryDataset(without, "training", skip_damaged=True).damaged
    assert not expected.damaged


def test_the_summary_is_of_the_whole_files_and_names_the_other(damaged, tmp_path, program):
    folder, without = damaged
    with pytest.raises(FileFormatError, match=r"mesh-0001\.h5"):
        dataset_info(folder)
    found, expected = dataset_info(folder, skip_damaged=True), dataset_info(without)
    assert list(found.damaged) == ["training/mesh-0001.h5"]
    assert found.splits == expected.splits
    path = tmp_path / "a.json"
    status, _, err = program("dataset", "info", folder, "--skip-damaged", "--json", path)
    assert status == 0
    assert "training/mesh-0001.h5" in err
    assert "training/mesh-0001.h5" in json.loads(path.read_text())["damaged"]


def test_truncated_files_are_refused_where_nothing_else_is_asked_for(tmp_path):
    folder = samples.dataset(tmp_path, splits=("training",))
    truncate(folder / "training" / "mesh-0001.h5")
    with pytest.raises(FileFormatError, match=r"mesh-0001\.h5"):
        TrajectoryDataset(folder, "training")
    for number in (0, 2, 3):
        truncate(folder / "training" / f"mesh-{number:04d}.h5")
    with pytest.raises(FileFormatError, match=r"mesh-0000\.h5"):
        TrajectoryDataset(folder, "training", skip_damaged=True)


def test_another_version_of_the_format_is_no_damage(tmp_path):
    folder = samples.dataset(tmp_path, splits=("training",))

    def newer(path):
        raise FileVersionError(f"{path}: version 9")

    with pytest.raises(FileVersionError, match="version 9"):
        read_files(shard_paths(folder, "training"), newer, {})

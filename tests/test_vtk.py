"""What ParaView reads: VTU by pyvista (VTK's own reader), times in the PVD."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
import pyvista

import pdcorrect as pc
from conftest import cross
from pdcorrect.errors import InputError, OutputError


@pytest.fixture(scope="module")
def run():
    return pc.rollout(pc.ProjectiveDynamics(pc.discretise(cross())), 5)


def test_the_series_is_read_back_as_it_was(run, tmp_path):
    stress = np.arange(len(run.cells), dtype=float)
    path = pc.write_vtu_series(
        run, tmp_path / "out", every=2,
        point_data=lambda frame: {"speed": np.linalg.norm(run.velocities[frame], axis=1)},
        cell_data=lambda frame: {"number": stress + frame},
    )  # fmt: skip
    entries = ET.parse(path).getroot().findall("Collection/DataSet")
    assert [float(e.get("timestep")) for e in entries] == list(run.times[::2])
    for frame, entry in zip(range(0, 6, 2), entries, strict=True):
        grid = pyvista.read(path.parent / entry.get("file"))
        np.testing.assert_array_equal(grid.points, run.positions[frame])
        np.testing.assert_array_equal(grid.cells_dict[pyvista.CellType.HEXAHEDRON], run.cells)
        np.testing.assert_array_equal(grid["displacement"], run.positions[frame] - run.points)
        np.testing.assert_array_equal(grid["velocity"], run.velocities[frame])
        np.testing.assert_array_equal(grid["number"], stress + frame)
        # VTK agrees that the cells are right way round
        assert (grid.compute_cell_sizes()["Volume"] > 0).all()
    assert len(list(path.parent.iterdir())) == 4
    reader = pyvista.get_reader(path)
    assert reader.time_values == list(run.times[::2])


def test_unwritable_folders_are_named(run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        pc.write_vtu_series(run, tmp_path / "file" / "out")
    with pytest.raises(InputError, match="every = 0"):
        pc.write_vtu_series(run, tmp_path, every=0)

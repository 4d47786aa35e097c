"""Runs in notebooks: as grids of PyVista, as pictures and as tables."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam


@pytest.mark.parametrize("element", ["hex8", "hex27"])
def test_grids_hold_the_frame_and_the_volume_of_its_cells(element):
    pv = pytest.importorskip("pyvista")
    problem = pc.discretise(beam((3, 1, 2)), element=element, mass="averaged")
    run = pc.rollout(pc.Newton(problem), frames=2)
    grid = run.to_pyvista(1)
    assert isinstance(grid, pv.UnstructuredGrid)
    np.testing.assert_array_equal(grid.points, run.positions[1])
    np.testing.assert_array_equal(grid["displacement"], run.positions[1] - run.points)
    np.testing.assert_array_equal(grid["velocity"], run.velocities[1])
    volume = run.to_pyvista(0).compute_cell_sizes()["Volume"]
    np.testing.assert_allclose(volume, problem.space.volumes(), rtol=1e-9)


def test_a_frame_is_drawn(tmp_path):
    pytest.importorskip("pyvista")
    run = pc.rollout(pc.Newton(pc.discretise(beam((3, 1, 2)))), frames=1)
    picture = tmp_path / "frame.png"
    run.plot(0, off_screen=True, screenshot=picture, window_size=(120, 90))
    assert picture.stat().st_size > 500


def test_a_table_escapes_what_it_shows():
    run = pc.rollout(pc.Newton(pc.discretise(beam((2, 1, 1)))), frames=1)
    run.attributes["note"] = "<b>"
    table = run._repr_html_()
    assert "&lt;b&gt;" in table
    assert table.count("<tr>") == 3 + len(run.attributes)

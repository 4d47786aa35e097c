"""Which cells lock because they bend alone, and the warning of them."""

import warnings

import numpy as np
import pytest

import pdcorrect as pc
from pdcorrect.errors import PdcorrectWarning
from pdcorrect.fem.mesh import bending_alone

WALL = {"region": {"plane": "x", "at": "min"}}


def scene(occupancy, element="hex8", clamps=(WALL,)):
    body = {"shape": "voxels", "occupancy": np.asarray(occupancy, dtype=int).tolist(),
            "cell_size": 0.1}  # fmt: skip
    material = {"young": 1e5, "poisson": 0.3, "density": 1e3}
    time, solver = {"step": 0.01, "frames": 1}, {"element": element}
    return pc.Scene(body=body, material=material, clamps=list(clamps), time=time, solver=solver)


def alone(occupancy, clamps=(WALL,)):
    problem = pc.discretise(scene(occupancy, "hex8-enhanced", clamps))
    return int(bending_alone(problem.mesh, problem.free).sum())


def held(plane, at, components=("x", "y", "z")):
    return {"region": {"plane": plane, "at": at}, "components": list(components)}


L = np.ones((4, 2, 4))
L[2:, :, 2:] = 0


@pytest.mark.parametrize(
    ("occupancy", "clamps", "count"),
    [
        (np.ones((6, 1, 1)), (WALL,), 6),
        (np.ones((6, 4, 1)), (WALL,), 24),
        (np.ones((6, 2, 2)), (WALL,), 0),
        (np.ones((1, 1, 1)), (WALL,), 0),  # no neighbour: nothing bends
        (L, (WALL,), 0),
        (np.ones((6, 1, 2)), (WALL, held("y", 0.0, "y"), held("y", 0.1, "y")), 0),  # plane strain
        (np.ones((6, 1, 2)), (WALL, held("y", 0.0, "y")), 0),
        (np.ones((4, 4, 1)), (WALL, held("z", 0.0, "z"), held("z", 0.1, "z")), 0),
    ],
    ids=["rod", "plate", "beam", "cell", "angle", "plane strain", "one side held", "pressed flat"],
)
def test_cells_bend_alone_where_one_is_the_whole_thickness(occupancy, clamps, count):
    assert alone(occupancy, clamps) == count


@pytest.mark.parametrize("element", ["hex8", "hex8-mean"])
def test_elements_that_lock_are_warned_of_in_one_line(element):
    with pytest.warns(PdcorrectWarning, match="6 of 6 cells are alone") as caught:
        pc.discretise(scene(np.ones((6, 1, 1)), element))
    (warning,) = caught
    assert "hex8-enhanced" in str(warning.message)
    assert "\n" not in str(warning.message)


@pytest.mark.parametrize("element", ["hex8-enhanced", "hex8-bubble", "hex27"])
def test_others_are_not(element):
    with warnings.catch_warnings():
        warnings.simplefilter("error", PdcorrectWarning)
        pc.discretise(scene(np.ones((6, 1, 1)), element))

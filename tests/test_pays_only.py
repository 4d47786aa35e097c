"""A scene pays only for what it uses: terms evaluated, modules imported, bytes held.

Five scenes from bare to full, stepped in a process of their own (`pays_only_scene`).
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pays_only_scene import SCENES
from pdcorrect.fem.mesh import voxel_mesh
from pdcorrect.fem.mesh_files import write_vtu

SCRIPT = Path(__file__).parent / "pays_only_scene.py"
NEEDED = {"full": {"meshio", "rich"}}
"""Optional or heavy packages that a scene needs; the others need none.  meshio imports rich."""
HEAVY = {"torch", "h5py", "pyvista", "vtkmodules", "meshio", "matplotlib", "pyamg", "cholespy"}
CLI = {"typer", "rich"}
NUMBER, FLAG = 8, 1  # bytes


@pytest.fixture(scope="module")
def used(tmp_path_factory):
    """What each scene used, by name."""
    path = tmp_path_factory.mktemp("mesh") / "block.vtu"
    mesh = voxel_mesh(np.ones((3, 2, 1), dtype=bool), (0, 0, 0), 0.05)
    write_vtu(path, mesh.positions, mesh.cells)
    command = [sys.executable, str(SCRIPT), str(path)]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}  # kernels whose calls are counted
    out = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    found = json.loads(out.stdout.splitlines()[-1])
    assert all(one["statuses"] == ["CONVERGED", "CONVERGED"] for one in found.values())
    return found


def test_the_volume_term_is_projected_where_there_is_one_and_at_its_own_points_only(used):
    """At all points of hex8 in blocks of 64; of the mean elements at one point a cell."""
    counts = {name: one["counts"] for name, one in used.items()}
    assert counts["bare"]["volume"] > 0  # the kernel is called, for no lane
    assert counts["bare"]["volume lanes"] == 0
    for name in ("volume", "loaded"):
        assert counts[name]["volume lanes"] == 64 * counts[name]["volume"]
    for name in ("best", "full"):
        assert 0 < counts[name]["volume lanes"] <= 8 * counts[name]["volume"]


@pytest.mark.parametrize(
    ("what", "users"),
    [
        ("modes", {"best", "full"}),
        ("damping", {"full"}),
        ("hyperelastic", set()),
        ("shear", set(SCENES)),
    ],
)
def test_a_term_is_evaluated_where_the_scene_has_it(used, what, users):
    assert {name for name, one in used.items() if one["counts"][what]} == users


@pytest.mark.parametrize("name", SCENES)
def test_only_the_packages_that_a_scene_needs_are_imported(used, name):
    packages = {module.split(".")[0] for module in used[name]["modules"]}
    assert packages & (HEAVY | CLI) == NEEDED.get(name, set())
    ours = {m.removeprefix("pdcorrect.") for m in used[name]["modules"] if "pdcorrect" in m}
    assert ("fem.mesh_files" in ours) == (name == "full")
    parts = {module.split(".")[0] for module in ours}
    assert not parts & {"batch", "data", "corrector", "training", "evaluation", "figures", "io"}
    assert not ours & {"solvers.newton", "solvers.adjoint", "fem.modes", "fem.stress", "metrics"}


def test_gradients_are_held_for_the_element_s_own_points_and_functions(used):
    cells = used["bare"]["sizes"][1]
    for name, one in used.items():
        functions, points = (11, 9) if name in ("best", "full") else (8, 8)
        assert one["lanes"] == [cells, functions, 3, points]


def test_a_scene_without_loads_clamps_or_terms_holds_nothing_for_them(used):
    size = {name: one["problem_bytes"] for name, one in used.items()}
    nodes = used["bare"]["sizes"][0]
    assert used["bare"]["loads"] == used["volume"]["loads"] == []
    assert size["bare"] == size["volume"]  # two numbers a point, whether or not one of them is 0
    held = nodes * 3 * (NUMBER + FLAG)
    assert used["bare"]["clamps"] <= held
    assert 0 < size["loaded"] - size["volume"] <= sum(used["loaded"]["loads"]) + held
    assert size["best"] < size["full"]
    for name in ("loaded", "best"):  # a dead load is a pattern, without operators
        nodes, (gravity,) = used[name]["sizes"][0], used[name]["loads"]
        assert gravity <= nodes * 3 * NUMBER + 100, name
    assert used["full"]["loads"][0] == used["best"]["loads"][0]
    stepper = {name: one["bytes"] - one["problem_bytes"] for name, one in used.items()}
    assert stepper["bare"] == stepper["volume"]
    assert stepper["loaded"] < stepper["volume"]  # clamped components are no unknowns
    assert stepper["loaded"] < stepper["best"]  # whose internal modes are condensed

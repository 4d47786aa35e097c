"""Regions by node numbers and by groups of a mesh file: the same part on every mesh."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from scipy.spatial import cKDTree

import pdcorrect as pc
from conftest import beam, box_mesh
from pdcorrect.errors import SceneError
from pdcorrect.fem.hexahedron import VTK_FACES
from pdcorrect.fem.mesh import Group, refine

NONE = np.zeros(0, np.int64)
MESH = box_mesh((3, 2, 2), (0.3, 0.2, 0.2), distortion=0.2)
"""Cells are counted by x, then y, then z."""


def faces_at(mesh, axis, at):
    """Cells and sides (n, 2) on a plane."""
    on = np.abs(mesh.positions[mesh.cells][:, VTK_FACES][..., axis] - at) < 1e-9
    return np.argwhere(on.all(axis=2))


LEFT = Group(NONE, faces_at(MESH, 0, 0.0), NONE)
RIGHT = Group(NONE, faces_at(MESH, 0, 0.3), NONE)
GROUPS = {
    "left": LEFT,
    "right": RIGHT,
    "foot": Group(np.arange(4), np.zeros((0, 2), np.int64), NONE),
    "left nodes": Group(
        NONE, np.zeros((0, 2), np.int64), np.flatnonzero(MESH.positions[:, 0] == 0)
    ),
    "empty": Group(NONE, np.zeros((0, 2), np.int64), NONE),
}
GROUPED = replace(MESH, groups=GROUPS)


def problem(region, load=None, element="hex8", k=1, **changes):
    loads = [load or {"kind": "gravity", "acceleration": [0, 0, -9.81]}]
    scene = beam((1, 1, 1), clamps=[{"region": region}], loads=loads, **changes)
    return pc.discretise(scene, k, element=element, mesh=GROUPED)


elements = pytest.mark.parametrize("element", ["hex8", "hex27"])
refinements = pytest.mark.parametrize("k", [1, 2, 3])


@elements
@refinements
def test_nodes_and_groups_of_a_plane_hold_what_the_plane_holds(element, k):
    plane = problem({"plane": "x", "at": "min"}, element=element, k=k).free
    assert not plane.all()
    nodes = np.flatnonzero(MESH.positions[:, 0] == 0).tolist()
    for region in ({"nodes": nodes}, {"group": "left"}, {"group": "left nodes"}):
        np.testing.assert_array_equal(problem(region, element=element, k=k).free, plane)


@elements
@refinements
def test_a_group_of_cells_holds_their_nodes(element, k):
    made = problem({"group": "foot"}, element=element, k=k)
    own = made.space.cells[: 4 * k**3]
    expected = np.zeros(len(made.positions), bool)
    expected[own] = True
    np.testing.assert_array_equal(~made.free.all(axis=1), expected)


@elements
@refinements
def test_single_nodes_and_edges_stay_points_and_lines(element, k):
    assert (~problem({"nodes": [5]}, element=element, k=k).free).all(axis=1).sum() == 1
    edge = [0, 1, 2]  # along z
    held = (~problem({"nodes": edge}, element=element, k=k).free).all(axis=1)
    assert held.sum() == 2 * k * (2 if element == "hex27" else 1) + 1


@refinements
def test_faces_on_both_ends_of_one_cell_do_not_hold_what_lies_between(k):
    plate = box_mesh((1, 3, 3), (0.1, 0.3, 0.3))
    ends = np.concatenate([faces_at(plate, 0, 0.0), faces_at(plate, 0, 0.1)])
    fine = refine(replace(plate, groups={"ends": Group(NONE, ends, NONE)}), k)
    cell, side = fine.groups["ends"].faces.T
    nodes = fine.cells[cell[:, None], VTK_FACES[side]]
    x = fine.positions[:, 0]
    np.testing.assert_array_equal(np.unique(nodes), np.flatnonzero((x < 1e-9) | (x > 0.1 - 1e-9)))
    assert len(cell) == 18 * k**2


@pytest.mark.parametrize("ks", [(2, 2), (3, 2), (2, 3)])
def test_refining_twice_is_refining_once(ks):
    twice = refine(refine(GROUPED, ks[0]), ks[1])
    once = refine(GROUPED, ks[0] * ks[1])
    for name, group in twice.groups.items():
        same = once.groups[name]
        for part in ("cells", "faces", "nodes"):
            assert len(getattr(group, part)) == len(getattr(same, part))
    for nodes in ([0], [0, 1, 2], np.flatnonzero(MESH.positions[:, 0] == 0)):
        a, b = (mesh.positions[mesh.refined_nodes(nodes)] for mesh in (once, twice))
        assert len(a) == len(b)
        assert cKDTree(a).query(b)[0].max() < 1e-12
    np.testing.assert_allclose(
        twice.from_coarse @ MESH.positions, twice.positions, rtol=0, atol=1e-14
    )


@elements
@refinements
@pytest.mark.parametrize(
    ("kind", "name", "area"),
    [("force", "right", 1.0), ("force", "foot", 1.0), ("force", "left nodes", 1.0),
     ("traction", "right", 0.04), ("traction", "left nodes", 0.04)],
)  # fmt: skip
def test_loads_on_groups_sum_to_what_they_say(element, k, kind, name, area):
    clamp = {"box": [[0.09, -1, -1], [0.21, 1, 1]]}
    load = {"kind": kind, "region": {"group": name}, kind: [1.0, 2.0, 3.0]}
    total = problem(clamp, load, element, k).external_forces(0.0).sum(axis=0)
    np.testing.assert_allclose(total, [area, 2 * area, 3 * area], rtol=1e-12)


@refinements
def test_pressure_on_a_group_acts_on_its_own_faces(k):
    load = {"kind": "pressure", "pressure": 5.0, "region": {"group": "right"}}
    total = problem({"group": "left"}, load, k=k).external_forces(0.0).sum(axis=0)
    np.testing.assert_allclose(total, [-0.2, 0, 0], atol=1e-14)


@refinements
def test_materials_of_groups(k):
    part = {"region": {"group": "foot"}, "young": 7e6, "density": 5.0}
    made = problem({"group": "left"}, k=k, materials=[part])
    np.testing.assert_array_equal(made.materials.young[: 4 * k**3], 7e6)
    assert (made.materials.young == 7e6).sum() == 4 * k**3
    np.testing.assert_array_equal(made.materials.density == 5.0, made.materials.young == 7e6)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"region": {"group": "lfet"}}, r"clamps\[0\].region.group = 'lfet'.*'left', 'right'"),
        ({"region": {"group": "empty"}}, "no node"),
        ({"region": {"group": "left"}, "materials": [{"region": {"group": "left"}, "young": 1.0}]},
         r"materials\[0\].*no cell"),
    ],
)  # fmt: skip
def test_groups_that_there_are_not_are_refused(settings, told):
    with pytest.raises(SceneError, match=told):
        problem(**settings)
    scene = beam((2, 1, 1), clamps=[{"region": {"group": "left"}}])
    with pytest.raises(SceneError, match="which has none"):
        pc.discretise(scene)


def test_meshes_held_by_nodes_converge_to_one_solution():
    """At rest under gravity; the tip's differences shrink as the cells do."""
    nodes = np.flatnonzero(MESH.positions[:, 0] == 0).tolist()
    tips = []
    for element, k in [("hex8", 1), ("hex8", 2), ("hex8", 4), ("hex27", 2)]:
        changes = {"time": {"step": 1.0, "frames": 1, "integrator": "quasi-static"}}
        made = problem({"nodes": nodes}, element=element, k=k, **changes)
        run = pc.rollout(pc.Newton(made), 1)
        tips.append((run.positions[-1] - run.positions[0])[made.mesh.coarse_nodes[-1]])
    away = np.linalg.norm(tips[:3] - tips[3], axis=1) / np.linalg.norm(tips[3])
    assert away[0] > 2 * away[1] > 4 * away[2]
    assert away[2] < 0.05


def test_a_scene_names_the_groups_of_its_mesh_file(tmp_path):
    data = {"part": [np.repeat([4, 9], 6)]}
    mesh = meshio.Mesh(MESH.positions, [("hexahedron", MESH.cells)], cell_data=data)
    meshio.write(tmp_path / "body.vtu", mesh)
    text = beam((1, 1, 1), loads=[], clamps=[{"region": {"group": "part=4"}}]).to_toml()
    start, end = text.index("[body]"), text.index("[material]")
    path = tmp_path / "scene.toml"
    path.write_text(text[:start] + '[body]\nshape = "file"\npath = "body.vtu"\n' + text[end:])
    scene = pc.Scene.load(path)
    assert pc.Scene.from_toml(scene.to_toml()) == scene
    free = pc.discretise(scene, 2).free
    assert (~free).any()
    assert free.any()

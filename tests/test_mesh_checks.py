"""What is wrong with a mesh is found, and named with the place; what is right is left alone."""

import numpy as np
import pytest

from block_meshes import TURNS, glue, o_grid, spokes, warped
from pdcorrect.errors import MeshError
from pdcorrect.fem.hexahedron import VTK_CORNERS, corner_jacobians, gauss_points, jacobians
from pdcorrect.fem.mesh import HexMesh, refine, voxel_mesh
from pdcorrect.fem.mesh_checks import _distances

CUBE = VTK_CORNERS.astype(float)

POSITIVE_ONLY_AT_CORNERS = {
    "2 x 2 x 2": [
        [0.25, 0.25, 0.5], [1.5, -0.25, 0.75], [0.75, 1.0, 0.5], [-0.5, 1.25, 0.0],
        [0.75, 0.75, 1.0], [0.25, 0.5, 0.75], [0.75, 1.0, 1.75], [-0.25, 0.5, 1.25],
    ],
    "3 x 3 x 3 only": [
        [0.25, 0.75, -0.25], [0.5, 0.0, 0.0], [0.25, 0.75, -0.5], [-0.75, 1.25, 0.25],
        [0.0, 0.0, 0.25], [1.0, 0.5, 1.75], [0.75, 0.75, 1.0], [-0.25, 1.25, 1.5],
    ],
}  # fmt: skip
"""Corners of cells whose trilinear map is inverted at points of a Gauss rule."""


def box(low, high):
    return CUBE * (np.array(high) - low) + low


def joined(*meshes):
    """The meshes side by side, without making nodes at the same place one."""
    starts = np.cumsum([0] + [len(m.positions) for m in meshes])
    return (
        np.concatenate([m.positions for m in meshes]),
        np.concatenate([m.cells + s for m, s in zip(meshes, starts, strict=False)]),
    )


def grid(*cells):
    return voxel_mesh(np.ones(cells, dtype=bool), (0, 0, 0), 1.0)


def test_every_renumbering_by_a_rotation_is_accepted_and_no_reflection():
    assert len(np.unique(TURNS, axis=0)) == 24
    for turn in TURNS:
        HexMesh.create(CUBE, turn[None])
        with pytest.raises(MeshError, match="inverted"):
            HexMesh.create(CUBE, turn[[4, 5, 6, 7, 0, 1, 2, 3]][None])


@pytest.mark.parametrize("rule", POSITIVE_ONLY_AT_CORNERS)
def test_cells_that_are_inverted_only_inside_are_refused(rule):
    corners = np.array(POSITIVE_ONLY_AT_CORNERS[rule])
    cells = np.arange(8)[None]
    assert corner_jacobians(corners, cells).min() > 0.05
    assert (jacobians(corners, cells, gauss_points(2)).min() > 0) == (rule == "3 x 3 x 3 only")
    with pytest.raises(MeshError, match="cell 0 around .* is inverted"):
        HexMesh.create(corners, cells)


def test_a_mirrored_mesh_is_told_from_a_bad_cell():
    mesh = grid(3, 2, 1)
    with pytest.raises(MeshError, match="6 of the 6 cells are so.* mirror image"):
        HexMesh.create(mesh.positions * [1, 1, -1], mesh.cells)
    cells = mesh.cells.copy()
    cells[3] = cells[3][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match="cell 3 ") as refused:
        HexMesh.create(mesh.positions, cells)
    assert "mirror" not in str(refused.value)


def test_lexicographic_node_order_is_told_from_a_mirrored_mesh():
    mesh = grid(3, 2, 1)
    order = [0, 1, 3, 2, 4, 5, 7, 6]
    with pytest.raises(MeshError, match="lexicographic") as refused:
        HexMesh.create(mesh.positions, mesh.cells[:, np.argsort(order)])
    assert ", ".join(map(str, order)) in str(refused.value)
    assert "mirror" not in str(refused.value)


def test_duplicate_nodes_are_named_both_with_their_places():
    left, right = grid(2, 1, 1), grid(1, 1, 1)
    right = HexMesh.create(right.positions + np.array([2, 0, 0]), right.cells)
    positions, cells = joined(left, right)
    with pytest.raises(MeshError, match=r"nodes 8 at \[2. 0. 0.\] and 12 at .*4 such.*Coherence"):
        HexMesh.create(positions, cells)
    positions[len(left.positions) :] += 1e-6  # as programs round
    with pytest.raises(MeshError, match="nodes 8 .* and 12 "):
        HexMesh.create(positions, cells)
    positions[len(left.positions) :, 0] += 1e-2  # a cut
    assert len(HexMesh.create(positions, cells).cells) == 3


def twice(mesh):
    """With one of its cells once more, in another turn."""
    return mesh.positions, np.vstack([mesh.cells, mesh.cells[1][TURNS[7]]])


WRONG = {
    "a node twice in a cell": (
        (CUBE[:7], np.array([[0, 1, 2, 3, 4, 5, 6, 6]])),
        "cell 0 around .* contains node 6 more than once",
    ),
    "a cell twice": (twice(grid(3, 1, 1)), r"cells 1 and 3 around \[1.5 0.5 0.5\]"),
    "three cells at a face": (
        glue(np.array([
            box([0, 0, 0], [1, 1, 1]), box([1, 0, 0], [2, 1, 1]), box([1, 0, 0], [1.7, 1, 1]),
        ])),
        r"face around \[1.  0.5 0.5\] .* 3 cells 0, 1, 2",
    ),
    "two cells on one side": (
        glue(np.array([box([0, 0, 0], [1, 1, 1]), box([0, 0, 0], [0.6, 1, 1])])),
        r"cells 0 and 1 .*\[0\.  0\.5 0\.5\]",
    ),
    "a node on an edge": (
        glue(np.array([
            box([0, 0, 0], [1, 1, 1]), box([1, 1, 0], [2, 2, 0.4]), box([1, 1, 0.4], [2, 2, 1]),
        ])),
        r"at \[1.  1.  0.4\] lies on .* cell 0 ",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("mesh", "words"), WRONG.values(), ids=WRONG)
def test_cells_that_do_not_join_at_whole_faces_are_refused(mesh, words):
    with pytest.raises(MeshError, match=words):
        HexMesh.create(*mesh)


def beside(mesh, cell, k):
    """One cell of a mesh cut k x k x k, the others left whole."""
    alone = HexMesh.create(mesh.positions[mesh.cells[cell]], np.arange(8)[None])
    cut = refine(alone, k)
    rest = mesh.positions[np.delete(mesh.cells, cell, axis=0)]
    return glue(rest, cut.positions[cut.cells])


@pytest.mark.parametrize("k", [2, 3])
@pytest.mark.parametrize("make", [lambda: spokes(3), lambda: warped(spokes(5)), o_grid])
def test_hanging_nodes_of_a_cell_that_is_cut_alone_are_refused(make, k):
    with pytest.raises(MeshError, match=r"node \d+ at .* lies on a face or an edge of cell \d+ "):
        HexMesh.create(*beside(make(), 4, k))


def test_different_divisions_on_both_sides_are_refused_and_a_gap_is_not():
    thirds = [box([1, y / 3, 0], [2, (y + 1) / 3, 1]) for y in range(3)]
    halves = [box([0, y / 2, 0], [1, (y + 1) / 2, 1]) for y in range(2)]
    with pytest.raises(MeshError, match="hanging node"):
        HexMesh.create(*glue(np.array(thirds + halves)))
    apart = np.array(thirds) + np.array([0.01, 0, 0])
    assert len(HexMesh.create(*glue(apart, np.array(halves))).cells) == 5


@pytest.mark.parametrize("make", [lambda: spokes(3), lambda: warped(spokes(5)), o_grid])
@pytest.mark.parametrize("stretch", [(1, 1, 1), (1, 1, 1e-4), (1e3, 1, 1)])
def test_good_meshes_pass_whatever_their_proportions(make, stretch):
    mesh = refine(make(), 2)
    created = HexMesh.create(mesh.positions * stretch, mesh.cells)
    np.testing.assert_array_equal(created.cells, mesh.cells)


def test_distances_from_warped_faces(rng):
    corners = CUBE[[0, 1, 2, 3]] + rng.uniform(-0.2, 0.2, size=(500, 4, 3))
    u, v = rng.uniform(0, 1, size=(2, 500, 1))
    a, b, c, d = np.moveaxis(corners, 1, 0)
    on = (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d
    np.testing.assert_allclose(_distances(corners, on), 0, atol=1e-12)
    np.testing.assert_allclose(_distances(corners, (a + b) / 2), 0, atol=1e-12)
    away = _distances(corners, on + np.array([0, 0, 0.1]))
    assert away.max() < 0.1 + 1e-12
    assert away.min() > 0.05
    flat = np.broadcast_to(CUBE[[0, 1, 2, 3]], (3, 4, 3))
    points = np.array([[0.3, 0.4, -0.5], [2.0, 0.5, 0.0], [2.0, 1.0, 1.0]])
    np.testing.assert_allclose(_distances(flat, points), [0.5, 1.0, np.sqrt(2)], atol=1e-12)

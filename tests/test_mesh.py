"""Meshes: node order, exact refinement, coincident nodes, refusals."""

import numpy as np
import pytest

from block_meshes import o_grid, spokes, warped
from pdcorrect.errors import MeshError, SceneError
from pdcorrect.fem.hexahedron import (
    VTK_CORNERS,
    VTK_EDGES,
    VTK_FACES,
    corner_jacobians,
    gauss_points,
    jacobians,
)
from pdcorrect.fem.mesh import HexMesh, boundary_faces, coincident_nodes, refine, voxel_mesh
from pdcorrect.fem.mesh_checks import row_groups
from pdcorrect.scene import Cross, Voxels, Weight


def cross(cells, arms, start, width, length):
    return Cross(
        shape="cross", cell_size=0.05, cells=cells, arms=arms, arm_start=start, arm_width=width,
        arm_length=length,
    ).occupancy()  # fmt: skip


def weight(support, second, start, pendulum, below, inflated):
    return Weight(
        shape="weight", cell_size=0.05, support_cells=support, second_support_length=second,
        pendulum_start=start, pendulum_cells=pendulum, weight_start=below, weight_cells=inflated,
    ).occupancy()  # fmt: skip


def cross_mesh():
    return voxel_mesh(*cross((6, 2, 2), 4, 3, 2, 1), 0.05)


def distorted_mesh():
    """Positions moved by a smooth map, cells' corners turned so that no two agree in order."""
    mesh = cross_mesh()
    x = mesh.positions / 0.05
    moved = mesh.positions + 0.05 * 0.15 * np.sin(x[:, [1, 2, 0]] * 1.3 + [0.2, 0.5, 0.9])
    cells = mesh.cells.copy()
    turn = [1, 2, 3, 0, 5, 6, 7, 4]  # a quarter turn about the local z axis
    cells[::3] = cells[::3][:, turn]
    return HexMesh.create(moved, cells)


def test_voxel_cells_are_in_vtk_order():
    mesh = cross_mesh()
    corners = mesh.positions[mesh.cells] - mesh.positions[mesh.cells[:, :1]]
    np.testing.assert_allclose(
        corners, np.broadcast_to(0.05 * VTK_CORNERS, corners.shape), atol=1e-15
    )


MESHES = {
    "cross": cross_mesh,
    "distorted cross": distorted_mesh,
    "3 cells round an edge": lambda: spokes(3),
    "5 cells round an edge, warped": lambda: warped(spokes(5)),
    "O-grid": o_grid,
    "O-grid, warped": lambda: warped(o_grid()),
}

every_mesh = pytest.mark.parametrize("make", MESHES.values(), ids=MESHES)


def volumes(mesh):
    return jacobians(mesh.positions, mesh.cells, gauss_points(2)).mean(axis=1)


def rows(mesh, local):
    """All faces or edges of the cells as sorted node numbers, and how many cells have each."""
    found = np.sort(mesh.cells[:, local].reshape(-1, local.shape[1]), axis=1)
    return np.unique(found, axis=0, return_counts=True)


def test_jacobians_are_the_derivatives_of_the_trilinear_map():
    mesh = warped(spokes(3))
    points = np.array([[0.2, 0.7, 0.4], [1.0, 0.0, 0.3]])

    def place(at):
        weights = np.where(VTK_CORNERS == 1, at, 1 - at).prod(axis=1)
        return np.einsum("k,cki->ci", weights, mesh.positions[mesh.cells])

    for point, found in zip(points, jacobians(mesh.positions, mesh.cells, points).T, strict=True):
        steps = 1e-5 * np.eye(3)
        slopes = [(place(point + step) - place(point - step)) / 2e-5 for step in steps]
        np.testing.assert_allclose(found, np.linalg.det(np.stack(slopes, axis=-1)), rtol=1e-7)


@every_mesh
@pytest.mark.parametrize("k", [2, 3])
def test_refinement_keeps_each_cells_volume_and_the_coarse_nodes(make, k):
    mesh = make()
    fine = refine(mesh, k)
    assert len(fine.cells) == k**3 * len(mesh.cells)
    np.testing.assert_array_equal(fine.positions[fine.coarse_nodes], mesh.positions)
    assert corner_jacobians(fine.positions, fine.cells).min() > 0
    parts = volumes(fine).reshape(len(mesh.cells), k**3)
    np.testing.assert_allclose(parts.sum(axis=1), volumes(mesh), rtol=1e-12)


@every_mesh
@pytest.mark.parametrize("k", [2, 3])
def test_refined_meshes_are_conforming(make, k):
    mesh = make()
    fine = refine(mesh, k)
    HexMesh.create(fine.positions, fine.cells)  # no duplicate or hanging nodes
    (edges, _), (faces, coarse), (_, shared) = (
        rows(mesh, VTK_EDGES), rows(mesh, VTK_FACES), rows(fine, VTK_FACES)
    )  # fmt: skip
    assert shared.max() == 2
    assert (shared == 1).sum() == k**2 * (coarse == 1).sum()
    assert (shared == 2).sum() == k**2 * (coarse == 2).sum() + 3 * k**2 * (k - 1) * len(mesh.cells)
    assert len(fine.positions) == (
        len(mesh.positions)
        + (k - 1) * len(edges)
        + (k - 1) ** 2 * len(faces)
        + (k - 1) ** 3 * len(mesh.cells)
    )


@every_mesh
def test_refining_twice_equals_refining_once_by_the_product(make):
    mesh = make()
    once, twice = refine(mesh, 6), refine(refine(mesh, 3), 2)
    order = coincident_nodes(twice.positions, once.positions, 1e-12)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(twice.positions)))
    np.testing.assert_array_equal(order[once.coarse_nodes], twice.coarse_nodes)
    np.testing.assert_array_equal(twice.positions[twice.coarse_nodes], mesh.positions)


@pytest.mark.parametrize("make", [cross_mesh, lambda: spokes(3), lambda: spokes(5), o_grid])
def test_flat_boundaries_keep_their_area_under_refinement(make):
    def area(mesh):
        a, b, c, d = np.moveaxis(mesh.positions[boundary_faces(mesh.cells)[0]], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(c - a, d - b), axis=1).sum()

    mesh = make()
    assert area(refine(mesh, 3)) == pytest.approx(area(mesh), rel=1e-12)


def test_boundary_faces_point_outwards_and_close_the_body():
    mesh = cross_mesh()
    faces, owners = boundary_faces(mesh.cells)
    a, b, c, d = np.moveaxis(mesh.positions[faces], 1, 0)
    normals = 0.5 * np.cross(c - a, d - b)
    np.testing.assert_allclose(normals.sum(axis=0), 0, atol=1e-15)
    outwards = np.einsum("ni,ni->n", normals, (a + c) / 2 - mesh.centres[owners])
    assert (outwards > 0).all()
    volume = np.einsum("ni,ni->", normals, (a + b + c + d) / 4) / 3
    assert volume == pytest.approx(len(mesh.cells) * 0.05**3)


def test_shapes_have_the_cells_they_promise():
    solid, corner = cross((10, 2, 2), 4, 3, 2, 4)
    assert solid.sum() == 10 * 4 + 4 * 4 * 4
    assert corner == (0, 4, 4)
    solid, corner = cross((10, 2, 2), 2, 3, 2, 4)
    assert solid.sum() == 10 * 4 + 2 * 4 * 4
    solid, corner = weight((8, 2, 2), 6, 3, (2, 2, 7), 3, (4, 4, 2))
    assert solid.sum() == 8 * 4 + (6 * 4 - 2 * 4) + 2 * 2 * 7 + (16 - 4) * 2
    np.testing.assert_array_equal(solid, solid[:, ::-1])  # symmetric across y


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cross((6, 2, 2), 4, 5, 2, 1), "at most the 6 cells"),
        (lambda: weight((4, 2, 2), 0, 3, (2, 2, 4), 0, (2, 2, 2)), "at most the 4"),
        (lambda: weight((8, 2, 2), 0, 3, (2, 2, 4), 3, (2, 2, 2)), "at most the 4"),
        (lambda: weight((8, 2, 2), 0, 3, (2, 2, 4), 0, (3, 2, 2)), "even number"),
        (lambda: weight((8, 2, 2), 5, 3, (2, 2, 4), 0, (2, 2, 2)), "second_support_length"),
        (
            lambda: Voxels(shape="voxels", cell_size=1.0, occupancy=[[[0, 0]]]).occupancy(),
            "at least one 1",
        ),
    ],
)
def test_impossible_shapes_are_refused(call, words):
    with pytest.raises(SceneError, match=words):
        call()


def test_bad_meshes_are_refused_with_the_place():
    mesh = cross_mesh()
    swapped = mesh.cells.copy()
    swapped[3] = swapped[3][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match="cell 3 "):
        HexMesh.create(mesh.positions, swapped)
    broken = mesh.positions.copy()
    broken[7, 1] = np.nan
    with pytest.raises(MeshError, match="node 7 "):
        HexMesh.create(broken, mesh.cells)
    broken[7, 1] = 1e160
    with pytest.raises(MeshError, match=r"node 7 .* at most 1e\+30 m from the origin"):
        HexMesh.create(broken, mesh.cells)
    with pytest.raises(MeshError, match="belongs to no cell"):
        HexMesh.create(np.vstack([mesh.positions, [9.0, 9, 9]]), mesh.cells)
    with pytest.raises(MeshError, match="expected 0 to"):
        HexMesh.create(mesh.positions, mesh.cells + len(mesh.positions))
    with pytest.raises(MeshError, match="no coincident node"):
        coincident_nodes(mesh.positions, mesh.positions + 0.01, 1e-9)


def test_equal_rows_are_grouped_as_numpy_does_and_in_its_order():
    rows = np.random.default_rng(0).integers(0, 3, (500, 4))
    _, first, counts = np.unique(rows, axis=0, return_index=True, return_counts=True)
    order, starts, found = row_groups(rows)
    assert (order[starts] == first).all()
    assert (found == counts).all()
    assert (rows[order] == np.repeat(rows[first], counts, axis=0)).all()

"""Meshes: node order, exact refinement, coincident nodes, refusals."""

import numpy as np
import pytest

from pdcorrect import shapes
from pdcorrect.errors import MeshError, SceneError
from pdcorrect.fem.mesh import (
    VTK_CORNERS,
    HexMesh,
    boundary_faces,
    coincident_nodes,
    corner_jacobians,
    refine,
    voxel_mesh,
)


def cross_mesh():
    return voxel_mesh(*shapes.cross((6, 2, 2), 4, 3, 2, 1), 0.05)


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


@pytest.mark.parametrize("k", [2, 3, 4])
@pytest.mark.parametrize("make", [cross_mesh, distorted_mesh])
def test_refinement_keeps_volume_nodes_and_conformity(make, k):
    mesh = make()
    fine = refine(mesh, k)
    assert len(fine.cells) == k**3 * len(mesh.cells)
    np.testing.assert_array_equal(fine.positions[fine.coarse_nodes], mesh.positions)
    assert corner_jacobians(fine.positions, fine.cells).min() > 0
    # conforming: the boundary is the refined boundary, with no inner cracks
    assert len(boundary_faces(fine.cells)[0]) == k**2 * len(boundary_faces(mesh.cells)[0])
    assert len(np.unique(np.round(fine.positions, 12), axis=0)) == len(fine.positions)


def test_refining_twice_equals_refining_once_by_the_product():
    mesh = distorted_mesh()
    once, twice = refine(mesh, 4), refine(refine(mesh, 2), 2)
    order = coincident_nodes(twice.positions, once.positions, 1e-12)
    assert len(np.unique(order)) == len(once.positions) == len(twice.positions)
    np.testing.assert_allclose(twice.positions[twice.coarse_nodes], mesh.positions, atol=0, rtol=0)


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
    solid, corner = shapes.cross((10, 2, 2), 4, 3, 2, 4)
    assert solid.sum() == 10 * 4 + 4 * 4 * 4
    assert corner == (0, 4, 4)
    solid, corner = shapes.cross((10, 2, 2), 2, 3, 2, 4)
    assert solid.sum() == 10 * 4 + 2 * 4 * 4
    solid, corner = shapes.weight((8, 2, 2), 6, 3, (2, 2, 7), 3, (4, 4, 2))
    assert solid.sum() == 8 * 4 + (6 * 4 - 2 * 4) + 2 * 2 * 7 + (16 - 4) * 2
    np.testing.assert_array_equal(solid, solid[:, ::-1])  # symmetric across y


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: shapes.cross((6, 2, 2), 4, 5, 2, 1), "at most the 6 cells"),
        (lambda: shapes.weight((4, 2, 2), 0, 3, (2, 2, 4), 0, (2, 2, 2)), "at most the 4"),
        (lambda: shapes.weight((8, 2, 2), 0, 3, (2, 2, 4), 3, (2, 2, 2)), "at most the 4"),
        (lambda: shapes.weight((8, 2, 2), 0, 3, (2, 2, 4), 0, (3, 2, 2)), "even number"),
        (lambda: shapes.weight((8, 2, 2), 5, 3, (2, 2, 4), 0, (2, 2, 2)), "second_support_length"),
        (lambda: shapes.voxels(np.zeros((2, 2, 2))), "at least one 1"),
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
    with pytest.raises(MeshError, match="belongs to no cell"):
        HexMesh.create(np.vstack([mesh.positions, [9.0, 9, 9]]), mesh.cells)
    with pytest.raises(MeshError, match="expected 0 to"):
        HexMesh.create(mesh.positions, mesh.cells + len(mesh.positions))
    with pytest.raises(MeshError, match="no coincident node"):
        coincident_nodes(mesh.positions, mesh.positions + 0.01, 1e-9)

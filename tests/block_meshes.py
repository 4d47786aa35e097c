"""Meshes that no grid gives: cells round an edge, an O-grid, turned corners, warped faces."""

import itertools

import numpy as np

from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.mesh import HexMesh


def _turns():
    """The 24 renumberings of a cell's corners by rotations of the cube, (24, 8)."""
    lookup = {tuple(corner): k for k, corner in enumerate(VTK_CORNERS)}
    for axes in itertools.permutations(range(3)):
        for flips in itertools.product((0, 1), repeat=3):
            matrix = np.eye(3)[list(axes)] * (1 - 2 * np.array(flips))
            if np.linalg.det(matrix) > 0:
                yield [lookup[tuple(abs(corner[list(axes)] - flips))] for corner in VTK_CORNERS]


TURNS = np.array(list(_turns()))


def glue(*cells):
    """Mesh of cells given by their corners' positions (C, 8, 3), equal places made one node."""
    corners = np.concatenate(cells)
    _, first, inverse = np.unique(
        np.round(corners.reshape(-1, 3), 9), axis=0, return_index=True, return_inverse=True
    )
    return corners.reshape(-1, 3)[first], inverse.reshape(-1, 8)


def _extruded(quads, heights, seed):
    """Quadrilaterals (n, 4, 2) drawn out along z, every cell's corners turned at random."""
    cells = []
    for low, high in itertools.pairwise(heights):
        for quad in quads:
            bottom, top = (np.column_stack([quad, np.full(4, z)]) for z in (low, high))
            cells.append(np.concatenate([bottom, top]))
    rng = np.random.default_rng(seed)
    turned = [cell[TURNS[rng.integers(24)]] for cell in cells]
    return HexMesh.create(*glue(np.array(turned)))


def spokes(n):
    """Cells (n) round one edge, in two layers; flat outer faces."""
    angles = np.pi * np.arange(2 * n) / n + 0.3
    radii = np.where(np.arange(2 * n) % 2, 1.2, 1.0) + 0.1 * np.cos(np.arange(2 * n))
    ring = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    quads = [
        [np.array([0.05, -0.1]), ring[2 * k], ring[2 * k + 1], ring[(2 * k + 2) % (2 * n)]]
        for k in range(n)
    ]
    return _extruded(np.array(quads), [0.0, 0.5, 1.3], n)


def o_grid():
    """A cylinder: a square core of 2 x 2 cells within a ring of 8 x 2, in two layers."""
    core = 0.4 * np.array([[-1, -1], [0, -1], [1, -1], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0]])
    circle = core / np.linalg.norm(core, axis=1)[:, None]
    rings = [core, 0.5 * (core + circle), circle]
    quads = [
        [outer[i], outer[j], inner[j], inner[i]]
        for inner, outer in itertools.pairwise(rings)
        for i, j in ((i, (i + 1) % 8) for i in range(8))
    ]
    quads += [
        0.4 * np.array([[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]], dtype=float)
        for x in (-1, 0)
        for y in (-1, 0)
    ]
    return _extruded(np.array(quads), [0.0, 0.3, 1.0], 8)


def warped(mesh):
    """The mesh after a smooth map that leaves no face flat."""
    x = mesh.positions
    return HexMesh.create(x + 0.08 * np.sin(2 * x[:, [1, 2, 0]] + [0.2, 0.5, 0.9]), mesh.cells)

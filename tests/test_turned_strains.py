"""Strains in the turned frame: derivatives of their potentials, and frames."""

import numpy as np
import pytest

from conftest import rotation
from pdcorrect.fem.cell_correction import CellCorrection, cell_shapes
from pdcorrect.fem.cube_symmetry import SIGNS

CELLS = 20  # more than one chunk


@pytest.fixture(scope="module")
def cells():
    """Distorted cells that share no nodes, with any symmetric K."""
    rng = np.random.default_rng(0)
    corners = 0.05 * SIGNS + 0.008 * rng.normal(size=(CELLS, 8, 3))
    shapes, sizes = cell_shapes(corners)
    K = rng.normal(size=(CELLS, 18, 18))
    numbers = np.arange(8 * CELLS).reshape(CELLS, 8)
    correction = CellCorrection(
        numbers, shapes, sizes, K + K.transpose(0, 2, 1), np.zeros((CELLS, 8, 8)),
        np.ones(CELLS, dtype=bool),
    )  # fmt: skip
    return correction, corners.reshape(-1, 3)


def moved(seed=1):
    return 0.04 * np.random.default_rng(seed).normal(size=(8 * CELLS, 3))


def slope(f, e=1e-4):
    return (8 * (f(e) - f(-e)) - (f(2 * e) - f(-2 * e))) / (12 * e)


@pytest.mark.parametrize(
    ("squeezed", "bent"),
    [(1.0, 0.3), (0.5, 0.5), (1.0, 1.0), (1.6, 0.2)],
    ids=["mild", "crushed", "folded", "drawn out"],
)
@pytest.mark.parametrize("shifted", [False, True])
def test_forces_and_tangent_are_the_derivatives_of_the_potential(cells, shifted, squeezed, bent):
    """Also where the strains fade."""
    correction, rest = cells
    rng = np.random.default_rng(2)
    shift = rng.normal(size=(CELLS if shifted else 0, 18))
    u, x = bent * moved() + (squeezed - 1.0) * rest, 0.02 * rng.normal(size=(8 * CELLS, 3))
    full, left = (np.linalg.norm(correction.strains(v)[:, 6:], axis=1) for v in (0.05 * moved(), u))
    faded = (left > 0.0) & (left < 0.9 * bent / 0.05 * full)  # rotations leave lengths
    assert (faded.sum() > 3) == ((squeezed, bent) != (1.0, 0.3)), faded.sum()

    def forces(t):
        return correction.energy_and_forces(u + t * x, shift)[1]

    work = -np.vdot(forces(0.0), x)
    found = slope(lambda t: correction.energy_and_forces(u + t * x, shift)[0])
    assert found == pytest.approx(work, rel=1e-8)
    tangent = correction.tangent(u, shift=shift)
    Kx = tangent.apply(x)
    assert Kx == pytest.approx(-slope(forces), abs=1e-7 * np.abs(Kx).max())
    H = tangent.matrices
    assert pytest.approx(H.transpose(0, 2, 1), abs=1e-12 * np.abs(H).max()) == H
    blocks = np.zeros((CELLS, 8, 8, 3, 3))
    tangent.add_to(blocks)
    by_cell = np.einsum("ckliJ,clJ->cki", blocks, x[correction.cells])
    assert by_cell.reshape(-1, 3) == pytest.approx(Kx, abs=1e-12 * np.abs(Kx).max())


def test_the_projected_tangent_is_positive_where_the_matrices_are(cells):
    correction, _ = cells
    positive = CellCorrection(
        correction.cells, correction.shapes, correction.sizes,
        correction.matrices @ correction.matrices, correction.masses, correction.learned,
    )  # fmt: skip
    values = np.linalg.eigvalsh(positive.tangent(moved(), project=True).matrices)
    assert values.min() >= -1e-12 * values.max()


def test_strains_do_not_change_in_rigid_motions_and_vanish_in_them(cells):
    correction, rest = cells
    R = rotation()
    u = moved()
    turned = (rest + u) @ R.T + [0.3, -0.1, 0.2] - rest
    strains = correction.strains(u)
    assert correction.strains(turned) == pytest.approx(strains, abs=1e-13)
    assert correction.strains(rest @ R.T - rest) == pytest.approx(0.0, abs=1e-15)


def test_affine_displacements_have_no_other_strains_than_stretch(cells):
    correction, rest = cells
    F = np.eye(3) + 0.08 * np.random.default_rng(3).normal(size=(3, 3))
    z = correction.strains(rest @ F.T - rest)
    assert z[:, 6:] == pytest.approx(0.0, abs=1e-15)
    _, s, Vt = np.linalg.svd(F)
    stretch = Vt.T @ np.diag(s) @ Vt
    J = np.prod(s)
    share = (1.5 * (J**2 - 1.0) / (J**2 + 2.0) + 3.0 - np.trace(stretch)) / 3.0
    assert z[:, :3] / correction.sizes[:, None] == pytest.approx(
        np.broadcast_to(np.diag(stretch) - 1.0 + share, (CELLS, 3)), abs=1e-12
    )


def test_crushed_and_drawn_out_cells_have_no_strains(cells):
    correction, rest = cells
    for F in (np.zeros((3, 3)), np.diag([1.0, 1.0, -0.9]), np.diag([2.2, 0.7, 0.7])):
        assert not correction.strains(rest @ F.T - rest).any()
        energy, forces = correction.energy_and_forces(rest @ F.T - rest)
        assert energy == 0.0
        assert not forces.any()
        assert not correction.tangent(rest @ F.T - rest).matrices.any()

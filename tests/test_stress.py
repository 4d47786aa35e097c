"""Stress: exact in affine states on distorted cells, in balance with the nodal forces."""

import numpy as np
import pytest

import pdcorrect as pc
from block_meshes import spokes, warped
from conftest import beam, disturbed, rotation
from pdcorrect.errors import InputError
from pdcorrect.fem import energies
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.materials import Materials
from pdcorrect.fem.operators import Space
from pdcorrect.fem.problem import problem_from_body
from pdcorrect.fem.stress import stress, von_mises
from test_mesh import distorted_mesh

ELEMENTS = [
    "hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced", "hex27",
]  # fmt: skip
ENERGIES = [
    "corotated", "corotated-only", "arap", "volume-only", "neo-hookean", "st-venant-kirchhoff",
    "linear-corotated",
]  # fmt: skip

every_element = pytest.mark.parametrize("element", ELEMENTS)
PAIRS = [
    (element, energy)
    for element in ELEMENTS
    for energy in ENERGIES
    if (element, energy) != ("hex8-bubble-mean", "volume-only")  # its modes have no stiffness
]
every_pair = pytest.mark.parametrize(("element", "energy"), PAIRS)


def body(element, energy="corotated", mesh=None, young=None, poisson=0.4, mass="lumped"):
    """A body of distorted cells without clamps; ``young`` is a number or one a cell."""
    scene = beam(
        clamps=[], loads=[], material={"energy": energy}, solver={"element": element, "mass": mass}
    )
    mesh = distorted_mesh() if mesh is None else mesh
    space = Space(mesh, element)
    count = len(mesh.cells)
    modulus = np.linspace(2e5, 4e5, count) if young is None else np.full(count, young)
    materials = Materials.from_moduli(
        scene.material, modulus, np.full(count, poisson), np.full(count, 1e3)
    )
    body = ElasticBody(mesh, space, space.quadrature(), materials, 0.05)
    return problem_from_body(scene, 1, body)


@every_pair
def test_affine_states_have_the_analytic_stress_on_distorted_cells(element, energy):
    problem = body(element, energy)
    F = rotation(4) @ np.diag([1.3, 0.95, 0.9]) @ rotation(5)
    found = stress(problem, problem.positions @ F.T + [0.1, 0.2, -0.3])
    for c, (mu, omega) in enumerate(
        zip(problem.materials.mu, problem.materials.volume_weight, strict=True)
    ):
        P = energies.first_piola(F, mu, omega, energy)
        sigma = P @ F.T / np.linalg.det(F)
        shape = found.cauchy[c].shape
        np.testing.assert_allclose(found.deformation[c], np.broadcast_to(F, shape), atol=1e-10)
        np.testing.assert_allclose(found.first_piola[c], np.broadcast_to(P, shape), atol=1e-4)
        np.testing.assert_allclose(found.cauchy[c], np.broadcast_to(sigma, shape), atol=1e-4)
    assert np.abs(found.cauchy).max() > 1e4


@every_element
def test_uniaxial_tension_has_one_stress_and_the_modulus_of_youngs_definition(element):
    """Small strain with free sides: sigma_xx = E eps, all else zero."""
    problem = body(element, young=3e5)
    strain = 1e-6
    F = np.diag([1 + strain, 1 - 0.4 * strain, 1 - 0.4 * strain])
    found = stress(problem, problem.positions @ F.T)
    expected = np.zeros((3, 3))
    expected[0, 0] = 3e5 * strain
    np.testing.assert_allclose(
        found.nodal_cauchy, np.broadcast_to(expected, (len(problem.positions), 3, 3)), atol=1e-5
    )
    np.testing.assert_allclose(found.von_mises, 3e5 * strain, rtol=1e-4)


@every_pair
def test_nodal_forces_follow_from_the_first_piola_stress(element, energy):
    problem = body(element, energy, mesh=warped(spokes(5)))
    positions = disturbed(problem, 0.2)
    found = stress(problem, positions)
    count = found.weights.shape[1]
    gradients = problem.quadrature.gradients[:, :count, : problem.cells.shape[1]]
    by_cell = -np.einsum("cq,cqij,cqkj->cki", found.weights, found.first_piola, gradients)
    forces = np.zeros_like(positions)
    np.add.at(forces, problem.cells, by_cell)
    size = np.abs(forces).max()
    np.testing.assert_allclose(forces, problem.forces(positions), atol=1e-9 * size)


@every_pair
def test_cauchy_stress_is_symmetric_and_turns_with_the_body(element, energy):
    problem = body(element, energy)
    positions, turn = disturbed(problem, 0.05), rotation(7)
    found = stress(problem, positions)
    size = np.abs(found.cauchy).max()
    np.testing.assert_allclose(found.cauchy, found.cauchy.swapaxes(2, 3), atol=1e-12 * size)
    turned = stress(problem, positions @ turn.T + [0.5, -0.2, 0.1])
    np.testing.assert_allclose(turned.cauchy, turn @ found.cauchy @ turn.T, atol=1e-7 * size)
    np.testing.assert_allclose(turned.von_mises, found.von_mises, atol=1e-7 * size)


@every_element
def test_a_body_that_only_turns_has_no_stress(element):
    problem = body(element)
    found = stress(problem, problem.positions @ rotation().T + 1.0)
    assert np.abs(found.cauchy).max() < 1e-8 * 4e5


def test_von_mises_of_pure_shear_and_of_pressure():
    shear = np.zeros((3, 3))
    shear[0, 1] = shear[1, 0] = 5.0
    turn = rotation()
    assert von_mises(turn @ shear @ turn.T) == pytest.approx(5.0 * np.sqrt(3))
    assert von_mises(shear - 7.0 * np.eye(3)) == pytest.approx(5.0 * np.sqrt(3))
    assert von_mises(-7.0 * np.eye(3)) == pytest.approx(0.0, abs=1e-14)
    assert von_mises(np.diag([0.0, -3.0, 0.0])) == pytest.approx(3.0)


def test_a_standing_column_carries_its_weight():
    """Sigma_xx = rho g (x - L) in a column that stands on x = 0, sides free to spread."""
    scene = beam(
        (8, 1, 1), poisson=0.0, clamps=[{"region": {"plane": "x", "at": 0.0}}],
        loads=[{"kind": "gravity", "acceleration": [-9.81, 0.0, 0.0]}],
        time={"integrator": "quasi-static"}, solver={"element": "hex27"},
    )  # fmt: skip
    problem = pc.discretise(scene)
    state = pc.Newton(problem)(problem.rest_state()).state
    found = stress(problem, state.positions)
    volume = found.weights.sum(axis=1)
    points = problem.space.interpolate(problem.positions)[..., 0]
    middle = (found.weights * points).sum(axis=1) / volume
    axial = (found.weights * found.cauchy[..., 0, 0]).sum(axis=1) / volume
    pressure = 1e3 * 9.81 * 0.16
    np.testing.assert_allclose(axial, pressure * (middle / 0.16 - 1), atol=2e-3 * pressure)
    x = problem.positions[:, 0]
    corners = (x > 0.01) & (x < 0.15) & np.isclose(x % 0.02, 0, atol=1e-9)
    np.testing.assert_allclose(
        found.nodal_cauchy[corners, 0, 0], pressure * (x[corners] / 0.16 - 1), atol=2e-3 * pressure
    )


@pytest.mark.parametrize("element", ["hex8", "hex8-mean", "hex27"])
def test_nodal_averages_of_a_linear_field_converge(element):
    """First order at the surface; exact at corners inside, which see all sides alike."""
    errors, inside = [], []
    for n in (2, 4):
        problem = pc.discretise(beam((2, 2, 2), 0.1, solver={"element": element}), refine=n // 2)
        found = stress(problem, problem.positions)
        points = problem.space.interpolate(problem.positions)[:, : found.weights.shape[1]]
        mean = found.at_nodes(points @ [1.0, -2.0, 3.0])
        error = np.abs(mean - problem.positions @ [1.0, -2.0, 3.0])
        errors.append(error.max())
        corners = np.unique(problem.cells[:, :8])
        within = (problem.positions[corners] % 0.2 > 1e-9).all(axis=1)
        inside.append(error[corners][within].max())
    assert errors[0] / errors[1] == pytest.approx(2)
    assert max(inside) < 1e-12


def test_nodal_averages_are_weighted_by_rest_volume():
    problem = body("hex8", mesh=warped(spokes(5)))
    found = stress(problem, problem.positions)
    values = np.random.default_rng(0).normal(size=(*found.weights.shape, 2))
    mean = found.at_nodes(values)
    node = int(np.bincount(problem.cells.ravel()).argmax())
    touching = (problem.cells == node).any(axis=1)
    assert np.ptp(found.weights[touching].sum(axis=1)) > 0.02 * found.weights.sum(axis=1).max()
    expected = np.average(
        values[touching].reshape(-1, 2), axis=0, weights=found.weights[touching].ravel()
    )
    np.testing.assert_allclose(mean[node], expected, rtol=1e-12)


def test_a_bent_strip_has_the_bending_stress():
    """Pure bending by the curvature k: sigma_xx = -E k z at small strain, nu = 0."""
    problem = pc.discretise(beam((8, 1, 1), poisson=0.0, solver={"element": "hex8-bubble"}))
    x, y, z = problem.positions.T
    z0, k = z - 0.01, 1e-4
    bent = np.column_stack([x - k * x * z0, y, z + 0.5 * k * x**2])
    found = stress(problem, bent)
    height = problem.space.interpolate(problem.positions)[..., 2] - 0.01
    np.testing.assert_allclose(found.cauchy[..., 0, 0], -1e6 * k * height, atol=2e-3 * k * 1e4)
    assert np.abs(found.cauchy[..., 0, 2]).max() < 2e-3 * k * 1e4


def test_wrong_input_is_named():
    problem = body("hex8")
    with pytest.raises(InputError, match="one row a node"):
        stress(problem, problem.positions[1:])
    with pytest.raises(InputError, match="NaN"):
        stress(problem, problem.positions * np.nan)
    found = stress(problem, problem.positions)
    with pytest.raises(InputError, match="quadrature point"):
        found.at_nodes(np.zeros((3, 3)))


def test_weights_may_differ_by_matrix(rng):
    F = np.eye(3) + 0.2 * rng.normal(size=(4, 5, 3, 3))
    mu, omega = rng.uniform(1, 2, size=(4, 1)), rng.uniform(1, 2, size=5)
    for function in (energies.energy_density, energies.first_piola, energies.elasticity):
        found = function(F, mu, omega)
        assert found[2, 3] == pytest.approx(function(F[2, 3], mu[2, 0], omega[3]), rel=1e-12)
    with pytest.raises(InputError, match=r"mu \(3,\)"):
        energies.first_piola(F, np.ones(3), 1.0)


@every_element
def test_corners_have_the_volume_ratio_of_an_affine_deformation(element):
    problem = body(element)
    F = np.array([[1.2, 0.3, 0.0], [0.0, 0.9, -0.2], [0.1, 0.0, 1.1]])
    found = problem.corner_volume_ratios(problem.positions @ F.T + 0.3)
    np.testing.assert_allclose(found, np.linalg.det(F), rtol=1e-10)
    assert found.shape == (len(problem.cells), 8)


def test_a_corner_pushed_through_its_cell_is_seen_there_and_not_at_the_quadrature_points():
    problem = pc.discretise(beam(clamps=[], loads=[]))
    corner = int(problem.positions.sum(axis=1).argmin())
    moved = problem.positions.copy()
    moved[corner] += 0.4 * problem.cell_size  # past the plane of its three neighbours
    assert problem.volume_ratios(moved).min() > 0.0
    ratios = problem.corner_volume_ratios(moved)
    cell, number = np.argwhere(problem.cells == corner)[0]
    # edges e_i - 0.4 (1, 1, 1) at the corner: 1 - 3 * 0.4
    assert ratios[cell, number] == pytest.approx(1.0 - 3 * 0.4)
    assert (np.delete(ratios.ravel(), 8 * cell + number) > 0.0).all()

"""What every element must satisfy, on cells that no grid gives."""

import numpy as np
import pytest

import pdcorrect as pc
from block_meshes import o_grid, spokes, warped
from conftest import (
    ELEMENTS,
    GRAVITY,
    beam,
    boundary_nodes,
    box_mesh,
    disturbed,
    held,
    problem_on,
    rotation,
)
from pdcorrect.errors import SceneError

WITH_MODES = ("hex8-bubble", "hex8-bubble-mean", "hex8-enhanced")
every_element = pytest.mark.parametrize("element", ELEMENTS)
SIZE = (0.10, 0.07, 0.12)
AFFINE = rotation(4) @ (np.eye(3) + 0.25 * np.random.default_rng(2).normal(size=(3, 3)))
AFFINE *= 1.03 / np.cbrt(np.linalg.det(AFFINE))  # stretches of 1.6, 0.9 and 0.8
MESHES = {
    "random": lambda: box_mesh((3, 2, 3), SIZE, 0.25, seed=1),
    "5 cells round an edge, warped": lambda: warped(spokes(5)),
    "O-grid": o_grid,
}
on_every_mesh = pytest.mark.parametrize("make", MESHES.values(), ids=MESHES)


def one_cell(element, poisson=0.3, **changes):
    """A free cell without a right angle or a flat face."""
    mesh = warped(box_mesh((1, 1, 1), (1.0, 0.8, 1.3)))
    return problem_on(mesh, element, material={"poisson": poisson, "young": 2e5}, **changes)


def stress_scale(problem):
    """N: shear modulus times the area of a cell's face."""
    return problem.materials.mu.max() * problem.cell_size**2


# --- shape functions -----------------------------------------------------------------------


@every_element
@on_every_mesh
def test_gradients_reproduce_affine_fields_and_modes_have_no_mean(make, element):
    problem = problem_on(make(), element)
    nodes = problem.cells.shape[1]
    gradients, size = problem.quadrature.gradients, problem.cell_size
    np.testing.assert_allclose(gradients[:, :, :nodes].sum(axis=2), 0, atol=1e-12 / size)
    moved = np.einsum(
        "cki,cqkj->cqij", problem.positions[problem.cells] @ AFFINE.T, gradients[:, :, :nodes]
    )
    np.testing.assert_allclose(moved, np.broadcast_to(AFFINE, moved.shape), atol=1e-11)
    for weights in (problem.quadrature.weights, problem.quadrature.volume_weights):
        np.testing.assert_allclose(weights.sum(axis=1), problem.space.volumes(), rtol=1e-12)
        means = np.einsum("cq,cqmj->cmj", weights, gradients[:, :, nodes:])
        assert means.shape[1] == (3 if element in WITH_MODES else 0)
        np.testing.assert_allclose(means, 0, atol=1e-13 * size**2)


@every_element
def test_mass_sums_to_density_times_volume(element):
    mesh, scene = box_mesh((3, 2, 2), SIZE, 0.25, seed=3), {"solver": {"mass": "consistent"}}
    problem = problem_on(mesh, element, **scene)
    volume = np.prod(SIZE)
    assert problem.mass.sum() == pytest.approx(1e3 * volume, rel=1e-12)
    lumped = problem_on(mesh, element).mass
    np.testing.assert_allclose(lumped, problem.mass, rtol=1e-12)
    assert (lumped > 0).all()
    first = problem.mass @ problem.positions
    np.testing.assert_allclose(first, 1e3 * volume * np.array(SIZE) / 2, rtol=1e-12)


@every_element
def test_consistent_mass_has_the_second_moments_of_a_box(element):
    problem = problem_on(box_mesh((3, 2, 2), SIZE), element, solver={"mass": "consistent"})
    size, x = np.array(SIZE), problem.positions
    exact = np.outer(size, size) / 4 + np.diag(size**2) / 12
    np.testing.assert_allclose(x.T @ problem.mass_times(x), 1e3 * np.prod(SIZE) * exact, rtol=1e-12)


def test_the_triquadratic_mass_integrates_products_of_quadratics():
    problem = problem_on(box_mesh((2, 1, 2), SIZE), "hex27", solver={"mass": "consistent"})
    x, y, z = problem.positions.T
    a, b, c = SIZE
    fields = np.column_stack([x**2, x * y, y**2 * z])
    exact = 1e3 * a * b * c * np.array(
        [
            [a**4 / 5, a**3 * b / 8, a**2 * b**2 * c / 18],
            [a**3 * b / 8, a**2 * b**2 / 9, a * b**3 * c / 16],
            [a**2 * b**2 * c / 18, a * b**3 * c / 16, b**4 * c**2 / 15],
        ]
    )  # fmt: skip
    np.testing.assert_allclose(fields.T @ problem.mass_times(fields), exact, rtol=1e-12)


# --- patch tests ---------------------------------------------------------------------------


@every_element
@on_every_mesh
def test_affine_deformation_is_in_equilibrium_inside_and_bends_no_mode(make, element):
    """Constant stress does no work on the modes, whose gradients have zero mean."""
    problem = problem_on(make(), element)
    x = problem.positions @ AFFINE.T + [0.1, -0.2, 0.3]
    relaxed = problem.relaxed(x)
    assert len(relaxed) - len(x) == (3 * len(problem.mesh.cells) if element in WITH_MODES else 0)
    np.testing.assert_allclose(relaxed[len(x) :], 0, atol=1e-11 * problem.cell_size)
    forces = problem.forces(x)
    inside = np.setdiff1d(np.arange(len(x)), boundary_nodes(problem))
    assert len(inside) >= 1
    assert np.abs(forces[inside]).max() < 1e-10 * np.abs(forces).max()


@every_element
@on_every_mesh
def test_an_affine_surface_gives_an_affine_body(make, element):
    """At a moderate change of volume; far from 1 hex8-bubble has lower, wavy minima."""
    problem = problem_on(make(), element, time={"integrator": "quasi-static"})
    target = problem.positions @ AFFINE.T
    problem = held(problem, boundary_nodes(problem), target)
    start = target + 0.05 * problem.cell_size * np.random.default_rng(7).normal(size=target.shape)
    result = pc.Newton(problem, tolerance=1e-12)(pc.State(start, np.zeros_like(start)))
    assert result.status is pc.Status.CONVERGED
    moved = np.abs(start - target)[problem.free].max()
    assert moved > 0.05 * problem.cell_size
    np.testing.assert_allclose(
        result.state.positions, target, rtol=0, atol=1e-10 * problem.cell_size
    )


# --- energy and its derivatives --------------------------------------------------------------


@every_element
def test_condensed_forces_and_stiffness_are_derivatives(element, rng):
    problem = problem_on(box_mesh((2, 2, 1), SIZE, 0.2, seed=5), element)
    p, d = disturbed(problem, 0.06, 1), rng.normal(size=problem.positions.shape)
    if element in WITH_MODES:
        assert np.abs(problem.relaxed(p)[len(p) :]).max() > 1e-3 * problem.cell_size
    energy, forces = problem.energy(p), problem.forces(p)
    change = problem.stiffness(p) @ d.ravel()

    def first(h):
        return abs(problem.energy(p + h * d) - energy + h * np.vdot(forces, d))

    def second(h):
        return np.linalg.norm((forces - problem.forces(p + h * d)).ravel() - h * change)

    for remainder in (first, second):
        assert np.log2(remainder(2e-5) / remainder(1e-5)) == pytest.approx(2, abs=0.05)


@every_element
def test_energy_does_not_depend_on_the_frame(element):
    problem = problem_on(warped(spokes(5)), element)
    p, turn = disturbed(problem, 0.08, 2), rotation(6)
    turned = p @ turn.T + [3.0, -2.0, 1.0]
    assert problem.energy(turned) == pytest.approx(problem.energy(p), rel=1e-11)
    np.testing.assert_allclose(
        problem.forces(turned), problem.forces(p) @ turn.T, atol=1e-9 * stress_scale(problem)
    )
    amplitudes = problem.relaxed(p)[len(p) :] @ turn.T
    np.testing.assert_allclose(
        problem.relaxed(turned)[len(p) :], amplitudes, atol=1e-9 * problem.cell_size
    )


@every_element
@on_every_mesh
def test_rigid_motion_costs_no_energy(make, element):
    problem = problem_on(make(), element)
    for seed in range(3):
        moved = problem.positions @ rotation(seed).T + [0.3, -0.2, 0.1]
        scale = problem.materials.mu.max() * problem.space.volumes().sum()
        assert problem.energy(moved) < 1e-24 * scale
        assert np.abs(problem.forces(moved)).max() < 1e-11 * stress_scale(problem)


@pytest.mark.parametrize("poisson", [0.3, 0.499])
@every_element
def test_only_rigid_motions_have_no_stiffness(element, poisson):
    problem = one_cell(element, poisson)
    values = np.linalg.eigvalsh(problem.stiffness(problem.positions).toarray())
    softest = values[6] / (problem.materials.mu[0] * problem.cell_size)
    assert np.abs(values[:6]).max() < 1e-11 * values[-1]
    assert softest > 0.01


@pytest.mark.parametrize("element", ["hex8-mean", "hex8-bubble-mean", "hex8-enhanced"])
def test_one_mode_a_cell_is_stiff_in_volume(element):
    """The mean volume constrains one mode, plain trilinear cells seven."""
    stiff = {}
    for kind in ("hex8", element):
        problem = one_cell(kind, 0.4999)
        values = np.linalg.eigvalsh(problem.stiffness(problem.positions).toarray())
        stiff[kind] = int((values > 30 * problem.materials.mu[0] * problem.cell_size).sum())
    assert stiff == {"hex8": 7, element: 1}


# --- solvers ---------------------------------------------------------------------------------


@every_element
@pytest.mark.parametrize("make", [None, MESHES["random"]], ids=["box", "random"])
def test_projective_dynamics_is_newton_for_every_element(make, element):
    mesh = box_mesh((4, 2, 2), (0.08, 0.04, 0.05)) if make is None else make()
    changes = {
        "clamps": [{"region": {"plane": "x", "at": 0.0}}],
        "loads": [*GRAVITY, {"kind": "torsion", "strength": 6e4}],
        "material": {"young": 3e5},
    }
    problem = problem_on(mesh, element, **changes)
    by_pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-8), frames=6)
    by_newton = pc.rollout(pc.Newton(problem, tolerance=1e-11), frames=6)
    moved = np.abs(by_newton.positions - problem.positions).max()
    assert moved > 0.1 * problem.cell_size
    assert np.abs(by_pd.positions - by_newton.positions).max() < 1e-8


def test_modes_that_nothing_resists_are_refused():
    scene = beam((2, 1, 1), material={"energy": "volume-only"})
    with pytest.raises(SceneError, match="nothing resists the element's modes"):
        pc.discretise(scene, element="hex8-bubble-mean")
    assert pc.discretise(scene, element="hex8-bubble").element == "hex8-bubble"

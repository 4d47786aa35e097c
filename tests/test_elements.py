"""What every element must satisfy, on cells that no grid gives."""

import warnings

import numpy as np
import pytest
import scipy.sparse.linalg as spla

import pdcorrect as pc
from block_meshes import o_grid, spokes, warped
from conftest import (
    CLAMPED,
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
from pdcorrect.errors import PdcorrectWarning, SceneError

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


# --- bending and volume of the best element --------------------------------------------------

FEET = [
    {"region": {"plane": "x", "at": "min"}, "components": ["x"]},
    {"region": {"nodes": [0]}, "components": ["y", "z"]},
]
"""A section that may contract, held against sliding; in `standing` against turning too."""


def standing(across, poisson, plane, element):
    """A beam of cubic cells, ten times as long as thick; ``plane``: in plane strain."""
    wide = 1 if plane else across
    corner = {"region": {"box": [[0, wide, 0], [0, wide, 0]]}, "components": ["z"]}
    strip = {"region": {"box": [[0, 0, 0], [99, 99, 99]]}, "components": ["y"]}
    clamps = [*FEET, strip if plane else corner]
    body = {"cells": [10 * across, wide, across], "cell_size": 1.0}
    return pc.discretise(beam(poisson=poisson, body=body, clamps=clamps), element=element)


def deflection(problem):
    """Of the end under the beam's own weight in small strain, m."""
    free = np.flatnonzero(problem.free)
    K = problem.stiffness(problem.positions)[free][:, free].tocsc()
    u = np.zeros(problem.free.size)
    u[free] = spla.spsolve(K, problem.external_forces(0.0).ravel()[free])
    x = problem.positions[:, 0]
    return -u.reshape(-1, 3)[x == x.max(), 2].mean()


def timoshenko(across, poisson, plane):
    """The same by beam theory, with Cowper's shear coefficient; plane strain's modulus."""
    young, length, h = 1e6, 10.0 * across, float(across)
    shear, k = young / (2 * (1 + poisson)), 10 * (1 + poisson) / (12 + 11 * poisson)
    if plane:
        young, k = young / (1 - poisson**2), 5 / 6
    return 9810 * (12 * length**4 / (8 * young * h**2) + length**2 / (2 * k * shear))


@pytest.mark.parametrize("plane", [False, True], ids=["beam", "plane strain"])
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49, 0.4999])
@pytest.mark.parametrize("across", [1, 2, 3])
def test_the_best_element_bends_as_beam_theory_says_and_does_not_lock(across, poisson, plane):
    found = deflection(standing(across, poisson, plane, "hex8-enhanced"))
    assert found == pytest.approx(timoshenko(across, poisson, plane), rel=0.02)


def test_the_volume_term_of_the_best_element_is_of_second_order_in_small_strain():
    """Its points have the moments of the cell's own linear functions, on distorted cells too."""
    problem = problem_on(MESHES["random"](), "hex8-enhanced")
    q = problem.quadrature
    first, volume = q.first_volume, q.weights.sum(axis=1)
    gauss = problem.space._basis.quadrature[0].T
    linear = np.concatenate([np.ones((8, 1)), gauss], axis=1)  # (Q, 4)
    w, v = q.weights[:, :first], q.volume_weights[:, first:]
    shares = problem.space.volume_shares()
    at = np.einsum("cq,cqp,qi->cpi", w, shares, linear) / v[..., None]
    mine = np.einsum("cp,cpi,cpj->cij", v, at, at)
    cell = np.einsum("cq,qi,qj->cij", w, linear, linear)
    np.testing.assert_allclose(mine, cell, atol=1e-13 * volume.max())


def test_large_bending_of_one_layer_of_cells_is_that_of_many():
    """A cantilever bent far by its own weight."""
    weight = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]
    material, time = {"young": 5e4, "poisson": 0.4}, {"integrator": "quasi-static", "frames": 1}
    scene = beam((16, 1, 1), 0.05, material=material, time=time, loads=weight)
    tips = {}
    for element, refine in (("hex8-enhanced", 1), ("hex27", 2)):
        problem = pc.discretise(scene, refine, element=element)
        run = pc.rollout(pc.Newton(problem), 1)
        end = problem.positions[:, 0] > 0.8 - 1e-9
        tips[element] = (run.positions[-1] - problem.positions)[end].mean(axis=0)
    assert -tips["hex27"][2] > 0.4
    distance = np.linalg.norm(tips["hex8-enhanced"] - tips["hex27"])
    assert distance < 0.02 * np.linalg.norm(tips["hex27"])


# --- a word about locking ----------------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-mean"])
@pytest.mark.parametrize(
    ("cells", "times"), [((4, 1, 2), 1), ((4, 2, 1), 1), ((4, 2, 2), 0), ((1, 1, 1), 0)]
)
def test_cells_that_bend_alone_are_warned_of(element, cells, times):
    scene = beam(cells)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pc.discretise(scene, element=element)
        pc.discretise(scene, refine=2, element=element)
        pc.discretise(scene, element="hex8-enhanced")
    told = [w for w in caught if issubclass(w.category, PdcorrectWarning)]
    assert len(told) == times
    for warning in told:
        assert element in str(warning.message)
        assert warning.filename == __file__


@pytest.mark.parametrize("low", [-9, 0.01], ids=["all", "one face"])
def test_a_strip_that_cannot_bend_out_of_its_plane_is_not_warned_of(low):
    strip = {"region": {"box": [[-9, low, -9], [9, 9, 9]]}, "components": ["y"]}
    scene = beam((6, 1, 2), clamps=[*CLAMPED, strip])
    with warnings.catch_warnings():
        warnings.simplefilter("error", PdcorrectWarning)
        pc.discretise(scene)


# --- solvers ---------------------------------------------------------------------------------


@every_element
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(None, id="box", marks=pytest.mark.slow),
        pytest.param(MESHES["random"], id="random"),
    ],
)
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

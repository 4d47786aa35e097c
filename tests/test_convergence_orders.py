"""Manufactured solutions: errors fall with the mesh as the elements' theory says.

The exact field is a finite stretch and rotation plus products of sines, whose derivatives
are exact to any order.  The body force -Div P = -dP/dF : grad F balances it, the surface is
held where it says, and the errors are integrated by shape functions and a quadrature of
this module.
"""

import itertools

import numpy as np
import pytest

import pdcorrect as pc
from block_meshes import warped
from conftest import ELEMENTS, boundary_nodes, box_mesh, held, problem_on, rotation
from pdcorrect.fem import energies
from pdcorrect.fem.hexahedron import VTK_CORNERS, VTK_EDGES, VTK_FACES

SIZE = (1.0, 0.8, 1.1)
AFFINE = rotation(4) @ np.diag([1.1, 0.9, 1.2])
WAVES = np.array([[2.0, 1.3, 0.7], [0.9, 2.2, 1.6]])
PHASES = np.array([[0.3, 1.1, 0.5], [0.8, 0.2, 1.4]])
AMPLITUDES = np.array([[0.12, -0.06], [0.07, 0.10], [-0.09, 0.08]])


def waves(x, *along):
    """Displacement (..., 3) of the sines at x, differentiated along each axis named."""
    orders = np.bincount(along, minlength=3) if along else np.zeros(3)
    factors = WAVES**orders * np.sin(WAVES * x[..., None, :] + PHASES + orders * np.pi / 2)
    return factors.prod(axis=-1) @ AMPLITUDES.T


def exact(x):
    return x @ AFFINE.T + waves(x)


def exact_gradient(x):
    return AFFINE + np.stack([waves(x, j) for j in range(3)], axis=-1)


def body_force(x, mu, omega, energy):
    """-Div P, (..., 3): -dP_ij/dF_kl d2 x_k / dX_l dX_j."""
    second = np.empty((*x.shape, 3, 3))
    for l, j in itertools.product(range(3), repeat=2):
        second[..., l, j] = waves(x, l, j)
    tangent = energies.elasticity(exact_gradient(x), mu, omega, energy=energy)
    return -np.einsum("...ijkl,...klj->...i", tangent, second)


def shape_functions(count, points):
    """Lagrange's polynomials of 8 or 27 nodes on the unit cell and their slopes."""
    nodes = VTK_CORNERS.astype(float)
    if count == 27:
        middles = [nodes[VTK_EDGES].mean(axis=1), nodes[VTK_FACES].mean(axis=1)]
        nodes = np.concatenate([nodes, *middles, [[0.5, 0.5, 0.5]]])
    places = np.unique(nodes)
    line = [np.poly1d(np.poly(np.delete(places, a))) for a in range(len(places))]
    line = [p / p(place) for p, place in zip(line, places, strict=True)]
    which = np.searchsorted(places, nodes)
    values = np.array([[line[a](points[:, i]) for i, a in enumerate(row)] for row in which])
    slopes = np.array([[line[a].deriv()(points[:, i]) for i, a in enumerate(r)] for r in which])
    parts = [[slopes[:, j] if j == i else values[:, j] for j in range(3)] for i in range(3)]
    return values.prod(axis=1), np.stack([np.prod(part, axis=0) for part in parts], axis=-1)


def errors(problem, positions):
    """Error of the nodal field and of its gradient in the L2 norm."""
    at, weight = np.polynomial.legendre.leggauss(5)
    points = np.stack(np.meshgrid(*[0.5 * (at + 1)] * 3), axis=-1).reshape(-1, 3)
    weights = np.prod(np.meshgrid(*[0.5 * weight] * 3), axis=0).ravel()
    values, slopes = shape_functions(problem.cells.shape[1], points)
    rest, now = problem.positions[problem.cells], positions[problem.cells]
    jacobian = np.einsum("cki,kqj->cqij", rest, slopes)
    volume = np.linalg.det(jacobian) * weights
    x = np.einsum("cki,kq->cqi", rest, values)
    F = np.einsum("cki,kqj->cqij", now, slopes) @ np.linalg.inv(jacobian)
    distance = np.einsum("cki,kq->cqi", now, values) - exact(x)
    return [
        np.sqrt(np.sum(volume * (difference**2).sum(axis=tuple(range(2, difference.ndim)))))
        for difference in (distance, F - exact_gradient(x))
    ]


def solved(mesh, element, energy, poisson=0.4):
    material = {"young": 1e3, "poisson": poisson, "energy": energy}
    problem = problem_on(mesh, element, material=material, time={"integrator": "quasi-static"})
    start = exact(problem.positions)
    problem = held(problem, boundary_nodes(problem), start)
    mu, omega = problem.materials.mu[0], problem.materials.volume_weight[0]
    points = problem.space.interpolate(problem.positions)
    forces = problem.space.body_load(body_force(points, mu, omega, energy))
    state = pc.State(start, np.zeros_like(start))
    result = pc.Newton(problem, tolerance=1e-11)(state, forces=forces)
    assert result.status is pc.Status.CONVERGED
    return problem, result.state.positions


def orders(counts, make, element, energy, poisson=0.4):
    """Fitted orders of the field and of its gradient over meshes of n cells an edge."""
    found = np.array([errors(*solved(make(n), element, energy, poisson)) for n in counts])
    return [float(-np.polyfit(np.log(counts), np.log(e), 1)[0]) for e in found.T]


MESHES = {
    "box": lambda n: box_mesh((n, n, n), SIZE),
    "distorted": lambda n: box_mesh((n, n, n), SIZE, 0.2, seed=n),
    "warped": lambda n: warped(box_mesh((n, n, n), SIZE)),
}
WANTED = {8: (1.9, 0.9), 27: (2.8, 1.9)}


def nodes_of(element):
    return 27 if element == "hex27" else 8


@pytest.mark.parametrize(
    ("element", "mesh", "energy"),
    [
        *((element, "distorted", "corotated") for element in ELEMENTS),
        ("hex8-enhanced", "warped", "neo-hookean"),
        ("hex27", "warped", "neo-hookean"),
    ],  # the others are slow, below
)
def test_errors_fall_with_the_orders_of_the_element(element, mesh, energy):
    counts = (3, 4, 6) if element == "hex27" else (4, 6, 8)
    field, gradient = orders(counts, MESHES[mesh], element, energy)
    wanted = WANTED[nodes_of(element)]
    assert wanted[0] <= field <= wanted[0] + 0.3
    assert wanted[1] <= gradient <= wanted[1] + 0.3


@pytest.mark.slow
@pytest.mark.parametrize("energy", ["corotated", "neo-hookean", "st-venant-kirchhoff"])
@pytest.mark.parametrize("mesh", MESHES)
@pytest.mark.parametrize("element", ELEMENTS)
def test_errors_fall_so_on_finer_meshes_of_every_kind(element, mesh, energy):
    counts = (4, 6, 8) if element == "hex27" else (6, 9, 13)
    field, gradient = orders(counts, MESHES[mesh], element, energy, 0.3)
    wanted = WANTED[nodes_of(element)]
    assert wanted[0] <= field <= wanted[0] + 0.3
    assert wanted[1] <= gradient <= wanted[1] + 0.3


def test_the_measured_errors_are_those_of_a_known_field():
    """The field x^2 in x direction instead of the exact one, on a box: errors by hand."""
    problem = problem_on(box_mesh((2, 1, 1), SIZE), "hex27")
    shift = np.zeros_like(problem.positions)
    shift[:, 0] = problem.positions[:, 0] ** 2
    far = errors(problem, exact(problem.positions) + 1e6 * shift)
    volume, a = np.prod(SIZE), SIZE[0]
    np.testing.assert_allclose(far[0], 1e6 * np.sqrt(volume * a**4 / 5), rtol=1e-6)
    np.testing.assert_allclose(far[1], 1e6 * np.sqrt(volume * 4 * a**2 / 3), rtol=1e-6)

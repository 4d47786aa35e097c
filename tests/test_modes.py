"""Modes of vibration: rigid motions, orthogonality, a beam's frequency."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, disturbed, rotation
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.modes import modes
from test_stress import ELEMENTS, body


def kinetic_product(problem, a, b):
    return float(np.vdot(a, problem.mass_times(b)))


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("element", ELEMENTS)
def test_a_free_body_has_six_rigid_modes(element, mass):
    problem = body(element, mass=mass)
    frequencies, shapes = modes(problem, 8)
    assert frequencies[:6].max() < 1e-3 * frequencies[6]
    assert frequencies[7] >= frequencies[6] > 0
    x = problem.positions - problem.positions.mean(axis=0)
    rigid = [np.broadcast_to(e, x.shape).ravel() for e in np.eye(3)]
    rigid += [np.cross(e, x).ravel() for e in np.eye(3)]
    basis = np.linalg.qr(np.array(rigid).T)[0]
    six = shapes[:6].reshape(6, -1).T
    np.testing.assert_allclose(basis @ (basis.T @ six), six, atol=1e-5 * np.abs(six).max())
    assert np.linalg.matrix_rank(six, tol=1e-3 * np.linalg.norm(six)) == 6


@pytest.mark.parametrize("mass", ["lumped", "consistent", "averaged"])
def test_modes_are_orthogonal_and_have_their_frequency_as_rayleigh_quotient(mass):
    problem = pc.discretise(beam(solver={"mass": mass, "element": "hex8-bubble-mean"}))
    found = modes(problem, 7)
    shapes = found.shapes
    assert (shapes[:, ~problem.free] == 0).all()
    product = [[kinetic_product(problem, a, b) for b in shapes] for a in shapes]
    np.testing.assert_allclose(product, np.eye(7), atol=1e-9)
    K = problem.stiffness(problem.positions)
    quotients = [u.ravel() @ (K @ u.ravel()) for u in shapes]
    np.testing.assert_allclose(quotients, (2 * np.pi * found.frequencies) ** 2, rtol=1e-8)
    residual = K @ shapes[3].ravel() - quotients[3] * problem.mass_times(shapes[3]).ravel()
    assert np.abs(residual[problem.free.ravel()]).max() < 1e-7 * np.abs(K @ shapes[3].ravel()).max()


def test_the_lowest_modes_are_those_of_a_dense_solver():
    import scipy.linalg

    problem = pc.discretise(beam((3, 2, 1), solver={"mass": "consistent"}))
    free = problem.free.ravel()
    K = problem.stiffness(problem.positions).toarray()[np.ix_(free, free)]
    M = np.kron(problem.mass_matrix.toarray(), np.eye(3))[np.ix_(free, free)]
    exact = np.sqrt(scipy.linalg.eigh(K, M, eigvals_only=True)[:10]) / (2 * np.pi)
    np.testing.assert_allclose(modes(problem, 10).frequencies, exact, rtol=1e-9)


def test_a_slender_beam_vibrates_as_euler_and_bernoulli_say():
    """F = 1.8751^2 / (2 pi L^2) sqrt(E I / (rho A)), twice: the section is square."""
    length, side = 0.4, 0.02
    problem = pc.discretise(
        beam((20, 1, 1), side, poisson=0.0, solver={"element": "hex27", "mass": "consistent"})
    )
    frequencies = modes(problem, 3).frequencies
    exact = 1.875104**2 / (2 * np.pi * length**2) * np.sqrt(1e6 * side**2 / 12 / 1e3)
    np.testing.assert_allclose(frequencies[:2], exact, rtol=0.01)
    assert frequencies[2] > 5 * exact


def test_frequencies_do_not_depend_on_rigid_motion_and_rise_with_tension():
    problem = body("hex8-mean", young=3e5)
    turned = problem.positions @ rotation().T + 0.3
    np.testing.assert_allclose(
        modes(problem, 9, turned).frequencies[6:], modes(problem, 9).frequencies[6:], rtol=1e-6
    )
    ends = [{"region": {"plane": "x", "at": at}} for at in (0.0, "max")]
    string = pc.discretise(beam((10, 1, 1), clamps=ends, poisson=0.0))
    stretched = string.positions * [1.2, 1.0, 1.0]
    assert modes(string, 1, stretched).frequencies[0] > 1.3 * modes(string, 1).frequencies[0]


def test_the_frequency_is_that_of_the_free_vibration():
    """A small deflection in the first mode comes back after one period."""
    problem = pc.discretise(beam((4, 1, 1), loads=[], time={"integrator": "midpoint"}))
    found = modes(problem, 1)
    shape = found.shapes[0] / np.abs(found.shapes[0]).max()
    period = 1.0 / found.frequencies[0]
    start = problem.positions + 1e-6 * shape
    state = pc.State(start, np.zeros_like(start))
    stepper = pc.Newton(problem, tolerance=1e-12, time_step=period / 80)
    run = pc.rollout(stepper, frames=80, state=state)
    amplitude = [kinetic_product(problem, p - problem.positions, shape) for p in run.positions]
    assert amplitude[40] / amplitude[0] == pytest.approx(-1, abs=0.01)
    assert amplitude[80] / amplitude[0] == pytest.approx(1, abs=0.01)


def test_unstable_positions_and_wrong_counts_are_refused():
    problem = pc.discretise(beam((6, 1, 1)))
    squeezed = problem.positions * [0.5, 1.0, 1.0]
    with pytest.raises(ConvergenceError, match="stable equilibrium"):
        modes(problem, 3, squeezed)
    for count in (0, -1, 1.5, True, int(problem.free.sum())):
        with pytest.raises(InputError, match="count"):
            modes(problem, count)
    with pytest.raises(InputError, match="one row a node"):
        modes(problem, 3, disturbed(problem, 0.1)[1:])


def test_modes_of_large_meshes_come_by_multigrid(monkeypatch):
    """With the rigid motions as near null-space also for a body that nothing holds."""
    from pdcorrect.fem import factorisation

    problem = pc.discretise(beam((8, 3, 3), clamps=[], loads=[]))
    expected = pc.modes(problem, 8).frequencies
    monkeypatch.setattr(factorisation, "choose_backend", lambda *args: "amg")
    found = pc.modes(problem, 8).frequencies
    np.testing.assert_allclose(found[6:], expected[6:], rtol=1e-9)
    assert found[:6].max() < 1e-5 * found[6]

"""The pointwise energy: exact derivatives, projections, invariance."""

import numpy as np
import pytest

from conftest import rotation
from pdcorrect.errors import InputError
from pdcorrect.fem import energies
from pdcorrect.scene.materials import Material, lame

R, Q = rotation(1), rotation(2)
CASES = {
    "random": np.eye(3) + 0.4 * np.random.default_rng(5).normal(size=(3, 3)),
    "identity": np.eye(3),
    "first two repeated": R @ np.diag([1.2, 1.2, 0.7]) @ Q,
    "last two repeated": R @ np.diag([1.2, 0.7, 0.7]) @ Q,
    "all repeated": 1.3 * R,
    "inverted": R @ np.diag([1.3, 1.0, -0.4]) @ Q,
    "inverted and repeated": R @ np.diag([1.0, 1.0, -0.4]) @ Q,
    "flat": R @ np.diag([1.3, 0.8, 0.0]) @ Q,
    "far expanded": R @ np.diag([3.0, 2.0, 1.2]) @ Q,
    "expanded, one direction flattened by V": R @ np.diag([3.0, 2.5, 2.2]) @ Q,
}
WEIGHTS = {"corotated": (1.0, 0.0), "volume": (0.0, 1.0), "both": (1.0, 3.0)}


OTHERS = ("neo-hookean", "st-venant-kirchhoff", "linear-corotated")


def taylor_slope(remainder, steps=(1e-3, 5e-4)):
    errors = [remainder(h) for h in steps]
    return np.log2(errors[0] / errors[1])


@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
@pytest.mark.parametrize("F", CASES.values(), ids=CASES)
def test_stress_and_tangent_are_derivatives_of_the_energy(F, weights, rng):
    d = rng.normal(size=(3, 3))
    slope = np.vdot(energies.first_piola(F, *weights), d)
    base = energies.energy_density(F, *weights)
    assert taylor_slope(
        lambda h: abs(energies.energy_density(F + h * d, *weights) - base - h * slope)
    ) == pytest.approx(2, abs=0.05)
    change = np.einsum("ijkl,kl->ij", energies.elasticity(F, *weights), d)
    base = energies.first_piola(F, *weights)
    assert taylor_slope(
        lambda h: np.linalg.norm(energies.first_piola(F + h * d, *weights) - base - h * change)
    ) == pytest.approx(2, abs=0.05)


@pytest.mark.parametrize("F", CASES.values(), ids=CASES)
def test_tangent_is_symmetric_and_its_projection_only_raises_eigenvalues(F):
    exact = energies.elasticity(F, 1.0, 3.0).reshape(9, 9)
    projected = energies.elasticity(F, 1.0, 3.0, project=True).reshape(9, 9)
    np.testing.assert_allclose(exact, exact.T, atol=1e-12)
    assert np.linalg.eigvalsh(projected).min() > -1e-12
    values = np.linalg.eigvalsh(exact)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(projected), np.sort(np.maximum(values, 0)), atol=1e-9
    )


def test_tangent_is_finite_on_the_kinks():
    for s in ([1.0, 0.5, -0.5], [2.0, 2.0, 2.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]):
        tangent = energies.elasticity(R @ np.diag(s) @ Q, 1.0, 3.0)
        assert np.isfinite(tangent).all()
        assert np.abs(tangent).max() < 1e6


def test_signed_svd_reproduces_any_matrix_with_proper_rotations(rng):
    F = np.concatenate(
        [
            rng.normal(size=(200, 3, 3)),
            rng.normal(size=(200, 3, 3)) * [1, 1, 1e-9],
            rng.normal(size=(50, 3, 1)) * rng.normal(size=(50, 1, 3)),
            1e3 * rng.normal(size=(50, 3, 3)),
            np.zeros((1, 3, 3)),
            np.array([-np.eye(3), np.diag([3.0, 3.0, -3.0])]),
        ]
    )
    U, s, V = energies.signed_svd(F)
    scale = np.abs(F).max(axis=(1, 2), keepdims=True) + 1e-300
    np.testing.assert_allclose((U * s[:, None] @ V.swapaxes(1, 2)) / scale, F / scale, atol=1e-14)
    for W in (U, V):
        np.testing.assert_allclose(
            W @ W.swapaxes(1, 2), np.broadcast_to(np.eye(3), W.shape), atol=1e-14
        )
        np.testing.assert_allclose(np.linalg.det(W), 1, atol=1e-13)
    assert (s[:, 0] >= s[:, 1] - 1e-12).all()
    assert (s[:, 1] >= np.abs(s[:, 2]) - 1e-12 * s[:, 0]).all()


@pytest.mark.parametrize("small", [1e-3, 1e-5, 1e-7])
def test_rotations_of_cells_squeezed_to_a_line_are_accurate(small):
    F = R @ np.diag([1.0, small, 0.5 * small]) @ Q
    np.testing.assert_allclose(energies.nearest_rotation(F), R @ Q, atol=1e-14 / small)


@pytest.mark.parametrize("least", [-1.0, -1e-9, -1e-11, 0.0, 1e-11, 1e-9, 1.0])
def test_only_negative_eigenvalues_of_the_diagonal_block_are_raised(least, rng):
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    block = turn @ np.diag([least, 0.7, 3.0]) @ turn.T
    T = np.zeros((12, 1))
    T[:6, 0] = *np.diag(block), block[0, 1], block[0, 2], block[1, 2]
    energies._project_diagonal(T, 0)
    xx, yy, zz, xy, xz, yz = T[:6, 0]
    found = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    expected = turn @ np.diag([max(least, 0.0), 0.7, 3.0]) @ turn.T
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_projections_are_idempotent(rng):
    F = rng.normal(size=(100, 3, 3))
    rotations = energies.nearest_rotation(F)
    np.testing.assert_allclose(energies.nearest_rotation(rotations), rotations, atol=1e-13)
    unimodular = energies.nearest_unit_determinant(F)
    np.testing.assert_allclose(np.linalg.det(unimodular), 1, atol=1e-12)
    np.testing.assert_allclose(
        energies.nearest_unit_determinant(unimodular), unimodular, atol=1e-10
    )


def test_projections_are_nearest(rng):
    """No other rotation and no other matrix of unit determinant is closer."""
    for _ in range(40):
        F = rng.normal(size=(3, 3)) * rng.uniform(0.3, 3)
        distance = np.linalg.norm(F - energies.nearest_rotation(F))
        others = np.array([rotation(seed) for seed in range(200)])
        assert np.linalg.norm(F - others, axis=(1, 2)).min() >= distance - 1e-12

        _, s, _ = energies.signed_svd(F)
        distance = np.linalg.norm(F - energies.nearest_unit_determinant(F))
        pairs = np.exp(rng.uniform(-4, 2, size=(4000, 2)))
        stretches = np.c_[pairs, 1 / pairs.prod(axis=1)]
        signs = np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
        for sign in signs:
            assert np.linalg.norm(stretches * sign - s, axis=1).min() >= distance - 1e-9


def test_energy_is_invariant_under_rotation_from_either_side(rng):
    F = rng.normal(size=(20, 3, 3))
    for G in (R @ F, F @ R):
        np.testing.assert_allclose(
            energies.energy_density(G, 1.0, 3.0), energies.energy_density(F, 1.0, 3.0), rtol=1e-12
        )
    np.testing.assert_allclose(
        energies.first_piola(R @ F, 1.0, 3.0), R @ energies.first_piola(F, 1.0, 3.0), atol=1e-11
    )


def test_small_strain_energy_has_the_effective_moduli(rng):
    """Psi -> mu |eps|^2 + omega/6 tr(eps)^2, so lambda_effective = omega / 3."""
    strain = rng.normal(size=(3, 3))
    strain = 1e-5 * (strain + strain.T)
    mu, omega = 2.0, 5.0
    expected = mu * (strain**2).sum() + omega / 6 * np.trace(strain) ** 2
    assert energies.energy_density(np.eye(3) + strain, mu, omega) == pytest.approx(
        expected, rel=1e-3
    )


# --- the other energies -----------------------------------------------------------------


def literal_density(F, mu, lam, energy):
    """The formulas of the theory page, on whole matrices."""
    J, identity = np.linalg.det(F), np.eye(3)
    if energy == "neo-hookean":
        squares = (F**2).sum(axis=(-2, -1)) - 3
        return mu / 2 * squares - mu * (J - 1) + (mu + lam) / 2 * (J - 1) ** 2
    if energy == "linear-corotated":
        stretches = np.linalg.svd(F, compute_uv=False)
        stretches[..., 2] *= np.sign(J)
        return mu * ((stretches - 1) ** 2).sum(-1) + lam / 2 * (stretches - 1).sum(-1) ** 2
    strain = 0.5 * (np.swapaxes(F, -1, -2) @ F - identity)
    trace = np.trace(strain, axis1=-2, axis2=-1)
    return mu * (strain**2).sum(axis=(-2, -1)) + lam / 2 * trace**2


@pytest.mark.parametrize("energy", OTHERS)
def test_other_energies_are_their_formulas(energy, rng):
    F = np.concatenate([rng.normal(size=(200, 3, 3)), list(CASES.values())])
    assert (np.linalg.det(F) < 0).sum() > 50
    np.testing.assert_allclose(
        energies.energy_density(F, 2.0, 7.5, energy),
        literal_density(F, 2.0, 2.5, energy),
        rtol=1e-12, atol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize("energy", OTHERS)
def test_other_energies_keep_their_digits_near_rest(energy, rng):
    """Where the sums in the formulas cancel, down to strains of 1e-7."""
    mu, lam = 3.0, 5.0
    strain = rng.normal(size=(10, 3, 3))
    strain = 1e-7 * (strain + np.swapaxes(strain, 1, 2))
    trace = np.trace(strain, axis1=1, axis2=2)
    linear = mu * (strain**2).sum((1, 2)) + 0.5 * lam * trace**2
    found = energies.energy_density(np.eye(3) + strain, mu, 3 * lam, energy)
    np.testing.assert_allclose(found, linear, rtol=1e-5)


@pytest.mark.parametrize("energy", OTHERS)
def test_stress_of_other_energies_is_the_derivative_of_the_formula(energy, rng):
    """Central differences of two sizes, extrapolated: nothing is left but round-off."""
    F = np.concatenate([rng.normal(size=(50, 3, 3)), list(CASES.values())])
    stress = energies.first_piola(F, 2.0, 7.5, energy)
    for i, j in np.ndindex(3, 3):
        d = np.zeros((3, 3))
        d[i, j] = 1.0

        def slope(h, d=d):
            up, down = (literal_density(F + s * h * d, 2.0, 2.5, energy) for s in (1, -1))
            return (up - down) / (2 * h)

        found = (4 * slope(1e-3) - slope(2e-3)) / 3
        np.testing.assert_allclose(stress[:, i, j], found, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("energy", OTHERS)
@pytest.mark.parametrize("F", CASES.values(), ids=CASES)
def test_derivatives_of_other_energies_have_taylor_remainders(F, energy, rng):
    d = rng.normal(size=(3, 3))
    density, stress = energies.energy_density, energies.first_piola
    base, first = density(F, 2.0, 7.5, energy), stress(F, 2.0, 7.5, energy)
    slope = np.vdot(first, d)
    change = np.einsum("ijkl,kl->ij", energies.elasticity(F, 2.0, 7.5, energy=energy), d)
    steps = (1e-4, 5e-5)
    assert taylor_slope(
        lambda h: abs(density(F + h * d, 2.0, 7.5, energy) - base - h * slope), steps
    ) == pytest.approx(2, abs=0.05)
    assert taylor_slope(
        lambda h: np.linalg.norm(stress(F + h * d, 2.0, 7.5, energy) - first - h * change), steps
    ) == pytest.approx(2, abs=0.05)


@pytest.mark.parametrize("energy", OTHERS)
def test_projected_tangents_of_other_energies_only_raise_eigenvalues(energy, rng):
    F = np.concatenate([rng.normal(size=(100, 3, 3)), list(CASES.values())])
    exact = energies.elasticity(F, 2.0, 7.5, energy=energy).reshape(-1, 9, 9)
    projected = energies.elasticity(F, 2.0, 7.5, project=True, energy=energy).reshape(-1, 9, 9)
    np.testing.assert_allclose(exact, exact.swapaxes(1, 2), atol=1e-11)
    values = np.linalg.eigvalsh(exact)
    assert (values[:, 0] < -0.1).sum() > 10
    assert np.linalg.eigvalsh(projected).min() > -1e-10
    np.testing.assert_allclose(
        np.linalg.eigvalsh(projected), np.sort(np.maximum(values, 0), axis=1), atol=1e-9
    )


@pytest.mark.parametrize("energy", OTHERS)
def test_other_energies_are_invariant_under_rotation_from_either_side(energy, rng):
    F = rng.normal(size=(20, 3, 3))
    density, stress = energies.energy_density, energies.first_piola
    for G in (R @ F, F @ R):
        np.testing.assert_allclose(
            density(G, 2.0, 7.5, energy), density(F, 2.0, 7.5, energy), rtol=1e-11
        )
    np.testing.assert_allclose(
        stress(R @ F @ Q, 2.0, 7.5, energy), R @ stress(F, 2.0, 7.5, energy) @ Q, atol=1e-10
    )
    np.testing.assert_allclose(density(R, 2.0, 7.5, energy), 0, atol=1e-14)
    np.testing.assert_allclose(stress(R, 2.0, 7.5, energy), 0, atol=1e-13)


@pytest.mark.parametrize("energy", ["corotated", *OTHERS])
def test_tangent_at_rest_is_that_of_the_effective_moduli(energy):
    """2 mu sym + lambda tr, with the moduli that the scene states for its material."""
    material = Material(energy=energy, young=3e5, poisson=0.4, density=1e3)
    assert material.effective.poisson == pytest.approx(0.4)
    mu, lam = lame(material.effective.young, material.effective.poisson)
    found = energies.elasticity(np.eye(3), material.mu, 3 * material.lam, energy=energy)
    one = np.eye(3)
    expected = lam * np.einsum("ij,kl->ijkl", one, one) + mu * (
        np.einsum("ik,jl->ijkl", one, one) + np.einsum("il,jk->ijkl", one, one)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9 * lam)


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match=r"\(2, 3\)"):
        energies.first_piola(np.zeros((2, 3)), 1.0, 1.0)
    with pytest.raises(InputError, match="NaN"):
        energies.first_piola(np.full((3, 3), np.nan), 1.0, 1.0)

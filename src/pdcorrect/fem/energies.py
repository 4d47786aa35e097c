"""The corotated energy with a volume term: density, stress and tangent.

Pointwise functions on NumPy arrays serve these and the other energies.

    Psi(F) = mu |F - R|^2 + omega/2 |F - V|^2

R is the nearest rotation and V the nearest matrix of unit determinant.  Both
are projections, so by the envelope theorem (thesis, below eq. 3-25)

    P = dPsi/dF = 2 mu (F - R) + omega (F - V).

In the frame of the signed SVD, F = U diag(s) V^T, everything depends on s
alone.  With k the multiplier of `nearest_volume_lanes` and v_i - s_i = k / v_i:

    dPsi/ds_i = 2 mu (s_i - 1) - omega k / v_i

and the tangent splits into one 3x3 block for the diagonal of U^T dF V and, for
each pair i < j, a symmetric and an antisymmetric mode.  Their closed forms below
stay finite for repeated singular values and for det F < 0.

Kinks, where a branch is taken: s2 + s3 = 0 (R not unique) and large expansion
where V is not unique (it flattens one direction, the third of the sorted SVD).
There the infinite or undefined modes of the tangent are set to zero.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.decomposition import OPTIONS, nearest_volume_lanes, scratch, signed_svd_lanes
from pdcorrect.fem.hyperelasticity import (
    COROTATED,
    energy_code,
    hyperelastic_lanes,
    hyperelastic_tangent_lanes,
)

Array = NDArray[np.float64]

_PAIRS = ((0, 1), (0, 2), (1, 2))
_KINK = 1e-9
"""Relative distance from a kink below which its tangent mode is set to zero."""
_CLEAR = 1e-10
"""Relative size above which a leading minor is positive whatever rounding did."""


@njit(**OPTIONS)
def corotated_lanes(s, v, k, mu, omega, first, density, t):  # type: ignore[no-untyped-def]
    """Energy density (L,) and principal stresses t (3, L) from the decompositions.

    ``mu`` and ``omega`` are (L,).  In lanes below ``first`` there is no volume
    term, and v and k are not read.
    """
    for l in range(s.shape[1]):
        e0, e1, e2 = s[0, l] - 1.0, s[1, l] - 1.0, s[2, l] - 1.0
        density[l] = mu[l] * (e0 * e0 + e1 * e1 + e2 * e2)
        t[0, l], t[1, l], t[2, l] = 2.0 * mu[l] * e0, 2.0 * mu[l] * e1, 2.0 * mu[l] * e2
    for l in range(first, s.shape[1]):
        g0, g1, g2 = k[l] / v[0, l], k[l] / v[1, l], k[l] / v[2, l]
        density[l] += 0.5 * omega[l] * (g0 * g0 + g1 * g1 + g2 * g2)
        t[0, l] -= omega[l] * g0
        t[1, l] -= omega[l] * g1
        t[2, l] -= omega[l] * g2


@njit(**OPTIONS)
def stress_lanes(U, t, V, P):  # type: ignore[no-untyped-def]
    """First Piola-Kirchhoff stress P (9, L) = U diag(t) V^T."""
    for l in range(t.shape[1]):
        for i in range(3):
            x = U[3 * i, l] * t[0, l]
            y = U[3 * i + 1, l] * t[1, l]
            z = U[3 * i + 2, l] * t[2, l]
            for j in range(3):
                P[3 * i + j, l] = x * V[3 * j, l] + y * V[3 * j + 1, l] + z * V[3 * j + 2, l]


@njit(**OPTIONS)
def corotated_tangent_lanes(s, v, k, mu, omega, first, T):  # type: ignore[no-untyped-def]
    """Tangent in the frame of the SVD, T (12, L), for the arguments of `corotated_lanes`.

    Rows 0-5: the diagonal block 00 11 22 01 02 12; rows 6-8 and 9-11: for the
    pairs 01 02 12 the eigenvalues of the symmetric and the antisymmetric mode.
    """
    for l in range(s.shape[1]):
        for i in range(3):
            T[i, l] = 2.0 * mu[l]
            T[3 + i, l] = 0.0
            T[6 + i, l] = 2.0 * mu[l]
            a, b = i // 2, 1 + (i + 1) // 2
            total = s[a, l] + s[b, l]
            kink = not total > _KINK * (s[0, l] + 1e-300)
            T[9 + i, l] = 0.0 if kink else 2.0 * mu[l] * (total - 2.0) / total
    for l in range(first, s.shape[1]):
        _volume_diagonal(s, v, l, omega[l], T)
        for pair in range(3):
            a, b = pair // 2, 1 + (pair + 1) // 2
            vv = v[a, l] * v[b, l]
            if s[a, l] + s[b, l] > _KINK * (s[0, l] + 1e-300):
                T[9 + pair, l] -= omega[l] * k[l] / (vv - k[l])
            if abs(vv + k[l]) > _KINK * vv:
                T[6 + pair, l] += omega[l] * k[l] / (vv + k[l])


@njit(**OPTIONS)
def finish_tangent_lanes(T, project):  # type: ignore[no-untyped-def]
    """Turn rows 6-11 of T (12, L) from eigenvalues into factors p, m of P_ij = p F_ij + m F_ji.

    ``project`` raises negative eigenvalues to zero before.
    """
    for l in range(T.shape[1]):
        if project:
            _project_diagonal(T, l)
        for pair in range(3):
            symmetric, antisymmetric = T[6 + pair, l], T[9 + pair, l]
            if project:
                symmetric, antisymmetric = max(symmetric, 0.0), max(antisymmetric, 0.0)
            T[6 + pair, l] = 0.5 * (symmetric + antisymmetric)
            T[9 + pair, l] = 0.5 * (symmetric - antisymmetric)


@njit(**OPTIONS)
def principal_stress_lanes(model, s, v, k, mu, omega, first, density, t):  # type: ignore[no-untyped-def]
    """Energy density (L,) and principal stresses t (3, L) of the energy with number ``model``.

    Fills v (3, L) and k (L,) by `nearest_volume_lanes` where the energy needs them.
    """
    if model == COROTATED:
        nearest_volume_lanes(s, v, k, first)
        corotated_lanes(s, v, k, mu, omega, first, density, t)
    else:
        hyperelastic_lanes(model, s, mu, omega, density, t)


@njit(**OPTIONS)
def principal_tangent_lanes(model, s, v, k, mu, omega, first, project, T):  # type: ignore[no-untyped-def]
    """Tangent T (12, L) in the frame of the SVD, see `finish_tangent_lanes`; else as above."""
    if model == COROTATED:
        nearest_volume_lanes(s, v, k, first)
        corotated_tangent_lanes(s, v, k, mu, omega, first, T)
    else:
        hyperelastic_tangent_lanes(model, s, mu, omega, T)
    finish_tangent_lanes(T, project)


@njit(**OPTIONS)
def _volume_diagonal(s, v, l, omega, T):  # type: ignore[no-untyped-def]
    """Add omega (I - dv/ds), with d_i = 2 v_i - s_i and dv/ds free of 0/0 at d_i = 0."""
    v0, v1, v2 = v[0, l], v[1, l], v[2, l]
    d0, d1, d2 = 2.0 * v0 - s[0, l], 2.0 * v1 - s[1, l], 2.0 * v2 - s[2, l]
    total = d1 * d2 / v0 + d0 * d2 / v1 + d0 * d1 / v2
    if abs(total) > _KINK * (v0 + v1 + v2):
        scale = omega / total
        T[0, l] += omega - scale * v0 * (d1 / v2 + d2 / v1)
        T[1, l] += omega - scale * v1 * (d0 / v2 + d2 / v0)
        T[2, l] += omega - scale * v2 * (d0 / v1 + d1 / v0)
        T[3, l] += scale * d2
        T[4, l] += scale * d1
        T[5, l] += scale * d0


@njit(**OPTIONS)
def _project_diagonal(T, l):  # type: ignore[no-untyped-def]
    """Raise the negative eigenvalues of the diagonal block to zero."""
    xx, yy, zz, xy, xz, yz = T[0, l], T[1, l], T[2, l], T[3, l], T[4, l], T[5, l]
    minor = xx * yy - xy * xy
    size = abs(xx) + abs(yy) + abs(zz)
    # leading minors clearly positive (Sylvester): no eigenvalue is negative
    if (
        xx > _CLEAR * size
        and minor > _CLEAR * size**2
        and zz * minor - xx * yz**2 - yy * xz**2 + 2.0 * xy * xz * yz > _CLEAR * size**3
    ):
        return
    block = np.empty((3, 3))
    for i in range(3):
        block[i, i] = T[i, l]
    block[0, 1] = block[1, 0] = T[3, l]
    block[0, 2] = block[2, 0] = T[4, l]
    block[1, 2] = block[2, 1] = T[5, l]
    values, vectors = np.linalg.eigh(block)
    if values[0] >= 0.0:
        return
    block[:] = 0.0
    for i in range(3):
        if values[i] > 0.0:
            for a in range(3):
                for b in range(3):
                    block[a, b] += values[i] * vectors[a, i] * vectors[b, i]
    for i in range(3):
        T[i, l] = block[i, i]
    T[3, l], T[4, l], T[5, l] = block[0, 1], block[0, 2], block[1, 2]


# --- pointwise functions on NumPy arrays, any leading shape --------------------


def signed_svd(F: Array) -> tuple[Array, Array, Array]:
    """U (..., 3, 3), s (..., 3), V (..., 3, 3) with F = U diag(s) V^T, both rotations proper."""
    flat, shape = _to_lanes(F)
    U, s, V, _, _ = _decompose(flat)
    return _from_lanes(U, shape), s.T.reshape(*shape, 3).copy(), _from_lanes(V, shape)


def nearest_rotation(F: Array) -> Array:
    """The rotation R (..., 3, 3) with det R = +1 nearest to F in the Frobenius norm."""
    U, _, V = signed_svd(F)
    return U @ np.swapaxes(V, -1, -2)


def nearest_unit_determinant(F: Array) -> Array:
    """The matrix V (..., 3, 3) with det V = 1 nearest to F in the Frobenius norm."""
    flat, shape = _to_lanes(F)
    U, s, V, v, k = _decompose(flat)
    nearest_volume_lanes(s, v, k, 0)
    scaled = _from_lanes(U, shape) * v.T.reshape(*shape, 1, 3)
    return scaled @ np.swapaxes(_from_lanes(V, shape), -1, -2)


def energy_density(F: Array, mu: ArrayLike, omega: ArrayLike, energy: str = "corotated") -> Array:
    """Psi(F), (...), J/m3, for F (..., 3, 3); ``energy`` as in `Material`.

    The weights ``mu`` and ``omega``, Pa, are numbers or arrays that broadcast to (...).
    """
    return _density_and_stress(F, mu, omega, energy)[0]


def first_piola(F: Array, mu: ArrayLike, omega: ArrayLike, energy: str = "corotated") -> Array:
    """P = dPsi/dF, (..., 3, 3), Pa, for the arguments of `energy_density`."""
    return _density_and_stress(F, mu, omega, energy)[1]


def elasticity(
    F: Array, mu: ArrayLike, omega: ArrayLike, project: bool = False, energy: str = "corotated"
) -> Array:
    """dP/dF, (..., 3, 3, 3, 3), Pa; ``project`` makes it positive semi-definite."""
    flat, shape = _to_lanes(F)
    U, s, V, v, k = _decompose(flat)
    T, weights = np.empty((12, flat.shape[1])), _weights(mu, omega, shape)
    principal_tangent_lanes(energy_code(energy), s, v, k, *weights, 0, project, T)
    C = np.zeros((flat.shape[1], 3, 3, 3, 3))  # in the frame of the SVD
    for i in range(3):
        C[:, i, i, i, i] = T[i]
    for pair, (i, j) in enumerate(_PAIRS):
        C[:, i, i, j, j] = C[:, j, j, i, i] = T[3 + pair]
        C[:, i, j, i, j] = C[:, j, i, j, i] = T[6 + pair]
        C[:, i, j, j, i] = C[:, j, i, i, j] = T[9 + pair]
    u, w = U.T.reshape(-1, 3, 3), V.T.reshape(-1, 3, 3)
    out = np.einsum("nia,njb,nabcd,nkc,nld->nijkl", u, w, C, u, w, optimize=True)
    return out.reshape(*shape, 3, 3, 3, 3)


def _density_and_stress(
    F: Array, mu: ArrayLike, omega: ArrayLike, energy: str
) -> tuple[Array, Array]:
    flat, shape = _to_lanes(F)
    U, s, V, v, k = _decompose(flat)
    weights = _weights(mu, omega, shape)
    density, t, P = np.empty(flat.shape[1]), np.empty_like(s), np.empty_like(flat)
    principal_stress_lanes(energy_code(energy), s, v, k, *weights, 0, density, t)
    stress_lanes(U, t, V, P)
    return density.reshape(shape), _from_lanes(P, shape)


def _weights(mu: ArrayLike, omega: ArrayLike, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Both weights, one a matrix of F."""
    try:
        flat = [np.broadcast_to(w, shape).astype(np.float64).ravel() for w in (mu, omega)]
    except ValueError:
        raise InputError(
            f"mu {np.shape(mu)} and omega {np.shape(omega)}: expected numbers, or shapes that "
            f"broadcast to F's {shape}."
        ) from None
    return flat[0], flat[1]


def _decompose(flat: Array) -> tuple[Array, ...]:
    """U (9, L), s (3, L), V (9, L) of matrices (9, L), and room for v (3, L) and k (L,)."""
    _, U, V, B, S, s, v, k = scratch(flat.shape[1])
    signed_svd_lanes(flat, U, s, V, B, S)
    return U, s, V, v, k


def _to_lanes(F: Array) -> tuple[Array, tuple[int, ...]]:
    F = np.asarray(F, dtype=np.float64)
    if F.shape[-2:] != (3, 3):
        raise InputError(f"F has shape {F.shape}: expected (..., 3, 3).")
    if not np.isfinite(F).all():
        raise InputError("F contains NaN or infinite entries.")
    return np.ascontiguousarray(F.reshape(-1, 9).T), F.shape[:-2]


def _from_lanes(A: Array, shape: tuple[int, ...]) -> Array:
    return A.T.reshape(*shape, 3, 3).copy()

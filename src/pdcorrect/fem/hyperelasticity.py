"""Other isotropic energies, for measuring the model error: density, stress and tangent.

With principal stretches s_i (signed), J = s_1 s_2 s_3 and lambda = omega / 3:

"neo-hookean", stable neo-Hookean (Smith, de Goes and Kim 2018, eq. 13 with their
lambda = lambda + mu, so that small strains give the Lame parameters asked for):

    mu/2 (|F|^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2

"st-venant-kirchhoff", with E = (F^T F - I)/2:

    mu |E|^2 + lambda/2 tr(E)^2

"linear-corotated", with F = R S, Hooke's law in the frame that turns with R:

    mu |S - I|^2 + lambda/2 tr(S - I)^2

ARAP is the corotated energy without its volume term.  In the frame of the SVD an
isotropic tangent is one 3x3 block for the diagonal and, for each pair i, j with
principal stresses t, the modes (t_i - t_j)/(s_i - s_j) and (t_i + t_j)/(s_i + s_j)
(Stomakhin et al. 2012).  Both quotients are polynomials for the first two, so nothing special
happens at repeated or opposite stretches; the third has corotated energy's kink.

The functions in `ENERGIES` are of numbers, for the kernels, and of tensors, for batches: stretches
(3), mu and lambda to the density and the principal stresses (3), and to the tangent (12) with rows
as in `corotated_tangent_lanes`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

from pdcorrect.errors import InputError
from pdcorrect.fem.decomposition import OPTIONS

COROTATED, NEO_HOOKEAN, ST_VENANT_KIRCHHOFF, LINEAR_COROTATED = 0, 1, 2, 3
"""What the kernels call the energies."""

_KINK = 1e-9
"""Sum of two stretches below which the mode that R makes infinite goes to zero."""

_CODES = {
    "corotated": COROTATED,
    "corotated-only": COROTATED,
    "arap": COROTATED,
    "volume-only": COROTATED,
    "neo-hookean": NEO_HOOKEAN,
    "st-venant-kirchhoff": ST_VENANT_KIRCHHOFF,
    "linear-corotated": LINEAR_COROTATED,
}


def energy_code(name: str) -> int:
    """The kernels' number of an energy of `Material`."""
    if name not in _CODES:
        raise InputError(f"energy {name!r}: expected one of {', '.join(_CODES)}.")
    return _CODES[name]


def model_name(code: int) -> str:
    """A name of the energy with a number of the kernels."""
    return next(name for name, known in _CODES.items() if known == code)


def neo_hookean(s, mu, lam):  # type: ignore[no-untyped-def]
    a, b, c = s
    x, y, z = a - 1.0, b - 1.0, c - 1.0  # near rest sums of a, b, c would cancel
    pairs, triple = x * y + y * z + z * x, x * y * z
    change = x + y + z + pairs + triple
    rest = 0.5 * (x * x + y * y + z * z) - pairs - triple
    q = (mu + lam) * change - mu
    density = mu * rest + 0.5 * (mu + lam) * change * change
    return density, (mu * a + q * b * c, mu * b + q * a * c, mu * c + q * a * b)


def neo_hookean_tangent(s, mu, lam):  # type: ignore[no-untyped-def]
    a, b, c = s
    both = mu + lam
    q = both * (a * b * c - 1.0) - mu
    return (
        mu + both * b * b * c * c, mu + both * c * c * a * a, mu + both * a * a * b * b,
        both * a * b * c * c + q * c, both * a * c * b * b + q * b, both * b * c * a * a + q * a,
        mu - q * c, mu - q * b, mu - q * a,
        mu + q * c, mu + q * b, mu + q * a,
    )  # fmt: skip


def st_venant_kirchhoff(s, mu, lam):  # type: ignore[no-untyped-def]
    a, b, c = s
    x, y, z = a - 1.0, b - 1.0, c - 1.0
    x, y, z = x + 0.5 * x * x, y + 0.5 * y * y, z + 0.5 * z * z
    pressure = lam * (x + y + z)
    density = mu * (x * x + y * y + z * z) + 0.5 * pressure * (x + y + z)
    twice = 2.0 * mu
    return density, (
        a * (twice * x + pressure), b * (twice * y + pressure), c * (twice * z + pressure),
    )  # fmt: skip


def st_venant_kirchhoff_tangent(s, mu, lam):  # type: ignore[no-untyped-def]
    a, b, c = s
    aa, bb, cc = a * a, b * b, c * c
    pressure = 0.5 * lam * (aa + bb + cc - 3.0)
    rest = pressure - mu
    return (
        rest + (3.0 * mu + lam) * aa, rest + (3.0 * mu + lam) * bb, rest + (3.0 * mu + lam) * cc,
        lam * a * b, lam * a * c, lam * b * c,
        rest + mu * (aa + bb + a * b), rest + mu * (aa + cc + a * c), rest + mu * (bb + cc + b * c),
        rest + mu * (aa + bb - a * b), rest + mu * (aa + cc - a * c), rest + mu * (bb + cc - b * c),
    )  # fmt: skip


def linear_corotated(s, mu, lam):  # type: ignore[no-untyped-def]
    x, y, z = s[0] - 1.0, s[1] - 1.0, s[2] - 1.0
    pressure, twice = lam * (x + y + z), 2.0 * mu
    density = mu * (x * x + y * y + z * z) + 0.5 * pressure * (x + y + z)
    return density, (twice * x + pressure, twice * y + pressure, twice * z + pressure)


def linear_corotated_tangent(s, mu, lam):  # type: ignore[no-untyped-def]
    a, b, c = s
    twice = 2.0 * mu
    whole = twice + lam
    rest = 2.0 * lam * (a + b + c - 3.0) - 2.0 * twice
    ab, ac, bc = a + b, a + c, b + c
    return (
        whole, whole, whole, lam, lam, lam, twice, twice, twice,
        twice + rest * ab / (ab * ab + _KINK * _KINK),
        twice + rest * ac / (ac * ac + _KINK * _KINK),
        twice + rest * bc / (bc * bc + _KINK * _KINK),
    )  # fmt: skip


ENERGIES: dict[int, tuple[Callable[..., Any], Callable[..., Any]]] = {
    NEO_HOOKEAN: (neo_hookean, neo_hookean_tangent),
    ST_VENANT_KIRCHHOFF: (st_venant_kirchhoff, st_venant_kirchhoff_tangent),
    LINEAR_COROTATED: (linear_corotated, linear_corotated_tangent),
}
(_neo, _neo_tangent), (_venant, _venant_tangent), (_linear, _linear_tangent) = (
    [njit(**OPTIONS)(function) for function in functions] for functions in ENERGIES.values()
)


@njit(**OPTIONS)
def hyperelastic_lanes(model, s, mu, omega, density, t):  # type: ignore[no-untyped-def]
    """Energy density (L,) and principal stresses t (3, L) for stretches s (3, L)."""
    for l in range(s.shape[1]):
        stretches, lam = (s[0, l], s[1, l], s[2, l]), omega[l] / 3.0
        if model == NEO_HOOKEAN:
            density[l], stress = _neo(stretches, mu[l], lam)
        elif model == ST_VENANT_KIRCHHOFF:
            density[l], stress = _venant(stretches, mu[l], lam)
        else:
            density[l], stress = _linear(stretches, mu[l], lam)
        t[0, l], t[1, l], t[2, l] = stress


@njit(**OPTIONS)
def hyperelastic_tangent_lanes(model, s, mu, omega, T):  # type: ignore[no-untyped-def]
    """Tangent T (12, L), rows as in `corotated_tangent_lanes`."""
    for l in range(s.shape[1]):
        stretches, lam = (s[0, l], s[1, l], s[2, l]), omega[l] / 3.0
        if model == NEO_HOOKEAN:
            tangent = _neo_tangent(stretches, mu[l], lam)
        elif model == ST_VENANT_KIRCHHOFF:
            tangent = _venant_tangent(stretches, mu[l], lam)
        else:
            tangent = _linear_tangent(stretches, mu[l], lam)
        for i in range(12):
            T[i, l] = tangent[i]

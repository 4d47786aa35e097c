"""Other isotropic energies, for measuring the model error: density, stress and tangent.

With principal stretches s_i (signed), J = s_1 s_2 s_3 and lambda = omega / 3:

"neo-hookean", stable neo-Hookean (Smith, de Goes and Kim 2018, eq. 13 with their
lambda = lambda + mu, so that small strains give the Lame parameters asked for):

    mu/2 (|F|^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2

"st-venant-kirchhoff", with E = (F^T F - I)/2:

    mu |E|^2 + lambda/2 tr(E)^2

ARAP is the corotated energy without its volume term.  In the frame of the SVD an
isotropic tangent is one 3x3 block for the diagonal and, for each pair i, j with
principal stresses t, the modes (t_i - t_j)/(s_i - s_j) and (t_i + t_j)/(s_i + s_j)
(Stomakhin et al. 2012).  Both quotients are polynomials here, so nothing special
happens at repeated or opposite stretches.
"""

from __future__ import annotations

from numba import njit

from pdcorrect.errors import InputError
from pdcorrect.fem.decomposition import OPTIONS

COROTATED, NEO_HOOKEAN, ST_VENANT_KIRCHHOFF = 0, 1, 2
"""What the kernels call the energies."""

_CODES = {
    "corotated": COROTATED,
    "corotated-only": COROTATED,
    "arap": COROTATED,
    "volume-only": COROTATED,
    "neo-hookean": NEO_HOOKEAN,
    "st-venant-kirchhoff": ST_VENANT_KIRCHHOFF,
}


def energy_code(name: str) -> int:
    """The kernels' number of an energy of `Material`."""
    if name not in _CODES:
        raise InputError(f"energy {name!r}: expected one of {', '.join(_CODES)}.")
    return _CODES[name]


def model_name(code: int) -> str:
    """A name of the energy with a number of the kernels."""
    return next(name for name, known in _CODES.items() if known == code)


@njit(**OPTIONS)
def hyperelastic_lanes(model, s, mu, omega, density, t):  # type: ignore[no-untyped-def]
    """Energy density (L,) and principal stresses t (3, L) for stretches s (3, L)."""
    for l in range(s.shape[1]):
        a, b, c = s[0, l], s[1, l], s[2, l]
        lam = omega[l] / 3.0
        if model == NEO_HOOKEAN:
            x, y, z = a - 1.0, b - 1.0, c - 1.0  # near rest sums of a, b, c would cancel
            pairs, triple = x * y + y * z + z * x, x * y * z
            change = x + y + z + pairs + triple
            rest = 0.5 * (x * x + y * y + z * z) - pairs - triple
            density[l] = mu[l] * rest + 0.5 * (mu[l] + lam) * change * change
            q = (mu[l] + lam) * change - mu[l]
            t[0, l] = mu[l] * a + q * b * c
            t[1, l] = mu[l] * b + q * a * c
            t[2, l] = mu[l] * c + q * a * b
        else:
            x, y, z = a - 1.0, b - 1.0, c - 1.0
            x, y, z = x + 0.5 * x * x, y + 0.5 * y * y, z + 0.5 * z * z
            trace = x + y + z
            density[l] = mu[l] * (x * x + y * y + z * z) + 0.5 * lam * trace * trace
            t[0, l] = a * (2.0 * mu[l] * x + lam * trace)
            t[1, l] = b * (2.0 * mu[l] * y + lam * trace)
            t[2, l] = c * (2.0 * mu[l] * z + lam * trace)


@njit(**OPTIONS)
def hyperelastic_tangent_lanes(model, s, mu, omega, T):  # type: ignore[no-untyped-def]
    """Tangent T (12, L), rows as in `corotated_tangent_lanes`."""
    for l in range(s.shape[1]):
        lam = omega[l] / 3.0
        change = s[0, l] * s[1, l] * s[2, l] - 1.0
        trace = 0.5 * (s[0, l] * s[0, l] + s[1, l] * s[1, l] + s[2, l] * s[2, l] - 3.0)
        q = (mu[l] + lam) * change - mu[l]
        for i in range(3):
            x, y, z = s[i, l], s[(i + 1) % 3, l], s[(i + 2) % 3, l]
            if model == NEO_HOOKEAN:
                T[i, l] = mu[l] + (mu[l] + lam) * y * y * z * z
            else:
                T[i, l] = mu[l] * (3.0 * x * x - 1.0) + lam * (x * x + trace)
        for pair in range(3):
            i, j, k = pair // 2, 1 + (pair + 1) // 2, 2 - pair
            x, y, z = s[i, l], s[j, l], s[k, l]
            if model == NEO_HOOKEAN:
                T[3 + pair, l] = (mu[l] + lam) * x * y * z * z + q * z
                T[6 + pair, l] = mu[l] - q * z
                T[9 + pair, l] = mu[l] + q * z
            else:
                both = x * x + y * y - 1.0
                T[3 + pair, l] = lam * x * y
                T[6 + pair, l] = lam * trace + mu[l] * (both + x * y)
                T[9 + pair, l] = lam * trace + mu[l] * (both - x * y)

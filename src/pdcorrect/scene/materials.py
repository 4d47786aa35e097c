"""Materials: what was asked for, and what the energy makes of it."""

from __future__ import annotations

from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from pdcorrect._config import Poisson, Positive, Strict
from pdcorrect.scene.regions import Region

Energy = Literal[
    "corotated", "corotated-only", "arap", "volume-only",
    "neo-hookean", "st-venant-kirchhoff", "linear-corotated",
]  # fmt: skip
Moduli = TypeVar("Moduli", float, NDArray[np.float64])


def lame(young: Moduli, poisson: Moduli) -> tuple[Moduli, Moduli]:
    """Lame parameters (mu, lambda), Pa, of Young's modulus (Pa) and Poisson's ratio."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def lame_slopes(young: Moduli, poisson: Moduli) -> tuple[tuple[Moduli, Moduli], ...]:
    """Derivatives of (mu, lambda) by Young's modulus, then by Poisson's ratio (Pa)."""
    mu, lam = lame(young, poisson)
    by_poisson = (
        -mu / (1 + poisson),
        young * (1 + 2 * poisson**2) / ((1 + poisson) * (1 - 2 * poisson)) ** 2,
    )
    return (mu / young, lam / young), by_poisson


class EffectiveModuli(Strict):
    """What the energy amounts to at small strain: E in Pa, Poisson's ratio."""

    young: float
    poisson: float


class Material(Strict):
    """Elastic material: corotated energy with an independent volume term.

    The energy density is ``mu |F - R|^2 + omega/2 |F - V|^2`` (section 3 of the
    theory page) with ``mu = E / (2 (1 + nu))`` and
    ``lambda = E nu / ((1 + nu) (1 - 2 nu))``.

    Attributes
    ----------
    energy
        "corotated" (both terms), "corotated-only" (also called "arap") or
        "volume-only"; "neo-hookean" (stable), "st-venant-kirchhoff" and
        "linear-corotated", see `pdcorrect.fem.hyperelasticity`.
    volume_weight
        "lame": omega = 3 lambda, which gives the E and nu asked for.
        "published": omega = lambda, DiffPD's rule.
    young, poisson, density
        Pa, dimensionless in [0, 0.5), kg/m3.
    """

    energy: Energy = "corotated"
    volume_weight: Literal["lame", "published"] = "lame"
    young: Positive
    poisson: Poisson
    density: Positive

    @property
    def has_shear_term(self) -> bool:
        """Whether the energy has a term that mu weighs."""
        return self.energy != "volume-only"

    @property
    def has_volume_term(self) -> bool:
        """Whether the energy has a term that lambda weighs."""
        return self.energy not in ("corotated-only", "arap")

    @property
    def mu(self) -> float:
        """Shear modulus, Pa."""
        return lame(self.young, self.poisson)[0]

    @property
    def lam(self) -> float:
        """First Lame parameter, Pa."""
        return lame(self.young, self.poisson)[1]

    @property
    def effective(self) -> EffectiveModuli:
        """Young's modulus and Poisson's ratio that the energy really has.

        For small strain ``|F - V|^2 = tr(eps)^2 / 3``, so the volume term acts
        as a first Lame parameter ``omega / 3``.
        """
        mu = self.mu if self.has_shear_term else 0.0
        lam = self.lam if self.has_volume_term else 0.0
        lam = lam if self.volume_weight == "lame" else lam / 3
        total = lam + mu
        if total == 0:
            return EffectiveModuli(young=0.0, poisson=0.0)
        return EffectiveModuli(young=mu * (3 * lam + 2 * mu) / total, poisson=lam / (2 * total))


class MaterialRegion(Strict):
    """Other values of the material in part of the body (cells by their centre)."""

    region: Region
    young: Positive | None = None
    poisson: Poisson | None = None
    density: Positive | None = None

"""Material values of each cell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.clamps import Selector
from pdcorrect.fem.hyperelasticity import COROTATED, energy_code
from pdcorrect.scene import Material, Scene
from pdcorrect.scene.materials import lame

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Materials:
    """Material of each cell.

    Attributes
    ----------
    young, poisson : (C,)
        Pa; dimensionless.
    mu, volume_weight : (C,)
        Weights of the two energy terms, Pa; zero where a term is left out.
    density : (C,)
        kg/m3.
    model : int
        The energy, see `energy_code`.
    """

    young: Array
    poisson: Array
    mu: Array
    volume_weight: Array
    density: Array
    model: int = COROTATED

    @classmethod
    def from_moduli(cls, rule: Material, young: Array, poisson: Array, density: Array) -> Materials:
        """Weights from Young's modulus (C,), Pa, and Poisson's ratio (C,).

        ``rule`` gives the energy's terms and the volume weight.
        """
        mu, lam = lame(young, poisson)
        omega = lam if rule.volume_weight == "published" else 3 * lam
        return cls(
            young=young,
            poisson=poisson,
            mu=mu if rule.has_shear_term else np.zeros_like(mu),
            volume_weight=omega if rule.has_volume_term else np.zeros_like(lam),
            density=density,
            model=energy_code(rule.energy),
        )

    @classmethod
    def from_scene(cls, scene: Scene, selector: Selector, count: int) -> Materials:
        """The scene's material and its regions, for ``count`` cells."""
        names = ("young", "poisson", "density")
        values = {name: np.full(count, float(getattr(scene.material, name))) for name in names}
        for i, part in enumerate(scene.materials):
            cells = selector.cells(part.region, f"materials[{i}].region")
            for name in names:
                if getattr(part, name) is not None:
                    values[name][cells] = getattr(part, name)
        return cls.from_moduli(scene.material, **values)

    def changed(
        self,
        rule: Material,
        young: float | Array | None,
        poisson: float | Array | None,
        density: float | Array | None,
    ) -> Materials:
        """The same with other values, each a number or one a cell (C,)."""
        if (young is None) != (poisson is None):
            raise InputError("with_material: expected young and poisson together.")
        count, new = len(self.mu), self
        if young is not None and poisson is not None:
            new = Materials.from_moduli(
                rule,
                _per_cell("young", young, count),
                _per_cell("poisson", poisson, count),
                self.density,
            )
        if density is not None:
            new = replace(new, density=_per_cell("density", density, count))
        return new


RANGES = {"young": "above 0", "poisson": "in [0, 0.5)", "density": "above 0"}
"""Of values that have a meaning."""


def _per_cell(name: str, value: float | Array, count: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (count,)):
        raise InputError(f"{name} has shape {array.shape}: expected a number or ({count},).")
    array = np.broadcast_to(array, (count,)).copy()
    fits = (array >= 0) & (array < 0.5) if name == "poisson" else array > 0
    bad = ~(np.isfinite(array) & fits)
    if bad.any():
        cell = int(np.argmax(bad))
        raise InputError(
            f"{name} of cell {cell} is {array[cell]}: expected a finite number {RANGES[name]}."
        )
    return array

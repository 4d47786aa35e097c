"""Material values of the scenes of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, padded
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Material
from pdcorrect.scene.materials import lame

NAMES = ("young", "poisson", "density")


@dataclass(frozen=True, eq=False)
class BatchMaterial:
    """Values of each cell, (B, C); its tensors are not changed.

    Attributes
    ----------
    young, poisson, density : (B, C)
        Pa, dimensionless, kg/m3.
    mu, volume_weight : (B, C)
        Of the two energy terms, Pa; zero where the energy leaves a term out.
    sound : (B,) bool
        Whether all of a scene's values are in their range.
    """

    young: Tensor
    poisson: Tensor
    density: Tensor
    mu: Tensor
    volume_weight: Tensor
    sound: Tensor

    @property
    def values(self) -> tuple[Tensor, Tensor, Tensor]:
        """Young's modulus, Poisson's ratio and density."""
        return self.young, self.poisson, self.density


def own_material(cells: CellBatch, problems: Sequence[Problem]) -> BatchMaterial:
    """What the problems have."""

    def tensor(arrays: Sequence[NDArray[np.float64]]) -> Tensor:
        return cells.tensor(padded(arrays, (cells.sizes.cells,)))

    every = [p.materials for p in problems]
    return BatchMaterial(
        tensor([m.young for m in every]),
        tensor([m.poisson for m in every]),
        tensor([m.density for m in every]),
        tensor([m.mu for m in every]),
        tensor([m.volume_weight for m in every]),
        torch.ones(len(every), dtype=torch.bool, device=cells.device),
    )


def changed(
    cells: CellBatch, rule: Material, base: BatchMaterial, given: Sequence[Tensor | None]
) -> BatchMaterial:
    """``base`` with the values that are given, each (B, C).

    ``rule`` says which terms the energy has and how Poisson's ratio weighs volume.
    """
    young, poisson, density = (
        old if m is None else m.detach().clone() for m, old in zip(given, base.values, strict=True)
    )
    mu, volume_weight = base.mu, base.volume_weight
    if given[0] is not None or given[1] is not None:
        shear, lam = lame(young, poisson)  # type: ignore[type-var]
        omega = lam if rule.volume_weight == "published" else 3.0 * lam
        mu = shear if rule.has_shear_term else torch.zeros_like(shear)
        volume_weight = omega if rule.has_volume_term else torch.zeros_like(lam)
    fits = (young > 0.0) & (poisson >= 0.0) & (poisson < 0.5) & (density > 0.0)
    fits &= torch.isfinite(young) & torch.isfinite(density)
    sound = (fits | ~cells.present_cells).all(dim=1)
    return BatchMaterial(young, poisson, density, mu, volume_weight, sound)


def by_cell(cells: CellBatch, name: str, value: Tensor | float | None) -> Tensor | None:
    """A number, or a tensor that broadcasts to (B, C), as (B, C).

    Raises
    ------
    InputError
        If it has another shape, type or device.
    """
    if value is None:
        return None
    shape = (cells.sizes.scenes, cells.sizes.cells)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        value = torch.tensor(float(value), dtype=cells.dtype, device=cells.rest.device)
    if not isinstance(value, Tensor):
        raise InputError(f"{name} is a {type(value).__name__}: expected a number or a tensor.")
    if value.dtype != cells.dtype or value.device != cells.rest.device:
        raise InputError(
            f"{name}: {value.dtype} on {value.device}; expected {cells.dtype} on "
            f"{cells.rest.device}, as the stepper."
        )
    try:
        return value.expand(shape)
    except RuntimeError:
        raise InputError(
            f"{name}: {tuple(value.shape)}; expected what broadcasts to {shape}, one value a "
            "cell of each scene."
        ) from None

"""Material values of the scenes of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch, scene_name
from pdcorrect.batch.states import check_tensor
from pdcorrect.errors import InputError
from pdcorrect.fem.materials import RANGES
from pdcorrect.fem.problem import Problem
from pdcorrect.scene import Material
from pdcorrect.scene.materials import lame

NAMES = ("young", "poisson", "density")


@dataclass(frozen=True, eq=False)
class BatchMaterial:
    """Values of each cell, (B, C); its tensors are not changed.

    Moduli in Pa, density in kg/m3; the weights of the two energy terms, Pa, are zero where the
    energy leaves a term out.  ``sound`` (B,) says whether all of a scene's values are in range.
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


def own_material(cells: CellBatch) -> BatchMaterial:
    """What the problems have."""
    every = [p.materials for p in cells.bodies.distinct]
    values = {
        name: cells.repeated([getattr(m, name) for m in every], cells.sizes.cells)
        for name in (*NAMES, "mu", "volume_weight")
    }
    sound = torch.ones(cells.sizes.scenes, dtype=torch.bool, device=cells.device)
    return BatchMaterial(**values, sound=sound)


def changed(
    cells: CellBatch, rule: Material, base: BatchMaterial, given: Sequence[Tensor | None]
) -> BatchMaterial:
    """``base`` with the values that are given, each (B, C).

    ``rule`` says which terms the energy has and how Poisson's ratio weighs volume.
    """
    if all(m is None for m in given):
        return base
    young, poisson, density = (
        old if m is None else m.detach().clone() for m, old in zip(given, base.values, strict=True)
    )
    mu, volume_weight = base.mu, base.volume_weight
    if given[0] is not None or given[1] is not None:
        shear, lam = lame(young, poisson)  # type: ignore[type-var]
        omega = lam if rule.volume_weight == "published" else 3.0 * lam
        mu = shear if rule.has_shear_term else torch.zeros_like(shear)
        volume_weight = omega if rule.has_volume_term else torch.zeros_like(lam)
    fits = torch.stack(in_range(young, poisson, density)).all(dim=0)
    sound = (fits | ~cells.present_cells).all(dim=1)
    return BatchMaterial(young, poisson, density, mu, volume_weight, sound)


def in_range(young: Tensor, poisson: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Which values have a meaning, see `pdcorrect.fem.materials.RANGES`."""
    return (
        (young > 0.0) & torch.isfinite(young),
        (poisson >= 0.0) & (poisson < 0.5),
        (density > 0.0) & torch.isfinite(density),
    )


def by_cell(cells: CellBatch, name: str, value: Tensor | float | None) -> Tensor | None:
    """A number, or a tensor that broadcasts to (B, C), as (B, C); others are refused."""
    if value is None:
        return None
    shape = (cells.sizes.scenes, cells.sizes.cells)
    if isinstance(value, (int, float)):
        value = torch.tensor(float(value), dtype=cells.dtype, device=cells.rest.device)
    check_tensor(cells, name, value)
    try:
        return value.expand(shape)
    except RuntimeError:
        raise InputError(
            f"{name}: {tuple(value.shape)}; expected what broadcasts to {shape}, one value a "
            f"cell of each scene: one value a scene is ({shape[0]}, 1)."
        ) from None


def check_material(cells: CellBatch, problems: Sequence[Problem], material: BatchMaterial) -> None:
    """Refuse values out of their range, naming scene and cell."""
    if material.sound.all():
        return
    fits = in_range(*material.values)
    for (name, wanted), value, fine in zip(RANGES.items(), material.values, fits, strict=True):
        bad = (~fine & cells.present_cells).nonzero()
        if len(bad):
            scene, cell = bad[0].tolist()
            raise InputError(
                f"{name} of cell {cell} in scene {scene_name(problems, scene)} is "
                f"{float(value[scene, cell]):g}: expected a finite number {wanted}."
            )

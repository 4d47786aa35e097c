"""What a learned element adds to a batch: `pdcorrect.fem.cell_correction` for B scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pdcorrect.batch import turned_strains
from pdcorrect.batch.gpu import small_products
from pdcorrect.batch.points import computed
from pdcorrect.fem.cell_correction import CellCorrection


class _State(NamedTuple):
    """Of each cell at a configuration, components first, (k, B C, 1): see `turned_strains`.

    R, S, (tr S - S)^-1, S's adjugate, z before it fades, how it fades and what is left of it; then
    the derivatives by that, those by S and z's vectors, w, and those by the shapes' amplitudes.
    """

    R: Tensor
    S: Tensor
    inverse: Tensor
    adjugate: Tensor
    z: Tensor
    fades: Tensor
    left: Tensor
    raw: Tensor
    y: Tensor
    w: Tensor
    conjugates: Tensor

    @property
    def frame(self) -> list[Tensor]:
        """What the cell's deformation alone gives."""
        return [self.R, self.S, self.inverse, self.adjugate, self.z, self.fades]


class BatchCorrection:
    """Energies, forces and second derivatives of the corrections of B bodies.

    Filled up to so many ``cells``, in the type and on the device of ``like``.
    """

    def __init__(self, corrections: Sequence[CellCorrection], cells: int, like: Tensor) -> None:
        count = len(corrections)
        self._shapes = like.new_zeros(count, cells, 7, 8)
        self._matrices = like.new_zeros(count, cells, 18, 18)
        self._sizes = like.new_ones(count, cells)
        for i, c in enumerate(corrections):
            self._shapes[i, : len(c.sizes)] = torch.as_tensor(c.shapes)
            self._sizes[i, : len(c.sizes)] = torch.as_tensor(c.sizes)
        self.write(corrections)

    def write(self, corrections: Sequence[CellCorrection]) -> None:
        """Take their matrices from now on."""
        for i, c in enumerate(corrections):
            self._matrices[i, : len(c.sizes)] = torch.as_tensor(c.matrices)

    def energy_and_forces(self, local: Tensor) -> tuple[Tensor, Tensor]:
        """J (B,) and N by cell (B, C, 8, 3) for displacements (B, C, 8, 3) of corners."""
        return self._potential(self._state(local))

    def strains(self, local: Tensor) -> Tensor:
        """What is left of z, (B, C, 18)."""
        return self._by_cell(self._frame(local)[-1])

    def whole(self, local: Tensor) -> Tensor:
        """Whether z does not fade at all, (B, C, 1)."""
        fades = self._by_cell(self._frame(local)[5])
        return (fades[..., :1] == 1.0) & (fades[..., 5:6] == 1.0)

    def viscous(self, local: Tensor, before: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
        """See `WrittenViscous`: (B,), and its derivatives by cell (B, C, 8, 3)."""
        energy, forces = self._potential(self.linearise_viscous(local, before, rate), before)
        return energy, -forces

    def linearise_viscous(self, local: Tensor, before: Tensor, rate: Tensor) -> _State:
        """What `apply` needs of it, with the same rate."""
        found = self._frame(local)
        return self._with(found, self.viscous_stress(self._by_cell(found[-1]) - before, rate))

    def rates(self, local: Tensor, x: Tensor) -> Tensor:
        """Change of what is left of z (B, C, 18) by displacements x (B, C, 8, 3)."""
        return self._by_cell(self._rates(self._frame(local)[:-1], x)[-1])

    def pulled(self, local: Tensor, stress: Tensor) -> Tensor:
        """Derivatives of stress . z by the displacements, (B, C, 8, 3), for (B, C, 18)."""
        return self._spread(self._with(self._frame(local), stress).conjugates)

    def stress(self, z: Tensor) -> Tensor:
        """K z, (B, C, 18)."""
        return small_products(self._matrices, z[..., None])[..., 0]

    def viscous_stress(self, z: Tensor, rate: Tensor) -> Tensor:
        """Times a rate, and with the part of K that viscosity has, see `WrittenViscous`."""
        return rate * without_trace(self.stress(without_trace(z)))

    def linearise(self, local: Tensor, project: bool = False) -> _State:
        """What `apply` needs; ``project`` as in `CellCorrection.tangent`."""
        state = self._state(local)
        if not project:
            return state
        own = {name: torch.zeros_like(getattr(state, name)) for name in ("raw", "y", "w")}
        return state._replace(**own)

    def apply(self, tangent: Sequence[Tensor], local: Tensor, rate: Tensor | None = None) -> Tensor:
        """The second derivative times changes (B, C, 8, 3), by cell; the rate is of viscosity."""
        at = _State(*tangent)
        *known, left = self._rates(at.frame, local)
        z = self._by_cell(left)
        raw = self.stress(z) if rate is None else self.viscous_stress(z, rate)
        inputs = [*at.frame, at.raw, at.y, at.w, *known, _components(raw)]
        (out,) = computed(turned_strains.changes, inputs, (21,), cell_by_cell=True)
        return self._spread(out)

    def _frame(self, local: Tensor) -> list[Tensor]:
        v = _components(small_products(self._shapes, local))
        sizes = self._sizes.reshape(1, -1, 1)
        return computed(turned_strains.frame, [v, sizes], (9, 9, 9, 9, 18, 8, 18))

    def _rates(self, frame: list[Tensor], x: Tensor) -> list[Tensor]:
        dv = _components(small_products(self._shapes, x))
        return computed(turned_strains.rates, [*frame, dv], (18, 9, 1, 3, 18))

    def _state(self, local: Tensor) -> _State:
        found = self._frame(local)
        return self._with(found, self.stress(self._by_cell(found[-1])))

    def _with(self, found: list[Tensor], stress: Tensor) -> _State:
        """The state with derivatives (B, C, 18) by what is left of z."""
        raw = _components(stress)
        after = computed(turned_strains.derivatives, [*found[:-1], raw], (18, 3, 21))
        return _State(*(*found, raw, *after))

    def _potential(self, at: _State, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Half of (z - before) . raw of each scene, and minus its derivatives."""
        change = at.left if before is None else at.left - _components(before)
        energy = 0.5 * (change * at.raw).sum(dim=0).reshape(len(self._sizes), -1).sum(dim=1)
        return energy, -self._spread(at.conjugates)

    def _by_cell(self, x: Tensor) -> Tensor:
        """(k, B C, 1) as (B, C, k)."""
        return x[..., 0].T.reshape(*self._sizes.shape, -1)

    def _spread(self, conjugates: Tensor) -> Tensor:
        rows = self._by_cell(conjugates).reshape(*self._sizes.shape, 7, 3)
        return small_products(self._shapes.transpose(-1, -2), rows)


def _components(x: Tensor) -> Tensor:
    """(B, C, ...) as (k, B C, 1)."""
    return x.flatten(0, 1).flatten(1).T[..., None]


def without_trace(z: Tensor) -> Tensor:
    """Strains (..., 18) whose first three numbers have no mean."""
    axial = z[..., :3] - z[..., :3].mean(dim=-1, keepdim=True)
    return torch.cat([axial, z[..., 3:]], dim=-1)

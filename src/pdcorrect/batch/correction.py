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

    R, S, (tr S - S)^-1, S's adjugate, z before it fades and how it fades; then the derivatives by
    what is left of z, those by S and z's vectors, and w.
    """

    R: Tensor
    S: Tensor
    inverse: Tensor
    adjugate: Tensor
    z: Tensor
    fades: Tensor
    raw: Tensor
    y: Tensor
    w: Tensor

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
        frame, left = self._frame(local)
        stress = self.stress(left)
        return self._energy(left, stress), -self._spread(self._with(frame, stress)[1])

    def strains(self, local: Tensor) -> Tensor:
        """What is left of z, (B, C, 18)."""
        return self._frame(local)[1]

    def whole(self, local: Tensor) -> Tensor:
        """Whether z does not fade at all, (B, C, 1)."""
        fades = self._by_cell(self._frame(local)[0][5])
        return (fades[..., :1] == 1.0) & (fades[..., 5:6] == 1.0)

    def viscous(self, local: Tensor, before: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
        """See `WrittenViscous`: (B,), and its derivatives by cell (B, C, 8, 3)."""
        frame, left = self._frame(local)
        stress = self.viscous_stress(left - before, rate)
        return self._energy(left - before, stress), self._spread(self._with(frame, stress)[1])

    def linearise_viscous(self, local: Tensor, before: Tensor, rate: Tensor) -> _State:
        """What `apply` needs of it, with the same rate."""
        frame, left = self._frame(local)
        return self._with(frame, self.viscous_stress(left - before, rate))[0]

    def rates(self, local: Tensor, x: Tensor) -> Tensor:
        """Change of what is left of z (B, C, 18) by displacements x (B, C, 8, 3)."""
        return self._by_cell(self._rates(self._frame(local)[0], x)[-1])

    def pulled(self, local: Tensor, stress: Tensor) -> Tensor:
        """Derivatives of stress . z by the displacements, (B, C, 8, 3), for (B, C, 18)."""
        return self._spread(self._with(self._frame(local)[0], stress)[1])

    def stress(self, z: Tensor) -> Tensor:
        """K z, (B, C, 18)."""
        return small_products(self._matrices, z[..., None])[..., 0]

    def viscous_stress(self, z: Tensor, rate: Tensor) -> Tensor:
        """Times a rate, and with the part of K that viscosity has, see `WrittenViscous`."""
        return rate * without_trace(self.stress(without_trace(z)))

    def linearise(self, local: Tensor, project: bool = False) -> _State:
        """What `apply` needs; ``project`` as in `CellCorrection.tangent`."""
        frame, left = self._frame(local)
        state, _ = self._with(frame, self.stress(left))
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

    def _frame(self, local: Tensor) -> tuple[list[Tensor], Tensor]:
        """See `_State.frame`; and what is left of z, (B, C, 18)."""
        v = _components(small_products(self._shapes, local))
        sizes = self._sizes.reshape(1, -1, 1)
        *frame, left = computed(turned_strains.frame, [v, sizes], (9, 9, 9, 9, 18, 8, 18))
        return frame, self._by_cell(left)

    def _rates(self, frame: list[Tensor], x: Tensor) -> list[Tensor]:
        dv = _components(small_products(self._shapes, x))
        return computed(turned_strains.rates, [*frame, dv], (18, 9, 1, 3, 18))

    def _with(self, frame: list[Tensor], stress: Tensor) -> tuple[_State, Tensor]:
        """For derivatives (B, C, 18) by what is left of z; also those by the amplitudes."""
        raw = _components(stress)
        y, w, conjugates = computed(turned_strains.derivatives, [*frame, raw], (18, 3, 21))
        return _State(*(*frame, raw, y, w)), conjugates

    def _energy(self, z: Tensor, stress: Tensor) -> Tensor:
        """Half of their product, of each scene, (B,), J."""
        return 0.5 * (z * stress).sum(dim=(1, 2))

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

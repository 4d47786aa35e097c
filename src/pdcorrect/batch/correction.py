"""What a learned element adds to a batch: `pdcorrect.fem.turned_strains` for B scenes, in torch.

All lengths are times the cell's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pdcorrect.batch.decomposition import product, signed_svd, transposed
from pdcorrect.batch.gpu import small_products
from pdcorrect.batch.points import Components, computed, moved
from pdcorrect.fem.cell_correction import CellCorrection
from pdcorrect.fem.cube_symmetry import MANDEL
from pdcorrect.fem.turned_strains import FADES, GONE, HUGE, KINK, LARGE, SHARES


class _State(NamedTuple):
    """Of each cell at a configuration: R, S, (tr S - S)^-1, S's adjugate and z before it fades.

    Then the derivatives by what is left of z, those by S and z's vectors, their tensor, and w;
    and what `_measures` tells.
    """

    R: Tensor
    S: Tensor
    inverse: Tensor
    adjugate: Tensor
    z: Tensor
    raw: Tensor
    y: Tensor
    tensor: Tensor
    w: Tensor
    fades: Tensor

    @property
    def strains(self) -> Tensor:
        """What is left of z."""
        return self.fades[..., :1] * self.fades[..., 5:6] * self.z


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
        self._mandel = torch.as_tensor(MANDEL).to(like)
        self.write(corrections)

    def write(self, corrections: Sequence[CellCorrection]) -> None:
        """Take their matrices from now on."""
        for i, c in enumerate(corrections):
            self._matrices[i, : len(c.sizes)] = torch.as_tensor(c.matrices)

    def energy_and_forces(self, local: Tensor) -> tuple[Tensor, Tensor]:
        """J (B,) and N by cell (B, C, 8, 3) for displacements (B, C, 8, 3) of corners."""
        state = self._state(local)
        energy = 0.5 * (state.strains * state.raw).sum(dim=(1, 2))
        return energy, -self._pulled(state)

    def strains(self, local: Tensor) -> Tensor:
        """z, (B, C, 18)."""
        return self._state(local).strains

    def whole(self, local: Tensor) -> Tensor:
        """Whether z does not fade at all, (B, C, 1)."""
        fades = self._state(local).fades
        return (fades[..., :1] == 1.0) & (fades[..., 5:6] == 1.0)

    def viscous(self, local: Tensor, before: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
        """See `WrittenViscous`: (B,), and its derivatives by cell (B, C, 8, 3)."""
        state = self.linearise_viscous(local, before, rate)
        energy = 0.5 * ((state.strains - before) * state.raw).sum(dim=(1, 2))
        return energy, self._pulled(state)

    def linearise_viscous(self, local: Tensor, before: Tensor, rate: Tensor) -> _State:
        """What `apply` needs of it, with the same rate."""
        at = self._state(local)
        return self._with(at, self.viscous_stress(at.strains - before, rate))

    def rates(self, local: Tensor, x: Tensor) -> Tensor:
        """Change of z (B, C, 18) by displacements x (B, C, 8, 3)."""
        state = self._state(local)
        dz, _, grown, _, _ = self._rates(state, small_products(self._shapes, x))
        c, slope, _, _, _, e, down, _ = torch.split(state.fades, 1, dim=-1)
        longer = (_shared(state.z) * dz).sum(dim=-1, keepdim=True)
        return c * e * dz + (slope * e * grown + c * down * longer) * state.z

    def pulled(self, local: Tensor, stress: Tensor) -> Tensor:
        """Derivatives of stress . z by the displacements, (B, C, 8, 3), for (B, C, 18)."""
        return self._pulled(self._with(self._state(local), stress))

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
        own = {k: torch.zeros_like(getattr(state, k)) for k in ("raw", "y", "tensor", "w")}
        return state._replace(**own)

    def apply(self, tangent: Sequence[Tensor], local: Tensor, rate: Tensor | None = None) -> Tensor:
        """The second derivative times changes (B, C, 8, 3), by cell; the rate is of viscosity."""
        dv = small_products(self._shapes, local)
        return self._spread(self._changes(_State(*tangent), dv, rate))

    def _pulled(self, at: _State) -> Tensor:
        return self._spread(_conjugates(at.R, at.tensor, at.w, at.y))

    def _spread(self, conjugates: Tensor) -> Tensor:
        return small_products(self._shapes.transpose(-1, -2), conjugates)

    def _state(self, local: Tensor) -> _State:
        v = small_products(self._shapes, local)  # (B, C, 7, 3)
        scenes, cells = v.shape[:2]
        size = self._sizes[..., None, None]
        H = (v[..., :3, :].transpose(-1, -2) / size).reshape(-1, 9).T[..., None]
        R, S, inverse = computed(_stretch, [H.contiguous()], (9, 9, 9))

        def matrices(x: Tensor) -> Tensor:
            return x[..., 0].T.reshape(scenes, cells, 3, 3)

        R, S, inverse = matrices(R), size * matrices(S), matrices(inverse) / size
        identity = torch.eye(3, dtype=v.dtype, device=v.device)
        A = _adjugates(S, S)
        turned = small_products(v[..., 3:, :], R).flatten(2)
        J, size = _contracted(S, A) / 3.0 / self._sizes[..., None] ** 3, self._sizes[..., None]
        E = (
            S
            + ((1.5 * size * (J * J - 1.0) / (J * J + 2.0) - _trace(S)) / 3.0)[..., None] * identity
        )
        strain = torch.einsum("nij,bcij->bcn", self._mandel, E)
        z = torch.cat([strain, turned], dim=2)
        fades = _measures(J, z, size)
        at = _State(R, S, inverse, A, z, z, z, S, z, fades)
        return self._with(at, self.stress(at.strains))

    def _with(self, at: _State, raw: Tensor) -> _State:
        """The state with derivatives by what is left of z."""
        c, slope, _, first, _, e, down, _ = torch.split(at.fades, 1, dim=-1)
        along = (raw * at.z).sum(dim=-1, keepdim=True)
        y = c * e * raw + along * c * down * _shared(at.z)
        trace = y[..., :3].sum(dim=-1, keepdim=True)
        y = self._added(y, (trace * first + along * slope * e)[..., None] * at.adjugate, trace)
        tensor = torch.einsum("nij,bcn->bcij", self._mandel, y[..., :6])
        torque = self._torque(at.S, tensor, _vectors(at.z), _vectors(y))
        w = small_products(at.inverse, torque[..., None])[..., 0]
        return at._replace(raw=raw, y=y, tensor=tensor, w=w)

    def _added(self, y: Tensor, tensor: Tensor, trace: Tensor) -> Tensor:
        """Y with a tensor more, less a third of a trace."""
        identity = torch.eye(3, dtype=y.dtype, device=y.device)
        tensor = tensor - trace[..., None] / 3.0 * identity
        more = torch.einsum("nij,bcij->bcn", self._mandel, tensor)
        return torch.cat([y[..., :6] + more, y[..., 6:]], dim=-1)

    def _torque(self, S: Tensor, T: Tensor, h: Tensor, y: Tensor) -> Tensor:
        return _axial(small_products(S, T)) + torch.linalg.cross(h, y).sum(dim=2)

    def _rates(self, at: _State, dv: Tensor) -> tuple[Tensor, ...]:
        """Changes of z and S, adjugate : dS, changes of z's vectors, and how the frame turns."""
        back = at.R.transpose(-1, -2)
        D = small_products(back, dv[..., :3, :].transpose(-1, -2))
        turn = small_products(at.inverse, -_axial(D)[..., None])[..., 0]
        dS = D - _cross_columns(turn, at.S)
        h = _vectors(at.z)
        dh = small_products(dv[..., 3:, :], at.R) - torch.linalg.cross(turn[..., None, :], h)
        identity = torch.eye(3, dtype=dS.dtype, device=dS.device)
        grown = _contracted(at.adjugate, dS)
        dE = dS + (at.fades[..., 3:4] * grown - _trace(dS) / 3.0)[..., None] * identity
        dz = torch.cat([torch.einsum("nij,bcij->bcn", self._mandel, dE), dh.flatten(2)], dim=2)
        return dz, dS, grown, dh, turn

    def _changes(self, at: _State, dv: Tensor, rate: Tensor | None) -> Tensor:
        """See `turned_strains`; (B, C, 7, 3)."""
        dz, dS, grown, dh, turn = self._rates(at, dv)
        h, y = _vectors(at.z), _vectors(at.y)
        c, slope, bend, first, second, e, down, turned = torch.split(at.fades, 1, dim=-1)
        longer = (_shared(at.z) * dz).sum(dim=-1, keepdim=True)
        ds = slope * e * grown + c * down * longer
        strains = c * e * dz + ds * at.z
        raw = self.stress(strains) if rate is None else self.viscous_stress(strains, rate)
        along = (at.raw * at.z).sum(dim=-1, keepdim=True)
        across = (raw * at.z + at.raw * dz).sum(dim=-1, keepdim=True)
        less = along * c * down
        more = across * c * down + along * (slope * grown * down + c * turned * longer)
        dy = c * e * raw + ds * at.raw + _shared(more * at.z + less * dz)
        before = c * e * at.raw + less * _shared(at.z)
        own, trace = (x[..., :3].sum(dim=-1, keepdim=True) for x in (before, dy))
        most = trace * first + across * slope * e + own * second * grown
        most = most + along * (bend * e * grown + slope * down * longer)
        change = 2.0 * (own * first + along * slope * e)[..., None] * _adjugates(at.S, dS)
        dy = self._added(dy, most[..., None] * at.adjugate + change, trace)
        dT = torch.einsum("nij,bcn->bcij", self._mandel, dy[..., :6])
        torque = self._torque(at.S, dT, h, _vectors(dy))
        torque = torque + self._torque(dS, at.tensor, dh, y)
        torque = torque - _trace(dS) * at.w + small_products(dS, at.w[..., None])[..., 0]
        dw = small_products(at.inverse, torque[..., None])[..., 0]
        dT = dT + _cross_columns(turn, _without(at.tensor, at.w))
        dy_vectors = _vectors(dy) + torch.linalg.cross(turn[..., None, :], y)
        return _conjugates(at.R, dT, dw, torch.cat([dy[..., :6], dy_vectors.flatten(2)], dim=2))


def without_trace(z: Tensor) -> Tensor:
    """Strains (..., 18) whose first three numbers have no mean."""
    axial = z[..., :3] - z[..., :3].mean(dim=-1, keepdim=True)
    return torch.cat([axial, z[..., 3:]], dim=-1)


def _adjugates(A: Tensor, B: Tensor) -> Tensor:
    """Half the change of A's adjugate by B; A's own where B is A; both symmetric."""
    both = A @ B
    a, b, trace = (_trace(x)[..., None] for x in (A, B, both))
    identity = torch.eye(3, dtype=A.dtype, device=A.device)
    return 0.5 * (both + both.transpose(-1, -2) - a * B - b * A + (a * b - trace) * identity)


def _rise(t: Tensor, width: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """From 0 at t = 0 to 1 at t = 1, and its first two derivatives by ``width`` times t."""
    t = t.clamp(0.0, 1.0)
    first = 30.0 * t * t * (1.0 - t) ** 2 / width
    second = 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t) / width**2
    return t * t * t * (10.0 - 15.0 * t + 6.0 * t * t), first, second


def _measures(J: Tensor, z: Tensor, size: Tensor) -> Tensor:
    """Eight numbers (B, C, 8), see `turned_strains`, of J and the cells' strains."""
    below = J * J + 2.0
    first = 3.0 * J / (below * size) ** 2
    second = 3.0 * (2.0 - 3.0 * J * J) / (below**3 * size**5)
    q = (_shared(z) * z).sum(dim=-1, keepdim=True) / size**2
    c = _rise((J - GONE) / (FADES - GONE), (FADES - GONE) * size**3)
    e = _rise((HUGE - q) / (HUGE - LARGE), (LARGE - HUGE) * 0.5 * size**2)
    return torch.cat([*c, first, second, *e], dim=-1)


def _shared(z: Tensor) -> Tensor:
    """Z's numbers times `SHARES`."""
    return torch.cat([SHARES[0] * z[..., :6], z[..., 6:]], dim=-1)


def _trace(A: Tensor) -> Tensor:
    """(B, C, 1)."""
    return A.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None]


def _contracted(A: Tensor, B: Tensor) -> Tensor:
    """A : B, (B, C, 1)."""
    return (A * B).sum(dim=(-2, -1))[..., None]


def _stretch(H: Components) -> list[Components]:
    """R, S and (tr S - S)^-1 of H + I."""
    U, s, V = signed_svd(moved(H))
    sums = [torch.clamp(s[(a + 1) % 3] + s[(a + 2) % 3], min=KINK) for a in range(3)]

    def with_values(d: Components) -> Components:
        """V diag(d) V^T."""
        both = [[V[3 * i + a] * V[3 * j + a] for a in range(3)] for i in range(3) for j in range(3)]
        return [x * d[0] + y * d[1] + z * d[2] for x, y, z in both]

    return [product(U, transposed(V)), with_values(s), with_values([1.0 / x for x in sums])]


def _vectors(y: Tensor) -> Tensor:
    return y[..., 6:].reshape(*y.shape[:-1], 4, 3)


def _axial(A: Tensor) -> Tensor:
    """e_ijk A_jk."""
    return torch.stack(
        [
            A[..., 1, 2] - A[..., 2, 1],
            A[..., 2, 0] - A[..., 0, 2],
            A[..., 0, 1] - A[..., 1, 0],
        ],
        dim=-1,
    )


def _cross_columns(a: Tensor, A: Tensor) -> Tensor:
    """[a] A."""
    return torch.linalg.cross(a[..., None], A, dim=-2)


def _without(T: Tensor, w: Tensor) -> Tensor:
    """T - [w]."""
    identity = torch.eye(3, dtype=T.dtype, device=T.device).expand(T.shape)
    return T - _cross_columns(w, identity)


def _conjugates(R: Tensor, T: Tensor, w: Tensor, y: Tensor) -> Tensor:
    """R (T - [w]) transposed, then R y_m, (B, C, 7, 3)."""
    first = small_products(R, _without(T, w)).transpose(-1, -2)
    return torch.cat([first, small_products(_vectors(y), R.transpose(-1, -2))], dim=2)

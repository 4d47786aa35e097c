"""Energy and mass that a learned element adds to the cells of a body, see `learned`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem import turned_strains, turned_tangents
from pdcorrect.fem.assembly import Assembly
from pdcorrect.fem.cube_symmetry import PATTERNS
from pdcorrect.fem.hexahedron import VTK_CORNERS, shape_derivatives
from pdcorrect.fem.operators import freeze
from pdcorrect.fem.turned_strains import SHARES

Array = NDArray[np.float64]

_POINTS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
_STEP = 1e-4
"""Of the size, for differences of fourth order of strains."""
_NO_SHIFT = np.empty((0, 18))


class Writer(Protocol):
    """Writes corrections from the weights mu and omega of each cell, (C,), Pa."""

    digest: str

    def correction(self, mu: Array, omega: Array) -> CellCorrection:
        """Those of a body."""

    def slopes(
        self, mu: Array, omega: Array, by_matrices: Array, by_masses: Array
    ) -> tuple[Array, Array]:
        """Derivatives by both weights, from those by a correction's matrices and masses."""


@dataclass(frozen=True, eq=False)
class CellCorrection:
    """Sum over cells of 1/2 z . K z with the strains z of `turned_strains`, and mass besides.

    Attributes
    ----------
    cells : (C, 8)
    shapes : (C, 7, 8)
        What z is made of, see `cell_shapes`.
    sizes : (C,)
        m.
    matrices : (C, 18, 18)
        K, N/m.
    masses : (C, 8, 8)
        At density 1, m3; rows add up to zero.
    learned : (C,) bool
        Cells that are corrected at all.
    writer : Writer, optional
        What wrote it, from the cells' moduli.
    """

    cells: NDArray[np.int64]
    shapes: Array
    sizes: Array
    matrices: Array
    masses: Array
    learned: NDArray[np.bool_]
    writer: Writer | None = None

    def __post_init__(self) -> None:
        freeze(self.cells)

    def energy_and_forces(self, u: Array, shift: Array = _NO_SHIFT) -> tuple[float, Array]:
        """1/2 z . K z - shift . z (J) and its forces (N, 3) for displacements (N or more, 3)."""
        energy, by_cell = np.empty(len(self.cells)), np.empty((*self.cells.shape, 3))
        turned_strains.energy_and_forces(
            len(energy), u, self.cells, self.shapes, self.sizes, self.matrices, shift, energy,
            by_cell,
        )  # fmt: skip
        return float(energy.sum()), self._gathered(u, by_cell)

    def strains(self, u: Array) -> Array:
        """z, (C, 18), m."""
        out = np.empty((len(self.cells), 18))
        turned_strains.strains(len(out), u, self.cells, self.shapes, self.sizes, out)
        return out

    def tangent(
        self, u: Array, project: bool = False, shift: Array = _NO_SHIFT, cells: slice = slice(None)
    ) -> CorrectionTangent:
        """The second derivative by u.

        With ``project`` what z's own second derivatives add is left out.  What remains is
        K between the rates of z: together with the element's projected stiffness it is positive
        semi-definite near rest.
        """
        part = self if cells == slice(None) else self.of_cells(cells)
        return CorrectionTangent(part, u, project, shift)

    def stress(self, z: Array) -> Array:
        """K z, (C, 18), N, for strains (C, 18)."""
        return np.asarray((self.matrices @ z[..., None])[..., 0])

    def pulled(self, u: Array, stress: Array) -> Array:
        """Derivatives (N or more, 3) of stress . z by the displacements u, for (C, 18)."""
        without = replace(self, matrices=np.zeros_like(self.matrices))
        return without.energy_and_forces(u, stress)[1]

    def whole(self, u: Array) -> NDArray[np.bool_]:
        """Cells (C,) whose strains do not fade, see `turned_strains`."""
        v = self.shapes @ u[self.cells] / self.sizes[:, None, None]
        s = np.linalg.svd(np.eye(3) + v[:, :3], compute_uv=False)
        J = np.linalg.det(np.eye(3) + v[:, :3])
        volume = 1.5 * (J**2 - 1.0) / (J**2 + 2.0)
        E = s - s.mean(axis=1, keepdims=True) + volume[:, None] / 3.0
        squares = np.square(E).sum(axis=1), np.square(v[:, 3:]).sum(axis=(1, 2))
        q = SHARES[0] * squares[0] + SHARES[-1] * squares[1]
        return np.asarray((J >= turned_strains.FADES) & (q <= turned_strains.LARGE))

    def scaled(self, factor: float | Array) -> CellCorrection:
        """A multiple of the matrices, or one of each, (C,)."""
        factors = np.broadcast_to(factor, len(self.cells))
        return replace(self, matrices=factors[:, None, None] * self.matrices)

    def without_volume(self) -> CellCorrection:
        """The matrices on strains whose trace is taken out."""
        rows = without_trace(self.matrices)
        return replace(self, matrices=without_trace(np.swapaxes(rows, -1, -2)))

    def matrix_slopes(self, u: Array, x: Array) -> Array:
        """Derivatives (C, 18, 18) of x . dW/du by the matrices, m2, for (N or more, 3)."""
        return _symmetric_products(self.rates(u, x), self.strains(u))

    def rates(self, u: Array, x: Array) -> Array:
        """Change (C, 18) of the strains by x, by differences of fourth order."""
        step = _STEP * self.sizes.mean() / max(float(np.abs(x).max()), 1e-300)
        return difference(lambda t: self.strains(u + t * step * x)) / step

    def tangent_slopes(self, u: Array, x: Array, z: Array) -> tuple[Array, Array]:
        """Derivatives of x . K z, K the projected tangent at u: by u, and by the matrices.

        (N or more, 3) and (C, 18, 18); by differences of fourth order.
        """
        alone = replace(self, cells=np.arange(self.cells.size).reshape(self.cells.shape))
        unit = np.linalg.pinv(self.shapes)  # (C, 8, 7): displacements of one amplitude each
        u_of, x_of, z_of = (field[self.cells].reshape(-1, 3) for field in (u, x, z))
        along, across = (
            (self.shapes @ field.reshape(*self.cells.shape, 3)).reshape(-1, 21, 1)
            for field in (x_of, z_of)
        )

        def contracted(v: Array) -> Array:
            H = alone.tangent(v, project=True).matrices
            return np.asarray((np.swapaxes(along, 1, 2) @ H @ across)[:, 0, 0])

        def along_way(way: Array) -> Array:
            return difference(lambda t: contracted(u_of + t * way))

        step = _STEP * self.sizes[:, None, None]
        slopes = np.empty((len(self.cells), 7, 3))
        for a in range(7):
            for i in range(3):
                way = np.zeros((*self.cells.shape, 3))
                way[..., i] = (step * unit)[..., a]
                slopes[:, a, i] = along_way(way.reshape(-1, 3))
        by_cell = np.swapaxes(self.shapes, 1, 2) @ (slopes / step)
        return self._gathered(u, by_cell), _symmetric_products(self.rates(u, x), self.rates(u, z))

    def of_cells(self, cells: slice) -> CellCorrection:
        """Of some cells."""
        names = ("cells", "shapes", "sizes", "matrices", "masses", "learned")
        return replace(self, **{name: getattr(self, name)[cells] for name in names})

    def _gathered(self, u: Array, by_cell: Array) -> Array:
        """Summed at the nodes; zero for what else u has."""
        out = np.zeros_like(u)
        out[: self.assembly.count] = self.assembly.gathered(by_cell)
        return out

    @cached_property
    def assembly(self) -> Assembly:
        """Sums cells' values at the nodes."""
        return Assembly(self.cells, int(self.cells.max()) + 1)


def difference(function: Callable[[float], Array]) -> Array:
    """Derivative at 0 of a function of t, by central differences of fourth order, t = 1, 2."""
    return (8.0 * (function(1.0) - function(-1.0)) - (function(2.0) - function(-2.0))) / 12.0


def without_trace(z: Array) -> Array:
    """Strains (..., 18) whose first three numbers have no mean."""
    out = z.copy()
    out[..., :3] -= z[..., :3].mean(axis=-1, keepdims=True)
    return out


def _symmetric_products(a: Array, b: Array) -> Array:
    out = a[:, :, None] * b[:, None]
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


@dataclass(frozen=True, eq=False)
class CorrectionTangent:
    """The second derivative of a correction's energy at displacements ``u`` (N or more, 3), m."""

    correction: CellCorrection
    u: Array
    project: bool
    shift: Array

    def apply(self, x: Array) -> Array:
        """Times x (N or more, 3)."""
        correction = self.correction
        by_cell = np.empty((*correction.cells.shape, 3))
        turned_tangents.products(
            len(by_cell), x, correction.cells, correction.shapes, self.matrices, by_cell
        )
        return correction._gathered(x, by_cell)

    @cached_property
    def matrices(self) -> Array:
        """(C, 21, 21), N/m, by the amplitudes of the cells' shapes."""
        correction = self.correction
        out = np.empty((len(correction.cells), 21, 21))
        turned_tangents.tangents(
            len(out), self.u, correction.cells, correction.shapes, correction.sizes,
            correction.matrices, self.shift, self.project, out,
        )  # fmt: skip
        return out

    def add_to(self, blocks: Array) -> None:
        """Add the cells' matrices to blocks (C, L, L, 3, 3) of nodes, N/m."""
        turned_tangents.add_blocks(len(blocks), self.matrices, self.correction.shapes, blocks)


def cell_shapes(corners: Array) -> tuple[Array, Array]:
    """Shapes (C, 7, 8) and sizes (C,), m, of cells with these corners (C, 8, 3) at rest.

    The first three rows give the mean gradient times the size, the others the four patterns'
    amplitudes, which vanish for affine displacements (Flanagan and Belytschko 1981).
    """
    points = np.stack(np.meshgrid(*[_POINTS] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    slopes = shape_derivatives(points)
    J = np.einsum("cki,jqk->cqij", corners, slopes)
    weights = np.abs(np.linalg.det(J))
    gradients = np.einsum("jqk,cqji->ckiq", slopes, np.linalg.inv(J), optimize=True)
    volumes = weights.sum(axis=1) / len(points)
    mean = np.einsum("ckiq,cq->cik", gradients, weights) / (len(points) * volumes)[:, None, None]
    sizes = np.cbrt(volumes)
    hourglass = PATTERNS / len(VTK_CORNERS)
    offsets = np.einsum("mk,cki->cmi", hourglass, corners)
    patterns = hourglass - np.einsum("cmi,cik->cmk", offsets, mean)
    return np.concatenate([sizes[:, None, None] * mean, patterns], axis=1), sizes

"""Finite element operators from scikit-fem: the only module that imports it.

scikit-fem keeps points as (3, N) and has its own order of a hexahedron's
corners; both are converted here and nowhere else.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from skfem import Basis, BilinearForm, ElementHex1, ElementHex2, FacetBasis, MeshHex1
from skfem.element import DiscreteField, Element
from skfem.mapping import MappingIsoparametric
from skfem.quadrature import get_quadrature

from pdcorrect.fem.assembly import scatter, summed_cells
from pdcorrect.fem.hexahedron import VTK_CORNERS, VTK_NODES
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.quadrature import FaceQuadrature, Quadrature, linear_shares, mean_shares

Array = NDArray[np.float64]


class _Element(NamedTuple):
    """scikit-fem's shape functions, two orders of quadrature, and what is added to them.

    ``volume`` is the part of the deformation that the volume term sees.
    """

    shape: type[Element]
    order: int
    mass_order: int
    volume: Literal["points", "mean", "linear"] = "points"
    bubbles: bool = False


_ELEMENTS = {
    "hex8": _Element(ElementHex1, 3, 5),
    "hex8-mean": _Element(ElementHex1, 3, 5, "mean"),
    "hex8-bubble": _Element(ElementHex1, 3, 5, bubbles=True),
    "hex8-bubble-mean": _Element(ElementHex1, 3, 5, "mean", bubbles=True),
    "hex8-enhanced": _Element(ElementHex1, 3, 5, "linear", bubbles=True),
    "hex8-learned": _Element(ElementHex1, 3, 5, "linear", bubbles=True),
    "hex27": _Element(ElementHex2, 5, 7),
}


@BilinearForm
def _density_product(u, v, w):  # type: ignore[no-untyped-def]
    return w.density * u * v


class _Mapping(MappingIsoparametric):  # type: ignore[misc]
    """Keeps its inverse Jacobians (3, 3, C, Q), which a basis asks for with each function."""

    def __init__(self, mesh: MeshHex1) -> None:
        super().__init__(mesh, mesh.elem(), mesh.bndelem)
        self._last: tuple[Array, Array] | None = None

    def invDF(self, X: Array, tind: Any = None) -> Array:
        """See scikit-fem."""
        if tind is not None:
            return np.asarray(super().invDF(X, tind))
        if self._last is None or self._last[0] is not X:
            self._last = (X, np.asarray(super().invDF(X)))
        return self._last[1]

    def forget(self) -> None:
        """Free that memory."""
        self._last = None


class _Values:
    """What forms without gradients need of a `skfem.Basis`, by another quadrature."""

    def __init__(self, basis: Basis, order: int) -> None:
        self.X, weights = get_quadrature(basis.mesh.refdom, order)
        self.dx = np.abs(basis.mapping.detDF(self.X)) * weights
        self.shapes = np.stack([basis.elem.lbasis(self.X, k)[0] for k in range(basis.Nbfun)])
        fields = [DiscreteField(np.broadcast_to(v, self.dx.shape)) for v in self.shapes]
        self.basis = [(field,) for field in fields]
        self.element_dofs, self.N = basis.element_dofs, basis.N
        self.Nbfun, self.nelems = basis.Nbfun, basis.nelems

    def default_parameters(self) -> dict[str, Any]:
        """See scikit-fem: places and sizes of cells, which no form here reads."""
        return {}


def freeze(*arrays: NDArray[np.generic]) -> None:
    """Make arrays read-only; numba compiles its kernels anew for those that are not."""
    for array in arrays:
        array.flags.writeable = False


class Space:
    """A scalar finite element space on a mesh; vector fields use it three times.

    Attributes
    ----------
    positions : (N, 3)
        Rest positions of the element's nodes, m.
    cells : (C, K)
        Node numbers, VTK order.
    local : (C, L)
        Numbers of all shape functions of a cell: its nodes, then its internal
        modes, which are numbered from N on.
    internal : int
        Number of internal modes of all cells.
    """

    def __init__(self, mesh: HexMesh, element: str = "hex8") -> None:
        self._kind = _ELEMENTS[element]
        self._element = self._kind.shape()
        vtk_nodes = VTK_NODES[: self._element.doflocs.shape[0]]
        # position of each VTK node in scikit-fem's list of local nodes
        distance = np.abs(vtk_nodes[:, None] - self._element.doflocs[None]).max(axis=-1)
        self._to_vtk = distance.argmin(axis=1)
        corner = np.abs(VTK_CORNERS[:, None] - ElementHex1().doflocs[None]).max(axis=-1)
        skfem_cells = np.empty_like(mesh.cells)
        skfem_cells[:, corner.argmin(axis=1)] = mesh.cells
        self._mesh = MeshHex1(
            np.ascontiguousarray(mesh.positions.T), np.ascontiguousarray(skfem_cells.T)
        )
        self._corners = mesh.positions[mesh.cells]
        mapping = _Mapping(self._mesh)
        self._basis = Basis(self._mesh, self._element, mapping, intorder=self._kind.order)
        mapping.forget()
        self.positions: Array = np.ascontiguousarray(self._basis.doflocs.T)
        self.cells: NDArray[np.int64] = np.ascontiguousarray(
            self._basis.element_dofs[self._to_vtk].T, dtype=np.int64
        )
        self.local, self.internal = self.cells, 0
        if self._kind.bubbles:
            self.internal = 3 * len(self.cells)
            modes = len(self.positions) + np.arange(self.internal).reshape(-1, 3)
            self.local = np.concatenate([self.cells, modes], axis=1)
        freeze(self.positions, self.cells, self.local)

    def shape_functions(self, points: Array) -> Array:
        """Of a cell's nodes (n, K) at points (n, 3) of the unit cell."""
        values = [self._element.lbasis(points.T, k)[0] for k in self._to_vtk]
        return np.stack([np.broadcast_to(v, len(points)) for v in values], axis=1)

    def quadrature(self) -> Quadrature:
        """Gradients and volumes at the quadrature points."""
        local = [self._basis.basis[k][0].grad for k in self._to_vtk]  # K x (3, C, Q)
        lanes = np.ascontiguousarray(np.transpose(np.stack(local), (2, 0, 1, 3)))  # (C, K, 3, Q)
        weights = np.ascontiguousarray(self._basis.dx)
        out = Quadrature(lanes, weights, weights)
        if self._kind.bubbles:
            out = out.with_incompatible_modes(self._corners, self._basis.quadrature[0].T)
        shares = self.volume_shares()
        out = out if shares is None else out.with_volume_points(shares)
        freeze(out.lanes, out.weights, out.volume_weights)
        return out

    def volume_shares(self) -> Array | None:
        """How much stress at the volume term's own points counts at the others, (C, Q, P).

        See `Quadrature.with_volume_points`; None if it has no points of its own.
        """
        weights = self._basis.dx
        if self._kind.volume == "points":
            return None
        if self._kind.volume == "mean":
            return mean_shares(weights)
        return linear_shares(weights, self._basis.quadrature[0].T)

    def mass(self, density: Array) -> sp.csr_matrix:
        """Consistent mass, integral of density u v, (N, N), kg; ``density`` is (C,)."""
        basis = self._mass_basis
        per_point = np.broadcast_to(density[:, None], basis.dx.shape)
        return sp.csr_matrix(_density_product.assemble(basis, density=per_point))

    @cached_property
    def _mass_basis(self) -> _Values:
        return _Values(self._basis, self._kind.mass_order)

    def cell_masses(self, rule: str) -> Array:
        """Each cell's share of the mass matrix at density 1, (C, K, K), m3.

        "lumped": row sums on the diagonal; "consistent"; "averaged": their mean; "per-node": the
        volume on every node (the mean over the cells that touch it), as DiffPD.
        """
        if rule == "per-node":
            share = self.volumes()[:, None] / np.bincount(self.cells.ravel())[self.cells]
            return share[:, :, None] * np.eye(self.cells.shape[1])
        consistent = self._consistent_cell_masses
        if rule == "consistent":
            return consistent
        diagonal = consistent.sum(axis=2)[:, :, None] * np.eye(self.cells.shape[1])
        return diagonal if rule == "lumped" else 0.5 * (consistent + diagonal)

    @cached_property
    def _consistent_cell_masses(self) -> Array:
        dx, values = self._mass_basis.dx, self._mass_basis.shapes[self._to_vtk]
        masses = np.einsum("cq,kq,lq->ckl", dx, values, values, optimize=True)
        masses.flags.writeable = False
        return masses

    def volumes(self) -> Array:
        """Rest volume of each cell, (C,), m3."""
        return np.asarray(self._basis.dx.sum(axis=1))

    def body_load(self, density: Array) -> Array:
        """Nodal forces (N, 3), N, of a force density (C, Q, 3), N/m3, at the quadrature points."""
        load = np.ascontiguousarray(np.moveaxis(density, 2, 1))  # (C, 3, Q)
        dx = self._basis.dx[:, None]
        by_shape, product = [], np.empty_like(load)
        for v in self._shapes[np.argsort(self._to_vtk)]:
            np.multiply(load, v, out=product)
            product *= dx
            by_shape.append(product.sum(axis=2))  # (C, 3)
        return scatter(self._basis.element_dofs, np.stack(by_shape), len(self.positions))

    def body_load_transposed(self, nodal: Array) -> Array:
        """Derivatives of nodal . `body_load` by the force density, (C, Q, 3)."""
        return self.interpolate(nodal) * self._basis.dx[..., None]

    def interpolate_transposed(self, values: Array) -> Array:
        """Derivatives (N, 3) of values . `interpolate` by the nodal field, for (C, Q, 3)."""
        cells = np.einsum("cqi,kq->cki", values, self._shapes, optimize=True)
        return scatter(self.cells, cells, len(self.positions))

    def interpolate(self, nodal: Array) -> Array:
        """Values (C, Q, 3) at the quadrature points of a nodal field (N, 3)."""
        return np.einsum("cki,kq->cqi", nodal[self.cells], self._shapes, optimize=True)

    @cached_property
    def points(self) -> Array:
        """The quadrature points at rest, (C, Q, 3), m."""
        points = self.interpolate(self.positions)
        points.flags.writeable = False
        return points

    @cached_property
    def _shapes(self) -> Array:
        """Shape functions at the quadrature points, (K, Q)."""
        return np.stack([np.asarray(self._basis.basis[k][0])[0] for k in self._to_vtk])

    def face_quadrature(self, faces: NDArray[np.int64]) -> FaceQuadrature:
        """Quadrature on the boundary faces with corner nodes ``faces`` (n, 4)."""
        key = {tuple(f): i for i, f in enumerate(np.sort(self._mesh.facets, axis=0).T.tolist())}
        numbers = np.array([key[tuple(sorted(f))] for f in faces.tolist()], dtype=np.int64)
        near = self._mesh.translated(-self._mesh.doflocs.min(axis=1))  # inverse maps need digits
        basis = FacetBasis(near, self._element, facets=numbers, intorder=self._kind.order)
        values = [
            np.broadcast_to(np.asarray(basis.basis[k][0]), basis.dx.shape) for k in self._to_vtk
        ]
        gradients = [basis.basis[k][0].grad for k in self._to_vtk]  # K x (3, n, Qf)
        return FaceQuadrature(
            cells=np.asarray(self._mesh.f2t[0, numbers], dtype=np.int64),
            values=np.moveaxis(np.stack(values), 0, -1),
            gradients=np.transpose(np.stack(gradients), (2, 3, 0, 1)),
            weights=np.asarray(basis.dx),
            normals=np.moveaxis(np.asarray(basis.normals), 0, -1),
        )


def lumped(mass: sp.csr_matrix) -> Array:
    """Row sums of a mass matrix, (N,), kg."""
    return np.asarray(mass.sum(axis=1)).ravel()


def mass_matrix(rule: str, space: Space, density: Array) -> sp.csr_matrix:
    """Mass (N, N), kg, by one of the rules of `scene.Solver`, for densities (C,), kg/m3."""
    if rule == "consistent":
        return space.mass(density)
    blocks = density[:, None, None] * space.cell_masses(rule)
    matrix = summed_cells(space.cells, blocks, len(space.positions))
    matrix.eliminate_zeros()
    return matrix

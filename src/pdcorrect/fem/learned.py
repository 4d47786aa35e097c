"""The learned element: corrections of cells' stiffness and mass that a network writes.

A cell's displacements are 18 numbers z, see `turned_strains`: its strain (Mandel's notation) times
its size, and the amplitudes of the four patterns that are not affine, in the frame that turns
with the cell.  Its energy gains

    1/2 z^T K z,    K = C^1/2 S C^1/2,    S = 2 k N (1 + N^2)^-1,

C the cell's own stiffness of z and k < 1: the eigenvalues of S lie between -k and k, so C + K is
positive.  Mass likewise, on the seven patterns of a scalar without its mean, so that the mass of
a cell stays the same, and what a translation feels.  The symmetric matrices N come from a
network on the graph of cells, see `neighbourhood`.  Strains are corrected in cells with a held
corner only; elsewhere affine deformations stay exact.

A body on planes of symmetry (rollers) is seen with its mirror images.  A cell keeps the element
without learning where the network was not trained: off a grid, beside other partly held nodes, of
another Poisson's ratio, or beside cells of much other modulus or density.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.cell_correction import CellCorrection, cell_shapes, difference
from pdcorrect.fem.clamps import Clamps
from pdcorrect.fem.cube_symmetry import MANDEL, SCALAR_PATTERNS
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.element_network import STRAINS, Network
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.fem.neighbourhood import (
    CellGraph,
    cell_graph,
    cell_graph_slopes,
    extremes,
    mirrored_parts,
    on_grids,
)

Array = NDArray[np.float64]

BOUND = 0.8
"""k of stiffness and mass."""
STIFFEST, VOLUME = 3.0, 0.3
"""The most that counts of the stiffness to changes of volume: so many times that to shear, or what
lets it change by this share of its own."""
LARGEST_POISSON = 0.4951
_LEAST_POISSON = -1e-9
_CONTRAST, _DENSITIES, _POISSONS = 10.0, 2.0, 0.1
"""Ratios of the moduli and of the densities in reach, those of the training, and the difference of
Poisson's ratios, whose training has one a body."""
_ROUNDING = 1.0 + 1e-6
_STEP = 1e-4
"""Of the shear modulus, for differences."""


def bounded(N: Array) -> Array:
    """S (..., n, n) for symmetric N."""
    return np.asarray(2.0 * BOUND * np.linalg.solve(np.eye(N.shape[-1]) + N @ N, N))


def strain_map(shapes: Array) -> Array:
    """T (..., 18, 24) with z = T u near rest for `cell_shapes` (..., 7, 8).

    u are the corners' displacements, component i of corner k in place 3 k + i.
    """
    out = np.zeros((*shapes.shape[:-2], 18, 8, 3))
    out[..., :6, :, :] = np.einsum("...jk,nij->...nki", shapes[..., :3, :], MANDEL)
    vectors = np.einsum("...mk,ij->...mikj", shapes[..., 3:, :], np.eye(3))
    out[..., 6:, :, :] = vectors.reshape(*shapes.shape[:-2], 12, 8, 3)
    return out.reshape(*shapes.shape[:-2], 18, 24)


@lru_cache(maxsize=1)
def scalar_map() -> Array:
    """Amplitudes (7, 8) of `SCALAR_PATTERNS` of a scalar at the corners."""
    return SCALAR_PATTERNS / 8.0


def own_stiffness(cells: Array, strains: Array) -> Array:
    """C (..., 18, 18) of cells from their stiffness (..., 24, 24) and z's rows T (..., 18, 24).

    Strains and patterns do not couple; the stiffness to changes of volume is cut off.
    """
    rows = np.swapaxes(strains, -1, -2)
    fields = np.linalg.solve(strains @ rows, strains)  # displacements with one of z's numbers each
    C = fields @ cells @ np.swapaxes(fields, -1, -2)
    C[..., :6, 6:] = C[..., 6:, :6] = 0.0
    values, axes = np.linalg.eigh(C[..., :6, :6])
    most = np.maximum(STIFFEST * values[..., :1], VOLUME / BOUND * values)
    C[..., :6, :6] = (axes * np.minimum(values, most)[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return C


def own_mass(cells: Array) -> Array:
    """The same (..., 7, 7) of their mass (..., 8, 8), with the mean in equilibrium."""
    full = np.concatenate([np.ones((1, 8)), SCALAR_PATTERNS])
    M = full @ cells @ full.T
    return np.asarray(M[..., 1:, 1:] - M[..., 1:, :1] * M[..., :1, 1:] / M[..., :1, :1])


def root(matrix: Array) -> Array:
    """Symmetric square root of symmetric positive matrices (..., n, n)."""
    values, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.sqrt(values)[..., None, :]) @ np.swapaxes(axes, -1, -2))


class ElementWriter:
    """What the network writes for the cells of one body, whatever its moduli."""

    def __init__(self, network: Network, body: ElasticBody, clamps: Clamps) -> None:
        self._network, self._body = network, body
        self.digest = network.digest
        self._grid, parts = on_grids(body.positions, body.cells)
        cells = self._grid.cells
        self._images = mirrored_parts(self._grid, parts, clamps.free, clamps.still)
        self._inside: NDArray[np.bool_] = ~self._images.held[: len(cells)].max(axis=1)
        least, most = self._extremes(body.materials.density)
        self._placed: dict[str, NDArray[np.bool_]] = {
            "that are not cubes of the grid": self._grid.regular,
            "beside nodes held in some components": ~self._images.partly,
            f"in reach of densities over {_DENSITIES:g} times apart": (
                most <= _ROUNDING * _DENSITIES * least
            ),
        }
        self._shapes, self._sizes = cell_shapes(body.positions[cells])
        self._back = np.argsort(self._grid.order, axis=1)  # to the mesh's order of corners

    def correction(self, mu: Array, omega: Array) -> CellCorrection:
        """For weights (C,) of the energy's two terms, Pa."""
        young, poisson = effective_moduli(mu, omega)
        graph, learned = self._seen(young, poisson)
        count = len(learned)
        matrices, masses = np.zeros((count, STRAINS, STRAINS)), np.zeros((count, 8, 8))
        if learned.any():
            S, R = (bounded(N) for N in self._answers(graph, learned))
            stiff, heavy = self._roots(mu, omega, learned)
            matrices[learned] = stiff @ S @ stiff
            masses[learned] = np.swapaxes(heavy, 1, 2) @ R @ heavy
        back, cell = self._back, np.arange(count)[:, None, None]
        return CellCorrection(
            self._body.cells,
            np.take_along_axis(self._shapes, back[:, None], axis=2),
            self._sizes,
            matrices,
            masses[cell, back[:, :, None], back[:, None, :]],
            learned,
            self,
        )

    def slopes(
        self, mu: Array, omega: Array, by_matrices: Array, by_masses: Array
    ) -> tuple[Array, Array]:
        """Derivatives by mu and omega, each (C,), from those by K (C, 18, 18) and the masses.

        What cells have of their own is differentiated by differences, the network's answers by
        the chain rule.
        """
        young, poisson = effective_moduli(mu, omega)
        graph, learned = self._seen(young, poisson)
        nothing = np.zeros(len(learned))
        if not learned.any():
            return nothing, nothing
        order, cell = self._grid.order, np.arange(len(learned))[:, None, None]
        G, J = by_matrices[learned], by_masses[cell, order[:, :, None], order[:, None]][learned]
        N, H = self._answers(graph, learned)
        S, R = bounded(N), bounded(H)

        def own(mu: Array, omega: Array) -> Array:
            stiff, heavy = self._roots(mu, omega, learned)
            out = np.zeros(len(learned))
            out[learned] = np.einsum("cij,cij->c", G, stiff @ S @ stiff)
            out[learned] += np.einsum("cij,cij->c", J, np.swapaxes(heavy, 1, 2) @ R @ heavy)
            return out

        step = _STEP * mu
        found = [
            difference(lambda t: own(mu + t * step, omega)) / step,
            difference(lambda t: own(mu, omega + t * step)) / step,
        ]
        stiff, heavy = self._roots(mu, omega, learned)
        original, own_cells = self._images.original, np.flatnonzero(learned)
        by_N, by_H = (np.zeros((len(original), *x.shape[1:])) for x in (N, H))
        by_N[own_cells] = _bounded_transposed(N, stiff @ G @ stiff)
        by_N[: len(learned)][self._inside, :6] = by_N[: len(learned)][self._inside, :, :6] = 0.0
        by_H[own_cells] = _bounded_transposed(H, heavy @ J @ np.swapaxes(heavy, 1, 2))
        by_numbers = self._network.slopes(graph, by_N, by_H)
        by_young, by_poisson = (
            np.bincount(original, slopes, len(learned))
            for slopes in cell_graph_slopes(
                graph, young[original], poisson[original].clip(0.0), by_numbers
            )
        )
        for which, moved in enumerate(_moduli_slopes(mu, omega)):
            found[which] = found[which] + by_young * moved[0] + by_poisson * moved[1]
        return found[0], found[1]

    def unlike(self, mu: Array, omega: Array) -> dict[str, int]:
        """How many cells the network was not trained for, by what they are."""
        fits = self._fits(*effective_moduli(mu, omega))
        return {what: int((~fit).sum()) for what, fit in fits.items() if not fit.all()}

    def _fits(self, young: Array, poisson: Array) -> dict[str, NDArray[np.bool_]]:
        """Which cells are as those of the training, by what the others are."""
        soft, stiff = self._extremes(np.nan_to_num(young, nan=np.inf))
        least, most = self._extremes(np.nan_to_num(poisson).clip(0.0))
        return {
            **self._placed,
            f"of nu outside 0 to {LARGEST_POISSON:.3g}": (
                (poisson >= _LEAST_POISSON) & (poisson <= LARGEST_POISSON)
            ),
            f"in reach of moduli over {_CONTRAST:g} times apart": (
                stiff <= _ROUNDING * _CONTRAST * soft
            ),
            f"in reach of nu over {_POISSONS:g} apart": most <= least + _ROUNDING * _POISSONS,
        }

    def _extremes(self, values: Array) -> tuple[Array, Array]:
        """Least and largest of cells' values in reach of each, (C,)."""
        images = self._images
        found = extremes(images.neighbours, values[images.original], self._network.reach)
        return found[0][: len(values)], found[1][: len(values)]

    def _seen(self, young: Array, poisson: Array) -> tuple[CellGraph, NDArray[np.bool_]]:
        """What the network sees of all cells and images, and which cells it was trained for."""
        images = self._images
        learned = np.logical_and.reduce([*self._fits(young, poisson).values()])
        young = np.where(np.isfinite(young), young, 0.0)[images.original]
        poisson = np.nan_to_num(poisson).clip(0.0)[images.original]
        with np.errstate(invalid="ignore"):
            graph = cell_graph(images.neighbours, young, poisson, images.held.astype(float))
        numbers = np.nan_to_num(graph.numbers)
        return CellGraph(numbers, graph.neighbours), learned

    def _answers(self, graph: CellGraph, learned: NDArray[np.bool_]) -> tuple[Array, Array]:
        """N and H of the learned cells, strains uncorrected away from held corners."""
        N, H = (x[: len(learned)][learned] for x in self._network(graph))
        inside = self._inside[learned]
        N[inside, :6], N[inside, :, :6] = 0.0, 0.0
        return N, H

    def _roots(self, mu: Array, omega: Array, learned: NDArray[np.bool_]) -> tuple[Array, Array]:
        """C^1/2 of stiffness (c, 18, 18), and of mass by a scalar's corner values (c, 7, 8).

        Of the learned cells; like cells share the work.
        """
        body, grid = self._body, self._grid
        values = np.column_stack([mu, omega, grid.order])
        if not body.quadrature.alike_gradients:
            values = np.column_stack([values, np.arange(len(values))])
        _, first, inverse = np.unique(values, axis=0, return_index=True, return_inverse=True)
        order, rows = grid.order[first], np.arange(len(first))[:, None, None]
        pairs = rows, order[:, :, None], order[:, None, :]
        blocks = rest_stiffness(body, mu, omega, first)[pairs]
        cells = blocks.transpose(0, 1, 3, 2, 4).reshape(-1, 24, 24)
        masses = body.space.cell_masses("averaged")[first][pairs]
        stiff = root(own_stiffness(cells, strain_map(self._shapes[first])))
        which = inverse.ravel()[learned]
        return stiff[which], root(own_mass(masses))[which] @ scalar_map()


def rest_stiffness(body: ElasticBody, mu: Array, omega: Array, few: NDArray[np.int64]) -> Array:
    """Stiffness at rest of some cells, internal modes eliminated, (c, 8, 8, 3, 3), N/m."""
    materials = replace(body.materials, mu=mu, volume_weight=omega)
    plain = ElasticBody(body.mesh, body.space, body.quadrature, materials, body.cell_size)
    blocks = plain.linearise(plain.extended(plain.positions)).blocks()[few]
    return Condensed(blocks, plain.space.local[few], plain.cells.shape[1]).blocks


def _bounded_transposed(N: Array, slopes: Array) -> Array:
    """Derivatives by N of a function that has these by S = `bounded` of N."""
    size = N.shape[-1]
    inverse = np.linalg.inv(np.eye(size) + N @ N)
    B = inverse @ N
    found = inverse @ slopes - B @ slopes @ B - inverse @ slopes @ B @ N
    return np.asarray(BOUND * (found + np.swapaxes(found, -1, -2)))


def effective_moduli(mu: Array, omega: Array) -> tuple[Array, Array]:
    """Young's modulus and Poisson's ratio of the law for small strain, each (C,).

    With Lame's second parameter omega / 3, see `viscosity`; NaN where there is no shear term.
    """
    lam = omega / 3.0
    with np.errstate(invalid="ignore", divide="ignore"):
        poisson = np.where(mu > 0.0, lam / (2.0 * (lam + mu)), np.nan)
    return 2.0 * mu * (1.0 + poisson), poisson


def _moduli_slopes(mu: Array, omega: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivatives of both moduli by mu, and by omega."""
    lam = omega / 3.0
    _, poisson = effective_moduli(mu, omega)
    by_mu, by_lam = -lam / (2.0 * (lam + mu) ** 2), mu / (2.0 * (lam + mu) ** 2)
    young = 2.0 * (1.0 + poisson) + 2.0 * mu * by_mu, 2.0 * mu * by_lam / 3.0
    return (young[0], by_mu), (young[1], by_lam / 3.0)

"""The learned element: corrections of cells' stiffness and mass that a network writes.

A cell's displacements are 18 numbers z: its strain S - I (Mandel's notation) times its size, and
the amplitudes of the four patterns that are not affine, in the frame that turns with the cell.
Its energy gains

    1/2 z^T K z,    K = C^1/2 S C^1/2,    S = 2 k N (1 + N^2)^-1,

C the cell's own stiffness of z and k < 1: the eigenvalues of S lie between -k and k, so C + K is
positive.  Mass likewise, on the seven patterns of a scalar without its mean, so that the mass of
a cell stays the same, and what a translation feels.  The symmetric matrices N come from a
perceptron that sees the cell's `neighbourhood`.  Strains are corrected in cells with a held
corner only; elsewhere affine deformations stay exact.

A cell keeps the element without learning where the network was not trained: off a grid, beside
partly held nodes, of another Poisson's ratio, or beside much softer or stiffer ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import FileFormatError, FileVersionError
from pdcorrect.fem.cell_correction import CellCorrection, cell_shapes
from pdcorrect.fem.cube_symmetry import (
    MANDEL,
    SCALAR_PATTERNS,
    on_scalars,
    on_strains,
)
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.internal_modes import Condensed
from pdcorrect.fem.neighbourhood import (
    CELLS,
    SIZE,
    neighbourhood_slopes,
    neighbourhoods,
    on_grid,
    permutations,
)

Array = NDArray[np.float64]

STRAINS, SCALARS = 18, 7
BOUND = 0.6
"""k of stiffness and mass."""
STIFFEST = 3.0
"""Of the shear stiffness: the most that counts of that to changes of volume."""
MODEL = Path(__file__).parent / "hex8_learned.safetensors"
LARGEST_POISSON = 0.4951
_LEAST_POISSON = -1e-9
_CONTRAST = 0.85
"""Of 2 E'/(E + E'): how far from 1 a neighbour's may be."""
_STEP = 1e-4
"""Of the shear modulus, for differences."""
_DIGEST = 16
_DIGITS = 6
"""Of the numbers of a neighbourhood: cells that differ by less are alike."""


def bounded(xp: Any, N: Any) -> Any:
    """S (..., n, n) for symmetric N, with ``xp`` numpy or torch."""
    one = xp.eye(N.shape[-1], dtype=N.dtype) if xp is np else xp.eye(N.shape[-1]).to(N)
    return 2.0 * BOUND * xp.linalg.solve(one + N @ N, N)


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
    most = STIFFEST * values[..., :1]
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


class Network:
    """The perceptron that writes N, by NumPy, in the precision of its weights.

    Parameters
    ----------
    arrays : dict
        Weights by name, as `pdcorrect.elements.network` has them.
    digest : str
        Of their file.

    Attributes
    ----------
    digest : str
    shape : (int, int)
        Numbers of a neighbourhood, and of an answer.
    """

    def __init__(self, arrays: dict[str, NDArray[Any]], digest: str = "") -> None:
        self.digest = digest
        numbers = sorted({int(name.split(".")[1]) for name in arrays})
        self._layers = [
            (arrays[f"layers.{n}.weight"].T, arrays[f"layers.{n}.bias"]) for n in numbers
        ]
        self._type = self._layers[0][0].dtype
        self.shape = len(self._layers[0][0]), self._layers[-1][0].shape[1]

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """N (C, 18, 18) and (C, 7, 7) for neighbourhoods (C, F), averaged over the symmetries."""
        first, inverse, turns = _alike_up_to_symmetry(x)
        distinct = np.take_along_axis(x[first], permutations()[turns[first]], axis=1)
        found = self._layered(self._turned(distinct))[-1].reshape(len(first), 48, -1)
        split = halves(STRAINS).places.shape[1]
        answers = []
        for part, size in ((found[..., :split], STRAINS), (found[..., split:], SCALARS)):
            half = halves(size)
            mean = _mean(part, half)[inverse]
            turned = np.take_along_axis(mean, half.places[turns], axis=1) * half.signs[turns]
            answers.append(turned[:, half.number])
        N, H = answers
        return N, H

    def slopes(self, x: Array, by_N: Array, by_H: Array) -> Array:
        """Derivatives (C, F) of a function by the neighbourhoods, from those by N and H."""
        layered = self._layered(self._turned(x))
        parts = (_mean_transposed(part, halves(part.shape[1])) for part in (by_N, by_H))
        back = np.concatenate(list(parts), axis=2).reshape(len(layered[-1]), -1)
        for i, (weight, _) in reversed(list(enumerate(self._layers))):
            back = back @ weight.T
            if i:
                before = layered[2 * i - 1]  # the sum that went into this layer's SiLU
                share = 1.0 / (1.0 + np.exp(-before))
                back *= share * (1.0 + before * (1.0 - share))
        turned = back.reshape(len(x), 48, -1)
        out = np.zeros(x.shape)
        for g, places in enumerate(permutations()):
            out[:, places] += turned[:, g]
        return out

    def _turned(self, x: Array) -> NDArray[Any]:
        return x.astype(self._type)[:, permutations()].reshape(-1, x.shape[1])

    def _layered(self, x: NDArray[Any]) -> list[NDArray[Any]]:
        """Input, then for each layer the sum and what SiLU makes of it; the answers last."""
        out = [x]
        for weight, bias in self._layers[:-1]:
            total = out[-1] @ weight + bias
            out += [total, total / (1.0 + np.exp(-total))]
        weight, bias = self._layers[-1]
        return [*out, out[-1] @ weight + bias]


class Halves(NamedTuple):
    """Lower halves of symmetric matrices (n, n), and what they become when a cell is turned.

    Attributes
    ----------
    number : (n, n)
        Place of each entry in the lower half.
    places, signs : (48, h)
        For each symmetry, y = signs * x[places] is the half of the matrix turned back.
    """

    number: NDArray[np.int64]
    places: NDArray[np.int64]
    signs: Array


@lru_cache(maxsize=2)
def halves(size: int) -> Halves:
    """Of matrices N of stiffness (`STRAINS`) or mass (`SCALARS`)."""
    moves = on_scalars() if size == SCALARS else on_strains()
    rows, columns = np.tril_indices(size)
    number = np.zeros((size, size), dtype=np.int64)
    number[rows, columns] = number[columns, rows] = np.arange(len(rows))
    back = np.argsort(moves.places, axis=1)  # N'[i, j] = s_i s_j N[p_i, p_j] of the turned cell
    signs = np.take_along_axis(moves.signs, back, axis=1)
    places = number[back[:, rows], back[:, columns]]
    return Halves(number, places, signs[:, rows] * signs[:, columns])


@lru_cache(maxsize=1)
def _probes() -> Array:
    """Two numbers of any neighbourhood in each of the cube's 48 orientations, (F, 48, 2)."""
    numbers = np.random.default_rng(0).normal(size=(SIZE, 2))
    out = np.empty((SIZE, 48, 2))
    for g, places in enumerate(permutations()):
        out[places, g] = numbers
    return out


def _alike_up_to_symmetry(
    x: Array,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Cells that stand for others, and for each cell its number among them, (C,).

    And the symmetry g for which x[permutations()[g]] is the same for all that are alike, (C,).
    """
    probed = np.tensordot(x, _probes(), axes=1)  # (C, 48, 2)
    lowest = probed[..., 0].argmin(axis=1)
    key = np.take_along_axis(probed, lowest[:, None, None], axis=1)[:, 0].round(_DIGITS)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel(), lowest


def _mean(lower: NDArray[Any], half: Halves) -> Array:
    """The mean (C, h) of lower halves (C, 48, h), turned back."""
    total = np.zeros((len(lower), lower.shape[2]))
    for g, (places, signs) in enumerate(zip(half.places, half.signs, strict=True)):
        total += lower[:, g, places] * signs
    return total / 48.0


def _mean_transposed(slopes: Array, half: Halves) -> Array:
    """Derivatives (C, 48, h) by the lower halves, from those (C, n, n) by the mean."""
    count = len(slopes)
    lower = np.zeros((count, half.places.shape[1]))
    for entry, place in enumerate(half.number.ravel()):
        lower[:, place] += slopes.reshape(count, -1)[:, entry]
    out = np.zeros((count, *half.places.shape))
    for g, (places, signs) in enumerate(zip(half.places, half.signs, strict=True)):
        out[:, g, places] = lower * signs / 48.0
    return out


@lru_cache(maxsize=1)
def released() -> Network:
    """The network that comes with the package.

    Raises
    ------
    FileFormatError, FileVersionError
        See `read_network`.
    """
    return read_network(MODEL)


def read_network(path: Path) -> Network:
    """A network from a file of weights.

    Raises
    ------
    FileFormatError
        If the file is missing or damaged.
    FileVersionError
        If the network sees other neighbourhoods, or answers otherwise.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        content = path.read_bytes()
        network = Network(load(content), hashlib.sha256(content).hexdigest()[:_DIGEST])
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as error:
        raise FileFormatError(
            f"{path}: no weights of a learned element ({error}): expected a file as `pdcorrect "
            "train-element` writes it. Install the package again for its own."
        ) from None
    expected = SIZE, sum(halves(n).places.shape[1] for n in (STRAINS, SCALARS))
    if network.shape != expected:
        raise FileVersionError(
            f"{path}: from {network.shape[0]} to {network.shape[1]} numbers: expected "
            f"{expected[0]} and {expected[1]}, those of this version's learned element."
        )
    return network


class ElementWriter:
    """What the network writes for the cells of one body, whatever its moduli.

    Parameters
    ----------
    network : Network
    body : ElasticBody
        Of an element with 8 nodes.
    free : (N, 3)
        Components that may move.
    """

    def __init__(self, network: Network, body: ElasticBody, free: NDArray[np.bool_]) -> None:
        self._network, self._body = network, body
        self.digest = network.digest
        self._grid = on_grid(body.positions, body.cells)
        held: NDArray[np.bool_] = ~free.max(axis=1)
        some: NDArray[np.bool_] = ~free.min(axis=1)
        cells = self._grid.cells
        self._held = held[cells].astype(float)
        self._inside = self._held.max(axis=1) == 0.0
        partly: NDArray[np.bool_] = (some & ~held)[cells].max(axis=1)
        self._fits: NDArray[np.bool_] = self._grid.regular & ~partly
        self._shapes, self._sizes = cell_shapes(body.positions[cells])
        self._back = np.argsort(self._grid.order, axis=1)  # to the mesh's order of corners

    def correction(self, mu: Array, omega: Array) -> CellCorrection:
        """For weights (C,) of the energy's two terms, Pa."""
        young, poisson = effective_moduli(mu, omega)
        x, learned = self._neighbourhoods(young, poisson)
        count = len(x)
        matrices, masses = np.zeros((count, STRAINS, STRAINS)), np.zeros((count, 8, 8))
        if learned.any():
            S, R = self._shares(x[learned], learned)
            stiff, heavy = self._roots(mu, omega)
            stiff, heavy = stiff[learned], heavy[learned] @ scalar_map()
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
        self, mu: Array, omega: Array, by_matrices: Array | None, by_masses: Array | None
    ) -> tuple[Array, Array]:
        """Derivatives by mu and omega, each (C,), from those by K (C, 18, 18) and the masses.

        Those that are None are zero.

        What cells have of their own is differentiated by differences of fourth order, the
        network's answers by the chain rule.
        """
        young, poisson = effective_moduli(mu, omega)
        x, learned = self._neighbourhoods(young, poisson)
        nothing = np.zeros(len(x))
        if not learned.any():
            return nothing, nothing
        G, J = self._in_order(by_matrices, by_masses, learned)
        N, H = self._answers(x[learned], learned)
        S, R = bounded(np, N), bounded(np, H)

        def own(mu: Array, omega: Array) -> Array:
            stiff, heavy = self._roots(mu, omega)
            stiff, heavy = stiff[learned], heavy[learned] @ scalar_map()
            out = np.zeros(len(x))
            out[learned] = np.einsum("cij,cij->c", G, stiff @ S @ stiff)
            out[learned] += np.einsum("cij,cij->c", J, np.swapaxes(heavy, 1, 2) @ R @ heavy)
            return out

        step = _STEP * mu
        found = [
            _difference(lambda t: own(mu + t * step, omega)) / step,
            _difference(lambda t: own(mu, omega + t * step)) / step,
        ]
        stiff, heavy = self._roots(mu, omega)
        stiff, heavy = stiff[learned], heavy[learned] @ scalar_map()
        by_N = _bounded_transposed(N, stiff @ G @ stiff)
        by_N[self._inside[learned], :6] = by_N[self._inside[learned], :, :6] = 0.0
        by_H = _bounded_transposed(H, heavy @ J @ np.swapaxes(heavy, 1, 2))
        by_x = np.zeros(x.shape)
        by_x[learned] = self._network.slopes(x[learned], by_N, by_H)
        by_young, by_poisson = neighbourhood_slopes(
            self._grid.place, young, poisson.clip(0.0), by_x
        )
        for which, moved in enumerate(_moduli_slopes(mu, omega)):
            found[which] = found[which] + by_young * moved[0] + by_poisson * moved[1]
        return found[0], found[1]

    def _in_order(
        self, by_matrices: Array | None, by_masses: Array | None, learned: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Those of the learned cells, with corners in the grid's order."""
        order, count = self._grid.order, len(learned)
        if by_matrices is None:
            by_matrices = np.zeros((count, STRAINS, STRAINS))
        if by_masses is None:
            by_masses = np.zeros((count, 8, 8))
        cell = np.arange(count)[:, None, None]
        by_masses = by_masses[cell, order[:, :, None], order[:, None, :]]
        return by_matrices[learned], by_masses[learned]

    def _neighbourhoods(self, young: Array, poisson: Array) -> tuple[Array, NDArray[np.bool_]]:
        """What the network sees of all cells, and which it was trained for."""
        learned = self._fits & (poisson >= _LEAST_POISSON) & (poisson <= LARGEST_POISSON)
        x = neighbourhoods(self._grid.place, young, poisson.clip(0.0), self._held)
        window = x[:, : CELLS**3]
        alike = np.abs(window - 1.0) <= _CONTRAST
        return x, np.asarray(learned & (alike | (window == 0.0)).all(axis=1))

    def _answers(self, x: Array, learned: NDArray[np.bool_]) -> tuple[Array, Array]:
        """N and H of the learned cells, strains uncorrected away from held corners."""
        N, H = self._network(x)
        inside = self._inside[learned]
        N[inside, :6], N[inside, :, :6] = 0.0, 0.0
        return N, H

    def _shares(self, x: Array, learned: NDArray[np.bool_]) -> tuple[Array, Array]:
        N, H = self._answers(x, learned)
        return bounded(np, N), bounded(np, H)

    def _roots(self, mu: Array, omega: Array) -> tuple[Array, Array]:
        """C^1/2 of stiffness (C, 18, 18) and of mass (C, 7, 7); like cells share the work."""
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
        return stiff[inverse.ravel()], root(own_mass(masses))[inverse.ravel()]


def rest_stiffness(body: ElasticBody, mu: Array, omega: Array, few: NDArray[np.int64]) -> Array:
    """Stiffness at rest of some cells, internal modes eliminated, (c, 8, 8, 3, 3), N/m."""
    materials = replace(body.materials, mu=mu, volume_weight=omega)
    plain = ElasticBody(body.mesh, body.space, body.quadrature, materials, body.cell_size)
    blocks = plain.linearise(plain.extended(plain.positions)).blocks()[few]
    if not plain.space.internal:
        return blocks
    return Condensed(blocks, plain.space.local[few], plain.cells.shape[1]).blocks


def _difference(function: Callable[[float], Array]) -> Array:
    """Derivative at 0 by central differences of fourth order."""
    return (8.0 * (function(1.0) - function(-1.0)) - (function(2.0) - function(-2.0))) / 12.0


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

"""The perceptron that writes the learned element's matrices, by NumPy, and its file."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import FileFormatError, FileVersionError
from pdcorrect.fem.cube_symmetry import on_scalars, on_strains
from pdcorrect.fem.neighbourhood import SIZE, permutations

Array = NDArray[np.float64]

STRAINS, SCALARS = 18, 7
"""Rows of the matrices of stiffness and of mass."""
MODEL = Path(__file__).parent / "hex8_learned.safetensors"
_DIGEST = 16
_DIGITS = 6
"""Of two random sums over a neighbourhood: cells that differ by less are alike."""


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

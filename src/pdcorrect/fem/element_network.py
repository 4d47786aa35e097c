"""The graph network that writes the learned element's matrices, by NumPy, and its file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pdcorrect._files import write_bytes
from pdcorrect.errors import FileFormatError, FileVersionError
from pdcorrect.fem.cube_symmetry import on_scalars, on_strains
from pdcorrect.fem.neighbourhood import NEIGHBOURS, SIZE, CellGraph, permutations

Array = NDArray[np.float64]

STRAINS, SCALARS = 18, 7
"""Rows of the matrices of stiffness and of mass."""
KIND = {"element": "hex8-learned 1"}
"""In every file of weights: what cells' numbers and the network's answers mean."""
MODEL = Path(__file__).parent / "hex8_learned.safetensors"
EPSILON = 1e-6
"""Of the mean square that features are divided by."""
_DIGEST = 16
_DIGITS = 1e6
"""Numbers of cells that differ by less than its inverse are alike."""
_ROWS = 4096
"""Of a convolution at a time."""


class Network:
    """The graph network that writes N, by NumPy, in the precision of its weights or single.

    Its weights have the names of `pdcorrect.elements.network`.

    ``digest`` is that of their file, ``shape`` the numbers of a cell and of an answer, ``reach``
    how many cells away an answer depends on, along each axis.
    """

    def __init__(self, arrays: dict[str, NDArray[Any]], digest: str = "") -> None:
        self.digest = digest
        arrays = {
            k: a.astype(np.float32) if a.dtype == np.float16 else a for k, a in arrays.items()
        }
        self._first, self._hidden, self._last = (
            _Linear(arrays[f"{name}.weight"], arrays[f"{name}.bias"])
            for name in ("first", "hidden", "last")
        )
        count = sum(name.startswith("norms.") for name in arrays)
        self._rounds = [
            (
                _Linear(arrays[f"rounds.{n}.weight"], arrays[f"rounds.{n}.bias"]),
                arrays[f"norms.{n}.weight"],
            )
            for n in range(count)
        ]
        self._type = self._first.weight.dtype
        self.shape = len(self._first.weight), self._last.weight.shape[1]
        self.reach = count + 1

    def __call__(self, graph: CellGraph) -> tuple[Array, Array]:
        """N (C, 18, 18) and (C, 7, 7), averaged over the symmetries.

        Cells in one of the 48 orientations that look alike as far as a round sees have the same
        features, which are evaluated once.
        """
        own, around = permutations()
        whole = np.round(_DIGITS * graph.numbers).astype(np.int64).astype(np.uint64)
        keys = _hashed(whole[:, places] for places in own)
        _, seen, kind = np.unique(keys, return_index=True, return_inverse=True)
        turn, cell = np.divmod(seen, len(graph.numbers))
        x = graph.numbers.astype(self._type)[cell[:, None], own[turn]]
        features = first = _silu(self._first(x))
        for convolution, scale in self._rounds:
            before = np.append(kind.reshape(48, -1), np.full((48, 1), len(features)), axis=1)
            pairs = zip(before, around, strict=True)
            keys = _hashed(kinds[graph.neighbours[:, places]] for kinds, places in pairs)
            _, seen, kind = np.unique(keys, return_index=True, return_inverse=True)
            turn, cell = np.divmod(seen, len(graph.numbers))
            table = before[turn[:, None], graph.neighbours[cell[:, None], around[turn]]]
            itself = before[turn, cell]
            normed = np.append(_normed(features) * scale, np.zeros_like(features[:1]), axis=0)
            sums = [
                convolution(normed[table[i : i + _ROWS]].reshape(len(table[i : i + _ROWS]), -1))
                for i in range(0, len(table), _ROWS)
            ]
            features = features[itself] + _silu(np.concatenate(sums))
            first = first[itself]
        found = self._last(_silu(self._hidden(np.concatenate([features, first], axis=1))))
        kinds, split = kind.reshape(48, -1), halves(STRAINS).places.shape[1]
        N, H = (
            _mean((part[row] for row in kinds), halves(size))[:, halves(size).number]
            for part, size in ((found[:, :split], STRAINS), (found[:, split:], SCALARS))
        )
        return N, H

    def slopes(self, graph: CellGraph, by_N: Array, by_H: Array) -> Array:
        """Derivatives (C, 37) of a function by the graph's numbers, from those by N and H."""
        back = np.concatenate(
            [_mean_transposed(part, halves(part.shape[1])) for part in (by_N, by_H)], axis=2
        )
        own, around = permutations()
        count = len(graph.numbers)
        out = np.zeros((count, SIZE))
        for g in range(48):
            table = graph.neighbours[:, around[g]]
            source = sp.csr_matrix(
                (np.ones(table.size), (np.arange(table.size), table.ravel())),
                shape=(table.size, count + 1),
            )[:, :count]
            out[:, own[g]] += self._turned_slopes(graph.numbers[:, own[g]], source, back[g])
        return out

    def _turned_slopes(self, x: Array, source: sp.csr_matrix, back: Array) -> Array:
        """The same in one orientation; ``source`` (27 C, C) takes each cell's neighbours."""
        count = len(x)
        sums: list[Array] = [self._first(x)]
        features = first = _silu(sums[0])
        stages = [features]
        for convolution, scale in self._rounds:
            normed = _normed(features) * scale
            sums.append(convolution((source @ normed).reshape(count, -1)))
            features = features + _silu(sums[-1])
            stages.append(features)
        hidden = self._hidden(np.concatenate([features, first], axis=1))
        slopes = (back @ self._last.weight.T) * _silu_slope(hidden) @ self._hidden.weight.T
        slopes, by_first = np.split(slopes, 2, axis=1)
        for n, (convolution, scale) in reversed(list(enumerate(self._rounds))):
            messages = (slopes * _silu_slope(sums[n + 1])) @ convolution.weight.T
            by_normed = (source.T @ messages.reshape(-1, features.shape[1])) * scale
            slopes = slopes + _normed_transposed(stages[n], by_normed)
        return np.asarray(((slopes + by_first) * _silu_slope(sums[0])) @ self._first.weight.T)


class _Linear:
    """x W + b, for W^T (outputs, inputs) as torch keeps it."""

    def __init__(self, weight: NDArray[Any], bias: NDArray[Any]) -> None:
        self.weight, self._bias = weight.T, bias

    def __call__(self, x: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(x @ self.weight + self._bias)


def _silu(x: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(x / (1.0 + np.exp(-x)))


def _silu_slope(x: NDArray[Any]) -> NDArray[Any]:
    share = 1.0 / (1.0 + np.exp(-x))
    return np.asarray(share * (1.0 + x * (1.0 - share)))


def _normed(x: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(x / np.sqrt((x * x).mean(axis=1, keepdims=True) + EPSILON))


def _normed_transposed(x: Array, slopes: Array) -> Array:
    size = np.sqrt((x * x).mean(axis=1, keepdims=True) + EPSILON)
    along = (x * slopes).mean(axis=1, keepdims=True)
    return np.asarray(slopes / size - x * along / size**3)


def _hashed(turned: Iterable[NDArray[Any]]) -> NDArray[np.uint64]:
    """A number for each row of whole numbers (C, F) of the 48 orientations, (48 C,).

    Rows alike have the same; two others out of n do by chance with n^2 / 2^65.
    """
    out = []
    for rows in turned:
        factors = np.random.default_rng(0).integers(1, 2**63, size=rows.shape[1], dtype=np.uint64)
        mixed = rows.astype(np.uint64) + np.uint64(1)
        mixed = (mixed ^ (mixed << np.uint64(13))) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
        out.append((mixed * (factors | np.uint64(1))).sum(axis=1, dtype=np.uint64))
    return np.concatenate(out)


class Halves(NamedTuple):
    """Lower halves of symmetric matrices: the number (n, n) of each entry in the half.

    For each of the 48 symmetries, y = signs * x[places] is the half of the matrix turned back.
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


def _mean(lower: Iterable[NDArray[Any]], half: Halves) -> Array:
    """The mean (C, h) of lower halves (C, h) of the 48 orientations, turned back."""
    halves = zip(lower, half.places, half.signs, strict=True)
    return np.asarray(sum(turned[:, places] * signs for turned, places, signs in halves) / 48.0)


def _mean_transposed(slopes: Array, half: Halves) -> Array:
    """Derivatives (48, C, h) by the lower halves, from those (C, n, n) by the mean."""
    count = len(slopes)
    lower = np.zeros((count, half.places.shape[1]))
    for entry, place in enumerate(half.number.ravel()):
        lower[:, place] += slopes.reshape(count, -1)[:, entry]
    out = np.zeros((48, *lower.shape))
    for turned, places, signs in zip(out, half.places, half.signs, strict=True):
        turned[:, places] = lower * signs / 48.0
    return out


@lru_cache(maxsize=1)
def released() -> Network:
    """The network that comes with the package."""
    return read_network(MODEL)


def read_network(path: Path) -> Network:
    """A network from a file of weights.

    Raises
    ------
    FileFormatError
        If the file is missing or damaged, or has other sizes.
    FileVersionError
        If it is of another version of the element.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(
            f"{path}: weights cannot be read ({error.strerror or error})."
        ) from None
    told = (
        f"{path}: no weights of a learned element, or damaged: expected a file as `pdcorrect "
        "tune-element` or `train-element` writes it."
    )
    try:
        arrays = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    except (SafetensorError, ValueError):
        raise FileFormatError(told) from None
    if (kind := header.get("__metadata__")) != KIND:
        raise FileVersionError(f"{path}: weights of {kind}: expected {KIND}: train or tune again.")
    if not all(np.isfinite(x).all() for x in arrays.values()):
        raise FileFormatError(f"{path}: weights that are not finite.")
    expected = SIZE, sum(halves(n).places.shape[1] for n in (STRAINS, SCALARS))
    try:
        network = Network(arrays, hashlib.sha256(content).hexdigest()[:_DIGEST])
        if network.shape == expected:  # one cell alone, for the sizes in between
            network(CellGraph(np.zeros((1, SIZE)), np.ones((1, NEIGHBOURS), dtype=np.int64)))
            return network
    except (KeyError, IndexError, ValueError):
        pass
    raise FileFormatError(told)


def write_network(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write weights by name, as `pdcorrect.elements.network` has them."""
    from safetensors.numpy import save

    write_bytes(path, save(dict(arrays), metadata=KIND))

"""The 48 symmetries of the cube, and how what belongs to a cubic cell changes under them.

A symmetry g is a signed permutation of the axes.  Displacements of a cell's corners are a
translation, a gradient and the four patterns of `PATTERNS` that no gradient has; all of these
change by signed permutations, so averages over the group are exact and cheap.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.hexahedron import VTK_CORNERS

Array = NDArray[np.float64]

SIGNS = 2.0 * VTK_CORNERS - 1.0
"""Of the corners, (8, 3): the cell's coordinates xi, eta, zeta from -1 to 1."""
_XI, _ETA, _ZETA = SIGNS.T
PATTERNS = np.stack([_ETA * _ZETA, _ZETA * _XI, _XI * _ETA, _XI * _ETA * _ZETA])
"""Of corner displacements that are not affine, (4, 8): hourglass modes."""
SCALAR_PATTERNS = np.concatenate([SIGNS.T, PATTERNS])
"""Of a scalar at the corners, without its mean, (7, 8)."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))
"""Entries of a symmetric tensor in Mandel's notation, in which the last three count root 2."""
MANDEL = np.zeros((6, 3, 3))
"""Orthonormal basis of symmetric tensors, (6, 3, 3)."""
for _n, (_i, _j) in enumerate(_PAIRS):
    MANDEL[_n, _i, _j] = MANDEL[_n, _j, _i] = 1.0 if _i == _j else np.sqrt(0.5)


class SignedPermutations(NamedTuple):
    """For each symmetry, y = signs * x[places]; both (48, n)."""

    places: NDArray[np.int64]
    signs: Array

    @classmethod
    def of(cls, matrices: Array) -> SignedPermutations:
        """Of orthogonal matrices (48, n, n) with one entry a row."""
        places = np.abs(matrices).argmax(axis=2)
        return cls(places, np.round(np.take_along_axis(matrices, places[..., None], 2)[..., 0]))


@lru_cache(maxsize=1)
def group() -> Array:
    """The symmetries as matrices, (48, 3, 3)."""
    out = np.zeros((48, 3, 3))
    choices = product(permutations(range(3)), product((1.0, -1.0), repeat=3))
    for matrix, (axes, signs) in zip(out, choices, strict=True):
        matrix[range(3), axes] = signs
    return out


@lru_cache(maxsize=1)
def on_strains() -> SignedPermutations:
    """On the 18 numbers z of a cell: strain in Mandel's notation, then patterns, axis by axis."""
    g = group()
    strain = np.einsum("nij,gik,gjl,mkl->gnm", MANDEL, g, g, MANDEL)
    pattern = _on_patterns(PATTERNS)
    vectors = np.einsum("gmn,gij->gminj", pattern, g).reshape(48, 12, 12)
    out = np.zeros((48, 18, 18))
    out[:, :6, :6], out[:, 6:, 6:] = strain, vectors
    return SignedPermutations.of(out)


@lru_cache(maxsize=1)
def on_scalars() -> SignedPermutations:
    """On amplitudes of the 7 `SCALAR_PATTERNS`."""
    return SignedPermutations.of(_on_patterns(SCALAR_PATTERNS))


@lru_cache(maxsize=8)
def on_window(width: int) -> NDArray[np.int64]:
    """Places (48, width^3) with y = x[places] for a cubic window of numbers about the cell."""
    middle = (width - 1) / 2.0
    offsets = np.stack(np.unravel_index(np.arange(width**3), (width,) * 3), axis=1) - middle
    before = np.einsum("gji,nj->gni", group(), offsets) + middle  # g^T offset
    index = np.round(before).astype(np.int64)
    return np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), (width,) * 3)


def _on_patterns(patterns: Array) -> Array:
    """Matrices (48, n, n) that patterns' amplitudes change by."""
    moved = np.einsum("gij,kj->gki", group(), SIGNS)  # where corner k goes
    corner = (np.abs(moved[:, :, None] - SIGNS).sum(axis=3) < 0.5).argmax(axis=2)  # (48, 8)
    return np.einsum("mgk,nk->gmn", patterns[:, corner], patterns) / 8.0

"""Force fields and area changes at points, with their derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ON_AXIS = 1e-9
"""Distance from the axis, of the body's extent, that is taken as zero."""


def torsion_field(points: Array, attraction: float, stretch: float) -> Array:
    """Unit rotational field of the thesis, eq. 6-1 to 6-3, at ``points`` (..., 3).

    f = (stretch, -z - attraction y, y - attraction z) / |...|, and 0 where the
    numerator vanishes (on the axis with no stretch) or is only a rounding error
    of the coordinates.
    """
    f, length = _torsion_vectors(points, attraction, stretch)
    return np.divide(f, length, out=np.zeros_like(f), where=length > 0.0)


def torsion_pull(points: Array, attraction: float, stretch: float, x: Array) -> Array:
    """Derivatives of x . `torsion_field` by the points (..., 3); zero where the field is."""
    f, length = _torsion_vectors(points, attraction, stretch)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0.0)
    f = f * inverse
    rest = (x - f * (f * x).sum(axis=-1, keepdims=True)) * inverse  # d|f|^-1 f
    out = np.zeros_like(points)
    out[..., 1] = rest[..., 2] - attraction * rest[..., 1]
    out[..., 2] = -rest[..., 1] - attraction * rest[..., 2]
    return out


def _torsion_vectors(points: Array, attraction: float, stretch: float) -> tuple[Array, Array]:
    """The field before it is scaled, and its lengths (..., 1), 0 where it is only round-off."""
    y, z = points[..., 1], points[..., 2]
    f = np.stack([np.full_like(y, stretch), -z - attraction * y, y - attraction * z], axis=-1)
    length = np.linalg.norm(f, axis=-1, keepdims=True)
    rounding = _ON_AXIS * np.abs(points).max(initial=0.0)
    return f, np.where(length > rounding, length, 0.0)


def cofactor(F: Array) -> Array:
    """Cofactor matrix det(F) F^-T of (..., 3, 3), also for singular F."""
    rows = [np.cross(F[..., (i + 1) % 3, :], F[..., (i + 2) % 3, :]) for i in range(3)]
    return np.stack(rows, axis=-2)


def tensor_cross(A: Array, B: Array) -> Array:
    """Derivative of `cofactor` at A in the direction B, (..., 3, 3); symmetric in both."""
    rows = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows.append(np.cross(A[..., j, :], B[..., k, :]) + np.cross(B[..., j, :], A[..., k, :]))
    return np.stack(rows, axis=-2)

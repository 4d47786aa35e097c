"""Checks of arrays that come from elsewhere; messages name the array and the place in it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.hexahedron import gauss_points, jacobians, shortest_edges
from pdcorrect.fem.mesh import HexMesh

Array = NDArray[Any]

_AT_REST = 1e-6
"""Of a cell's shortest edge: how far frame 0 may be from the rest shape."""


def finite_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Values as float64, if they have a shape and are finite."""
    try:
        array = np.ascontiguousarray(values, dtype=np.float64).reshape(np.shape(values))
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected numbers of shape {shape}.") from None
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}: expected {shape}.")
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InputError(f"{name}: not finite at {place}: expected finite numbers.")
    return array


def optional_array(
    name: str, values: ArrayLike | None, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """The same where there are values."""
    return None if values is None else finite_array(name, values, shape)


def per_cell(name: str, values: ArrayLike, count: int) -> NDArray[np.float64]:
    """One value for each cell, (C,), of one for all or of as many."""
    if np.ndim(values) == 0:
        return np.full(count, finite_array(name, values, ()))
    return finite_array(name, values, (count,))


def check_moduli(moduli: dict[str, Array], time_step: float) -> None:
    """Refuse materials and time steps out of their ranges."""
    for name in ("young", "density"):
        if (moduli[name] <= 0).any():
            raise InputError(f"{name}: {moduli[name].min():g}: expected more than 0 in every cell.")
    ratio = moduli["poisson"]
    if (ratio < 0).any() or (ratio >= 0.5).any():
        raise InputError("poisson: expected 0 or more and less than 0.5 in every cell.")
    if not (np.isfinite(time_step) and time_step > 0):
        raise InputError(f"time_step = {time_step}: expected more than 0 s.")


def check_rest(where: str, positions: Array, mesh: HexMesh) -> None:
    """Refuse positions (N, 3) that are not the rest shape."""
    away = np.linalg.norm(positions - mesh.positions, axis=1)
    node = int(np.argmax(away))
    if away[node] > _AT_REST * shortest_edges(mesh.positions, mesh.cells).min():
        raise InputError(
            f"{where}: in frame 0 node {node} is {away[node]:.3g} m away from its rest position: "
            "expected the rest shape (starts_at_rest=False allows another)."
        )


def check_volumes(where: str, positions: Array, mesh: HexMesh) -> None:
    """Refuse cells with det F <= 0 at a point of the 2 x 2 x 2 Gauss rule."""
    points = gauss_points(2)
    rest = jacobians(mesh.positions, mesh.cells, points)
    for frame, now in enumerate(positions):
        ratios = jacobians(now, mesh.cells, points) / rest
        if ratios.min() <= 0:
            cell = int(np.argmin(ratios.min(axis=1)))
            raise InputError(
                f"{where}: in frame {frame} cell {cell} is inverted (det F = "
                f"{ratios[cell].min():.3g}): expected det F > 0."
            )

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
"""Of a cell's shortest edge: how far what rests may be from the rest shape."""
_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Of the largest coordinate: the same, of positions that were stored as float32."""


def real_array(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Values as float64, if they are real numbers."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an array of real numbers.") from None
    if array.dtype.kind not in "biuf":
        raise InputError(f"{name}: {array.dtype}: expected real numbers.")
    return np.asarray(array, dtype=np.float64, order="C")


def finite_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Values as float64, if they have a shape and are finite."""
    array = real_array(name, values)
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}: expected {shape}.")
    if not np.isfinite(array).all():
        place = f" at {np.argwhere(~np.isfinite(array))[0].tolist()}" if shape else ""
        raise InputError(f"{name}: not finite{place}: expected finite numbers.")
    return array


def optional_array(
    name: str, values: ArrayLike | None, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """The same where there are values."""
    return None if values is None else finite_array(name, values, shape)


def integer_array(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Values as int64, if they are whole numbers, of whatever type."""
    array = real_array(name, values)
    whole = np.isfinite(array) & (array == np.round(array))
    if not whole.all():
        place = tuple(np.argwhere(~whole)[0].tolist())
        raise InputError(f"{name}: {array[place]:g} at {list(place)}: expected whole numbers.")
    return array.astype(np.int64)


def bool_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Values as bool, if they are that, or integers 0 and 1, and have a shape."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected bool of shape {shape}.") from None
    if array.shape != shape or array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise InputError(
            f"{name}: {array.dtype} of shape {array.shape}: expected bool, or integers 0 and 1, "
            f"of shape {shape}."
        )
    return array.astype(np.bool_)


def per_cell(name: str, values: ArrayLike, count: int) -> NDArray[np.float64]:
    """One value for each cell, (C,), of one for all or of as many."""
    array = real_array(name, values)
    if array.ndim == 0:
        return np.full(count, finite_array(name, array, ()))
    return finite_array(name, array, (count,))


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


def from_rest(where: str, positions: Array, mesh: HexMesh) -> Array:
    """Positions (T+1, N, 3) with exactly the rest shape in frame 0; refuse another there."""
    away = np.linalg.norm(positions[0] - mesh.positions, axis=1)
    node = int(np.argmax(away))
    if away[node] > _tolerance(mesh):
        raise InputError(
            f"{where}: in frame 0 node {node} is {away[node]:.3g} m away from its rest position: "
            "expected the rest shape."
        )
    return np.concatenate([mesh.positions[None], positions[1:]])


def with_held_nodes(where: str, positions: Array, mesh: HexMesh, free: Array) -> Array:
    """Positions (T, N, 3) with held components exactly at rest; refuse those that move."""
    away = np.where(free, 0.0, np.abs(positions - mesh.positions))
    frame, node, axis = (int(i) for i in np.unravel_index(np.argmax(away), away.shape))
    if away[frame, node, axis] > _tolerance(mesh):
        raise InputError(
            f"{where}[{frame}]: node {node} is held in {'xyz'[axis]} and "
            f"{away[frame, node, axis]:.3g} m away from its rest position: expected held "
            "components to stay there; clamps that move are not supported."
        )
    return np.where(free, positions, mesh.positions)


def _tolerance(mesh: HexMesh) -> float:
    """How far from the rest shape what rests may be, m."""
    shortest = shortest_edges(mesh.positions, mesh.cells).min()
    return float(_AT_REST * shortest + _ROUNDING * np.abs(mesh.positions).max())


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

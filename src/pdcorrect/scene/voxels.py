"""Voxel bodies: which cells of a regular grid are solid.

Each function returns a boolean occupancy array (nx, ny, nz) and the grid index
of the cell whose lowest corner lies at the origin, so that a shape may extend
to negative coordinates.  `cross` and `weight` follow figures 6.1 and 6.2 of the
thesis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import SceneError

_MOST_CELLS = 10**8

Occupancy = tuple[NDArray[np.bool_], tuple[int, int, int]]


def _grid(cells: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Empty grid, if it is of a size that can be meant."""
    if math.prod(cells) > _MOST_CELLS:
        raise SceneError(
            f"body: a grid of {cells[0]} x {cells[1]} x {cells[2]} cells: expected at most "
            f"{_MOST_CELLS:.0e} in all."
        )
    return np.zeros(cells, dtype=bool)


def beam(cells: tuple[int, int, int]) -> Occupancy:
    """Solid block of ``cells`` cells with one corner at the origin."""
    return _grid(cells) | True, (0, 0, 0)


def cross(
    cells: tuple[int, int, int], arms: int, arm_start: int, arm_width: int, arm_length: int
) -> Occupancy:
    """Beam along x with symmetric perpendicular branches (fig. 6.1).

    Parameters
    ----------
    cells : tuple of int
        Cells of the central beam along x, y, z; its corner is the origin.
    arms : {2, 4}
        2: branches along +z and -z; 4: along +y and -y as well.
    arm_start, arm_width : int
        The branches cover the cells ``arm_start <= i < arm_start + arm_width``
        along x.
    arm_length : int
        Cells by which each branch sticks out of the beam.
    """
    nx, ny, nz = cells
    if arm_start + arm_width > nx:
        raise SceneError(
            f"body.arm_start + body.arm_width = {arm_start + arm_width}: expected at most "
            f"the {nx} cells of the beam along x. Move the arms or lengthen the beam."
        )
    side = arm_length if arms == 4 else 0
    solid = _grid((nx, ny + 2 * side, nz + 2 * arm_length))
    beam_y, beam_z = slice(side, side + ny), slice(arm_length, arm_length + nz)
    arm_x = slice(arm_start, arm_start + arm_width)
    solid[:, beam_y, beam_z] = True
    solid[arm_x, beam_y, :] = True
    if arms == 4:
        solid[arm_x, :, beam_z] = True
    return solid, (0, side, arm_length)


def weight(
    support_cells: tuple[int, int, int],
    second_support_length: int,
    pendulum_start: int,
    pendulum_cells: tuple[int, int, int],
    weight_start: int,
    weight_cells: tuple[int, int, int],
) -> Occupancy:
    """One or two support beams and a pendulum with an inflation (fig. 6.2).

    The first support lies along x with a corner at the origin.  A second one,
    if any, crosses it along y, centred on it, at the place of the pendulum.
    The pendulum hangs below (towards -z) and carries the inflated part.

    Parameters
    ----------
    support_cells : tuple of int
        Cells of the first support along x, y, z.
    second_support_length : int
        Cells of the second support along y; 0 leaves it out.
    pendulum_start : int
        First cell of the pendulum, and of the second support, along x.
    pendulum_cells : tuple of int
        Cells of the pendulum along x, y and downwards.
    weight_start : int
        Cells between the support and the inflated part.
    weight_cells : tuple of int
        Cells of the inflated part along x, y and downwards, centred on the
        pendulum.
    """
    sx, sy, sz = support_cells
    px, py, pz = pendulum_cells
    wx, wy, wz = weight_cells
    _check_weight(support_cells, pendulum_start, pendulum_cells, weight_start, weight_cells)
    for name, size in (("pendulum_cells[1]", py), ("second_support_length", second_support_length)):
        if size and (size - sy) % 2:
            raise SceneError(
                f"body.{name} = {size}: expected the support's {sy} cells along y plus or minus an "
                "even number, so that it is centred."
            )

    half_x = (wx - px) // 2
    left = max(0, half_x - pendulum_start)
    right = max(0, pendulum_start + px + half_x - sx)
    second = max(second_support_length, 0)
    width = max(sy, py, wy, second)
    solid = _grid((left + sx + right, width, sz + pz))

    def centred(size: int) -> slice:
        start = (width - size) // 2
        return slice(start, start + size)

    x0 = left + pendulum_start
    solid[left : left + sx, centred(sy), pz:] = True
    if second:
        solid[x0 : x0 + px, centred(second), pz:] = True
    solid[x0 : x0 + px, centred(py), :pz] = True
    top = pz - weight_start
    solid[x0 - half_x : x0 + px + half_x, centred(wy), top - wz : top] = True
    return solid, (left, (width - sy) // 2, pz)


def _check_weight(
    support: tuple[int, int, int],
    pendulum_start: int,
    pendulum: tuple[int, int, int],
    weight_start: int,
    inflated: tuple[int, int, int],
) -> None:
    if pendulum_start + pendulum[0] > support[0]:
        raise SceneError(
            f"body.pendulum_start + body.pendulum_cells[0] = {pendulum_start + pendulum[0]}: "
            f"expected at most the {support[0]} cells of the support along x."
        )
    if weight_start + inflated[2] > pendulum[2]:
        raise SceneError(
            f"body.weight_start + body.weight_cells[2] = {weight_start + inflated[2]}: expected "
            f"at most the {pendulum[2]} cells of the pendulum downwards."
        )
    for axis, name in enumerate("xy"):
        excess = inflated[axis] - pendulum[axis]
        if excess < 0 or excess % 2:
            raise SceneError(
                f"body.weight_cells[{axis}] = {inflated[axis]}: expected the pendulum's "
                f"{pendulum[axis]} cells along {name} plus an even number, so that the "
                "inflated part is centred."
            )


def voxels(occupancy: NDArray[np.bool_]) -> Occupancy:
    """Any occupancy array (nx, ny, nz), its corner at the origin."""
    solid = np.asarray(occupancy)
    if solid.ndim != 3 or not solid.any():
        raise SceneError(
            f"body.occupancy has shape {solid.shape} and {int(np.count_nonzero(solid))} solid "
            "cells: expected a three-dimensional array of 0 and 1 with at least one 1."
        )
    return solid.astype(bool), (0, 0, 0)

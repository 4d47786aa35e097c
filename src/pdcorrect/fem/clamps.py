"""Clamps of a scene: which nodes its regions select, what moves freely, where the rest is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import SceneError
from pdcorrect.fem.mesh import HexMesh, boundary_faces
from pdcorrect.scene import Clamp, Motion, Region

_TOLERANCE = 1e-6
"""Of the coarse cell size: how far a node may lie outside a region it belongs to."""


class Selector:
    """Resolves regions on one mesh.

    Parameters
    ----------
    mesh : HexMesh
    positions : (N, 3)
        Rest positions of all element nodes, m; the first ones may be the
        mesh's corners.
    cell_size : float
        Coarse cell size, m, the unit of the geometric tolerance.
    """

    def __init__(self, mesh: HexMesh, positions: NDArray[np.float64], cell_size: float) -> None:
        self._mesh = mesh
        self._positions = positions
        self._tolerance = _TOLERANCE * cell_size

    @cached_property
    def _boundary(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return boundary_faces(self._mesh.cells)

    def nodes(self, region: Region, key: str) -> NDArray[np.int64]:
        """Numbers of the nodes in a region; ``key`` names it in messages."""
        if region.nodes is not None:
            coarse = self._mesh.coarse_nodes
            if max(region.nodes) >= len(coarse):
                raise SceneError(
                    f"{key}.nodes names node {max(region.nodes)}: expected 0 to "
                    f"{len(coarse) - 1}, the nodes of the coarse mesh."
                )
            return coarse[np.unique(region.nodes)]
        inside = region.contains(self._positions, self._tolerance, self._mesh.bounds)
        return self._found(np.flatnonzero(inside), region, key, "node")

    def coarse_nodes(self, region: Region, key: str) -> NDArray[np.int64]:
        """The nodes of a region that the unrefined mesh has too."""
        nodes = np.intersect1d(self.nodes(region, key), self._mesh.coarse_nodes)
        return self._found(nodes, region, key, "node of the coarse mesh")

    def cells(self, region: Region, key: str) -> NDArray[np.int64]:
        """Numbers of the cells whose centre is in a region."""
        if region.nodes is not None:
            raise SceneError(
                f"{key} = {region.describe()}: expected a region with a volume (box, sphere, "
                "everywhere), for cells are chosen by their centres."
            )
        inside = region.contains(self._mesh.centres, self._tolerance, self._mesh.bounds)
        return self._found(np.flatnonzero(inside), region, key, "cell centre")

    def faces(self, region: Region, key: str) -> NDArray[np.int64]:
        """Corner nodes (n, 4) of the boundary faces that lie wholly in a region."""
        faces, _ = self._boundary
        member = np.zeros(len(self._mesh.positions), dtype=bool)
        if region.nodes is not None:
            member[self.nodes(region, key)] = True
        else:
            member = region.contains(self._mesh.positions, self._tolerance, self._mesh.bounds)
        found = np.flatnonzero(member[faces].all(axis=1))
        return faces[self._found(found, region, key, "boundary face")]

    def _found(
        self, chosen: NDArray[np.int64], region: Region, key: str, kind: str
    ) -> NDArray[np.int64]:
        if not len(chosen):
            low, high = self._mesh.bounds
            raise SceneError(
                f"{key} = {region.describe()} contains no {kind}: expected at least one. "
                f"The body extends from {low.tolist()} to {high.tolist()} m."
            )
        return chosen


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Clamps:
    """Clamped components of all nodes.

    Attributes
    ----------
    free : (N, 3) bool
        Components that may move.
    rest : (N, 3)
        Rest positions, m.
    moving : tuple of (nodes, components, Course)
        Clamps with a prescribed motion.
    """

    free: NDArray[np.bool_]
    rest: Array
    moving: tuple[tuple[NDArray[np.int64], NDArray[np.int64], Course], ...]

    @property
    def still(self) -> NDArray[np.bool_]:
        """Components (N, 3) that are held where they are."""
        out = ~self.free
        for nodes, components, _ in self.moving:
            out[np.ix_(nodes, components)] = False
        return out

    def positions(self, time: float) -> Array:
        """Prescribed positions (N, 3), m, at a time (s); meaningful where not free."""
        if not self.moving:
            return self.rest
        out = self.rest.copy()
        for nodes, components, course in self.moving:
            moved = course(self.rest[nodes], time)
            out[np.ix_(nodes, components)] = moved[:, components]
        return out


def resolve_clamps(clamps: tuple[Clamp, ...], selector: Selector, rest: Array) -> Clamps:
    """Find the clamped components.

    Raises
    ------
    SceneError
        If a region selects nothing or two clamps move a component differently.
    """
    owner = np.full(rest.shape, -1)
    moving = []
    for i, clamp in enumerate(clamps):
        nodes = selector.nodes(clamp.region, f"clamps[{i}].region")
        components = np.array(sorted("xyz".index(c) for c in clamp.components))
        place = np.ix_(nodes, components)
        for earlier in np.unique(owner[place][owner[place] >= 0]):
            if clamp.motion != clamps[earlier].motion:
                node = nodes[(owner[place] == earlier).any(axis=1)][0]
                raise SceneError(
                    f"clamps[{earlier}] and clamps[{i}] move node {node} at "
                    f"{rest[node].tolist()} differently: expected regions or components that do "
                    "not overlap, or the same motion."
                )
        owner[place] = i
        if clamp.motion is not None:
            moving.append((nodes, components, Course(clamp.motion)))
    free = owner < 0
    if not free.any():
        raise SceneError("clamps hold every component of every node: expected a free one.")
    return Clamps(free, rest, tuple(moving))


class Course:
    """A prescribed motion with its tables as arrays, which steps look up again and again."""

    def __init__(self, motion: Motion) -> None:
        self._times = np.array(motion.times)
        self._angles = None if motion.rotation is None else np.array(motion.rotation)
        self._axis, self._centre = "xyz".index(motion.axis), np.array(motion.centre)
        self._ways = () if motion.displacement is None else tuple(np.array(motion.displacement).T)

    def __call__(self, points: Array, time: float) -> Array:
        """``points`` (n, 3) rotated and displaced as prescribed for a time (s)."""
        out = points
        if self._angles is not None:
            angle = math.radians(float(np.interp(time, self._times, self._angles)))
            out = self._centre + (points - self._centre) @ _rotation(self._axis, angle).T
        if self._ways:
            out = out + [np.interp(time, self._times, way) for way in self._ways]
        return out


def _rotation(axis: int, angle: float) -> Array:
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i] = math.sin(angle)
    matrix[i, j] = -math.sin(angle)
    return matrix


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

"""Clamps of a scene: which nodes its regions select, what moves freely, where the rest is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pdcorrect.errors import SceneError
from pdcorrect.fem.hexahedron import VTK_CORNERS, VTK_FACES, VTK_NODES
from pdcorrect.fem.mesh import Group, HexMesh, boundary_faces
from pdcorrect.fem.mesh_checks import connected_parts
from pdcorrect.fem.multigrid import rigid_motions
from pdcorrect.fem.operators import Space
from pdcorrect.scene import Clamp, Motion, Region
from pdcorrect.scene.regions import unit_vector

_RIGID = 1e-9
"""Relative size of a rigid motion at clamped components that counts as none."""
_TOLERANCE = 1e-6
"""Of the coarse cell size: how far a node may lie outside a region it belongs to."""


class Selector:
    """Resolves regions on one mesh, with an element's ``space``.

    The coarse ``cell_size``, m, is the unit of the geometric tolerance.
    """

    def __init__(self, mesh: HexMesh, space: Space, cell_size: float) -> None:
        self._mesh = mesh
        self._space = space
        self._tolerance = _TOLERANCE * cell_size

    @cached_property
    def _boundary(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return boundary_faces(self._mesh.cells)

    def nodes(self, region: Region, key: str) -> NDArray[np.int64]:
        """Numbers of the nodes in a region; ``key`` names it in messages."""
        group = self._group(region, key)
        if group is None and region.nodes is None:
            inside = region.contains(self._space.positions, self._tolerance, self._mesh.positions)
        else:
            inside = self._between(self._corners(region, key))
        if group is not None:
            self._add_group(group, inside)
        return self._found(np.flatnonzero(inside), region, key, "node")

    def coarse_nodes(self, region: Region, key: str) -> NDArray[np.int64]:
        """The nodes of a region that the unrefined mesh has too."""
        nodes = np.intersect1d(self.nodes(region, key), self._mesh.coarse_nodes)
        return self._found(nodes, region, key, "node of the coarse mesh")

    def cells(self, region: Region, key: str) -> NDArray[np.int64]:
        """Numbers of the cells whose centre is in a region, or of a group's cells."""
        if region.nodes is not None:
            raise SceneError(
                f"{key} = {region.describe()}: expected a region with a volume (box, sphere, "
                "group, everywhere), for cells are chosen by their centres."
            )
        group = self._group(region, key)
        if group is not None:
            return self._found(group.cells, region, key, "cell")
        inside = region.contains(self._mesh.centres, self._tolerance, self._mesh.positions)
        return self._found(np.flatnonzero(inside), region, key, "cell centre")

    def faces(self, region: Region, key: str) -> NDArray[np.int64]:
        """Corner nodes (n, 4) of the boundary faces that lie wholly in a region.

        Of a group they are its own faces, or those of its cells, or of its nodes.
        """
        faces, owners = self._boundary
        group = self._group(region, key)
        if group is not None and len(group.faces):
            sides = (faces[:, None] == self._mesh.cells[owners][:, VTK_FACES]).all(axis=2)
            own = np.isin(6 * owners + sides.argmax(axis=1), group.faces @ [6, 1])
        elif group is not None and len(group.cells):
            own = np.isin(owners, group.cells)
        else:
            own = np.asarray(self._corners(region, key)[faces].all(axis=1))
        return faces[self._found(np.flatnonzero(own), region, key, "boundary face")]

    def is_surface(self, region: Region, key: str) -> bool:
        """Whether a region has an area and no volume: a plane, or a group without cells."""
        group = self._group(region, key)
        return region.plane is not None if group is None else not len(group.cells)

    def _corners(self, region: Region, key: str) -> NDArray[np.bool_]:
        """Which nodes of the mesh (N,) belong to a region; of a group, its nodes."""
        group = self._group(region, key)
        if group is not None:
            return np.isin(np.arange(len(self._mesh.positions)), group.nodes)
        if region.nodes is None:
            return region.contains(self._mesh.positions, self._tolerance, self._mesh.positions)
        listed = np.array(region.nodes)
        count = len(self._mesh.coarse_nodes)
        if listed.max() >= count:
            raise SceneError(
                f"{key}.nodes names node {listed.max()}: expected 0 to {count - 1}, the nodes of "
                "the coarse mesh."
            )
        return self._mesh.refined_nodes(listed)

    def _group(self, region: Region, key: str) -> Group | None:
        """The group that a region names, if it names one."""
        groups = self._mesh.groups
        if region.group is None:
            return None
        if region.group not in groups:
            names = ", ".join(map(repr, groups)) or "none"
            raise SceneError(
                f"{key}.group = {region.group!r}: expected a named body, or a group of its mesh, "
                f"which has {names}."
            )
        return groups[region.group]

    def _add_group(self, group: Group, inside: NDArray[np.bool_]) -> None:
        """Mark the nodes of the element that are on a group's cells and faces."""
        cells = self._space.cells
        inside[cells[group.cells]] = True
        for side in range(6):
            axis, end = divmod(side, 2)
            local = np.flatnonzero(VTK_NODES[: cells.shape[1], axis] == end)
            own = group.faces[group.faces[:, 1] == side, 0]
            inside[cells[own][:, local]] = True

    def _between(self, member: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Nodes of the element all of whose corners are ``member`` nodes (N,) of the mesh.

        Corners of the cell, face or edge that a node lies in.
        """
        cells = self._space.cells
        away = np.abs(VTK_NODES[: cells.shape[1], None] - VTK_CORNERS).max(axis=2) > 0.5  # (K, 8)
        inside = (member[self._mesh.cells][:, None] | away).all(axis=2)
        out = np.zeros(len(self._space.positions), dtype=bool)
        out[cells[inside]] = True
        return out

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
    """Components (N, 3) that are free, rest positions (N, 3), m, and the clamps that move.

    Those by their nodes, components and course; ``oblique`` ones leave all components free.
    """

    free: NDArray[np.bool_]
    rest: Array
    moving: tuple[tuple[NDArray[np.int64], NDArray[np.int64], Course], ...]
    oblique: tuple[ObliqueClamp, ...] = ()

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


@dataclass(frozen=True, eq=False)
class ObliqueClamp:
    """Nodes (m,) held along a unit vector that is no axis; their course, if they move."""

    nodes: NDArray[np.int64]
    normal: Array
    course: Course | None

    def displacements(self, rest: Array, time: float) -> Array:
        """Of the clamp's nodes, (m, 3), m, at a time (s), for rest positions (N, 3) of all."""
        places = rest[self.nodes]
        return np.zeros_like(places) if self.course is None else self.course(places, time) - places


def resolve_clamps(clamps: tuple[Clamp, ...], selector: Selector, rest: Array) -> Clamps:
    """Find the clamped components; two clamps may not move one differently."""
    owner = np.full(rest.shape, -1)
    moving, oblique = [], []
    for i, clamp in enumerate(clamps):
        nodes = selector.nodes(clamp.region, f"clamps[{i}].region")
        course = None if clamp.motion is None else Course(clamp.motion)
        if not clamp.held and clamp.normal is not None:
            oblique.append(ObliqueClamp(nodes, unit_vector(clamp.normal), course))
            continue
        components = np.array(sorted("xyz".index(c) for c in clamp.held))
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
        if course is not None:
            moving.append((nodes, components, course))
    free = owner < 0
    if not free.any():
        raise SceneError("clamps hold every component of every node: expected a free one.")
    return Clamps(free, rest, tuple(moving), tuple(oblique))


class Course:
    """A prescribed motion with its tables as arrays, which steps look up again and again."""

    def __init__(self, motion: Motion) -> None:
        self._times = np.array(motion.times)
        self._angles = None if motion.rotation is None else np.array(motion.rotation)
        self._axis, self._centre = unit_vector(motion.axis), np.array(motion.centre)
        self._ways = () if motion.displacement is None else tuple(np.array(motion.displacement).T)

    def frame(self, time: float) -> tuple[Array, Array]:
        """R (3, 3) and b (3,) of x = R X + b at a time (s)."""
        return self(np.eye(3), time).T - (at := self(np.zeros((1, 3)), time)[0])[:, None], at

    def __call__(self, points: Array, time: float) -> Array:
        """``points`` (n, 3) rotated and displaced as prescribed for a time (s)."""
        out = points
        if self._angles is not None:
            angle = np.interp(time, self._times, self._angles)
            turn = Rotation.from_rotvec(angle * self._axis, degrees=True)
            out = self._centre + turn.apply(points - self._centre)
        if self._ways:
            out = out + [np.interp(time, self._times, way) for way in self._ways]
        return out


def check_held(positions: Array, cells: NDArray[np.int64], clamps: Clamps) -> None:
    """Refuse a body of which `rigid_freedom` says something: without inertia it has no solution."""
    told = rigid_freedom(positions, cells, clamps)
    if told:
        raise SceneError(
            f"{told}: expected clamps against every rigid motion, for quasi-static bodies have no "
            "inertia."
        )


def rigid_freedom(positions: Array, cells: NDArray[np.int64], clamps: Clamps) -> str:
    """How clamps let a body of nodes at positions (N, 3), m, or a part of it, move as a rigid one.

    Empty if they hold it.
    """
    part = connected_parts(cells, len(positions))
    count = int(part.max()) + 1
    for number in range(count):
        nodes = np.flatnonzero(part == number)
        motions = rigid_motions(positions[nodes])
        rows = [motions[~clamps.free[nodes].ravel()]]
        for one in clamps.oblique:
            own = motions.reshape(-1, 3, 6)[np.isin(nodes, one.nodes)]
            rows.append(np.einsum("i,nij->nj", one.normal, own))
        held = np.concatenate(rows)
        triangle = np.linalg.qr(held, mode="r")  # few rows, whatever the number of clamped nodes
        loose = la.null_space(triangle, rcond=_RIGID) if len(held) else np.eye(6)
        if not loose.size:
            continue
        turns = np.where(np.abs(loose[3:]) > _RIGID, loose[3:], 0.0)
        moves = loose[:3] @ la.null_space(turns, rcond=_RIGID)
        told = [
            f"{verb} {' and '.join(_directions(space))}"
            for verb, space in (("move along", moves), ("turn about", la.orth(turns, rcond=_RIGID)))
            if space.size
        ]
        which = "the body" if count == 1 else f"the part of the body at node {nodes[0]}"
        return f"clamps let {which} {' and '.join(told)}"
    return ""


def _directions(space: Array) -> list[str]:
    """A basis of a space of directions (3, k) in words, axes by name where they lie in it."""
    inside = np.linalg.norm(la.orth(space).T, axis=0) > 1.0 - _RIGID
    named = [name for name, is_in in zip("xyz", inside, strict=True) if is_in]
    if len(named) == space.shape[1]:
        return named
    scaled = [(column / np.abs(column).max()).round(3) + 0.0 for column in space.T]  # no -0.0
    return [str(column.tolist()) for column in scaled]

"""The coarse mesh of a scene: that of each of its bodies, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from pdcorrect._environment import total_memory
from pdcorrect.errors import MeshError, SceneError
from pdcorrect.fem.locate import locate
from pdcorrect.fem.mesh import Group, HexMesh, voxel_mesh
from pdcorrect.scene import MeshFile, Scene, Voxels
from pdcorrect.scene.bodies import Body

_LEAST_BYTES = 4000
"""Of memory that a cell takes, less than half of what was measured; eight times it as "hex27"."""
_TOUCHING = 1e-6
"""Of the mean cell size: how near a node of one body is to another that it touches."""


def scene_mesh(scene: Scene, refine: int = 1) -> HexMesh:
    """The mesh of all bodies, which share no nodes.

    A named body is a group of cells; the groups of its own then have its name before theirs.

    Raises
    ------
    SceneError
        If a mesh, cut into ``refine`` ** 3 a cell, does not fit into memory; if bodies touch, or
        have groups of one name.
    """
    meshes: dict[str, HexMesh] = {}
    cells = 0
    for key, body in scene.all_bodies.items():
        try:
            meshes[key], cells = _body_mesh(body, scene, refine, cells)
        except SceneError as error:
            raise SceneError(key + str(error).removeprefix("body")) from None
    if len(meshes) == 1:
        return meshes["body"]
    _check_apart(meshes)
    return _joined(meshes)


def check_size(scene: Scene, cells: int, refine: int) -> None:
    """Refuse meshes that cannot fit into the memory of the machine, before it is filled."""
    memory = total_memory()
    most = memory / (_LEAST_BYTES * (8 if scene.solver.element == "hex27" else 1))
    if cells * refine**3 > most:
        raise SceneError(
            f"body: {cells} cells, {cells * refine**3} with refine = {refine}: expected at most "
            f"{most:.0f} in the {memory / 1e9:.3g} GB of memory that this program may use. Use "
            "larger cells or a smaller refine."
        )


def _body_mesh(body: Body, scene: Scene, refine: int, before: int) -> tuple[HexMesh, int]:
    """A body's mesh with its groups, and the cells of all bodies up to it, ``before`` without."""
    if isinstance(body, MeshFile):
        from pdcorrect.fem.mesh_files import read_hex_mesh  # meshio only where it is needed

        mesh = read_hex_mesh(body.path, body.scale)
        count = before + len(mesh.cells)
        check_size(scene, count, refine)
        return _with_groups(mesh, body.name, mesh.groups), count
    solid, origin_index = body.occupancy()
    count = before + int(np.count_nonzero(solid))
    check_size(scene, count, refine)
    try:
        mesh = voxel_mesh(solid, origin_index, body.cell_size, body.origin)
    except MeshError:  # a grid's cells can only lose their volume to rounding
        raise SceneError(
            f"body.cell_size = {body.cell_size:g} with body.origin = {list(body.origin)}: cells "
            "have no volume in double precision: expected a size of about that of the body's "
            "coordinates, in metres."
        ) from None
    labels = body.labels() if isinstance(body, Voxels) else None
    own = np.zeros(0) if labels is None else labels[solid]
    groups = {str(k): _cells_only(np.flatnonzero(own == k)) for k in np.unique(own).tolist()}
    return _with_groups(mesh, body.name, groups), count


def _cells_only(cells: NDArray[np.int64]) -> Group:
    return Group(cells, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))


def _with_groups(mesh: HexMesh, name: str | None, groups: Mapping[str, Group]) -> HexMesh:
    """A mesh with a group of all its cells, if it has a name, and with these."""
    if name is not None:
        groups = {f"{name}.{key}": group for key, group in groups.items()}
        groups = {name: _cells_only(np.arange(len(mesh.cells))), **groups}
    return replace(mesh, groups=groups)


def _check_apart(meshes: Mapping[str, HexMesh]) -> None:
    """Refuse bodies of which one has a node in or on another: nodes are found by their places."""
    for (key, mesh), (other_key, other) in permutations(meshes.items(), 2):
        near = _TOUCHING * np.ptp(other.positions[other.cells], axis=1).mean()
        low, high = other.bounds
        inside = ((mesh.positions >= low - near) & (mesh.positions <= high + near)).all(axis=1)
        points = mesh.positions[inside]
        if not len(points):
            continue
        distances = locate(other.positions, other.cells, points)[2]
        if distances.min() <= near:
            at = points[distances.argmin()].tolist()
            raise SceneError(
                f"{key} touches {other_key} at {at} m: expected bodies apart, for they are neither "
                "joined nor in contact."
            )


def _joined(meshes: Mapping[str, HexMesh]) -> HexMesh:
    """The meshes beside each other; groups keep their names."""
    nodes = cells = 0
    groups: dict[str, Group] = {}
    numbered = []
    for key, mesh in meshes.items():
        for name, group in mesh.groups.items():
            if name in groups:
                raise SceneError(
                    f"{key}: group {name!r} is another body's too: expected names that differ; "
                    "groups of a body with a name have it before theirs."
                )
            faces = group.faces + np.array([cells, 0])
            groups[name] = Group(group.cells + cells, faces, group.nodes + nodes)
        numbered.append(mesh.cells + nodes)
        nodes, cells = nodes + len(mesh.positions), cells + len(mesh.cells)
    positions = np.concatenate([mesh.positions for mesh in meshes.values()])
    return HexMesh(positions, np.concatenate(numbered), np.arange(nodes), groups)

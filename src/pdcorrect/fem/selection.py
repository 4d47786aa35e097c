"""Regions of a scene turned into nodes, cells and boundary faces of a mesh."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import SceneError
from pdcorrect.fem.mesh import HexMesh, boundary_faces
from pdcorrect.scene import Region

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

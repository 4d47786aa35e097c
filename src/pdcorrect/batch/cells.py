"""Elastic energy, forces and tangents of many bodies at once.

Bodies of different sizes are padded: configurations are (B, U, 3) with each body's nodes
first, then, from a common place on, its internal modes.  Cells and nodes that a body does
not have carry no weight and stay at zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.bodies import Bodies
from pdcorrect.batch.fused import rows_of, sums, sums_of_rows
from pdcorrect.batch.levels import places
from pdcorrect.batch.narrowing import with_rows
from pdcorrect.batch.points import Points, Tangent
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.quadrature import Quadrature


class Sizes(NamedTuple):
    """Of a padded batch: scenes, nodes, modes, cells, shape functions and points a cell."""

    scenes: int
    nodes: int
    modes: int
    cells: int
    width: int
    points: int

    @property
    def unknowns(self) -> int:
        """Nodes and modes."""
        return self.nodes + self.modes


def padded(arrays: Sequence[NDArray[Any]], shape: tuple[int, ...], fill: float = 0) -> NDArray[Any]:
    """Arrays stacked into (B, *shape), each in the low corner."""
    out = np.full((len(arrays), *shape), fill, dtype=arrays[0].dtype)
    for i, array in enumerate(arrays):
        corner: tuple[Any, ...] = (i, *(slice(n) for n in array.shape))
        out[corner] = array
    return out


class CellBatch:
    """The cells of B problems with the same element and energy, weightless until `set_weights`.

    Parameters
    ----------
    problems : sequence of Problem
    device, dtype
        Of everything that is computed.

    Attributes
    ----------
    sizes : Sizes
    bodies : Bodies
        Of the scenes.
    node_counts : list of int
    present_nodes, present_cells : (B, N), (B, C) bool
        Which are a body's own, not padding.
    """

    def __init__(
        self, problems: Sequence[Problem], device: torch.device, dtype: torch.dtype
    ) -> None:
        first = problems[0]
        width, points = first.space.local.shape[1], first.quadrature.weights.shape[1]
        self.sizes = Sizes(
            len(problems),
            max(len(p.positions) for p in problems),
            max(p.space.internal for p in problems),
            max(len(p.cells) for p in problems),
            width,
            points,
        )
        self.bodies = Bodies.of(problems)
        distinct = self.bodies.distinct
        self._owners = torch.as_tensor(self.bodies.owners, device=device)
        self.node_counts = [len(p.positions) for p in problems]
        self.mode_counts = [p.space.internal for p in problems]
        self.device, self.dtype = device, dtype
        n = self.sizes
        self.rest = self.repeated([p.positions for p in distinct], n.unknowns, 3)
        local = [self._renumbered(p) for p in distinct]
        scene = torch.arange(n.scenes, device=device).reshape(-1, 1, 1)
        cells = self._numbers(local, 0, n.cells, width)
        self._cells = (cells + n.unknowns * scene).reshape(-1)
        found = [places(cells, n.unknowns) for cells in local]
        slots = self._numbers(found, -1, n.unknowns, max(table.shape[1] for table in found))
        values = n.cells * width
        slots = torch.where(slots < 0, n.scenes * values, slots + values * scene)
        self._slots = slots.flatten(0, 1)
        self.present_cells = self._first([len(p.cells) for p in problems], n.cells)
        self.present_nodes = self._first(self.node_counts, n.nodes)
        quadratures = [p.quadrature for p in distinct]
        volumes = [[q.weights for q in quadratures], [q.volume_weights for q in quadratures]]
        self._volumes = torch.stack([self.repeated(v, n.cells, points) for v in volumes])
        self._volumes = self._volumes.reshape(2, -1)
        self._weights = torch.zeros_like(self._volumes)
        self._points = Points(
            first.materials.model,
            first.quadrature.first_volume if first.scene.material.has_volume_term else points,
            points,
            compiled=device.type == "cuda",
        )
        self._identity = torch.eye(3, dtype=dtype, device=device).reshape(9, 1)
        self._gradients = self._gradient_sets(quadratures)

    def narrowed(self, rows: Tensor) -> CellBatch:
        """Of some scenes."""
        n, numbers = self.sizes, rows.tolist()
        moved = (torch.arange(len(rows), device=rows.device) - rows)[:, None]
        last = n.scenes * n.cells * n.width
        slots = self._slots.reshape(n.scenes, -1)[rows]
        shifted = slots + moved * n.cells * n.width
        slots = torch.where(slots < last, shifted, len(rows) * n.cells * n.width)
        cells = self._cells.reshape(n.scenes, -1)[rows] + moved * n.unknowns
        return with_rows(
            self, rows, "rest", "present_nodes", "present_cells", "_gradients", "_owners",
            sizes=n._replace(scenes=len(rows)),
            bodies=Bodies(self.bodies.distinct, self.bodies.owners[numbers]),
            node_counts=[self.node_counts[i] for i in numbers],
            mode_counts=[self.mode_counts[i] for i in numbers],
            _cells=cells.reshape(-1),
            _slots=slots.reshape(-1, self._slots.shape[1]),
            _weights=self._weights.reshape(2, n.scenes, -1)[:, rows].reshape(2, -1),
            _volumes=self._volumes.reshape(2, n.scenes, -1)[:, rows].reshape(2, -1),
        )  # fmt: skip

    # --- arrays to and from tensors -----------------------------------------------------

    def tensor(self, array: NDArray[Any]) -> Tensor:
        """On the device, in the batch's type."""
        return torch.as_tensor(np.ascontiguousarray(array), dtype=self.dtype, device=self.device)

    def nodal(self, arrays: Sequence[NDArray[Any]]) -> Tensor:
        """Nodal arrays (N, ...) of the bodies, padded to (B, U, ...)."""
        return self.tensor(padded(arrays, (self.sizes.unknowns, *arrays[0].shape[1:])))

    def configurations(self, arrays: Sequence[NDArray[Any]]) -> Tensor:
        """Configurations (N + B, 3) of the scenes, padded to (B, U, 3)."""
        return self._spread(arrays, self.node_counts)

    def repeated(self, arrays: Sequence[NDArray[Any]], *shape: int) -> Tensor:
        """An array of each of the ``bodies``, padded, for all scenes: (B, *shape)."""
        return self._of_scenes(self.tensor(padded(arrays, shape)))

    def repeated_configurations(self, arrays: Sequence[NDArray[Any]]) -> Tensor:
        """Configurations (N + B, 3) of the ``bodies``, padded, for all scenes: (B, U, 3)."""
        counts = [len(p.positions) for p in self.bodies.distinct]
        return self._of_scenes(self._spread(arrays, counts))

    def _spread(self, arrays: Sequence[NDArray[Any]], node_counts: Sequence[int]) -> Tensor:
        out = np.zeros((len(arrays), self.sizes.unknowns, 3))
        for i, (array, nodes) in enumerate(zip(arrays, node_counts, strict=True)):
            modes = array[nodes:]
            out[i, : len(array[:nodes])] = array[:nodes]
            out[i, self.sizes.nodes : self.sizes.nodes + len(modes)] = modes
        return self.tensor(out)

    def _of_scenes(self, x: Tensor) -> Tensor:
        """Rows of the bodies for all scenes."""
        return x if self.bodies.one_a_scene else x[self._owners]

    def _numbers(self, arrays: Sequence[NDArray[np.int64]], fill: int, *shape: int) -> Tensor:
        """As `repeated`, of whole numbers."""
        return self._of_scenes(torch.as_tensor(padded(arrays, shape, fill), device=self.device))

    def _first(self, counts: Sequence[int], most: int) -> Tensor:
        """Which of ``most`` come before a scene's count, (B, most) bool."""
        numbers = torch.arange(most, device=self.device)
        return numbers < torch.tensor(counts, device=self.device)[:, None]

    def _renumbered(self, problem: Problem) -> NDArray[np.int64]:
        nodes = len(problem.positions)
        local = problem.space.local
        return np.where(local < nodes, local, local + self.sizes.nodes - nodes)

    def _gradient_sets(self, quadratures: Sequence[Quadrature]) -> Tensor:
        """Gradients (B, L, 3 Q) where a scene's cells are all alike, else (B, C, L, 3 Q)."""
        n = self.sizes
        shape = (n.width, 3 * n.points)
        if all(q.alike_gradients for q in quadratures):
            return self.repeated([q.lanes[0].reshape(shape) for q in quadratures], *shape)
        every = [q.lanes.reshape(len(q.lanes), *shape) for q in quadratures]
        return self.repeated(every, n.cells, *shape)

    # --- energy ---------------------------------------------------------------------------

    def energy_and_forces(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Elastic energies (B,), J, and forces (B, U, 3), N, of configurations (B, U, 3)."""
        density, P = self._points.stress(self.gradients(y - self.rest, 1.0), self._weights)
        return density.reshape(self.sizes.scenes, -1).sum(dim=1), -self.gathered(P)

    def linearise(self, y: Tensor) -> Tangent:
        """The tangent at configurations, for `apply`."""
        return self._points.tangent(self.gradients(y - self.rest, 1.0), self._weights)

    def apply(self, tangent: Tangent, x: Tensor) -> Tensor:
        """Tangent times x, both (B, U, 3)."""
        return self.gathered(self._points.product(tangent, self.gradients(x, 0.0)))

    def set_weights(self, mu: Tensor, omega: Tensor) -> None:
        """Weights of the two energy terms from now on, (B, C), Pa."""
        shape = (2, self.sizes.scenes, self.sizes.cells, self.sizes.points)
        volumes = self._volumes.reshape(shape)
        values = torch.stack([mu, omega])[..., None] * volumes
        self._weights.copy_(torch.where(volumes != 0.0, values, 0.0).reshape(2, -1))

    def smallest_volume_ratios(self, positions: Tensor) -> Tensor:
        """Smallest det F over the quadrature points of each body, (B,), for (B, N, 3).

        Of the nodes' displacements alone, see `ElasticBody.volume_ratios`.
        """
        return self.volume_ratios(positions).amin(dim=1)

    def volume_ratios(self, positions: Tensor) -> Tensor:
        """The same of each cell, (B, C); infinite in padding."""
        n = self.sizes
        u = torch.zeros_like(self.rest)
        u[:, : n.nodes] = positions - self.rest[:, : n.nodes]
        a, b, c, d, e, f, g, h, i = self.gradients(u, 1.0).unbind()
        ratios = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
        by_cell = ratios.reshape(n.scenes, n.cells, n.points).amin(dim=2)
        return torch.where(self.present_cells, by_cell, math.inf)

    def rotations(self, F: Tensor) -> Tensor:
        """Nearest rotations (9, M) of matrices (9, M)."""
        return self._points.rotations(F)

    def weight_slopes(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of x . dW/dy by each cell's mu and omega, two (B, C)."""
        n = self.sizes
        F, D = self.gradients(y - self.rest, 1.0), self.gradients(x, 0.0)
        out = []
        for term in (0, 1):
            weights = torch.zeros_like(self._weights)
            weights[term] = self._volumes[term]
            _, P = self._points.stress(F, weights)
            out.append((P * D).sum(dim=0).reshape(n.scenes, n.cells, n.points).sum(dim=2))
        return out[0], out[1]

    def gradients(self, u: Tensor, diagonal: float) -> Tensor:
        """Diagonal I + sum_k u_k grad N_k, (9, B C Q), for (B, U, 3)."""
        n = self.sizes
        local = self.local(u).transpose(2, 3)
        out = local.reshape(*self._rows, n.width) @ self._gradients
        out = out.reshape(n.scenes, n.cells, 9, n.points).permute(2, 0, 1, 3).reshape(9, -1)
        if diagonal:
            out = out + diagonal * self._identity
        return out

    def gathered(self, P: Tensor) -> Tensor:
        """sum_q P_ij dN_k/dx_j summed over the cells, (B, U, 3), for P (9, B C Q)."""
        n = self.sizes
        P = P.reshape(9, n.scenes, n.cells, n.points).permute(1, 2, 0, 3)
        local = P.reshape(*self._rows, 3 * n.points) @ self._gradients.transpose(-1, -2)
        return self.summed(local.reshape(n.scenes, n.cells, 3, n.width).transpose(2, 3))

    def local(self, u: Tensor) -> Tensor:
        """A configuration's values in each cell, (B, C, L, 3)."""
        n = self.sizes
        return rows_of(u.reshape(-1, 3), self._cells).reshape(n.scenes, n.cells, n.width, 3)

    def summed(self, local: Tensor) -> Tensor:
        """Values (B, C, L, 3) of cells summed into configurations (B, U, 3), in a fixed order."""
        n = self.sizes
        flat = local.reshape(n.scenes * n.cells * n.width, 3)
        return sums_of_rows(flat, self._slots).reshape(n.scenes, n.unknowns, 3)

    def summed_numbers(self, local: Tensor) -> Tensor:
        """Numbers (B, C, L) of cells summed at the nodes, (B, N); not for work in every step."""
        n = self.sizes
        slots = self._slots.reshape(n.scenes, n.unknowns, -1)[:, : n.nodes].flatten(0, 1)
        return sums(local.reshape(-1, 1), slots).reshape(n.scenes, n.nodes)

    @property
    def _rows(self) -> tuple[int, ...]:
        """Leading shape of the products with gradients: by scene where its cells are alike."""
        n = self.sizes
        return (n.scenes, 3 * n.cells) if self._gradients.ndim == 3 else (n.scenes, n.cells, 3)

"""Elastic energy, forces and tangents of many bodies at once.

Bodies of different sizes are padded: configurations are (B, U, 3) with each body's nodes
first, then, from a common place on, its internal modes, cell by cell.  Cells and nodes that
a body does not have carry no weight and stay at zero.  What is known at quadrature points
is (k, B C, Q); on a GPU the k numbers of a cell are side by side in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.batch.correction import BatchCorrection
from pdcorrect.batch.gpu import assembled, at_corners, in_cells, sums
from pdcorrect.batch.points import Points, Tangent, deformation
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.quadrature import Quadrature

Numbers = NDArray[np.int64]


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

    Attributes
    ----------
    sizes : Sizes
    bodies : DistinctBodies
    node_counts : list of int
    volumes : (2, B C, Q)
        Of the points in both terms of the energy, m3.
    point_weights : (2, B C, Q)
        The same times mu and omega, J.
    points : Points
    free : (B, U, 3)
        1 where a component may move, 0 where not and in padding.
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
        self.bodies = DistinctBodies.of(problems)
        distinct = self.bodies.distinct
        self._owners = torch.as_tensor(self.bodies.owners, device=device)
        self.node_counts = [len(p.positions) for p in problems]
        self.device, self.dtype = device, dtype
        n = self.sizes
        self.rest = self.repeated([p.positions for p in distinct], n.unknowns, 3)
        corners = first.cells.shape[1]
        self._corners = self._numbers([p.cells for p in distinct], 0, n.cells, corners)
        found = [places(p.cells, len(p.positions)) for p in distinct]
        slots = self._numbers(found, -1, n.nodes, max(table.shape[1] for table in found))
        self._slots = of_all(slots, n.cells * corners)
        self.free = self.configurations([p.free_unknowns for p in problems])
        self.present_cells = self._first([len(p.cells) for p in problems], n.cells)
        self.present_nodes = self._first(self.node_counts, n.nodes)
        quadratures = [p.quadrature for p in distinct]
        volumes = [[q.weights for q in quadratures], [q.volume_weights for q in quadratures]]
        self.volumes = torch.stack([self.repeated(v, n.cells, points) for v in volumes])
        self.volumes = self.volumes.reshape(2, -1, points)
        self.point_weights = torch.zeros_like(self.volumes)
        self.points = Points(
            first.materials.model,
            first.quadrature.first_volume if first.scene.material.has_volume_term else points,
            points,
        )
        self._gradients = self._gradient_sets(quadratures)
        written = [p.correction for p in problems if p.correction is not None]
        self.correction = BatchCorrection(written, n.cells, self.rest) if written else None

    # --- arrays to and from tensors -----------------------------------------------------

    def tensor(self, array: NDArray[Any]) -> Tensor:
        """On the device, in the batch's type."""
        return torch.as_tensor(np.ascontiguousarray(array), dtype=self.dtype, device=self.device)

    def nodal(self, arrays: Sequence[NDArray[Any]]) -> Tensor:
        """Nodal arrays (N, ...) of the scenes, padded to (B, N, ...)."""
        return self.tensor(padded(arrays, (self.sizes.nodes, *arrays[0].shape[1:])))

    def configurations(self, arrays: Sequence[NDArray[Any]]) -> Tensor:
        """Configurations (N + B, 3), or nodal arrays, of the scenes, padded to (B, U, 3)."""
        out = np.zeros((len(arrays), self.sizes.unknowns, 3))
        for row, array, nodes in zip(out, arrays, self.node_counts, strict=True):
            modes = slice(self.sizes.nodes, self.sizes.nodes + len(array) - nodes)
            row[:nodes], row[modes] = array[:nodes], array[nodes:]
        return self.tensor(out)

    def repeated(self, arrays: Sequence[NDArray[Any]], *shape: int) -> Tensor:
        """An array of each of the ``bodies``, padded, for all scenes: (B, *shape)."""
        return self._of_scenes(self.tensor(padded(arrays, shape)))

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
        u = y - self.rest
        density, P = self.points.stress(self.gradients(u), self.point_weights)
        energy, forces = density.reshape(self.sizes.scenes, -1).sum(dim=1), -self.gathered(P)
        if self.correction is None:
            return energy, forces
        more, by_cell = self.correction.energy_and_forces(self.local(u))
        return energy + more, forces + self.of_corners(by_cell)

    def linearise(self, y: Tensor, project: bool = False) -> Tangent:
        """The tangent at configurations, for `apply`; ``project`` as in `Points.tangent`."""
        u = y - self.rest
        tangent = self.points.tangent(self.gradients(u), self.point_weights, project)
        if self.correction is None:
            return tangent
        return *tangent, *self.correction.linearise(self.local(u), project)

    def apply(self, tangent: Tangent, x: Tensor) -> Tensor:
        """Tangent times x, both (B, U, 3)."""
        out = self.gathered(self.points.product(tangent[:3], self.gradients(x)))
        if self.correction is None:
            return out
        return out + self.of_corners(self.correction.apply(tangent[3:], self.local(x)))

    def of_corners(self, by_cell: Tensor) -> Tensor:
        """Values (B, C, K, 3) of corners summed, and none for modes, (B, U, 3)."""
        missing = self.sizes.width - by_cell.shape[2]
        return self.summed(torch.nn.functional.pad(by_cell, (0, 0, 0, missing)))

    def set_weights(self, mu: Tensor, omega: Tensor) -> None:
        """Weights of the two energy terms from now on, (B, C), Pa."""
        volumes = self._by_scene(self.volumes)
        values = torch.stack([mu, omega])[..., None] * volumes
        self.point_weights.copy_(torch.where(volumes != 0.0, values, 0.0).flatten(1, 2))

    def volume_ratios(self, positions: Tensor) -> Tensor:
        """Smallest det F over the quadrature points of each cell, (B, C), for (B, N, 3).

        Of the nodes' displacements alone, see `ElasticBody.volume_ratios`; infinite in padding.
        """
        n = self.sizes
        u = torch.zeros_like(self.rest)
        u[:, : n.nodes] = positions - self.rest[:, : n.nodes]
        ratios = self.points.volume_ratios(self.gradients(u))
        by_cell = ratios.reshape(n.scenes, n.cells, n.points).amin(dim=2)
        return torch.where(self.present_cells, by_cell, math.inf)

    def weight_slopes(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of x . dW/dy by each cell's mu and omega, two (B, C)."""
        n = self.sizes
        H, D = self.gradients(y - self.rest), self.gradients(x)
        out = []
        for term in (0, 1):
            weights = torch.zeros_like(self.point_weights)
            weights[term] = self.volumes[term]
            _, P = self.points.stress(H, weights)
            out.append((P * D).sum(dim=0).reshape(n.scenes, n.cells, n.points).sum(dim=2))
        return out[0], out[1]

    def gradients(self, u: Tensor) -> Tensor:
        """H = sum_k u_k grad N_k, (9, B C, Q), for (B, U, 3)."""
        n = self.sizes
        rows = in_cells(u, self._corners, n.modes)
        if u.is_cuda:
            return deformation(rows, self._gradients)
        by_cell = rows.reshape(*self._rows, n.width) @ self._gradients
        return by_cell.reshape(-1, 9, n.points).transpose(0, 1).contiguous()

    def gathered(self, P: Tensor) -> Tensor:
        """sum_q P_ij dN_k/dx_j summed over the cells, (B, U, 3), for P (9, B C, Q)."""
        n = self.sizes
        rows = P.transpose(0, 1).reshape(*self._rows, 3 * n.points)
        local = rows @ self._gradients.transpose(-1, -2)
        return self.summed(local.reshape(n.scenes, n.cells, 3, n.width).transpose(2, 3))

    def mode_gradients(self) -> Tensor:
        """Gradients of the internal modes at the points, (B C, L - K, 3, Q), 1/m."""
        n, nodes = self.sizes, self._corners.shape[2]
        rows = self._gradients[..., nodes:, :]
        found = rows.reshape(*rows.shape[:-1], 3, n.points)
        if self._gradients.ndim == 3:
            found = found[:, None].expand(-1, n.cells, -1, -1, -1)
        return found.flatten(0, 1)

    def local(self, x: Tensor) -> Tensor:
        """A nodal field's values (B, N or U, 3) at the corners of each cell, (B, C, K, 3)."""
        return at_corners(x, self._corners)

    def modes(self, u: Tensor) -> Tensor:
        """A configuration's modes in each cell, (B, C, L - K, 3)."""
        n = self.sizes
        return u[:, n.nodes :].reshape(n.scenes, n.cells, -1, 3)

    def summed(self, local: Tensor) -> Tensor:
        """Values of the cells' corners, or of all their shape functions, as a field.

        (B, C, K, 3) as (B, N, 3), or (B, C, L, 3) as (B, U, 3); corners meet at the nodes
        and are summed in a fixed order.
        """
        return assembled(local, self._slots, self._corners.shape[2])

    def summed_numbers(self, local: Tensor) -> Tensor:
        """Numbers (B, C, K) of cells summed at the nodes, (B, N); not for work in every step."""
        n = self.sizes
        return sums(local.reshape(-1, 1), self._slots).reshape(n.scenes, n.nodes)

    def _by_scene(self, x: Tensor) -> Tensor:
        """(k, B C, Q) as (k, B, C, Q)."""
        return x.reshape(len(x), self.sizes.scenes, self.sizes.cells, x.shape[-1])

    @property
    def _rows(self) -> tuple[int, ...]:
        """Leading shape of the products with gradients: by scene where its cells are alike."""
        n = self.sizes
        return (n.scenes, 3 * n.cells) if self._gradients.ndim == 3 else (n.scenes, n.cells, 3)


def kinds(
    problems: Sequence[Problem], key: Callable[[Problem], Hashable]
) -> tuple[list[Problem], list[int]]:
    """One problem of each key, and which of them each problem is like."""
    seen: dict[Hashable, int] = {}
    owners = [seen.setdefault(key(p), len(seen)) for p in problems]
    firsts = [owners.index(k) for k in range(len(seen))]
    return [problems[i] for i in firsts], owners


@dataclass(frozen=True, eq=False)
class DistinctBodies:
    """The problems of a batch without their loads, each once, and which of them each scene is.

    What depends on nothing else is computed once a body.
    """

    distinct: list[Problem]
    owners: NDArray[np.int64]

    @classmethod
    def of(cls, problems: Sequence[Problem]) -> DistinctBodies:
        """Known by the objects that `Problem.with_loads` shares; numbers are not compared."""

        def key(p: Problem) -> tuple[Hashable, ...]:
            parts = (p.mesh, p.space, p.quadrature, p.materials, p.mass_matrix, p.clamps)
            return p.mass_rule, *map(id, parts)

        distinct, owners = kinds(problems, key)
        return cls(distinct, np.array(owners, dtype=np.int64))

    @property
    def one_a_scene(self) -> bool:
        """Whether the scenes are the distinct bodies in their order."""
        return np.array_equal(self.owners, np.arange(len(self.distinct)))


def of_all(numbers: Tensor, size: int) -> Tensor:
    """Numbers (B, R, n) of each scene's own ``size`` rows as those of all scenes, (B R, n).

    Those below zero stand for nothing, and become B times ``size``.
    """
    scene = torch.arange(len(numbers), device=numbers.device)[:, None, None]
    of_its_own = numbers + size * scene
    return torch.where(numbers < 0, size * len(numbers), of_its_own).flatten(0, 1)


def places(cells: Numbers, count: int) -> Numbers:
    """Where each node occurs in the raveled cells, (N, most), filled up with -1."""
    flat = cells.ravel()
    order = np.argsort(flat, kind="stable")
    return table_rows(flat[order], order, count, -1)[0]


def table_rows(rows: Numbers, values: Numbers, count: int, fill: int) -> tuple[Numbers, Numbers]:
    """Values by sorted rows as a table (count, most), and the place of each in its row."""
    counts = np.bincount(rows, minlength=count)
    places = np.arange(len(rows)) - (np.cumsum(counts) - counts)[rows]
    out = np.full((count, counts.max()), fill, dtype=np.int64)
    out[rows, places] = values
    return out, places


# --- scenes that are together ---------------------------------------------------------------------


def scene_name(problems: Sequence[Problem], i: int) -> str:
    """A scene's number and name."""
    return f"{i} ({problems[i].scene.name!r})"


def check_problems(
    problems: Sequence[Problem], time_step: float | None, integrator: str | None
) -> tuple[Problem, ...]:
    """The problems; scenes that cannot step together are refused, naming one and what differs.

    ``time_step`` and ``integrator`` are those asked for, or None for the scenes' own.
    """
    problems = tuple(problems)
    if not problems:
        raise InputError("no problems: expected one or more scenes.")
    first = problems[0].scene
    names = ["solver.element", "material.energy", "material.volume_weight"]
    names += ["damping.viscosity", "damping.mass", "damping.stiffness"]
    if time_step is None:
        names += ["time.step", "time.substeps"]
    if integrator is None:
        names.append("time.integrator")
    if (integrator or first.time.integrator) == "generalised-alpha":
        names.append("time.spectral_radius")
    for i, problem in enumerate(problems):
        for found, what in (
            (problem.contact, "obstacles"),
            (problem.fibres, "actuators"),
            (problem.rollers, "oblique rollers"),
        ):
            if found is not None:
                raise InputError(
                    f"scene {scene_name(problems, i)} has {what}, which batches do not know: "
                    "expected none. Step it by ProjectiveDynamics or Newton."
                )
        for name in names:
            mine, theirs = (attrgetter(name)(scene) for scene in (problem.scene, first))
            if mine != theirs:
                raise InputError(
                    f"scene {scene_name(problems, i)}: {name} = {mine!r}, the first one's is "
                    f"{theirs!r}: expected the same. Make a batch of each kind."
                )
    return problems


def usable_device(device: str | torch.device) -> torch.device:
    """A device that torch has here."""
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        found = torch.device("meta")
    if found.type not in ("cpu", "cuda"):
        raise InputError(f"device = {device!r}: expected 'cpu', 'cuda', 'cuda:1', ...")
    count = torch.cuda.device_count()
    if found.type == "cuda" and (found.index or 0) >= count:
        raise InputError(
            f"device = {str(found)!r}: torch finds {count} CUDA devices here; expected one of "
            "those, or 'cpu'."
        )
    return found

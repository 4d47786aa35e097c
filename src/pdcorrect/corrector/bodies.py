"""`BodyGraph`: what a corrector, and its gate, know of bodies before they move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from pdcorrect.corrector.frames import (
    cell_axes,
    node_axes,
    polar_rotations,
    turned_back,
    turns_between,
)
from pdcorrect.errors import InputError
from pdcorrect.fem.graph import mesh_edges, node_means
from pdcorrect.fem.mesh import boundary_faces
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


def _known(function: Callable[[Any], Tensor]) -> cached_property[Tensor]:
    """Computed once, and for later use with derivatives too."""
    return cached_property(torch.inference_mode(False)(function))


@dataclass(frozen=True, eq=False)
class BodyGraph:
    """The meshes of B bodies as one graph: n nodes, E directed edges, c cells in all.

    Attributes
    ----------
    rest : (n, 3)
        m.
    free : (n, 3) bool
        Components that may move.
    mass, young, poisson, density : (n,)
        kg; means over the cells of a node: Pa, dimensionless, kg/m3.
    edge_index : (2, E) int64
        Each edge of a cell once in both directions, ordered by the first row, which is the
        receiver.
    cells : (c, 8) int64
        VTK order.
    graph : (n,) int64
        The body of each node.
    cell_size, time_step : (B,)
        m and s.
    """

    rest: Tensor
    free: Tensor
    mass: Tensor
    young: Tensor
    poisson: Tensor
    density: Tensor
    edge_index: Tensor
    cells: Tensor
    graph: Tensor
    cell_size: Tensor
    time_step: Tensor

    @classmethod
    def of(
        cls,
        problems: Sequence[Problem],
        time_step: float | None = None,
        *,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> BodyGraph:
        """The coarse meshes of some problems; ``time_step`` (s) is the first one's by default.

        Raises
        ------
        InputError
            If there is none, or cells have more than their eight corners as nodes.
        """
        if not problems:
            raise InputError("problems: expected one or more.")
        bodies = [_one(problem) for problem in problems]
        joined = {name: np.concatenate([b[name] for b in bodies]) for name in _NODAL}
        counts = [len(b["rest"]) for b in bodies]
        first = np.cumsum([0, *counts[:-1]])
        step = problems[0].time_step if time_step is None else time_step

        def tensor(array: Any) -> Tensor:
            found = torch.as_tensor(np.ascontiguousarray(array), device=device)
            return found.to(dtype) if found.is_floating_point() else found

        offset = list(zip(bodies, first, strict=True))
        return cls(
            **{name: tensor(values) for name, values in joined.items()},
            edge_index=tensor(np.concatenate([b["edge_index"] + o for b, o in offset], axis=1)),
            cells=tensor(np.concatenate([b["cells"] + o for b, o in offset])),
            graph=tensor(np.repeat(np.arange(len(bodies)), counts)),
            cell_size=tensor(np.array([p.cell_size / p.refine for p in problems])),
            time_step=tensor(np.full(len(problems), step)),
        )

    @classmethod
    def of_batch(cls, batch: Any) -> BodyGraph:
        """The bodies of a batch of `pdcorrect.data.reader.MeshSample`."""
        return cls(
            **{name: getattr(batch, name) for name in _NODAL},
            edge_index=batch.edge_index,
            cells=batch.cells,
            graph=batch.batch,
            cell_size=_cell_sizes(batch.rest, batch.cells, batch.batch, batch.num_graphs),
            time_step=batch.time_step,
        )

    @property
    def bodies(self) -> int:
        """B."""
        return len(self.cell_size)

    @property
    def time_steps(self) -> Tensor:
        """Logarithm of each body's time step over its cell size, s/m, (B,), float64.

        Networks of frame features see E h²/(rho c²) and loads as f h²/(m c): of one material and
        loads to match only this ratio counts.
        """
        return (self.time_step.double() / self.cell_size.double()).log()

    @_known
    def node_counts(self) -> Tensor:
        """Nodes of each body, (B,), in the type of ``rest``."""
        return self.node_sums(torch.ones_like(self.mass))

    @_known
    def cell_counts(self) -> Tensor:
        """Cells that touch each node, (n,), in the type of ``rest``."""
        corners = self.cells.reshape(-1)
        ones = torch.ones_like(corners, dtype=self.rest.dtype)
        return torch.zeros_like(self.mass).index_add(0, corners, ones)

    @_known
    def rest_inverses(self) -> Tensor:
        """Inverses of the cells' axes at rest, (c, 3, 3), 1/m."""
        return torch.linalg.inv(cell_axes(self.rest, self.cells))

    @_known
    def rest_frames(self) -> Tensor:
        """Frames of the nodes at rest: rotations (n, 3, 3)."""
        return polar_rotations(node_axes(self.rest, self.cells, self.cell_counts))

    @_known
    def rest_edges(self) -> Tensor:
        """From receiver to sender at rest, in the receiver's frame, (E, 3), m."""
        here, there = self.edge_index
        return turned_back(self.rest_frames[here], self.rest[there] - self.rest[here])

    @_known
    def rest_turns(self) -> Tensor:
        """Rotation from the receiver's to the sender's frame at rest, (E, 3)."""
        here, there = self.edge_index
        frames = self.rest_frames
        return turns_between(frames[here], frames[there])

    @_known
    def shapes(self) -> Tensor:
        """What a gate knows of the bodies at rest, (B, 10), see `shape_measures`."""
        return torch.as_tensor(shape_measures(self)).to(self.rest)

    def by_node(self, values: Tensor) -> Tensor:
        """Values (B, ...) of bodies at their nodes, (n, ...)."""
        return values.index_select(0, self.graph)

    def node_sums(self, values: Tensor) -> Tensor:
        """Sums (B, ...) over the nodes of each body of values (n, ...)."""
        out = values.new_zeros(self.bodies, *values.shape[1:])
        return out.index_add(0, self.graph, values)

    def body_means(self, values: Tensor) -> Tensor:
        """Means (B, ...) over the nodes of each body of values (n, ...)."""
        counts = self.node_counts.to(values.dtype)
        return self.node_sums(values) / counts.reshape(-1, *[1] * (values.ndim - 1))

    def some(self, flags: Tensor) -> Tensor:
        """Whether any of the flags (n, ...) of each body is set, (B,)."""
        return self.node_sums(flags.flatten(1).any(dim=1).to(self.rest.dtype)) > 0.0

    def sound(self, values: Tensor) -> Tensor:
        """Whether all values (n, ...) of each body are finite, (B,)."""
        return ~self.some(~torch.isfinite(values))

    def with_material(
        self, mass: Tensor, young: Tensor, poisson: Tensor, density: Tensor
    ) -> BodyGraph:
        """The same bodies of another material: nodal masses (n,), kg, and values (c,) of cells.

        What is known of their rest is kept, also by a gate.
        """
        corners = self.cells.reshape(-1)

        def mean(values: Tensor) -> Tensor:
            each = values.to(self.rest).repeat_interleave(self.cells.shape[1])
            return torch.zeros_like(self.mass).index_add(0, corners, each) / self.cell_counts

        found = replace(
            self, mass=mass.to(self.rest), young=mean(young), poisson=mean(poisson),
            density=mean(density),
        )  # fmt: skip
        known = {name: vars(self)[name] for name in (*KNOWN, "shapes") if name in vars(self)}
        vars(found).update(known)
        return found

    def to(
        self, device: str | torch.device | None = None, dtype: torch.dtype | None = None
    ) -> BodyGraph:
        """The same elsewhere or in another precision."""
        moved = {}
        for field in fields(self):
            value: Tensor = getattr(self, field.name)
            moved[field.name] = value.to(device, dtype if value.is_floating_point() else None)
        return BodyGraph(**moved)


REST_OF_NODES = ("rest_frames", "cell_counts")
REST_OF_EDGES = ("rest_edges", "rest_turns")
REST_OF_CELLS = ("rest_inverses",)
KNOWN = (*REST_OF_NODES, *REST_OF_EDGES, *REST_OF_CELLS, "node_counts")
"""What a graph computes of its bodies at rest once for a network, when first asked for."""

_NODAL = ("rest", "free", "mass", "young", "poisson", "density")


def _one(problem: Problem) -> dict[str, Any]:
    if problem.cells.shape[1] != 8:
        raise InputError(
            f"scene {problem.scene.name!r}: cells with {problem.cells.shape[1]} nodes: the "
            "corrector expects 8, their corners."
        )
    materials, nodes = problem.materials, len(problem.positions)
    means = {
        name: node_means(getattr(materials, name), problem.cells, nodes)
        for name in ("young", "poisson", "density")
    }
    return {
        "rest": problem.positions, "free": problem.free, "mass": problem.mass, **means,
        "edge_index": mesh_edges(problem.cells), "cells": problem.cells.astype(np.int64),
    }  # fmt: skip


def _cell_sizes(rest: Tensor, cells: Tensor, graph: Tensor, bodies: int) -> Tensor:
    """Cube root of the mean cell volume of each body, m."""
    volumes = torch.linalg.det(cell_axes(rest, cells))
    owner = graph[cells[:, 0]]
    sums = volumes.new_zeros(bodies).index_add(0, owner, volumes)
    counts = torch.bincount(owner, minlength=bodies).to(volumes.dtype)
    return torch.pow(sums / counts, 1.0 / 3.0)


# --- the shape of a body at rest ---------------------------------------------------------

SHAPE_MEASURES = (
    "nodes", "largest radius", "middle radius", "smallest radius", "volume to surface",
    "supported", "fixity", "distance", "overhang", "spread",
)  # fmt: skip
"""What `shape_measures` gives, in order."""

_LEAST_RADIUS = 0.1
"""Cell sizes; flatter bodies count as this."""

_LEAST_SHARE = 1e-3
"""Of the nodes; fewer count as this."""


def shape_measures(bodies: BodyGraph) -> Array:
    """Size, slenderness and supports of B bodies, (B, 10).

    No measure depends on place, orientation, units or numbering, nor on whether a body is alone
    in its batch.  Supports are nodes with a held component; lengths are in cell sizes:

    - ``nodes``: the logarithm of their number;
    - ``largest radius``, ``middle radius``, ``smallest radius``: logarithms of the principal radii
      of gyration, that is of the nodes' root mean squared distances from their centre along the
      principal axes;
    - ``volume to surface``: the logarithm of the number of cells over that of outer faces;
    - ``supported``: the logarithm of the share of supports among the nodes;
    - ``fixity``: the logarithm of the share of the supports' components that are held;
    - ``distance``: the logarithm of 1 plus the mean length of the shortest paths along edges from
      nodes to a support; where there is none it counts as two for each node of the body, unless
      the body has no support;
    - ``overhang``: the distance between the centres of the supports and of all nodes, over the
      root mean squared distance of all nodes from theirs;
    - ``spread``: the logarithm of 1 plus the root mean squared distance of the supports from their
      centre: small for one clamp, large for supports at several places.

    The last four are 0 for bodies without supports.
    """
    parts = bodies.rest.double(), bodies.cell_size.double(), bodies.free, bodies.edge_index
    rest, cell_size, free, edge_index = (part.detach().cpu().numpy() for part in parts)
    cells, graph = bodies.cells.cpu().numpy(), bodies.graph.cpu().numpy()

    def count(which: Numbers) -> Numbers:
        return np.bincount(which, minlength=bodies.bodies).astype(np.int64)

    def means(values: Array, which: Numbers, number: Numbers) -> Array:
        total = np.zeros((bodies.bodies, *values.shape[1:]))
        np.add.at(total, which, values)
        return total / np.maximum(number, 1).reshape(-1, *[1] * (values.ndim - 1))

    counts = count(graph)
    x = rest / cell_size[graph][:, None]
    arms = x - means(x, graph, counts)[graph]
    gyration = means(arms[:, :, None] * arms[:, None, :], graph, counts)
    radii = np.sqrt(np.linalg.eigvalsh(gyration).clip(_LEAST_RADIUS**2))[:, ::-1]
    owners = graph[cells[:, 0]]
    faces = count(owners[boundary_faces(cells)[1]])

    held = ~free.all(axis=1)
    at, supports = graph[held], count(graph[held])
    fixity = np.where(supports > 0, means((~free[held]).mean(axis=1), at, supports), 1.0)
    centre = means(arms[held], at, supports)
    apart = means(np.square(arms[held] - centre[at]).sum(axis=1), at, supports)
    overhang = np.linalg.norm(centre, axis=1) / np.sqrt(np.square(radii).sum(axis=1))
    paths = _distances(x, edge_index, np.flatnonzero(held))
    paths = np.where(np.isfinite(paths), paths, 2.0 * counts[graph] * (supports[graph] > 0))
    return np.column_stack([
        np.log(counts),
        np.log(radii),
        np.log(count(owners) / faces),
        np.log((supports / counts).clip(_LEAST_SHARE)),
        np.log(fixity),
        np.log1p(means(paths, graph, counts)),
        overhang,
        np.log1p(np.sqrt(apart)),
    ])  # fmt: skip


def _distances(x: Array, edge_index: Numbers, sources: Numbers) -> Array:
    """Lengths (n,) of the shortest paths from the nearest source; infinite where there is none."""
    if not len(sources):
        return np.full(len(x), np.inf)
    here, there = edge_index
    lengths = np.linalg.norm(x[there] - x[here], axis=1)
    paths = csr_array((lengths, (here, there)), shape=(len(x), len(x)))
    found: Array = dijkstra(paths, indices=sources, min_only=True)
    return found

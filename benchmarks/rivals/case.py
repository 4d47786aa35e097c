"""The beam that all contestants simulate, and how a contestant is run; NumPy only.

A contestant is a script with ``SETTINGS``: by name the material law, the meshes (``refine``) and
further arguments of its ``simulate(case, law, ...)``, which yields the positions of ``case.points``
after each frame.  It runs in the environment of its library:

    python SCRIPT CASE SETTING REFINE OUT.npz
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np

Array = np.ndarray
COUNTS, SIZE = (12, 2, 2), 0.04
"""Coarse cells along x, y, z, and their edge, m."""
DENSITY, GRAVITY, STEP, FRAMES = 1e3, 9.81, 0.01, 60
"""kg/m3, m/s2 along -z, s."""
TWIST = 3e4
"""N/m3, of a body force about the axis of the beam."""
CASES: dict[str, dict[str, Any]] = {
    "weight": {"young": 1e6, "poisson": 0.3},
    "weight, nu 0.45": {"young": 1e6, "poisson": 0.45},
    "twist, nu 0.45": {"young": 1e6, "poisson": 0.45, "twist": TWIST},
}
"""Young's modulus, Pa, Poisson's ratio, and twisting force in place of gravity."""
_CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
_EVEN = np.array([[0, 2, 5, 7], [1, 0, 2, 5], [3, 0, 2, 7], [4, 0, 5, 7], [6, 2, 5, 7]])
_ODD = np.array([[1, 3, 4, 6], [0, 1, 3, 4], [2, 1, 3, 6], [5, 1, 4, 6], [7, 3, 4, 6]])


class Case:
    """A beam of ``refine`` cells along each edge of a coarse one, clamped at x = 0.

    ``points`` (N, 3), m; ``cells`` (C, 8) in VTK order; ``tets`` (5 C, 4), alternately cut so that
    neighbours fit, of positive volume; ``coarse`` indices of the coarse nodes; ``clamped`` too.
    """

    def __init__(self, name: str, refine: int = 1) -> None:
        self.name, self.refine = name, refine
        values = CASES[name]
        self.young, self.poisson = values["young"], values["poisson"]
        self.mu = self.young / (2 * (1 + self.poisson))
        self.lam = 2 * self.mu * self.poisson / (1 - 2 * self.poisson)
        self.twist = values.get("twist", 0.0)
        self.gravity = np.array([0.0, 0.0, 0.0 if self.twist else -GRAVITY])
        self.density, self.step, self.frames = DENSITY, STEP, FRAMES
        self.counts, self.size = tuple(refine * n for n in COUNTS), SIZE / refine
        grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in self.counts), indexing="ij"), -1)
        self.grid = grid.reshape(-1, 3)
        self.points = self.size * self.grid
        self.coarse = np.flatnonzero((self.grid % refine == 0).all(axis=1))
        self.clamped = np.flatnonzero(self.grid[:, 0] == 0)

    def number(self, grid: Array) -> Array:
        """Of the nodes with places (..., 3) in the grid."""
        _, ny, nz = self.counts
        return (grid[..., 0] * (ny + 1) + grid[..., 1]) * (nz + 1) + grid[..., 2]

    @cached_property
    def low(self) -> Array:
        """Place (C, 3) of each cell's lowest corner in the grid."""
        return self.grid[(self.grid < self.counts).all(axis=1)]

    @cached_property
    def cells(self) -> Array:
        return self.number(self.low[:, None] + _CORNERS)

    @cached_property
    def tets(self) -> Array:
        odd = self.low.sum(axis=1) % 2 == 1
        cuts = np.where(odd[:, None, None], _ODD, _EVEN)
        tets = np.take_along_axis(self.cells[:, None], cuts, axis=2).reshape(-1, 4)
        edges = self.points[tets[:, 1:]] - self.points[tets[:, :1]]
        tets[np.linalg.det(edges) < 0] = tets[np.linalg.det(edges) < 0][:, [0, 1, 3, 2]]
        return tets

    @cached_property
    def lumped(self) -> Array:
        """Nodal masses (N,) of the hexahedra, kg."""
        share = self.density * self.size**3 / 8
        return np.bincount(self.cells.ravel(), minlength=len(self.points)) * share

    def force_density(self, points: Array) -> Array:
        """Body force (..., 3) at points, N/m3, without gravity."""
        across = points[..., 1:] - 0.5 * SIZE * np.array(COUNTS[1:])
        turned = np.stack([0 * across[..., 0], -across[..., 1], across[..., 0]], axis=-1)
        radius = np.linalg.norm(across, axis=-1, keepdims=True)
        return self.twist * turned / np.where(radius == 0, 1, radius)

    @cached_property
    def forces(self) -> Array:
        """Nodal forces (N, 3) of the twist, integrated over the hexahedra, N."""
        places = (_CORNERS - 0.5) / np.sqrt(3) + 0.5
        shapes = np.abs(1 - _CORNERS - places[:, None]).prod(axis=2)  # (point, node)
        at = self.points[self.cells[:, 0]][:, None] + self.size * places
        parts = np.einsum("qn,cqd->cnd", shapes, self.force_density(at)) * self.size**3 / 8
        total = np.zeros_like(self.points)
        np.add.at(total, self.cells, parts)
        return total

    def match(self, points: Array) -> Array:
        """Indices of this case's points among ``points`` (M, 3)."""
        places = {
            tuple(row): k for k, row in enumerate(np.rint(4 * points / self.size).astype(int))
        }
        return np.array([places[tuple(4 * row)] for row in self.grid])


def main(
    simulate: Callable[..., Iterator[Array]], settings: Mapping[str, Mapping[str, Any]]
) -> None:
    """Run what the command line asks for; write positions of the coarse nodes and seconds.

    The first frame's seconds hold all set-up too: imports, meshing, compilation.
    """
    name, setting, refine, out = sys.argv[1:]
    case = Case(name, int(refine))
    wall, cpu, frames = [time.perf_counter()], [time.process_time()], [case.points[case.coarse]]
    chosen = {key: value for key, value in settings[setting].items() if key != "refine"}
    for positions in simulate(case, **chosen):
        wall.append(time.perf_counter())
        cpu.append(time.process_time())
        frames.append(np.array(positions, dtype=float)[case.coarse])
        if not np.isfinite(frames[-1]).all():
            break
    np.savez(out, positions=frames, wall=np.diff(wall), cpu=np.diff(cpu))

"""A scene on one mesh as contestants read it, and how they are run; NumPy only.

A contestant is a script with ``SETTINGS``: by name the material law, the meshes of the beam
(``refine``) and of other ``scenes``, and further arguments of its ``simulate(case, law, ...)``,
which yields the positions of ``case.points`` after each frame.  It runs in the environment of its
library, on a file that `cases.write` made:

    python SCRIPT CASE.npz SETTING OUT.npz

What its library cannot do raises `Refused`, whose text is written to OUT.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray
PARTS = 120
"""Parts of a frame for each of which the mean amplitude of a load is given.

Where steps end with parts, means over them are exact."""
MESHES = "refine", "scenes"
_EVEN = np.array([[0, 2, 5, 7], [1, 0, 2, 5], [3, 0, 2, 7], [4, 0, 5, 7], [6, 2, 5, 7]])
_ODD = np.array([[1, 3, 4, 6], [0, 1, 3, 4], [2, 1, 3, 6], [5, 1, 4, 6], [7, 3, 4, 6]])

_FACES = np.array(
    [[0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]]
)


class Refused(Exception):
    """A contestant cannot simulate the case, for the reason given."""


class Case:
    """A body of C equal cubic cells with N nodes, SI units.

    Attributes
    ----------
    points : (N, 3)
    cells : (C, 8)
        VTK order.
    coarse, clamped
        Numbers of the coarse mesh's nodes, in its order, and of the held ones.
    young, poisson, density : (C,)
    velocity : (3,)
        At time 0, of all but the clamped nodes.
    accelerations, densities, twists : (L, 3), (L, C, 3), (L, 6)
        Of each load: acceleration of the body, force density N/m3 in its cells, and field
        (strength N/m3, attraction, stretch, centre) of a scene's torsion.
    nodal : (L, N, 3)
        Nodal forces of ``densities`` and ``twists`` on trilinear hexahedra, N.
    amplitudes : (L, (frames + 1) PARTS)
        Mean amplitudes in parts of the frames.
    step, frames
        Of a frame, s, and how many.
    scene, refine
        The scene as TOML and cells along each edge of a coarse one, for this package's own runs.
    """

    points: Array
    cells: Array
    coarse: Array
    clamped: Array
    young: Array
    poisson: Array
    density: Array
    velocity: Array
    accelerations: Array
    densities: Array
    twists: Array
    nodal: Array
    amplitudes: Array

    def __init__(self, path: str | Path) -> None:
        with np.load(path) as found:
            for key in found:
                setattr(self, key, found[key])
        self.step, self.scene, self.refine = float(self.step), str(self.scene), int(self.refine)
        self.frames = self.amplitudes.shape[1] // PARTS - 1
        self.mu = self.young / (2 * (1 + self.poisson))
        self.lam = 2 * self.mu * self.poisson / (1 - 2 * self.poisson)
        self.size = float(self.points[self.cells[0, 1], 0] - self.points[self.cells[0, 0], 0])

    def substeps(self, longest: float) -> int:
        """Steps a frame of at most so many seconds."""
        return math.ceil(self.step / longest - 1e-9)

    def factors(self, substeps: int, at: float = 0.5) -> Array:
        """Mean amplitude of each load in each step, (frames, substeps, L).

        Over a step's length around the time ``at``, a share of the step, at which its equation
        holds.  So impulses are kept: what begins at once gives the rest, h (at - 0.5) times the
        load at time 0, by a scheme's first acceleration.
        """
        length = PARTS / substeps
        middles = (np.arange(self.frames * substeps) + at) * length
        sums = np.pad(self.amplitudes.cumsum(axis=1), [(0, 0), (1, 0)])
        first, last = (
            [np.interp(middles + end, np.arange(sums.shape[1]), row) for row in sums]
            for end in (-0.5 * length, 0.5 * length)
        )
        means = (np.array(last) - first) / length
        return means.T.reshape(self.frames, substeps, len(sums))

    @property
    def steady(self) -> bool:
        """Whether no load changes."""
        return bool(np.ptp(self.amplitudes, axis=1).max(initial=0.0) == 0.0)

    def uniform(self, values: Array) -> float:
        """The one value of all cells."""
        if np.ptp(values):
            raise Refused("several materials")
        return float(values[0])

    @cached_property
    def low(self) -> Array:
        """Place (C, 3) of each cell's lowest corner in the grid."""
        corner = self.points[self.cells[:, 0]] - self.points.min(axis=0)
        return np.rint(corner / self.size).astype(int)

    @cached_property
    def tets(self) -> Array:
        """Five tetrahedra of each cell (5 C, 4) of positive volume; neighbours fit."""
        odd = self.low.sum(axis=1) % 2 == 1
        cuts = np.where(odd[:, None, None], _ODD, _EVEN)
        tets = np.take_along_axis(self.cells[:, None], cuts, axis=2).reshape(-1, 4)
        edges = self.points[tets[:, 1:]] - self.points[tets[:, :1]]
        tets[np.linalg.det(edges) < 0] = tets[np.linalg.det(edges) < 0][:, [0, 1, 3, 2]]
        return tets

    @property
    def owners(self) -> Array:
        """The cell of each tetrahedron."""
        return np.repeat(np.arange(len(self.cells)), 5)

    def force_density(self, load: int, points: Array, cells: Array) -> Array:
        """Of a load at points (..., 3) in cells (...), gravity included, N/m3."""
        strength, attraction, stretch, *centre = self.twists[load]
        _, y, z = np.moveaxis(points - centre, -1, 0)
        field = np.stack([stretch + 0 * y, -z - attraction * y, y - attraction * z], axis=-1)
        length = np.linalg.norm(field, axis=-1, keepdims=True)
        uniform = self.densities[load] + self.density[:, None] * self.accelerations[load]
        return uniform[cells] + strength * field / np.where(length == 0, 1, length)

    def held(self, points: Array) -> Array:
        """Which points (M, 3) lie on faces of cells whose four corners are clamped."""
        faces = self.cells[:, _FACES]
        faces = self.points[faces[np.isin(faces, self.clamped).all(axis=2)]]
        low, high = (end(faces, axis=1) for end in (np.min, np.max))
        near = 1e-6 * self.size
        inside = (points[:, None] > low - near) & (points[:, None] < high + near)
        return inside.all(axis=2).any(axis=1)

    def match(self, points: Array) -> Array:
        """Indices of this case's points among ``points`` (M, 3)."""
        places = {
            tuple(row): k for k, row in enumerate(np.rint(4 * points / self.size).astype(int))
        }
        return np.array([places[tuple(row)] for row in np.rint(4 * self.points / self.size)])


def with_middles(points: Array, tets: Array) -> tuple[Array, Array]:
    """Points and tetrahedra of ten nodes, Abaqus's order."""
    ends = np.sort(tets[:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]], axis=2)
    edges, numbers = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middles = numbers.reshape(-1, 6) + len(points)
    return np.concatenate([points, points[edges].mean(axis=1)]), np.hstack([tets, middles])


def main(
    simulate: Callable[..., Iterator[Array]], settings: Mapping[str, Mapping[str, Any]]
) -> None:
    """Run what the command line asks for; write positions of the coarse nodes and seconds.

    The first frame's seconds hold all set-up too: imports, meshing, compilation.
    """
    path, setting, out = sys.argv[1:]
    case = Case(path)
    wall, cpu, frames = [time.perf_counter()], [time.process_time()], [case.points[case.coarse]]
    chosen = {key: value for key, value in settings[setting].items() if key not in MESHES}
    try:
        for positions in simulate(case, **chosen):
            wall.append(time.perf_counter())
            cpu.append(time.process_time())
            frames.append(np.array(positions, dtype=float)[case.coarse])
            if not np.isfinite(frames[-1]).all():
                break
    except Refused as error:
        np.savez(out, refused=str(error))
    else:
        np.savez(out, positions=frames, wall=np.diff(wall), cpu=np.diff(cpu))

"""Contact of a body's surface with obstacles: a barrier on gaps, and Coulomb friction.

Each contact point a has a gap d_a and an area w_a, the share of the boundary at rest that
Simpson's rule gives it: corners, edge and face centres of the boundary faces.  Its energy is

    B_a = w_a k D b(d_a / D),    b(s) = -(s - 1)^2 ln s for s < 1, else 0,

with the distance D and stiffness k of the obstacle: twice continuously differentiable, and
infinite where d_a falls to zero (Li et al. 2020, eq. 6, here by area, so that pressure does not
depend on the mesh).

Friction of a step in which points slide by u_a, in the tangent plane and beyond the obstacle's
own motion, is lagged (eq. 12 to 17 there): with the force N_a and the plane of an earlier iterate

    D_a = m N_a f(|u_a|),    f' = 2 u/e - u^2/e^2 for u < e, else 1,

e the slip velocity times the step.  It is convex and dissipative.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from pdcorrect.errors import PdcorrectWarning, SceneError
from pdcorrect.fem.assembly import sparse_times
from pdcorrect.fem.decomposition import OPTIONS
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.mesh import HexMesh, boundary_faces
from pdcorrect.fem.obstacles import RigidObstacle
from pdcorrect.fem.operators import Space
from pdcorrect.scene.obstacles import Obstacle

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_DISTANCE = 0.01
"""Of the coarse cell size, see `scene.obstacles`."""
_SLIP = 0.01
"""Of the coarse cell size a second."""
_TOUCH = 1e-6
"""Of the coarse cell size: how far a body at rest may reach into an obstacle that it touches."""
_MARGIN = 0.9
"""Of the way to an obstacle that an iterate may go."""
_ROUNDING = 1e-12
"""Of shape functions that are zero at a point."""
_LINE = np.array([0.0, 0.5, 1.0])
_SIMPSON = np.array([1.0, 4.0, 1.0]) / 6.0


@njit(**OPTIONS)
def barrier(s):  # type: ignore[no-untyped-def]
    """B and its first two derivatives at s (n,); infinite value for s <= 0."""
    value, first, second = np.empty_like(s), np.empty_like(s), np.empty_like(s)
    for i in range(len(s)):
        inside = min(max(s[i], 1e-100), 1.0)
        e, log = inside - 1.0, math.log(inside)
        ratio = e / inside
        value[i] = -e * e * log if s[i] > 0.0 else math.inf
        first[i] = -2.0 * e * log - e * ratio
        second[i] = -2.0 * log - 4.0 * ratio + ratio * ratio
    return value, first, second


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a body's boundary that may touch something.

    Attributes
    ----------
    operator : (n, N) sparse
        Shape functions: nodal values to those at the points.
    areas : (n,)
        At rest, m2.
    cells : (n,)
        A cell that each point belongs to, in order.
    local : (n, K)
        Shape functions of that cell's nodes.
    """

    operator: sp.csr_matrix
    areas: Array
    cells: Index
    local: Array

    def __len__(self) -> int:
        return len(self.areas)


def surface_points(mesh: HexMesh, space: Space, free: NDArray[np.bool_]) -> SurfacePoints:
    """The contact points of a body, without those whose nodes are all held."""
    faces, owners = boundary_faces(mesh.cells)
    s, t = (x.ravel() for x in np.meshgrid(_LINE, _LINE, indexing="ij"))
    corners = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=1)  # (9, 4)
    along = np.stack([-(1 - t), 1 - t, t, -t], axis=1), np.stack([-(1 - s), -s, s, 1 - s], axis=1)
    places = mesh.positions[faces]  # (f, 4, 3)
    normals = np.cross(*(np.einsum("pk,fki->fpi", slope, places) for slope in along))
    areas = np.linalg.norm(normals, axis=2) * np.outer(_SIMPSON, _SIMPSON).ravel()
    number = (mesh.cells[owners][:, None, :] == faces[:, :, None]).argmax(axis=2)  # (f, 4)
    at = np.einsum("pk,fki->fpi", corners, VTK_CORNERS[number]).reshape(-1, 3)
    cells, local = np.repeat(owners, 9), space.shape_functions(at)
    local[np.abs(local) < _ROUNDING] = 0.0
    nodes = np.where(local != 0.0, space.cells[cells], -1)  # the same for a point of several faces
    _, first, which = np.unique(
        np.sort(nodes, axis=1), axis=0, return_index=True, return_inverse=True
    )
    total = np.bincount(which.ravel(), weights=areas.ravel()).astype(np.float64)
    movable = np.asarray(free.any(axis=1))
    loose = (movable[nodes[first]] & (nodes[first] >= 0)).any(axis=1)
    first, total = first[loose], total[loose]
    order = np.argsort(cells[first], kind="stable")
    first, total = first[order], total[order]
    cells, local = cells[first], local[first]
    rows = np.repeat(np.arange(len(cells)), local.shape[1])
    entries = (local.ravel(), (rows, space.cells[cells].ravel()))
    operator = sp.csr_matrix(entries, shape=(len(cells), len(space.positions)))
    operator.eliminate_zeros()
    return SurfacePoints(operator, total, cells, local)


@dataclass(frozen=True, eq=False)
class Touching:
    """Points within an obstacle's distance, n of them.

    ``force`` (n,), N, and ``slope``, N/m, are minus the first and the second derivative of their
    energies by the gap; ``normals`` (n, 3) and ``curvatures`` (n, 3, 3) those of the gap.
    """

    points: Index
    value: float
    force: Array
    slope: Array
    normals: Array
    curvatures: Array

    def matrices(self, project: bool = False) -> Array:
        """Second derivatives (n, 3, 3) of the energies, N/m.

        ``project`` leaves out the part of the surface's curvature, which is never positive.
        """
        n = self.normals
        out = self.slope[:, None, None] * n[:, :, None] * n[:, None, :]
        return out if project else out - self.force[:, None, None] * self.curvatures


class Contact:
    """A body's surface and all obstacles of its scene.

    Parameters
    ----------
    declared : sequence of Obstacle
    points : SurfacePoints
    rest : (N, 3)
        Rest positions, m.
    cell_size : float
        Coarse cell size, m, the unit of default distances and slip velocities.
    stiffness : float
        Pa, of obstacles that have none of their own.

    Attributes
    ----------
    obstacles : list of RigidObstacle
    distances, stiffnesses, slips, frictions : list of float
        m, Pa, m/s and coefficient, one an obstacle.

    Raises
    ------
    SceneError
        If an obstacle reaches into the body at time 0, or is too thin to be moved in.
    """

    def __init__(
        self,
        declared: Sequence[Obstacle],
        points: SurfacePoints,
        rest: Array,
        cell_size: float,
        stiffness: float,
    ) -> None:
        self.points = points
        self._transposed = points.operator.T.tocsr()
        self.distances = [o.distance or _DISTANCE * cell_size for o in declared]
        self.stiffnesses = [o.stiffness or stiffness for o in declared]
        self.slips = [o.slip or _SLIP * cell_size for o in declared]
        self.frictions = [o.friction for o in declared]
        self.obstacles: list[RigidObstacle] = []
        at, spacing = points.operator @ rest, float(np.sqrt(points.areas.mean()))
        for i, (one, distance) in enumerate(zip(declared, self.distances, strict=True)):
            gaps = RigidObstacle(one).gaps(at, 0.0)
            worst = int(gaps.argmin())
            if gaps[worst] < -_TOUCH * cell_size:
                raise SceneError(
                    f"obstacles[{i}] reaches {-gaps[worst]:.3g} m into the body at "
                    f"{at[worst].tolist()} m: expected a body outside at time 0."
                )
            recess = max(0.0, distance - float(gaps[worst]))
            found = RigidObstacle(one, recess)
            thickness, width, _ = found.extents
            if 2.0 * recess >= thickness:
                raise SceneError(
                    f"obstacles[{i}] touches the body and is {thickness:.3g} m thick: "
                    f"expected more than twice its distance, {distance:.3g} m."
                )
            if width < spacing:
                warnings.warn(
                    f"obstacles[{i}] is {width:.3g} m wide and contact points lie "
                    f"{spacing:.3g} m apart: it may pass between them. Use smaller cells.",
                    PdcorrectWarning,
                    stacklevel=4,
                )
            self.obstacles.append(found)

    def at(self, nodal: Array) -> Array:
        """Values at the points (n, 3) of a nodal field or configuration."""
        return sparse_times(self.points.operator, nodal)

    def gaps(self, nodal: Array, time: float) -> Array:
        """Of each obstacle and point, (obstacles, n), m."""
        return self.gaps_at(self.at(nodal), time)

    def gaps_at(self, x: Array, time: float) -> Array:
        """The same for points at x (n, 3)."""
        return np.stack([o.gaps(x, time) for o in self.obstacles])

    def touching(self, x: Array, time: float) -> list[Touching]:
        """By obstacle, what its barrier makes of points at x (n, 3) at a time (s)."""
        out = []
        for obstacle, D, k in zip(self.obstacles, self.distances, self.stiffnesses, strict=True):
            gaps = obstacle.gaps(x, time)
            points = np.flatnonzero(gaps < D)  # without any the kernels are run, so loaded, too
            areas = self.points.areas[points]
            value, first, second = barrier(gaps[points] / D)
            normals, curvatures = obstacle.derivatives(x[points], time)
            force, slope = -k * areas * first, k / D * areas * second
            energy = float(k * D * (areas @ value))
            out.append(Touching(points, energy, force, slope, normals, curvatures))
        return out

    def longest_step(self, x: Array, way: Array, time: float) -> float:
        """Largest share of the points' paths, at most 1, that keeps away from all obstacles."""
        return min(1.0, _MARGIN * min(o.first_hit(x, way, time) for o in self.obstacles))

    def spread(self, values: Array, unknowns: int) -> Array:
        """Values (n, 3) at the points as nodal ones, on configurations (unknowns, 3)."""
        out = np.zeros((unknowns, 3))
        out[: self._transposed.shape[0]] = sparse_times(self._transposed, values)
        return out

    def add_product(self, points: Index, matrices: Array, x: Array, out: Array) -> None:
        """Add to ``out`` matrices (m, 3, 3) of some points times x, both on configurations."""
        A = self.points.operator
        _add_product(A.indptr, A.indices, A.data, points, matrices, x, out)

    def add_to(self, blocks: Array, matrices: Array, points: Index) -> None:
        """Add matrices (m, 3, 3) of some points to those of their cells, (C, L, L, 3, 3)."""
        _add_blocks(self.points.cells, self.points.local, points, matrices, blocks)


@njit(**OPTIONS)
def _add_product(starts, nodes, shares, points, matrices, x, out):  # type: ignore[no-untyped-def]
    """Add A^T H A x for A in compressed rows, of which ``points`` have an H."""
    at = np.empty(3)
    for m in range(len(points)):
        row = range(starts[points[m]], starts[points[m] + 1])
        at[:] = 0.0
        for k in row:
            for i in range(3):
                at[i] += shares[k] * x[nodes[k], i]
        for i in range(3):
            image = 0.0
            for j in range(3):
                image += matrices[m, i, j] * at[j]
            for k in row:
                out[nodes[k], i] += shares[k] * image


@njit(**OPTIONS)
def _add_blocks(cells, local, points, matrices, blocks):  # type: ignore[no-untyped-def]
    """Add A^T H A to the matrices of the cells."""
    for m in range(len(points)):
        block, shares = blocks[cells[points[m]]], local[points[m]]
        for k in range(len(shares)):
            for l in range(len(shares)):
                both = shares[k] * shares[l]
                if both != 0.0:
                    for i in range(3):
                        for j in range(3):
                            block[k, l, i, j] += both * matrices[m, i, j]

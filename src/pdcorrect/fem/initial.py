"""Where a run starts that goes on from a frame of another one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import SceneError
from pdcorrect.fem.locate import locate, trilinear

Array = NDArray[np.float64]

_OUTSIDE = 1e-3
"""Of the cell size: how far a node at rest may lie outside the other run's body."""


def motion_from(path: Path, frame: int, rest: Array, cell_size: float) -> tuple[Array, Array]:
    """Positions (m) and velocities (m/s) of nodes at ``rest`` (N, 3) in a trajectory file.

    Those of the same nodes if the meshes are the same; else displacements and velocities are
    interpolated from the corners of the other run's cells.

    Raises
    ------
    SceneError
        If the file cannot be read, has no such frame, or is of another body.
    """
    points, cells, positions, velocities = _read(path, frame)
    if points.shape == rest.shape and np.abs(points - rest).max() <= 1e-9 * cell_size:
        return positions, velocities
    corners = cells[:, :8]
    found, local, distances = locate(points, corners, rest)
    if distances.max() > _OUTSIDE * cell_size:
        node = int(distances.argmax())
        raise SceneError(
            f"initial.run = {str(path)!r}: node {node} at {rest[node].tolist()} m is "
            f"{distances[node]:.3g} m outside that run's body: expected a run of the same body."
        )
    nodes, shares = corners[found], trilinear(local)
    displacement = np.einsum("nk,nki->ni", shares, (positions - points)[nodes])
    return rest + displacement, np.einsum("nk,nki->ni", shares, velocities[nodes])


def _read(path: Path, frame: int) -> tuple[Array, NDArray[np.int64], Array, Array]:
    import h5py  # only where there is a file

    try:
        with h5py.File(path) as file:
            count = len(file["times"])
            if not -count <= frame < count:
                raise SceneError(
                    f"initial.frame = {frame}: expected {-count} to {count - 1}, the frames of "
                    f"{str(path)!r}."
                )
            positions, velocities = (
                np.array(file[name][range(count)[frame]], dtype=np.float64)
                for name in ("positions", "velocities")
            )
            points = np.array(file["mesh/points"], dtype=np.float64)
            if not points.shape == positions.shape == velocities.shape == (len(points), 3):
                raise ValueError(f"{positions.shape} positions of {points.shape} nodes")
            return points, file["mesh/cells"][:], positions, velocities
    except SceneError:
        raise
    except Exception as error:  # HDF5 raises nearly every type on damaged bytes
        raise SceneError(
            f"initial.run = {str(path)!r} cannot be read ({error}): expected a trajectory file, as "
            "of pdcorrect simulate, of a run that has ended (simulate --resume ends one that was "
            "killed)."
        ) from None

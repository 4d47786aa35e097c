"""Where a run starts that goes on from a frame of another one."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError, PdcorrectWarning, SceneError
from pdcorrect.fem.locate import locate, trilinear
from pdcorrect.scene import Clamp, Scene

Array = NDArray[np.float64]

_OUTSIDE = 1e-3
"""Of the cell size: how far a node at rest may lie outside the other run's body."""


def motion_from(
    path: Path, frame: int, rest: Array, cell_size: float, clamps: tuple[Clamp, ...]
) -> tuple[Array, Array]:
    """Positions (m) and velocities (m/s) of nodes at ``rest`` (N, 3) in a trajectory file.

    Those of the same nodes if the meshes are the same; else displacements and velocities are
    interpolated from the corners of the other run's cells.  A `PdcorrectWarning` says if its scene
    does not hold what ``clamps`` do.

    Raises
    ------
    SceneError
        If the file cannot be read, has no such frame, or is of another body.
    """
    points, cells, positions, velocities, scene_toml = _read(path, frame)
    _warn_of_clamps(path, scene_toml, clamps)
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


def _warn_of_clamps(path: Path, scene_toml: str, clamps: tuple[Clamp, ...]) -> None:
    try:
        earlier = Scene.from_toml(scene_toml).clamps
    except InputError:  # of another program, or of an older version
        return
    had, has = ([one.model_copy(update={"motion": None}) for one in x] for x in (earlier, clamps))
    if had != has:
        warnings.warn(
            f"initial.run = {str(path)!r}: that run's scene has other clamps ({len(had)}, this one "
            f"{len(has)}): what one of them alone holds is let go, or stopped, in the first step.",
            PdcorrectWarning,
            stacklevel=4,
        )


def _read(path: Path, frame: int) -> tuple[Array, NDArray[np.int64], Array, Array, str]:
    import h5py  # only where there is a file

    try:
        with h5py.File(path, locking=False) as file:
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
            text = file.attrs.get("scene_toml", b"")
            scene_toml = text.decode() if isinstance(text, bytes) else str(text)
            return points, file["mesh/cells"][:], positions, velocities, scene_toml
    except SceneError:
        raise
    except Exception as error:  # HDF5 raises nearly every type on damaged bytes
        raise SceneError(
            f"initial.run = {str(path)!r} cannot be read ({error}): expected a trajectory file, as "
            "of pdcorrect simulate, of a run that has ended (simulate --resume ends one that was "
            "killed)."
        ) from None

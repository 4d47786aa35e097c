"""What training needs of a file of a data set, without the rest of it.

Files are opened, read and closed at once: nothing here keeps a handle.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.hdf5_checks import RefusalError, words
from pdcorrect.data.schema import HASH, MESH, REFERENCE
from pdcorrect.data.shard_reader import opened
from pdcorrect.fem.graph import mesh_edges, node_means, velocities

Array = NDArray[Any]


@dataclass(frozen=True)
class ShardHeader:
    """What a file holds, found without reading its arrays.

    Attributes
    ----------
    path : Path
    number : int
        Of the mesh in its split.
    nodes, cells : int
    steps : tuple of int
        T of each simulation.
    runs : tuple of (names of runs with positions, names of runs with predictions)
        For each simulation.
    scenes : tuple of bool
        Whether each simulation has its scene.
    time_step : float
        s.
    config_hash, content_hash : str
    """

    path: Path
    number: int
    nodes: int
    cells: int
    steps: tuple[int, ...]
    runs: tuple[tuple[frozenset[str], frozenset[str]], ...]
    scenes: tuple[bool, ...]
    time_step: float
    config_hash: str
    content_hash: str


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """A mesh as a graph.

    Attributes
    ----------
    rest : (N, 3) float64
        m.
    free : (N, 3) bool
    mass : (N,) float64
        kg.
    cells : (C, 8) int64
    edge_index : (2, E) int64
        See `mesh_edges`.
    cell_young, cell_poisson, cell_density : (C,) float64
        Pa, dimensionless, kg/m3.
    young, poisson, density : (N,) float64
        Their means over the cells of each node.
    """

    rest: Array
    free: Array
    mass: Array
    cells: Array
    edge_index: Array
    cell_young: Array
    cell_poisson: Array
    cell_density: Array
    young: Array
    poisson: Array
    density: Array


@dataclass(frozen=True, eq=False)
class MotionArrays:
    """A simulation's motion; frame t of the last three belongs to the step from t to t + 1.

    Attributes
    ----------
    positions : (T+1, N, 3)
        Of the reference, m.
    velocities : (T, N, 3) float64
        Of the reference in the frames that steps start from, m/s.
    forces : (T, N, 3)
        N.
    predictions : dict of str to (T, N, 3)
        One step of a model from each frame of the reference, m.
    rollouts : dict of str to (T+1, N, 3)
        m.
    """

    positions: Array
    velocities: Array
    forces: Array
    predictions: dict[str, Array]
    rollouts: dict[str, Array]


def read_header(path: Path) -> ShardHeader:
    """Sizes and names of a file of a data set.

    Raises
    ------
    FileFormatError
        If it is damaged or something else.
    """
    with opened(path, verify=False) as file:
        groups = _simulations(file)
        return ShardHeader(
            path=path,
            number=int(file.attrs["number"]),
            nodes=len(file[MESH["points"][0]]),
            cells=len(file[MESH["cells"][0]]),
            steps=tuple(len(group["forces"]) for group in groups),
            runs=tuple((_with(g, "positions"), _with(g, "predictions")) for g in groups),
            scenes=tuple(str(group.attrs["scene"]) != "" for group in groups),
            time_step=float(file.attrs["time_step"]),
            config_hash=str(file.attrs["config_hash"]),
            content_hash=str(file.attrs[HASH]),
        )


def read_arrays(
    path: Path, predictions: Sequence[str] = (), rollouts: Sequence[str] = ()
) -> tuple[MeshArrays, list[MotionArrays]]:
    """The mesh of a file and the motion of each of its simulations.

    Parameters
    ----------
    path : Path
    predictions, rollouts : sequence of str
        Names of the runs whose predictions and positions are read.

    Raises
    ------
    FileFormatError
        If the file is damaged, something else, or does not hold them.
    """
    with opened(path, verify=False) as file:
        time_step = float(file.attrs["time_step"])
        motions = [_motion(g, time_step, predictions, rollouts) for g in _simulations(file)]
        return _mesh(file), motions


def _simulations(file: h5py.File) -> list[h5py.Group]:
    return [file["simulations"][key] for key in sorted(file["simulations"])]


def _with(simulation: h5py.Group, name: str) -> frozenset[str]:
    return frozenset(run for run, group in simulation["runs"].items() if name in group)


def _mesh(file: h5py.File) -> MeshArrays:
    found = {name: file[place][()] for name, (place, _, _) in MESH.items()}
    cells = found["cells"].astype(np.int64)
    moduli = {name: found[name] for name in ("young", "poisson", "density")}
    nodes = len(found["points"])
    return MeshArrays(
        rest=found["points"],
        free=found["free"],
        mass=found["mass"],
        cells=cells,
        edge_index=mesh_edges(cells),
        **{f"cell_{name}": values for name, values in moduli.items()},
        **{name: node_means(values, cells, nodes) for name, values in moduli.items()},
    )


def _motion(
    group: h5py.Group, time_step: float, predictions: Sequence[str], rollouts: Sequence[str]
) -> MotionArrays:
    positions = _of_run(group, REFERENCE, "positions")
    stored = group["runs"][REFERENCE].get("velocities")
    return MotionArrays(
        positions=positions,
        velocities=(
            velocities(positions[:-1], time_step)
            if stored is None
            else np.asarray(stored[:-1], dtype=np.float64)
        ),
        forces=group["forces"][()],
        predictions={name: _of_run(group, name, "predictions") for name in predictions},
        rollouts={name: _of_run(group, name, "positions") for name in rollouts},
    )


def _of_run(simulation: h5py.Group, run: str, name: str) -> Array:
    """Positions or predictions of a run."""
    place = f"runs/{run}/{name}"
    if place not in simulation:
        raise RefusalError(f"{words(f'{simulation.name}/{place}'.lstrip('/'))} is missing")
    return np.asarray(simulation[place][()])


Value = TypeVar("Value")


class RecentlyUsed(Generic[Value]):
    """Values by number; the least recently used go first when they exceed ``limit`` bytes.

    The value asked for last always stays, however large.  A pickled copy is empty.

    Parameters
    ----------
    load : callable
        Number -> value.
    size : callable
        Value -> bytes.
    limit : int
        Bytes.
    """

    def __init__(
        self, load: Callable[[int], Value], size: Callable[[Value], int], limit: int
    ) -> None:
        self.load, self.size, self.limit = load, size, limit
        self.bytes = 0
        self._values: OrderedDict[int, Value] = OrderedDict()

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, number: int) -> bool:
        return number in self._values

    def __getitem__(self, number: int) -> Value:
        if number in self._values:
            self._values.move_to_end(number)
            return self._values[number]
        value = self.load(number)
        self._values[number] = value
        self.bytes += self.size(value)
        while self.bytes > self.limit and len(self._values) > 1:
            _, oldest = self._values.popitem(last=False)
            self.bytes -= self.size(oldest)
        return value

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "bytes": 0, "_values": OrderedDict()}

"""`Trajectory`, and the `Stepper` that makes one.

A stepper is anything that maps a state to a `StepResult`; projective dynamics,
Newton and the corrected solver are interchangeable because of it.
"""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import require_extra
from pdcorrect.state import State, StepResult

if TYPE_CHECKING:
    from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]


class Stepper(Protocol):
    """Anything that advances a state by one step.

    All that the next step depends on belongs into the `State`.  A stepper that
    carries anything else from step to step may have a method
    ``restore(run: Trajectory) -> None``: before a run is continued from a file,
    it is called with the frames so far.
    """

    @property
    def problem(self) -> Problem:
        """The discretised scene it steps."""

    def __call__(self, state: State, forces: Array | None = None) -> StepResult:
        """Advance ``state`` by one time step, with extra nodal forces (N, 3), N."""

    def describe(self) -> dict[str, str]:
        """Method and back end, for summaries and files."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Frames of a run; frame 0 is the initial state.

    Attributes
    ----------
    positions, velocities : (T+1, N, 3) float64
        m and m/s.
    times : (T+1,) float64
        s.
    stats : mapping of str to (T,) arrays
        ``status`` (names of `Status`), ``iterations``, ``residual`` (N),
        ``error_estimate`` (m), ``seconds`` (wall clock) and energies (J), one
        entry a step.
    points : (N, 3) float64
        Rest positions, m.
    cells : (C, K) int
        Node numbers, VTK order.
    scene_toml : str
        The scene it came from; empty for foreign data.
    attributes : mapping of str to str
        Solver, refinement, element, mass, code version.
    problem : Problem or None
        What was stepped; None when read from a file.
    memory : mapping of str to (T+1, N, 3) float64
        ``State.memory`` of the frames; NaN in those that have none.
    """

    positions: Array
    velocities: Array
    times: Array
    stats: Mapping[str, NDArray[Any]]
    points: Array
    cells: NDArray[np.int64]
    scene_toml: str = ""
    attributes: Mapping[str, str] = field(default_factory=dict)
    problem: Problem | None = None
    memory: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"Trajectory({len(self)} steps to t = {self.times[-1]:g} s, {len(self.points)} nodes, "
            f"{len(self.cells)} cells)"
        )

    def __len__(self) -> int:
        """Number of steps T (there are T + 1 frames)."""
        return len(self.times) - 1

    def _repr_html_(self) -> str:
        """A table for notebooks."""
        moved = np.linalg.norm(self.positions - self.points, axis=2).max()
        rows = {
            "steps": f"{len(self)}, to t = {self.times[-1]:g} s",
            "mesh": f"{len(self.points)} nodes, {len(self.cells)} cells",
            "largest displacement": f"{1e3 * moved:.4g} mm",
            **self.attributes,
        }
        lines = (
            f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"
            for name, value in rows.items()
        )
        return f"<table>{''.join(lines)}</table>"

    def to_pyvista(self, frame: int = -1) -> Any:
        """A frame as `pyvista.UnstructuredGrid` (extra ``view``).

        Points are the positions, point data ``displacement`` (m) and ``velocity`` (m/s); cells of
        27 nodes are VTK's triquadratic hexahedra.
        """
        require_extra("pyvista", "view")
        import pyvista as pv

        kind = {8: pv.CellType.HEXAHEDRON, 27: pv.CellType.TRIQUADRATIC_HEXAHEDRON}
        cells = {kind[self.cells.shape[1]]: self.cells}
        grid = pv.UnstructuredGrid(cells, self.positions[frame])
        grid.point_data["displacement"] = self.positions[frame] - self.points
        grid.point_data["velocity"] = self.velocities[frame]
        return grid

    def plot(self, frame: int = -1, **options: Any) -> Any:
        """Show a frame, coloured by displacement; options of `pyvista.DataSet.plot`."""
        return self.to_pyvista(frame).plot(**{"scalars": "displacement", **options})

    def state(self, frame: int = -1) -> State:
        """The state at a frame."""
        memory = {n: a[frame] for n, a in self.memory.items() if np.isfinite(a[frame]).all()}
        return State(
            self.positions[frame], self.velocities[frame], float(self.times[frame]), memory
        )

"""What bodies are coloured by: values at their nodes, and one scale for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.fem.mesh import coincident_nodes
from pdcorrect.fem.problem import Problem
from pdcorrect.fem.stress import stress, von_mises
from pdcorrect.figures.panels import Body
from pdcorrect.figures.sheet import ColourBar, length_unit, pressure_unit, round_limit
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
Colour = Literal["displacement", "error", "stress", "volume"]


@dataclass(frozen=True)
class _Field:
    """Title of the colour bar, colour map, and the unit of values."""

    title: str
    palette: str
    unit: Callable[[float], tuple[float, str]] | None


_FIELDS = {
    "displacement": _Field("displacement", "viridis", length_unit),
    "error": _Field("distance to the reference", "YlOrRd", length_unit),
    "stress": _Field("von Mises stress", "plasma", pressure_unit),
    "volume": _Field("det F, volume over volume at rest", "coolwarm", None),
}
COLOURS = tuple(_FIELDS)


def body_of(
    run: Trajectory,
    frames: NDArray[np.int64],
    colour: Colour | None,
    reference: Trajectory | None = None,
    reference_frames: NDArray[np.int64] | None = None,
) -> Body:
    """A run at frames (n,) with its values; to a reference at as many frames of its own."""
    if colour is None:
        return Body(run, frames, None)
    if colour == "error":
        if reference is None or reference_frames is None:
            raise InputError("colour = 'error': expected a reference trajectory.")
        run = on_nodes_of(run, reference)
        nodes = coincident_nodes(reference.points, run.points, _tolerance(run))
        truth = reference.positions[reference_frames][:, nodes]
        return Body(run, frames, np.linalg.norm(run.positions[frames] - truth, axis=2))
    return Body(run, frames, nodal_values(run, frames, colour))


def nodal_values(run: Trajectory, frames: Sequence[int] | NDArray[np.int64], colour: str) -> Array:
    """Displacement (m), von Mises stress (Pa) or det F at the nodes in frames (n,), (n, N).

    Stress and det F are averaged to the nodes, see `Stress.at_nodes`.
    """
    if colour == "displacement":
        return np.linalg.norm(run.positions[frames] - run.points, axis=2)
    from pdcorrect.io.trajectory_reader import problem_of

    problem, field = problem_of(run), _von_mises if colour == "stress" else _volume_ratio
    return np.stack([field(problem, run.positions[frame]) for frame in frames])


def _von_mises(problem: Problem, positions: Array) -> Array:
    return von_mises(stress(problem, positions).nodal_cauchy)


def _volume_ratio(problem: Problem, positions: Array) -> Array:
    found = stress(problem, positions)
    return found.at_nodes(np.linalg.det(found.deformation))


def on_nodes_of(run: Trajectory, other: Trajectory) -> Trajectory:
    """A run at the nodes of another one, with its cells, where it has more nodes."""
    if len(run.points) <= len(other.points):
        return run
    nodes = coincident_nodes(run.points, other.points, _tolerance(other))
    return replace(
        run, positions=run.positions[:, nodes], velocities=run.velocities[:, nodes],
        points=other.points, cells=other.cells,
    )  # fmt: skip


def _tolerance(run: Trajectory) -> float:
    return 1e-6 * float(np.ptp(run.points[run.cells[0]], axis=0).max())


def scaled(bodies: Sequence[Body], colour: Colour) -> tuple[list[Body], ColourBar]:
    """Values in the unit in which the largest reads best, and their common scale."""
    field, values = _FIELDS[colour], [body.values for body in bodies if body.values is not None]
    if field.unit is None:  # ratios, on both sides of 1
        limit = round_limit(max(float(np.abs(v - 1.0).max()) for v in values) or 1e-3)
        return list(bodies), ColourBar(field.title, field.palette, 1.0 + limit, 1.0 - limit)
    largest = max(float(v.max()) for v in values)
    factor, unit = field.unit(largest or 1e-3)
    bar = ColourBar(f"{field.title} [{unit}]", field.palette, round_limit(factor * largest or 1.0))
    return [replace(b, values=factor * v) for b, v in zip(bodies, values, strict=True)], bar

"""Whether a file's motions can be those of its scenes: volumes, models, loads, single steps.

What a file says of its own steps is not proof of them.  Forces are computed again from the
scenes, and some steps of the coarse models are taken again from the stored states; the reference
is held against them, too, since predictions start from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.engines import MOST_ITERATIONS, step_forces
from pdcorrect.data.importing import INTEGRATOR
from pdcorrect.data.plan import MeshPlan
from pdcorrect.data.schema import REFERENCE, STATISTICS, Array, Shard, Simulation
from pdcorrect.data.simulate import models, rebuilt_problems
from pdcorrect.errors import InputError
from pdcorrect.fem.hexahedron import shape_derivatives
from pdcorrect.fem.problem import BASES, Problem
from pdcorrect.solvers.projective import ProjectiveDynamics
from pdcorrect.state import State

_CENTRE = np.full((1, 3), 0.5)
_STEP_ERROR = 10.0
"""Largest distance from a step that is taken again, in tolerances of the data set."""
_ROUNDINGS = 16.0
"""The same for rounding, in spacings of the largest coordinate: a step starts from two frames."""


def volume_faults(shard: Shard, simulation: Simulation) -> Iterator[str]:
    """Cells that a run turns inside out: by its statistics, and by det F at their centres.

    The latter on the coarse nodes, of what is stored; det F at quadrature points, and on the
    mesh of the reference, is in the statistics alone.
    """
    cells = shard.cells.astype(np.int64)
    for name, run in simulation.runs.items():
        ratios = run.statistics.get("smallest_volume_ratios")
        if ratios is not None and ratios.min() <= 0:
            yield f"{name}: det F is {ratios.min():.3g} after step {ratios.argmin() + 1}"
        for what, values in (("positions", run.positions), ("predictions", run.predictions)):
            if values is None:
                continue
            inverted = np.array([_central(frame, cells).min() <= 0 for frame in values])
            if inverted.any():
                first = inverted.argmax()
                yield f"{name}: a cell is inside out in its {what}, first in row {first}"


def _central(positions: Array, cells: Array) -> Array:
    """Determinants of the trilinear map at the cells' centres, (C,), m3."""
    slopes = shape_derivatives(_CENTRE)[:, 0]  # (3, 8)
    a, b, c = np.matmul(slopes, positions[cells]).transpose(1, 0, 2)
    found: Array = np.einsum("ni,ni->n", a, np.cross(b, c))
    return found


def model_faults(config: DatasetConfig, plan: MeshPlan, shard: Shard) -> Iterator[str]:
    """Runs that say to be of other models than the configuration's, or not how they went."""
    for name, model in models(config, plan).items():
        wanted: dict[str, str | int | float] = {
            "refine": model.refine,
            "time_step": plan.step / model.divisor,
            "solver": config.reference.solver if model.truth else "pd",
        }
        for k, simulation in enumerate(shard.simulations):
            run = simulation.runs.get(name)
            if run is None:
                continue
            for key, value in wanted.items():
                if run.attributes.get(key) != value:
                    yield (
                        f"simulation {k:04d}: {name}: its {key} is {run.attributes.get(key)!r}: "
                        f"expected {value!r}"
                    )
            for key in sorted(STATISTICS.keys() - run.statistics.keys()):
                yield f"simulation {k:04d}: {name}: no {key}: expected those of its steps"


def step_faults(path: Path, shard: Shard, count: int, tolerance: float) -> Iterator[str]:
    """Steps of the coarse models that come out otherwise when they are taken again.

    Parameters
    ----------
    path : Path
        Of the shard's file, for messages.
    shard : Shard
        Generated, not imported.
    count : int
        Single steps and steps of rollouts of each simulation and model.
    tolerance : float
        The solver's, m.
    """
    for name in BASES:
        if all(name in simulation.runs for simulation in shard.simulations):
            try:
                problems = rebuilt_problems(shard, path, name)
            except InputError as error:
                yield str(error).removeprefix(f"{path}: ").removesuffix(".")
                return
            yield from _repeated(shard, name, problems, count, tolerance)


def _repeated(
    shard: Shard, name: str, problems: list[Problem], count: int, tolerance: float
) -> Iterator[str]:
    stepper = ProjectiveDynamics(
        problems[0].with_loads([]), float(shard.attributes["tolerance"]),
        max_iterations=MOST_ITERATIONS, recover=False,
    )  # fmt: skip
    for k, (simulation, problem) in enumerate(zip(shard.simulations, problems, strict=True)):
        run, reference = simulation.runs[name], simulation.runs.get(REFERENCE)
        pairs = {"positions": (run.positions, run.positions)}
        if reference is not None:
            pairs["predictions"] = (reference.positions, run.predictions)
        for what, (starts, ends) in pairs.items():
            if starts is None or ends is None:
                continue
            limit = _STEP_ERROR * tolerance + _rounding(starts)
            for row, away, times in _again(stepper, problem, starts, ends, k, count):
                if not away <= times * limit:
                    yield (
                        f"simulation {k:04d}: {name}: step {row + 1} of its {what} is {away:.3g} m "
                        f"off when it is taken again: expected at most {times * limit:.3g} m"
                    )
                    break


def _again(
    stepper: ProjectiveDynamics, problem: Problem, starts: Array, ends: Array, k: int, count: int
) -> Iterator[tuple[int, float, int]]:
    """Steps of simulation k that are taken again: row, distance (m), and how often errors add up.

    Steps of backward Euler from rows of ``starts``, spread over the simulation; of others the
    first ones in a row, since they remember more than two frames tell.
    """
    after = ends[-(len(starts) - 1) :]  # of a rollout all frames but the first
    state = problem.initial_state()
    for i in range(min(count, len(after))):
        row, times = i, i + 1
        if stepper.integrator == INTEGRATOR:
            row, times = (31 * k + i * len(after) // count) % len(after), 1
            state = _start(problem, starts, row)
        state = stepper(state, step_forces(stepper, problem, state)).state
        yield row, float(np.abs(state.positions - after[row]).max()), times


def _start(problem: Problem, frames: Array, row: int) -> State:
    """A frame with the velocities of backward Euler."""
    if row == 0:
        return problem.initial_state()
    h, rest = problem.time_step, problem.positions
    frame, before = (frames[k].astype(np.float64) for k in (row, row - 1))
    frame, before = (np.where(problem.free, x, rest) for x in (frame, before))
    return State(frame, (frame - before) / h, row * h)


def _rounding(values: Array) -> float:
    return float(_ROUNDINGS * np.finfo(values.dtype).eps * np.abs(values).max())

"""Checks of what a batch, its steps and its derivatives are given."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

import torch
from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.batch.material import BatchMaterial, in_range
from pdcorrect.batch.states import BatchState
from pdcorrect.errors import InputError
from pdcorrect.fem.materials import RANGES
from pdcorrect.fem.problem import Problem
from pdcorrect.state import State


def scene_name(problems: Sequence[Problem], i: int) -> str:
    """A scene's number and name."""
    return f"{i} ({problems[i].scene.name!r})"


# --- scenes and options --------------------------------------------------------------------------


def check_problems(
    problems: Sequence[Problem], time_step: float | None, integrator: str | None
) -> tuple[Problem, ...]:
    """The problems; scenes that cannot step together are refused, naming one and what differs.

    ``time_step`` and ``integrator`` are those asked for, or None for the scenes' own.
    """
    problems = tuple(problems)
    if not problems:
        raise InputError("no problems: expected one or more scenes.")
    first = problems[0].scene
    names = ["solver.element", "material.energy", "material.volume_weight"]
    names += ["damping.viscosity", "damping.mass", "damping.stiffness"]
    if time_step is None:
        names += ["time.step", "time.substeps"]
    if integrator is None:
        names.append("time.integrator")
    if (integrator or first.time.integrator) == "generalised-alpha":
        names.append("time.spectral_radius")
    for i, problem in enumerate(problems):
        for found, what in (
            (problem.contact, "obstacles"),
            (problem.fibres, "actuators"),
            (problem.rollers, "oblique rollers"),
        ):
            if found is not None:
                raise InputError(
                    f"scene {scene_name(problems, i)} has {what}, which batches do not know: "
                    "expected none. Step it by ProjectiveDynamics or Newton."
                )
        for name in names:
            mine, theirs = (attrgetter(name)(scene) for scene in (problem.scene, first))
            if mine != theirs:
                raise InputError(
                    f"scene {scene_name(problems, i)}: {name} = {mine!r}, the first one's is "
                    f"{theirs!r}: expected the same. Make a batch of each kind."
                )
    return problems


def usable_device(device: str | torch.device) -> torch.device:
    """A device that torch has here."""
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        found = torch.device("meta")
    if found.type not in ("cpu", "cuda"):
        raise InputError(f"device = {device!r}: expected 'cpu', 'cuda', 'cuda:1', ...")
    count = torch.cuda.device_count()
    if found.type == "cuda" and (found.index or 0) >= count:
        raise InputError(
            f"device = {str(found)!r}: torch finds {count} CUDA devices here; expected one of "
            "those, or 'cpu'."
        )
    return found


# --- tensors -------------------------------------------------------------------------------------


def check_tensor(cells: CellBatch, name: str, x: Tensor) -> None:
    """Refuse what is no tensor of the batch's type on its device."""
    kind = f"{x.dtype} on {x.device}" if isinstance(x, Tensor) else f"a {type(x).__name__}"
    if kind != f"{cells.dtype} on {cells.rest.device}":
        raise InputError(
            f"{name}: {kind}; expected a tensor of {cells.dtype} on {cells.rest.device}, as the "
            "stepper: convert it, or make the stepper with other dtype= and device=."
        )


def check_nodal(cells: CellBatch, name: str, x: Tensor) -> None:
    """Refuse what is not (B, N, 3) of the batch's type on its device."""
    check_tensor(cells, name, x)
    wanted = (cells.sizes.scenes, cells.sizes.nodes, 3)
    if tuple(x.shape) != wanted:
        raise InputError(
            f"{name}: {tuple(x.shape)}; expected {wanted}: scenes, nodes of the largest one, 3."
        )


def by_cell(cells: CellBatch, name: str, value: Tensor | float | None) -> Tensor | None:
    """A number, or a tensor that broadcasts to (B, C), as (B, C); others are refused."""
    if value is None:
        return None
    shape = (cells.sizes.scenes, cells.sizes.cells)
    if isinstance(value, (int, float)):
        value = torch.tensor(float(value), dtype=cells.dtype, device=cells.rest.device)
    check_tensor(cells, name, value)
    try:
        return value.expand(shape)
    except RuntimeError:
        raise InputError(
            f"{name}: {tuple(value.shape)}; expected what broadcasts to {shape}, one value a "
            f"cell of each scene: one value a scene is ({shape[0]}, 1)."
        ) from None


def check_material(cells: CellBatch, problems: Sequence[Problem], material: BatchMaterial) -> None:
    """Refuse values out of their range, naming scene and cell."""
    if material.sound.all():
        return
    fits = in_range(*material.values)
    for (name, wanted), value, fine in zip(RANGES.items(), material.values, fits, strict=True):
        bad = (~fine & cells.present_cells).nonzero()
        if len(bad):
            scene, cell = bad[0].tolist()
            raise InputError(
                f"{name} of cell {cell} in scene {scene_name(problems, scene)} is "
                f"{float(value[scene, cell]):g}: expected a finite number {wanted}."
            )


def check_finite(problems: Sequence[Problem], name: str, x: Tensor) -> None:
    """Refuse a nodal tensor with NaN or infinity, in padding too, naming scene and node."""
    bad = (~torch.isfinite(x).all(dim=2)).nonzero()
    if len(bad):
        scene, node = bad[0].tolist()
        raise InputError(
            f"{name} of node {node} in scene {scene_name(problems, scene)} is "
            f"{x[scene, node].tolist()}: expected finite numbers."
        )


# --- states and results --------------------------------------------------------------------------


def check_states(cells: CellBatch, states: Sequence[State]) -> tuple[State, ...]:
    """The states; refused where there is not one for each scene, or shapes are wrong."""
    states = tuple(states)
    if len(states) != len(cells.node_counts):
        raise InputError(f"{len(states)} states: expected {len(cells.node_counts)}, one a scene.")
    for i, (state, count) in enumerate(zip(states, cells.node_counts, strict=True)):
        if len(state.positions) != count:
            raise InputError(f"state {i} has {len(state.positions)} nodes: expected {count}.")
    names = set(states[0].memory)
    if any(set(s.memory) != names for s in states):
        raise InputError("some states have a memory that others lack: expected all or none.")
    return states


def check_state(cells: CellBatch, state: BatchState) -> None:
    """Refuse what is no state of the batch."""
    check_nodal(cells, "positions", state.positions)
    check_nodal(cells, "velocities", state.velocities)
    _finite_times(cells, state.times)
    for name, x in state.memory.items():
        check_nodal(cells, f"memory {name!r}", x)


def start_times(cells: CellBatch, times: Sequence[float] | None) -> tuple[float, ...]:
    """One time for each scene, s; zeros if there are none."""
    return (0.0,) * cells.sizes.scenes if times is None else _finite_times(cells, times)


def _finite_times(cells: CellBatch, times: Sequence[float]) -> tuple[float, ...]:
    scenes = cells.sizes.scenes
    try:
        found = tuple(float(t) for t in times)
    except (TypeError, ValueError):
        found = ()
    if len(found) != scenes or not all(map(math.isfinite, found)):
        raise InputError(f"times = {times!r}: expected {scenes} finite numbers, one a scene.")
    return found

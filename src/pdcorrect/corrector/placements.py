"""What a correction is added to: the coarse answer, the loads, or the first iterate.

All of it holds for NumPy arrays and tensors alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import numpy as np
import torch

from pdcorrect.errors import InputError
from pdcorrect.solvers.schemes import Scheme

Values = Any
"""A NumPy array or a tensor."""


def where(condition: Values, one: Values, other: Values) -> Values:
    """``one`` where a condition holds, else ``other``; either may be a number."""
    library = np if isinstance(condition, np.ndarray) else torch
    return library.where(condition, one, other)


def filled(like: Values, value: float) -> Values:
    """A number in the shape and type of other values."""
    return (np if isinstance(like, np.ndarray) else torch).full_like(like, value)


Velocity = Literal["recomputed", "kept"]
"""Of corrected states: what the integrator makes of the corrected positions, or the coarse
solver's own."""


def ballistic(state: Any, h: float, forces: Any, mass: Any, free: Any, held: Any) -> Any:
    """Positions after a step under inertia and loads alone, p + h v + h2 f/m, m.

    What the network is shown as the proposed positions before the coarse solver was asked.
    Clamped components are where the clamps will be.

    Parameters
    ----------
    state
        With positions and velocities (..., 3).
    h : float
        s.
    forces : (..., 3)
        All loads during the step, N.
    mass : (...)
        Row sums of the mass matrix, kg.
    free : (..., 3)
        True where a component may move.
    held : (..., 3)
        Prescribed positions at the end of the step, m; not used where a component may move.
    """
    ahead = state.positions + h * state.velocities + h**2 * forces / mass[..., None]
    return where(free, ahead, held)


def as_forces(correction: Any, h: float, mass: Any) -> Any:
    """Nodal forces that move free masses by a correction (..., 3), m, within a step, N.

    m delta/h2 with the row sums of the mass matrix, whatever the solver's mass rule.
    """
    return mass[..., None] * correction / h**2


def check_velocity(velocity: str, integrator: str) -> None:
    """Refuse velocities that have no meaning with an integrator.

    Raises
    ------
    InputError
    """
    if velocity not in get_args(Velocity):
        raise InputError(f"velocity = {velocity!r}: expected 'recomputed' or 'kept'.")
    if velocity == "kept" and integrator in ("bdf2", "generalised-alpha"):
        raise InputError(
            f"velocity = 'kept' with {integrator}: what it remembers would not belong to the "
            "corrected positions. Expected velocity = 'recomputed', or backward-euler, midpoint "
            "or quasi-static."
        )


def moved(
    scheme: Scheme,
    state: Any,
    correction: Any,
    velocity: Velocity,
    mass_times: Callable[[Any], Any],
) -> tuple[Any, Any, Mapping[str, Any]]:
    """Positions, velocities and memory of a state after a step, corrected.

    Recomputed velocities, and memory, are those that the integrator would have given had the
    corrected positions been its solution; by backward Euler v = (p - p_before)/h.  They are
    linear in the solution, so each takes its own multiple of the correction.

    Parameters
    ----------
    scheme : Scheme
        Of the step that led to ``state``.
    state
        With positions and velocities (..., 3) and a memory.
    correction : (..., 3)
        m; zero where clamped.
    velocity : {"recomputed", "kept"}
    mass_times : callable
        The mass matrix times a correction, zero where clamped.
    """
    positions = state.positions + correction
    if velocity == "kept":
        return positions, state.velocities, state.memory
    by_y = correction / scheme.positions.coefficients["y"]
    change = {"y": by_y}
    if "internal_forces" in state.memory:
        change["internal_forces_after"] = scheme.inertia * mass_times(by_y)
    memory = {}
    for name, array in state.memory.items():
        row = scheme.memory[name][0].coefficients
        memory[name] = sum((row.get(key, 0.0) * x for key, x in change.items()), array)
    velocities = state.velocities + scheme.velocities.coefficients.get("y", 0.0) * by_y
    return positions, velocities, memory

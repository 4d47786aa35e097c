"""What the scenes of a batch must have in common, and what a step is given."""

from __future__ import annotations

from torch import Tensor

from pdcorrect.batch.cells import CellBatch
from pdcorrect.errors import InputError
from pdcorrect.fem.problem import Problem


def check_problems(
    problems: tuple[Problem, ...], time_step: float | None, integrator: str | None
) -> None:
    """Refuse scenes that cannot step together, naming one and what differs.

    ``time_step`` and ``integrator`` are those asked for, or None for the scenes' own.
    """
    if not problems:
        raise InputError("no problems: expected one or more scenes.")
    first = problems[0]
    for i, problem in enumerate(problems):
        scene, other = problem.scene, first.scene
        pairs = [
            ("element", problem.element, first.element),
            ("material.energy", scene.material.energy, other.material.energy),
            ("material.volume_weight", scene.material.volume_weight, other.material.volume_weight),
            ("damping.mass", scene.damping.mass, other.damping.mass),
        ]
        if time_step is None:
            pairs.append(("time.step", scene.time.step, other.time.step))
        if integrator is None:
            pairs.append(("time.integrator", scene.time.integrator, other.time.integrator))
        name = other.time.integrator if integrator is None else integrator
        if name == "generalised-alpha":
            radii = scene.time.spectral_radius, other.time.spectral_radius
            pairs.append(("time.spectral_radius", *radii))
        for key, mine, theirs in pairs:
            if mine != theirs:
                raise InputError(
                    f"scene {i} ({scene.name!r}): {key} = {mine!r}, the first one's is "
                    f"{theirs!r}: expected the same. Make a batch of each kind."
                )
        if scene.damping.stiffness:
            raise InputError(
                f"scene {i} ({scene.name!r}): damping.stiffness is not available in batches: "
                "expected 0. Use ProjectiveDynamics."
            )
        if problem.clamps.moving and name in ("midpoint", "generalised-alpha"):
            raise InputError(
                f"scene {i} ({scene.name!r}): moving clamps with {name} are not "
                "available in batches. Use ProjectiveDynamics."
            )


def check_nodal(cells: CellBatch, name: str, x: Tensor) -> None:
    """Refuse what is not (B, N, 3) of the batch's type on its device."""
    wanted = (cells.sizes.scenes, cells.sizes.nodes, 3)
    device = cells.rest.device
    if tuple(x.shape) != wanted or x.dtype != cells.dtype or x.device != device:
        raise InputError(
            f"{name}: {tuple(x.shape)}, {x.dtype}, on {x.device}; expected {wanted}, "
            f"{cells.dtype}, on {device}, as the stepper."
        )

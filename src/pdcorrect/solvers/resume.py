"""Continue a run from its file: whether it is the same run, and from which state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pdcorrect._config import parse_toml
from pdcorrect.errors import InputError
from pdcorrect.solvers.rollout import run_attributes
from pdcorrect.state import State
from pdcorrect.trajectory import Stepper, Trajectory

_SHOWN = 4
_NONE = "nothing"


def continue_from(stepper: Stepper, run: Trajectory) -> State:
    """The state to go on from, after telling the stepper about the frames so far.

    Parameters
    ----------
    stepper : Stepper
        If it has a method ``restore``, that is called with ``run``.
    run : Trajectory
        The frames so far.

    Raises
    ------
    InputError
        If another scene, mesh or solver made them.
    """
    check_same_run(stepper, run)
    restore = getattr(stepper, "restore", None)
    if restore is not None:
        restore(run)
    return run.state(-1)


def check_same_run(stepper: Stepper, run: Trajectory, name: str = "the run") -> None:
    """Raise `InputError`, saying what differs, if the stepper would have made other frames."""
    found = differences(stepper, run)
    if found:
        more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise InputError(
            f"{name}: cannot be continued, its frames are of another run: "
            f"{'; '.join(found[:_SHOWN])}{more}. Ask for the same, or start again under "
            "another name."
        )


def differences(stepper: Stepper, run: Trajectory) -> list[str]:
    """How a run differs from what a stepper would do, one phrase each; frames do not count."""
    problem = stepper.problem
    old, new = _settings(run.scene_toml), _settings(problem.scene.to_toml())
    old |= run.attributes
    new |= run_attributes(stepper)
    found = [
        f"{name} was {old.get(name, _NONE)}, now {new.get(name, _NONE)}"
        for name in dict.fromkeys((*old, *new))
        if old.get(name) != new.get(name)
    ]
    for name, was, now in (
        ("nodes", run.points, problem.positions),
        ("cells", run.cells, problem.cells),
    ):
        if not np.array_equal(was, now):
            found.append(f"the mesh's {name} are different ones ({len(was)}, now {len(now)})")
    return found


def _settings(scene_toml: str) -> dict[str, str]:
    """A scene's keys, dotted, and values as text, without the number of frames."""
    try:
        scene = parse_toml(scene_toml)
    except ValueError:
        return {"scene": "unreadable"}
    settings = dict(_flat("", scene))
    settings.pop("time.frames", None)
    return settings


def _flat(prefix: str, table: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", repr(value)

"""Typed exceptions, and the check for optional dependencies.

Every error that a user can cause derives from `PdcorrectError`; the command
line turns those into one paragraph and exit status 2 (bad input) or 1 (the
computation failed).
"""

from __future__ import annotations

import importlib
from types import ModuleType


class PdcorrectError(Exception):
    """Base class of everything this package raises on purpose."""


class PdcorrectWarning(UserWarning):
    """What was asked for can be done, and is likely to be something else than was meant."""


class InputError(PdcorrectError, ValueError):
    """An argument, array or file content is not acceptable."""


class SceneError(InputError):
    """A scene is malformed or contradicts itself."""


class MeshError(InputError):
    """A mesh cannot be used: inverted cells, wrong cell type, bad indices."""


class FileFormatError(InputError):
    """A file is damaged or is not what it was taken for."""


class FileVersionError(FileFormatError):
    """A file is whole, but of a version of its format that this code does not read."""


class OutputError(PdcorrectError, OSError):
    """A result could not be written."""


class ConvergenceError(PdcorrectError, RuntimeError):
    """A step failed after every fallback.

    Attributes
    ----------
    trajectory : Trajectory or None
        The frames computed before the failing step, when a rollout was running.
    result : StepResult or None
        The failing step.
    """

    def __init__(self, message: str, trajectory: object = None, result: object = None) -> None:
        super().__init__(message)
        self.trajectory = trajectory
        self.result = result


class MissingExtraError(PdcorrectError, ImportError):
    """An optional dependency is not installed."""


EXTRAS = {
    "torch": "learn", "torch_geometric": "learn", "tensorboard": "learn",
    "pyvista": "view", "matplotlib": "view", "imageio": "view", "trame": "view", "dask": "cluster",
    "distributed": "cluster",
}  # fmt: skip
"""Optional dependencies, by the extra that contains them."""


def require_extra(module: str, extra: str) -> ModuleType:
    """Import an optional dependency, or say which extra of this package contains it.

    Raises
    ------
    MissingExtraError
        If the import fails.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{module} is needed for this and could not be imported ({error}). "
            f"Install it with: pip install 'pdcorrect[{extra}]'"
        ) from error

"""Where models are: by the path of their folder, or by the name of one that is released."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pdcorrect._environment import home_folder
from pdcorrect.corrector.model_description import DESCRIPTION, WEIGHTS
from pdcorrect.errors import InputError

_EXPECTED = f"expected a folder with {DESCRIPTION} and {WEIGHTS}"


def model_folder(path_or_name: str | Path) -> Path:
    """Where a model given by path or name is.

    Raises
    ------
    InputError
        If there is none, or it is no path or name.
    """
    if not isinstance(path_or_name, (str, os.PathLike)) or not str(path_or_name).strip():
        raise InputError(
            f"model {path_or_name!r}: expected the name of a model or the path of its folder."
        )
    named = isinstance(path_or_name, str) and path_or_name.strip(".") != ""
    named = named and not set(str(path_or_name)) & {"/", os.sep}
    folder = models_folder() / path_or_name if named else Path(path_or_name)
    if has_model(folder):
        return folder
    if not named:
        raise InputError(f"{folder}: {_without_model(folder)}.")
    here = ", which is a folder here" if Path(path_or_name).is_dir() else ""
    raise InputError(
        f"model {path_or_name!r}: not in {models_folder()}: expected one of "
        f"{', '.join(_released()) or '(none)'}, or a path such as ./{path_or_name}{here}."
    )


def has_model(folder: Path) -> bool:
    """Whether a folder holds a model, be it half of one."""
    return any((folder / name).is_file() for name in (DESCRIPTION, WEIGHTS))


def models_folder() -> Path:
    """Where models are looked up by name.

    Raises
    ------
    InputError
        If the environment does not say, and the code is not in its checkout.
    """
    return home_folder("models", ", or the path of a model")


def unlike_ends(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of paths that are all unlike, such as "seed-1/model".

    Raises
    ------
    InputError
        If a folder comes twice.
    """
    for folder in folders:
        if folders.count(folder) > 1:
            raise InputError(f"{folder} comes twice: expected each one once.")
    longest = max((len(folder.parts) for folder in folders), default=0)
    for length in range(1, longest + 1):
        names = ["/".join(folder.parts[-length:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return []


def _without_model(path: Path) -> str:
    """What is there in place of a model's folder, and what is expected."""
    if path.is_dir():
        inner = _models_in(path)
        such_as = f", such as {path}{os.sep}{inner[0]}" if inner else ""
        return f"holds no model: {_EXPECTED}{such_as}"
    try:
        released = _released()
    except InputError:  # no models can be given by name
        released = []
    names = f", or the name of a released model: {', '.join(released)}" if released else ""
    return f"{'a file' if path.is_file() else 'not there'}: {_EXPECTED}{names}"


def _released() -> list[str]:
    return _models_in(models_folder())


def _models_in(folder: Path) -> list[str]:
    """Names of the folders in a folder that hold models."""
    return sorted(path.parent.name for path in folder.glob(f"*/{DESCRIPTION}"))

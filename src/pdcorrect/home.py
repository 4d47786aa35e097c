"""Where models and validation cases are looked up by name: they are in no wheel."""

from __future__ import annotations

import os
from pathlib import Path

import pdcorrect
from pdcorrect.errors import InputError

HOME = "PDCORRECT_HOME"
"""Environment variable: the folder with ``models`` and ``validation``; the checkout by default."""


def home_folder(name: str, instead: str = "") -> Path:
    """The folder ``name`` of the checkout, or of the folder that the environment names.

    Parameters
    ----------
    name : str
    instead : str
        What a user may give in its place, for the message.

    Raises
    ------
    InputError
        If the environment does not say, and the code is not in its checkout.
    """
    home = os.environ.get(HOME)
    if home:
        return Path(home) / name
    checkout = Path(pdcorrect.__file__).resolve().parents[2]
    if not (checkout / "pyproject.toml").is_file():
        raise InputError(
            f"{name} by name: expected the environment variable {HOME} to name the folder that "
            f"has {name!r} in it{instead}."
        )
    return checkout / name

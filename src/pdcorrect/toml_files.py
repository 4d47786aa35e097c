"""Files of TOML, and which of the kinds that there are one looks like."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pdcorrect.errors import InputError
from pdcorrect.toml_text import parse_toml

SCENE = "a scene"
TRAINING = "the configuration of a training"
DATASET = "the configuration of a data set"

_MARKS = {
    SCENE: ("body", "time", "clamps", "loads"),
    TRAINING: ("stages", "corrector", "fitting"),
    DATASET: ("family", "motion", "reference", "evaluation"),
}
"""Keys at the top that only one kind has."""


def read_text(path: str | Path, kind: str, refusal: type[InputError] = InputError) -> str:
    """The text of a file that is to be of a kind.

    Raises
    ------
    InputError
        As ``refusal``, if it cannot be read or is a folder.
    """
    if isinstance(path, str) and "\n" in path:
        raise refusal("path is a text of several lines: expected a path; from_toml takes texts.")
    if not isinstance(path, (str, os.PathLike)):
        raise refusal(f"path is a {type(path).__name__}: expected that of a TOML file.")
    path = Path(path)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise refusal(f"{path}: cannot be read (not a UTF-8 text file).") from None
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and os.path.isdir(path):
            told = f"is a folder: expected {kind} in a TOML file{_meant(path, kind)}"
            raise refusal(f"{path}: {told}") from None
        reason = getattr(error, "strerror", None) or error
        raise refusal(f"{path}: cannot be read ({reason}).") from None


def read_tables(
    text: str, kind: str, source: str, refusal: type[InputError] = InputError
) -> dict[str, Any]:
    """What a text holds that is to be of a kind.

    Raises
    ------
    InputError
        As ``refusal``, if it is not TOML or looks like another kind.
    """
    try:
        data = parse_toml(text)
    except ValueError as error:
        raise refusal(f"{source}: not valid TOML: {error}.") from None
    found = looks_like(data)
    if found not in (None, kind) and not _marks(data, kind):
        raise refusal(f"{source}: looks like {found}; expected {kind}.")
    return data


def looks_like(data: Mapping[str, Any]) -> str | None:
    """The kind whose marks there are most of, if there are any."""
    counts = {kind: _marks(data, kind) for kind in _MARKS}
    best = max(counts, key=lambda kind: counts[kind])
    return best if counts[best] else None


def _marks(data: Mapping[str, Any], kind: str) -> int:
    return sum(key in data for key in _MARKS[kind])


def _meant(folder: Path, kind: str) -> str:
    """Which files in a folder may be meant, as the end of a sentence."""
    try:
        found = [path for path in sorted(folder.glob("*.toml")) if _kind_of(path) == kind]
    except OSError:
        found = []
    if len(found) == 1:
        return f"; did you mean {found[0]}?"
    return f", such as {found[0]}." if found else "; none is in it."


def _kind_of(path: Path) -> str | None:
    try:
        return looks_like(parse_toml(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return None

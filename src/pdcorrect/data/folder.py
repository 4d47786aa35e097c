"""Which files a data set's folder holds: ``<split>/mesh-0000.h5`` and so on."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from pdcorrect.data.config import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.schema import SUFFIX
from pdcorrect.errors import InputError

_NAME = re.compile(rf"mesh-(\d+){re.escape(SUFFIX)}")
_FIRST = (TRAINING, VALIDATION, EVALUATION)


Folders = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""Of one data set, or of several."""


def folders_of(data: Folders) -> tuple[Path, ...]:
    """Folders of data sets whose files are read one after the other.

    Raises
    ------
    InputError
        If there is none, or one comes twice.
    """
    if isinstance(data, (str, os.PathLike)):
        return (Path(data),)
    found = tuple(map(Path, data))
    if not found:
        raise InputError("no data set: expected the folder of one or more.")
    known: set[Path] = set()
    for folder in found:
        if folder.resolve() in known:
            raise InputError(f"{folder}: expected each data set once.")
        known.add(folder.resolve())
    return found


def all_shards(folder: str | Path) -> list[Path]:
    """Files of meshes, by split and number; only their names count."""
    found = (path for path in Path(folder).glob(f"*/mesh-*{SUFFIX}") if _NAME.fullmatch(path.name))
    return sorted(found, key=lambda path: (*_rank(path.parent.name), shard_number(path)))


def shard_number(path: Path) -> int:
    """Number of a mesh, from its file's name."""
    return int(path.stem.removeprefix("mesh-"))


def splits_of(folder: str | Path) -> list[str]:
    """Names of the splits that there are files of: the usual ones first.

    Raises
    ------
    InputError
        If there are none.
    """
    found = list(dict.fromkeys(path.parent.name for path in all_shards(folder)))
    if not found:
        raise InputError(
            f"{folder}: no data set: expected folders of splits with files mesh-0000{SUFFIX}."
        )
    return found


def shard_paths(folder: str | Path, split: str, without: Collection[str] = ()) -> list[Path]:
    """Files of a split, by number; not those of some names, such as ``training/mesh-0042``.

    A name may begin with that of the folder, ``FOLDER/training/mesh-0042``; then it means no
    file of others.  Names of other files do not matter.

    Raises
    ------
    InputError
        If there are none, or none are left; if ``without`` is one name in place of several.
    """
    if isinstance(without, str):
        raise InputError(f"without = {without!r}: expected a list of names, such as [{without!r}].")
    paths = [path for path in all_shards(folder) if path.parent.name == split]
    if not paths:
        names = ", ".join(splits_of(folder))
        few = " (it has round(validation_share * training.meshes) meshes, which may be none)"
        hint = few if split == VALIDATION else ""
        raise InputError(f"{folder}: no split {split!r}{hint}: expected one of {names}.")
    kept = [path for path in paths if not _names(path).intersection(without)]
    if not kept:
        raise InputError(f"{folder}, {split}: all {len(paths)} files are left out: expected fewer.")
    return kept


def _names(path: Path) -> set[str]:
    """What a file may be called, without and with its data set's folder."""
    split = path.parent
    name = f"{split.name}/{path.stem}"
    return {name, f"{split.parent.resolve().name}/{name}"}


def _rank(split: str) -> tuple[int, str]:
    return (_FIRST.index(split) if split in _FIRST else len(_FIRST)), split

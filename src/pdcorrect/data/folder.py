"""Which files a data set's folder holds: ``<split>/mesh-0000.h5`` and so on."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pdcorrect.data.configuration import EVALUATION, TRAINING, VALIDATION, DatasetConfig
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import CONFIG, SUFFIX
from pdcorrect.errors import FileFormatError, FileVersionError, InputError

_NAME = re.compile(rf"mesh-\d+{re.escape(SUFFIX)}")
_FIRST = (TRAINING, VALIDATION, EVALUATION)


def all_shards(folder: str | Path) -> list[Path]:
    """Files of meshes, by split and number; only their names count."""

    def place(path: Path) -> tuple[int, str, int]:
        split = path.parent.name
        return _FIRST.index(split) if split in _FIRST else 3, split, shard_number(path)

    found = (path for path in Path(folder).glob(f"*/mesh-*{SUFFIX}") if _NAME.fullmatch(path.name))
    return sorted(found, key=place)


def shard_number(path: Path) -> int:
    """Number of a mesh, from its file's name."""
    return int(path.stem.removeprefix("mesh-"))


def splits_of(folder: str | Path) -> list[str]:
    """Names of the splits that there are files of: the usual ones first."""
    found = list(dict.fromkeys(path.parent.name for path in all_shards(folder)))
    if not found:
        raise InputError(
            f"{folder}: no data set: expected folders of splits with files mesh-0000{SUFFIX}."
        )
    return found


def shard_paths(folder: str | Path, split: str, without: Collection[str] = ()) -> list[Path]:
    """Files of a split, by number; not those of some names, such as ``training/mesh-0042``."""
    paths = [path for path in all_shards(folder) if path.parent.name == split]
    if not paths:
        names = ", ".join(splits_of(folder))
        few = " (it has round(validation_share * training.meshes) meshes, which may be none)"
        hint = few if split == VALIDATION else ""
        raise InputError(f"{folder}: no split {split!r}{hint}: expected one of {names}.")
    kept = [path for path in paths if f"{split}/{path.stem}" not in without]
    if not kept:
        raise InputError(f"{folder}, {split}: all {len(paths)} files are left out: expected fewer.")
    return kept


Damage = dict[Path, str]
"""Damaged files and what is wrong with them."""
Found = TypeVar("Found")


def read_files(
    paths: Sequence[Path], read: Callable[[Path], Found], damaged: Damage | None
) -> list[Found]:
    """What ``read`` makes of each file.

    With ``damaged`` files that are damaged are noted there and left out; `FileFormatError` if all
    are.
    """
    found = []
    for path in paths:
        try:
            found.append(read(path))
        except FileFormatError as error:
            if damaged is None or isinstance(error, FileVersionError):
                raise
            damaged[path] = str(error)
    if damaged and not found:
        first = damaged[paths[0]]
        raise FileFormatError(f"all {len(paths)} files are damaged, the first one so: {first}")
    return found


def missing_files(folder: str | Path, split: str | None = None) -> list[Path]:
    """Files that ``config.toml`` asks for, of all splits or one, and that are not there.

    None are missing where there is no configuration, as in imported data sets.
    """
    folder = Path(folder)
    if not (folder / CONFIG).exists():
        return []
    plans = make_plan(DatasetConfig.load(folder / CONFIG))
    paths = [plan.path(folder) for plan in plans if split in (None, plan.split)]
    return [path for path in paths if not path.exists()]


def check_whole(folder: str | Path, splits: Iterable[str]) -> None:
    """Refuse splits of which files are missing."""
    for split in splits:
        missing = missing_files(folder, split)
        if missing:
            raise InputError(
                f"{folder}, {split}: {len(missing)} of the files that {CONFIG} asks for are "
                f"missing, as {missing[0].name}: expected all of them ('pdcorrect dataset "
                "generate' goes on), or --incomplete for those that are there."
            )


def manifest_content(config: DatasetConfig, hashes: Mapping[str, str | None]) -> dict[str, Any]:
    """What the manifest says of files by name, with one hash of them all."""
    whole = hashlib.sha256(json.dumps(dict(hashes), sort_keys=True).encode()).hexdigest()
    return {
        "dataset": config.name,
        "config_hash": config.hash(),
        "content_hash": whole,
        "files": dict(hashes),
    }

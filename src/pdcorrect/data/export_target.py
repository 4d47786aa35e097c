"""The folder that an export is written to: filled as a whole, and never with two of them."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py

from pdcorrect._files import make_folder
from pdcorrect.errors import OutputError

SIMULATOR = "pdcorrect"
"""In ``meta.json``."""
_SERIES = re.compile(r".+-\d{4,}-\d+-.+(\.pvd|_\d{4,}\.vtu)")
"""Names of the files of `export_vtu`."""
_STAGING = "export.part"
"""Folder in the target of what is not whole yet."""


@contextlib.contextmanager
def staging_folder(target: Path, overwrite: bool) -> Iterator[Path]:
    """A new folder in ``target`` to write to, which is gone in the end.

    If that fails, ``target`` is as it was before.
    """
    earlier = _exported(target)
    if earlier and not overwrite:
        raise OutputError(
            f"{target}: holds files of an export already, as {earlier[0].name}; choose another "
            "folder, or delete them with --overwrite (overwrite=True)."
        )
    existed = target.is_dir()
    staging = target / _STAGING
    shutil.rmtree(staging, ignore_errors=True)
    make_folder(staging)
    try:
        yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if not existed:
            with contextlib.suppress(OSError):  # not empty: it was filled
                target.rmdir()


def placed(written: Sequence[Path], target: Path) -> list[Path]:
    """Move all files of the staging folder to ``target``, instead of an earlier export's."""
    try:
        earlier, new = _exported(target), sorted((target / _STAGING).iterdir())
        for place in (target / path.name for path in new):
            if place.exists() and place not in earlier:
                raise OutputError(f"{place}: exists already, not from an export; move it first.")
        for path in earlier:
            path.unlink()
        for path in new:
            path.replace(target / path.name)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error}).") from None
    return [target / path.name for path in written]


def _exported(target: Path) -> list[Path]:
    """Files of earlier exports in a folder; their content or name tells."""
    if not target.is_dir():
        return []
    return [path for path in sorted(target.iterdir()) if path.is_file() and _is_exported(path)]


def _is_exported(path: Path) -> bool:
    if path.suffix == ".json":
        with contextlib.suppress(OSError, ValueError, RecursionError):
            meta = json.loads(path.read_text(encoding="utf-8"))
            return isinstance(meta, dict) and meta.get("simulator") == SIMULATOR
        return False
    if path.suffix == ".h5":
        with contextlib.suppress(OSError, RuntimeError), h5py.File(path, "r") as file:
            return "0/world_pos" in file and "0/mesh_pos" in file
        return False
    return _SERIES.fullmatch(path.name) is not None

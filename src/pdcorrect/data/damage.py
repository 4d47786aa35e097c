"""Which files of a data set are whole, for readers that may leave out the others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pdcorrect.data.shard_reader import stored_hashes
from pdcorrect.errors import FileFormatError, FileVersionError

Damage = dict[Path, str]
"""Damaged files and what is wrong with them."""


def whole_files(paths: Sequence[Path], damaged: Damage | None) -> list[Path]:
    """The files that are to be read.

    Parameters
    ----------
    paths : sequence of Path
    damaged : dict or None
        Where given, each file is compared with its checksum, which reads all of it; those
        that are damaged are noted here and left out.

    Raises
    ------
    FileFormatError
        If all files are damaged.
    FileVersionError
        If one is of another version, which is no damage.
    """
    if damaged is None:
        return list(paths)
    whole = []
    for path in paths:
        try:
            stored_hashes(path)
        except FileVersionError:
            raise
        except FileFormatError as error:
            damaged[path] = str(error)
        else:
            whole.append(path)
    if paths and not whole:
        first = damaged[paths[0]]
        raise FileFormatError(f"all {len(paths)} files are damaged, the first one so: {first}")
    return whole

"""Files that appear under their names only when they are whole."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path, part: Path | None = None) -> Iterator[Path]:
    """A name to write to, by default `part_of` the path, which then takes its place.

    After an error the file at ``path`` is the old one, or there is none.
    """
    part = part_of(path) if part is None else part
    try:
        yield part
        part.replace(path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def part_of(path: Path) -> Path:
    """Where what is to replace a file is written."""
    return path.with_name(path.name + ".part")

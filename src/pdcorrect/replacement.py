"""Files that appear under their names only when they are whole."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

from pdcorrect.errors import OutputError


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


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all, whoever else writes it at the time.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with _own_part(path) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(path: Path, data: bytes) -> None:
    """The same for any content.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with _own_part(path) as part:
        part.write_bytes(data)


@contextlib.contextmanager
def _own_part(path: Path) -> Iterator[Path]:
    try:
        with replacing(path, part_of_process(path)) as part:
            yield part
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}).") from None


def make_folder(folder: str | Path) -> Path:
    """Create a folder for files, and those above it, if it is not there.

    Raises
    ------
    OutputError
        If it cannot be created.
    """
    folder = Path(folder)
    if folder.is_file():
        raise OutputError(f"{folder}: is a file: expected a folder, or a new name.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created ({error.strerror or error}).") from None
    return folder


def part_of_process(path: Path) -> Path:
    """Where this process writes what is to become a file, unlike any other's place."""
    return path.with_name(f"{path.name}.{_host()}.{os.getpid()}.{secrets.token_hex(4)}.part")


def clear_parts(folder: Path) -> None:
    """Delete what processes of this machine that are no more have left unfinished."""
    for part in folder.rglob("*.part"):
        fields = part.name.split(".")
        if len(fields) > 4 and fields[-4] == _host() and not _alive(int(fields[-3])):
            part.unlink(missing_ok=True)


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", socket.gethostname())


def _alive(process: int) -> bool:
    """Whether a process of this machine can still write."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return not _awaited(process)


def _awaited(process: int) -> bool:
    """Whether a process has ended and only its number is kept, for a parent to ask (Linux)."""
    try:
        text = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return text.rpartition(")")[2].split()[:1] in (["Z"], ["X"])  # after the name in brackets

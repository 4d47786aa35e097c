"""Files that appear under their names only when they are whole; SIGTERM as an exception."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from pdcorrect.errors import OutputError


@contextlib.contextmanager
def replacing(path: Path, part: Path | None = None) -> Iterator[Path]:
    """A name to write to, by default `part_of` the path, which then takes its place.

    After an error the file at ``path`` is the old one, or there is none.
    """
    part = part_of(path) if part is None else part
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())  # else a crash of the machine may leave an empty file
        part.replace(path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def part_of(path: Path) -> Path:
    """Where what is to replace a file is written."""
    return path.with_name(path.name + ".part")


def check_new(
    *paths: Path,
    overwrite: bool,
    remedy: str = "choose another name, or replace it with --overwrite (overwrite=True)",
) -> None:
    """Refuse to replace files, unless told to, and ever what is no file."""
    for path in paths:
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is a folder, a device or a pipe; give the name of a file.")
        if path.exists() and not overwrite:
            raise OutputError(f"{path}: exists already; {remedy}.")


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, see `write_bytes`."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes, part: Path | None = None) -> None:
    """Write a file whole or not at all, by default whoever else writes it at the time."""
    try:
        with replacing(path, part_of_process(path) if part is None else part) as part:
            part.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}).") from None


def make_folder(folder: str | Path) -> Path:
    """Create a folder for files, and those above it, if it is not there."""
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


_PAUSE, _CLOSING = 0.01, 1.0
"""Before a lost signal is repeated, and for closing after a SIGTERM, s."""
INTERRUPTED, TERMINATED = 130, 143
"""Exit status after Ctrl-C and after SIGTERM."""


class Terminated(BaseException):
    """The process was asked to end; as `KeyboardInterrupt`, it is no `Exception`."""


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` in the main thread at the first SIGTERM.

    Others are ignored while files are closed, for a second; later ones end the process at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler, hook = signal.signal(signal.SIGTERM, _terminate), sys.unraisablehook
    sys.unraisablehook = _insist
    try:
        yield
    except Terminated:
        hook = _silent  # the process ends
        raise
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def ctrl_c_ignored() -> Iterator[None]:
    """For processes started now: this one ends them, and they need not complain of Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _silent(lost: Any) -> None:
    """Nothing: what was half made when the signal came may fail to be deleted."""


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.signal(number, partial(_again, time.monotonic()))
    raise Terminated


def _again(first: float, number: int, frame: FrameType | None) -> None:
    """End the process, unless it may still be closing: the first signal was lost, or that hangs."""
    if time.monotonic() > first + _CLOSING:
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)


def _insist(lost: Any) -> None:
    """Signal again if Python dropped the exception, as it does in destructors and callbacks.

    Other errors in destructors after the signal are those of objects whose making it cut short.
    """
    if lost.exc_type is not Terminated:
        if signal.getsignal(signal.SIGTERM) is _terminate:
            sys.__unraisablehook__(lost)
        return
    signal.signal(signal.SIGTERM, _terminate)
    again = threading.Timer(_PAUSE, signal.raise_signal, [signal.SIGTERM])
    again.daemon = True
    again.start()

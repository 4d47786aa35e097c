"""The checksum of a data set's file: its first 512 bytes say what the rest must be.

HDF5 leaves that room, the user block, to others.  It holds three lines of text, padded
with zeros::

    pdcorrect-dataset 1
    bytes 10485760
    sha256 0f3c...

the format's version, the size of the whole file, and the SHA-256 of the first two lines
and of everything after the user block.  A damaged file is thus found out before HDF5,
which some damage makes crash, sees any of it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from pdcorrect.errors import FileFormatError, FileVersionError

FORMAT = "pdcorrect-dataset"
VERSION = 1
USER_BLOCK = 512
"""Bytes."""

_TEXT = re.compile(
    rb"(?P<lead>pdcorrect-dataset (?P<version>\d{1,9})\nbytes (?P<size>\d{1,18})\n)"
    rb"sha256 (?P<sum>[0-9a-f]{64})\n\0*"
)
_HDF5 = b"\x89HDF\r\n\x1a\n"


def seal(image: memoryview) -> None:
    """Write the user block of a file that is whole but for it, in place."""
    lead = f"{FORMAT} {VERSION}\nbytes {len(image)}\n".encode()
    text = lead + f"sha256 {_checksum(lead, image[USER_BLOCK:])}\n".encode()
    image[:USER_BLOCK] = text.ljust(USER_BLOCK, b"\0")


def check_seal(path: Path) -> None:
    """Compare a file's size and version with its seal.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is something else, truncated, or newer than this code.
    """
    with _opened(path) as file:
        _check_version(path, _parsed(path, file))


def read_sealed(path: Path) -> bytes:
    """All bytes of a file, after comparing each of them with its seal.

    Raises
    ------
    FileFormatError
        As `check_seal`, and if any byte has changed.
    """
    with _opened(path) as file:
        found = _parsed(path, file)
        file.seek(0)
        data = file.read()
    if _checksum(found["lead"], memoryview(data)[USER_BLOCK:]) != found["sum"].decode():
        raise FileFormatError(
            f"{path}: damaged: its checksum (SHA-256) is not the one noted in its first "
            f"{USER_BLOCK} bytes; copy or generate it again."
        )
    _check_version(path, found)
    return data


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """A regular file opened for reading; what the system refuses becomes one sentence."""
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
        if regular:
            with path.open("rb") as file:
                yield file
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror or error}).") from None
    if not regular:
        raise FileFormatError(f"{path}: not a regular file: expected a file of a data set.")


def _checksum(lead: bytes, rest: memoryview) -> str:
    digest = hashlib.sha256(lead)
    digest.update(rest)
    return digest.hexdigest()


def _parsed(path: Path, file: IO[bytes]) -> dict[str, bytes]:
    """Lines of the user block of a file that has the size they say."""
    block = file.read(USER_BLOCK)
    size = os.fstat(file.fileno()).st_size
    found = _TEXT.fullmatch(block) if len(block) == USER_BLOCK else None
    if found is None:
        raise FileFormatError(f"{path}: {_strange(block)}.")
    if int(found["size"]) != size:
        what = "truncated" if size < int(found["size"]) else "damaged"
        raise FileFormatError(f"{path}: {what}: expected {int(found['size'])} bytes, got {size}.")
    return found.groupdict()


def _strange(block: bytes) -> str:
    """Why a user block is not one of this format."""
    if not block:
        return "the file is empty: expected a file of a data set"
    if block.startswith(_HDF5):
        return "an HDF5 file, but not one of a data set: it lacks the checksum in front"
    first = f"{FORMAT} ".encode()
    if not block.startswith(first[: len(block)]):
        return f"not a file of a data set: it does not begin with {FORMAT!r}"
    if len(block) < USER_BLOCK:
        return f"truncated: expected at least {USER_BLOCK} bytes, got {len(block)}"
    return f"damaged: its first {USER_BLOCK} bytes are not the size and the checksum of the rest"


def _check_version(path: Path, found: dict[str, bytes]) -> None:
    version = int(found["version"])
    if version > VERSION:
        raise FileVersionError(
            f"{path}: written by a newer pdcorrect, in format version {version}; this one reads "
            f"version {VERSION}: update pdcorrect."
        )
    if version < VERSION:
        raise FileVersionError(f"{path}: format version {version}: expected {VERSION}.")

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

import hashlib
import os
import re
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


def seal(image: memoryview) -> None:
    """Write the user block of a file that is whole but for it, in place."""
    lead = f"{FORMAT} {VERSION}\nbytes {len(image)}\n".encode()
    digest = hashlib.sha256(lead)
    digest.update(image[USER_BLOCK:])
    image[:USER_BLOCK] = lead.ljust(USER_BLOCK, b"\0")
    text = lead + f"sha256 {digest.hexdigest()}\n".encode()
    image[: len(text)] = text


def check_seal(file: IO[bytes], verify: bool) -> None:
    """Compare an open file's size and version with its seal, and with ``verify`` all its bytes.

    Raises
    ------
    FileFormatError
        If the file is something else, damaged, truncated, or of another version.
    """
    block = file.read(USER_BLOCK)
    size = os.fstat(file.fileno()).st_size
    found = _TEXT.fullmatch(block) if len(block) == USER_BLOCK else None
    if found is None:
        cut = 0 < size < USER_BLOCK and block.startswith(FORMAT.encode()[:size])
        what = "truncated" if cut else "no file of a data set, or damaged at its beginning"
        raise FileFormatError(f"{what}: expected {FORMAT!r} and a checksum in front")
    if int(found["size"]) != size:
        what = "truncated" if size < int(found["size"]) else "damaged"
        raise FileFormatError(f"{what}: expected {int(found['size'])} bytes, got {size}")
    if verify:
        digest = hashlib.file_digest(file, lambda: hashlib.sha256(found["lead"]))  # type: ignore[arg-type]
        if digest.hexdigest() != found["sum"].decode():
            raise FileFormatError(
                "damaged: its checksum (SHA-256) is not the one in front; copy or generate it again"
            )
    if int(found["version"]) != VERSION:
        raise FileVersionError(
            f"format version {int(found['version'])}: this pdcorrect reads version {VERSION}"
        )

"""First bytes of an HDF5 file, and reading a file whose end or closing is missing.

HDF5 refuses a file that is shorter than its superblock says, or that its writer
never closed; its reading mode for files in writing waits for ever where something is
damaged.  `RepairedFile` gives HDF5 such a file as if it were closed, with zeros in place
of what is missing; every index and chunk of a trajectory carries a checksum, so those
zeros are noticed and never taken for data.
"""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdcorrect.errors import FileFormatError

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_SIZE = 48  # bytes of a version 3 superblock with 8-byte offsets
_END, _CHECKSUM = 28, 44  # byte positions of the end-of-file address and the checksum
_WORD = 0xFFFFFFFF


@dataclass(frozen=True)
class Superblock:
    """What the first bytes of an HDF5 file say about the rest.

    Attributes
    ----------
    end : int
        Bytes that the file should have; 0 if this version does not tell simply.
    in_writing : bool
        Whether a writer has it open, or was killed before it could close it.
    size : int
        Bytes that the file has.
    """

    end: int
    in_writing: bool
    size: int

    @property
    def truncated(self) -> bool:
        """Whether bytes are missing at the end."""
        return self.size < self.end


def read_superblock(path: Path) -> Superblock:
    """Read and check the superblock of a file.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is not HDF5, or its superblock is damaged.
    """
    try:
        with path.open("rb") as file:
            head, size = file.read(_SIZE), os.fstat(file.fileno()).st_size
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror}).") from None
    if not head or head[:8] != _SIGNATURE[: len(head)]:
        raise FileFormatError(f"{path}: not an HDF5 file: expected a trajectory of pdcorrect.")
    if len(head) < _SIZE:
        raise FileFormatError(
            f"{path}: truncated: expected at least {_SIZE} bytes, got {size}; no frame is left."
        )
    version, offset_size = head[8], head[9]
    if version != 3 or offset_size != 8:
        return Superblock(0, False, size)  # written by another program: HDF5 checks it
    if _lookup3(head[:_CHECKSUM]) != struct.unpack_from("<I", head, _CHECKSUM)[0]:
        raise FileFormatError(f"{path}: damaged: the checksum of its first bytes is wrong.")
    return Superblock(struct.unpack_from("<Q", head, _END)[0], head[11] != 0, size)


class RepairedFile(io.RawIOBase):
    """A readable view of a trajectory file, marked as closed and padded with zeros."""

    def __init__(self, path: Path, block: Superblock) -> None:
        super().__init__()
        self._file = path.open("rb")
        head = bytearray(self._file.read(_SIZE))
        self._size = max(block.size, block.end)
        head[11] = 0
        head[_END : _END + 8] = struct.pack("<Q", self._size)
        head[_CHECKSUM:] = struct.pack("<I", _lookup3(bytes(head[:_CHECKSUM])))
        self._head = bytes(head)
        self._at = 0

    def readable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a byte position of the padded file."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """Byte position."""
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill ``buffer`` from the file; zeros beyond its end."""
        count = len(buffer)
        self._file.seek(self._at)
        data = self._file.read(count).ljust(count, b"\0")
        if self._at < _SIZE:
            data = (self._head[self._at :] + data[_SIZE - self._at :])[:count]
        buffer[:] = data
        self._at += count
        return count

    def close(self) -> None:
        """Close the file behind the view."""
        self._file.close()
        super().close()


def _rotate(x: int, k: int) -> int:
    return ((x << k) | (x >> (32 - k))) & _WORD


def _lookup3(data: bytes) -> int:
    """Bob Jenkins's lookup3 hash with initial value 0, HDF5's checksum of metadata."""
    a = b = c = (0xDEADBEEF + len(data)) & _WORD
    last = max(0, (len(data) - 1) // 12) * 12
    for start in range(0, last, 12):
        x, y, z = struct.unpack_from("<3I", data, start)
        a, b, c = (a + x) & _WORD, (b + y) & _WORD, (c + z) & _WORD
        for shift in (4, 6, 8, 16, 19, 4):
            a = ((a - c) & _WORD) ^ _rotate(c, shift)
            c = (c + b) & _WORD
            a, b, c = b, c, a
    x, y, z = struct.unpack("<3I", data[last:].ljust(12, b"\0"))
    a, b, c = (a + x) & _WORD, (b + y) & _WORD, (c + z) & _WORD
    for shift in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _rotate(b, shift)) & _WORD
        a, b, c = b, c, a
    return b

"""One writer of a file at a time: an advisory lock on the file itself."""

from __future__ import annotations

import errno
import os
import struct
from pathlib import Path
from typing import Any

from pdcorrect._files import part_of, write_bytes
from pdcorrect.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl: Any = None  # type: ignore[no-redef]

_TAKEN = errno.EACCES, errno.EAGAIN
_NO_LOCKS = errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL
"""What file systems without locks answer."""


class WriteLock:
    """Keeps other writers from the file at ``path``, if there is one, until it is released.

    Readers are not hindered.  The lock belongs to the open file: it ends with the process and stays
    when the file is renamed.  On Windows and on file systems without locks there is none.

    Raises
    ------
    OutputError
        If another program has it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._status = path, _status(path)
        self._file: int | None = None
        self.acquire()

    def __enter__(self) -> WriteLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __del__(self) -> None:
        self.release()

    def acquire(self) -> None:
        """Lock the file again, after a release."""
        if self._file is None:
            self._file = _locked(self.path, self.path)
        self.check()

    def release(self) -> None:
        """Let others write; harmless when repeated."""
        file, self._file = self._file, None
        if file is not None:
            os.close(file)

    def check(self) -> None:
        """Raise `OutputError` if another file has the name by now, or none."""
        if not _same(_status(self.path), self._status):
            ours = "has been replaced, moved or deleted"
            told = "is being written" if self._status is None else ours
            raise OutputError(f"{self.path}: {told} by another program.")

    def write(self, data: bytes) -> None:
        """Replace the file by one of this content, which is locked before it has the name."""
        part = part_of(self.path)
        new = _locked(part, self.path, os.O_CREAT)
        try:
            if new is not None:
                self._check_part(part, os.fstat(new))
            write_bytes(self.path, data, part)
        except BaseException:
            if new is not None:
                os.close(new)
            raise
        self.release()
        self._file, self._status = new, _status(self.path)

    def _check_part(self, part: Path, ours: os.stat_result) -> None:
        """Refuse if another program has been faster; else nobody can replace the file now."""
        if not _same(_status(part), ours):
            raise OutputError(f"{self.path}: is being written by another program.")
        try:
            self.check()
        except OutputError:
            part.unlink(missing_ok=True)
            raise


def _locked(path: Path, name: Path, flags: int = 0) -> int | None:
    """Open and lock a file for the writer of ``name``; None if it cannot be opened."""
    if fcntl is None:
        return None
    try:
        file = os.open(path, os.O_RDWR | flags, 0o666)
    except OSError:  # that it cannot be written is told when it is
        return None
    try:
        _lock(file)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            os.close(file)
            told = "is being written by another program" if error.errno in _TAKEN else str(error)
            raise OutputError(f"{name}: {told}.") from None
    return file


def _lock(file: int) -> None:
    """Lock all of a file exclusively, or raise `OSError` at once."""
    if hasattr(fcntl, "F_OFD_SETLK"):  # closing another descriptor of the file keeps this lock
        whole = struct.pack("hhqqi0q", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
        fcntl.fcntl(file, fcntl.F_OFD_SETLK, whole)
    else:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except OSError:
        return None


def _same(one: os.stat_result | None, other: os.stat_result | None) -> bool:
    """Whether both are of one file, or of none."""
    if one is None or other is None:
        return one is other
    return os.path.samestat(one, other)

"""Room on the disk before HDF5 needs it.

HDF5 does not survive a failed write: it retries for ever, or crashes the process
when it ends, and what it was changing may be lost.  So the file is lengthened
first, where a full disk, a quota or a limit shows as a plain `OSError` and
nothing has been harmed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

_UNSUPPORTED = (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS)


class Reserve:
    """Keeps a file longer than what has been written to it so far."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._end = 0

    def ensure(self, used: int, need: int) -> None:
        """Make room for ``need`` bytes after the ``used`` ones.

        Raises
        ------
        OSError
            If there is none.
        """
        allocate = getattr(os, "posix_fallocate", None)  # not on every system
        if used + need <= self._end or allocate is None:
            return
        descriptor = os.open(self._path, os.O_RDWR)
        try:
            allocate(descriptor, used, need)
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise
        finally:
            os.close(descriptor)
        self._end = used + need

    def release(self, used: int) -> None:
        """Cut off what was not needed of the closed file."""
        if self._end and self._path.stat().st_size > used:
            os.truncate(self._path, used)
        self._end = 0


def abandon(file: Any, path: Path) -> None:
    """Close an h5py file that can no longer be written, without changing it on the disk.

    HDF5 is given a scratch copy to finish its writing on.  If there is no room
    for one either, the file stays open.
    """
    with contextlib.suppress(Exception), tempfile.TemporaryFile() as scratch:
        with path.open("rb") as original:
            shutil.copyfileobj(original, scratch)
        scratch.flush()
        os.dup2(scratch.fileno(), file.id.get_vfd_handle())
        file.close()

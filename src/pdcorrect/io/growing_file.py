"""An HDF5 file that grows by one record at a time and survives its writer.

Each record is one chunk of every growing dataset, with a checksum.  One dataset
counts the complete records, because it is written after the others have reached
the file.  While it grows the file is in HDF5's single-writer/multiple-reader
mode: a killed writer leaves it readable.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import part_of, replacing
from pdcorrect.errors import OutputError
from pdcorrect.io.superblock import read_superblock

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

    HDF5, which would write its metadata, is given a scratch copy to finish on.  If there is no
    room for one either, the file stays open.
    """
    with contextlib.suppress(Exception), tempfile.TemporaryFile() as scratch:
        with path.open("rb") as original:
            shutil.copyfileobj(original, scratch)
        scratch.flush()
        os.dup2(scratch.fileno(), file.id.get_vfd_handle())
        file.close()


_LIBRARY = ("v110", "v110")  # readable by HDF5 1.10 and later; what the swmr mode needs
_FILL: dict[str, Any] = {"f": np.nan, "i": -1, "S": b""}


class Column(NamedTuple):
    """A growing dataset: type and shape of an entry, and the first record that has one."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...] = ()
    first: int = 0

    @property
    def size(self) -> int:
        """Bytes of an entry."""
        return self.dtype.itemsize * math.prod(self.shape)


class GrowingFile:
    """Attributes and fixed arrays, then records.

    Parameters
    ----------
    path : Path
        A new file in an existing folder.
    columns : mapping of str to Column
        Growing datasets; more may be added with a record.
    counter : str
        The one of them that is written last.
    first : mapping of str to value
        Record 0.
    attributes : mapping of str to str or int
    arrays : mapping of str to array
        Datasets that do not grow.
    overwrite, compress : bool
        Replace an existing file; use gzip with byte shuffling.

    Raises
    ------
    OutputError
        If the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, Column],
        counter: str,
        first: Mapping[str, Any],
        attributes: Mapping[str, str | int],
        arrays: Mapping[str, NDArray[np.generic]],
        *,
        overwrite: bool = False,
        compress: bool = False,
    ) -> None:
        _check_target(path, overwrite)
        self.path = path
        self.records = 0
        self._filters = _filters(compress)
        self._columns: dict[str, Column] = {}
        self._counter = counter
        self._reserve = Reserve(path)
        self._broken = False
        with io.BytesIO() as memory:  # complete before anything is on the disk
            with h5py.File(memory, "w", libver=_LIBRARY) as self._file:
                self._create(attributes, arrays)
                self._add(columns)
                self._write(first)
            _save(memory.getvalue(), path)

    @classmethod
    def reopen(
        cls,
        path: Path,
        columns: Mapping[str, Column],
        counter: str,
        records: int,
        attributes: Mapping[str, str | int],
    ) -> Self | None:
        """A finished file again, to append to; parameters as for a new one.

        Returns
        -------
        GrowingFile or None
            None if the file was not closed, has more or less than these whole
            records, other attributes, or a layout that does not grow.
        """
        block = read_superblock(path)
        if block.in_writing or not 0 < block.end <= block.size:
            return None
        expected = {
            name: (c.dtype, (max(0, records - c.first), *c.shape), (1, *c.shape), True)
            for name, c in columns.items()
        }
        with h5py.File(path, "r", locking=False) as stored:
            if _layout(stored) != expected or _texts(stored.attrs) != _texts(attributes):
                return None
            compressed = stored[counter].compression is not None
        file = cls.__new__(cls)
        file.path, file.records = path, records
        file._columns, file._counter = dict(columns), counter
        file._filters, file._reserve = _filters(compressed), Reserve(path)
        file._broken, file._file = False, None  # opened with the next record
        return file

    def append(self, entries: Mapping[str, Any], columns: Mapping[str, Column]) -> None:
        """Write one record.

        Parameters
        ----------
        entries : mapping of str to value
            What is left out gets the fill value (NaN, -1, empty).
        columns : mapping of str to Column
            Datasets of ``entries``; new ones are added.

        Raises
        ------
        OutputError
            If the disk is full or fails; the records before are intact.
        """
        if self._broken:
            raise OutputError(f"{self.path}: nothing more can be written after a failure.")
        new = {name: column for name, column in columns.items() if name not in self._columns}
        if new or not self._file:
            self._declare(new)
        self._make_room()
        with self._reporting():
            self._write(entries)

    @property
    def complete(self) -> int:
        """Records that the file has, also where a signal came before the last was counted."""
        if self._broken or not self._file:
            return self.records
        return len(self._file[self._counter])

    def close(self) -> None:
        """Finish the file; harmless when repeated."""
        if not self._broken and self._file:
            with self._reporting():
                self._file.close()
                self._reserve.release(read_superblock(self.path).end)

    def _create(
        self, attributes: Mapping[str, str | int], arrays: Mapping[str, NDArray[np.generic]]
    ) -> None:
        for name, value in attributes.items():
            if isinstance(value, str):
                # of fixed length, so that it lies under the checksum of the file's index
                data = value.encode("utf-8")
                dtype = h5py.string_dtype("utf-8", max(1, len(data)))
                self._file.attrs.create(name, np.bytes_(data), dtype=dtype)
            else:
                self._file.attrs.create(name, value)
        for name, array in arrays.items():
            self._file.create_dataset(name, data=array, chunks=array.shape, **self._filters)

    def _add(self, columns: Mapping[str, Column]) -> None:
        for name, (dtype, shape, first) in columns.items():
            dataset = self._file.create_dataset(
                name,
                (max(0, self.records - first), *shape),
                dtype,
                maxshape=(None, *shape),
                chunks=(1, *shape),
                fillvalue=_FILL[dtype.kind],
                **self._filters,
            )
            if len(dataset):
                dataset[...] = _FILL[dtype.kind]
        self._columns |= columns

    def _declare(self, new: Mapping[str, Column]) -> None:
        """Open the file, with more datasets; they are added to a copy that then replaces it."""
        self.close()
        part = part_of(self.path)
        with self._reporting():
            try:
                if new:
                    shutil.copyfile(self.path, part)
                    Reserve(part).ensure(part.stat().st_size, self._room(new))
                    with h5py.File(part, "r+", libver=_LIBRARY) as self._file:
                        self._add(new)
                    part.replace(self.path)
                self._file = h5py.File(self.path, "r+", libver=_LIBRARY)
                self._file.swmr_mode = True
            finally:
                part.unlink(missing_ok=True)

    def _write(self, entries: Mapping[str, Any]) -> None:
        for name, column in self._columns.items():
            if name != self._counter and self.records >= column.first:
                self._extend(name, entries)
        self._file.flush()
        self._extend(self._counter, entries)
        self._file.flush()
        self.records += 1

    def _extend(self, name: str, entries: Mapping[str, Any]) -> None:
        dtype, _, first = self._columns[name]
        dataset = self._file[name]
        dataset.resize(self.records - first + 1, axis=0)
        dataset[self.records - first] = entries.get(name, _FILL[dtype.kind])

    def _room(self, new: Mapping[str, Column] = MappingProxyType({})) -> int:
        """Bytes for a record and for ``new`` datasets, with the blocks of their indices."""
        size = 2 * sum(c.size for c in self._columns.values())
        index = 256 * (16 + math.isqrt(self.records)) * (len(self._columns) + len(new))
        filled = sum(2048 + (56 + c.size) * self.records for c in new.values())
        return size + index + filled + 32768

    def _make_room(self) -> None:
        with self._reporting():
            self._reserve.ensure(self._file.id.get_filesize(), self._room())

    @contextlib.contextmanager
    def _reporting(self) -> Iterator[None]:
        """Turn what HDF5 raises into `OutputError`, and give the file up."""
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            self._broken = True
            if self._file:
                abandon(self._file, self.path)
            raise OutputError(
                f"{self.path}: cannot be written ({_reason(error)}); its first {self.records} "
                "frames are intact. Free some space or choose another place."
            ) from error


def _check_target(path: Path, overwrite: bool) -> None:
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: is a folder, a device or a pipe; give the name of a file.")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; create it first.")
    if path.exists() and not overwrite:
        raise OutputError(
            f"{path}: exists already; choose another name, overwrite it with --overwrite "
            "(overwrite=True), or continue it with --resume (TrajectoryWriter.resume)."
        )


def _save(data: bytes, path: Path) -> None:
    """Write all or nothing: a killed process leaves no file without its beginning."""
    try:
        with replacing(path) as part:
            part.write_bytes(data)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({_reason(error)}); choose another place."
        ) from error


def _filters(compress: bool) -> dict[str, Any]:
    checksum = {"fletcher32": True}
    gzip = {"shuffle": True, "compression": "gzip", "compression_opts": 4}
    return checksum | gzip if compress else checksum


def _texts(attributes: Mapping[str, Any]) -> dict[str, str]:
    return {
        name: value.decode("utf-8") if isinstance(value, bytes) else str(value)
        for name, value in attributes.items()
    }


def _layout(file: Any) -> dict[str, tuple[Any, ...]]:
    """Type, shape, chunks and checksums of the datasets that can grow."""
    found: dict[str, tuple[Any, ...]] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.maxshape[:1] == (None,):
            found[name] = (item.dtype, item.shape, item.chunks, item.fletcher32)

    file.visititems(visit)
    return found


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number is not None:
        return os.strerror(number)
    text = str(error)
    return text.splitlines()[0] if text else type(error).__name__

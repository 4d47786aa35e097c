"""What HDF5 may hold in place of what a file of a data set should, and how it is told.

HDF5 knows links to nowhere and to other files, names that are no text, references, and
lengths that no file could hold.  Each becomes a `RefusalError` that names the place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np

Value = str | int | float
_DENSEST = 1100
"""Times by which gzip can make data smaller, at most."""
_MOST_LINKS = 5
"""Links to nowhere that are named."""


class RefusalError(Exception):
    """Why a file is not accepted; becomes `FileFormatError` with the file's name."""


# --- places ------------------------------------------------------------------------------


def words(place: str) -> str:
    """A place in the file in words: "forces of simulation 0003"."""
    parts = place.split("/", 2)
    if parts[0] != "simulations" or len(parts) < 2:
        return place
    simulation = f"simulation {parts[1]}"
    return simulation if len(parts) == 2 else f"{parts[2]} of {simulation}"


def symbols(shape: tuple[Any, ...]) -> str:
    """A shape with letters, as Python writes tuples."""
    return f"({', '.join(str(n) for n in shape)}{',' if len(shape) == 1 else ''})"


def check_links(file: h5py.File) -> None:
    """Refuse links to other files, and those that lead nowhere, all by name."""
    nowhere = []
    for place, group, name in _links(file, "", set()):
        link = group.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise RefusalError(
                f"{words(place)} is a link to another file, {link.filename!r}: expected all of it "
                "in this one"
            )
        if isinstance(link, h5py.SoftLink) and not _leads(group, name):
            nowhere.append(words(place))
    if nowhere:
        more = len(nowhere) - _MOST_LINKS
        told = ", ".join(nowhere[:_MOST_LINKS]) + (f" and {more} more" if more > 0 else "")
        raise RefusalError(
            f"the link {told} leads nowhere" if len(nowhere) == 1 else f"links lead nowhere: {told}"
        )


def _links(group: h5py.Group, place: str, seen: set[int]) -> Iterator[tuple[str, h5py.Group, str]]:
    """Places, groups and names of all links, each group's once."""
    seen.add(h5py.h5o.get_info(group.id).addr)
    for name in members_of(group, words(place) or "the file"):
        inside = f"{place}/{name}".lstrip("/")
        yield inside, group, name
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            item = group[name]
            if isinstance(item, h5py.Group) and h5py.h5o.get_info(item.id).addr not in seen:
                yield from _links(item, inside, seen)


def _leads(group: h5py.Group, name: str) -> bool:
    """Whether a link leads somewhere; one may lead to itself."""
    try:
        return group.get(name) is not None
    except Exception:  # of many types, by the kind of loop
        return False


def members_of(group: h5py.Group, where: str) -> list[str]:
    """Names of what a group holds."""
    return [_text(name, f"{where} holds") for name in group]


def _text(name: str | bytes, where: str) -> str:
    if not isinstance(name, str):
        raise RefusalError(f"{where} the name {name!r:.60}, which is no text: expected UTF-8")
    return name


# --- arrays ------------------------------------------------------------------------------


def type_name(kind: np.dtype[Any]) -> str:
    """A type as NumPy calls it, or what HDF5 stores where NumPy has no name."""
    if h5py.check_ref_dtype(kind) is not None:
        return "reference"
    if h5py.check_string_dtype(kind) is not None:
        return "text"
    return "rows of any length" if h5py.check_vlen_dtype(kind) is not None else str(kind)


def check_inside(dataset: h5py.Dataset, file_size: int, where: str) -> None:
    """Refuse lengths that the file's bytes cannot hold, and what lies in other files."""
    size = math.prod(dataset.shape) * dataset.dtype.itemsize
    stored = min(dataset.id.get_storage_size(), file_size)
    if size <= stored and not dataset.external:
        return
    if size > stored * (_DENSEST if dataset.compression else 1) or dataset.external:
        raise RefusalError(
            f"{where} has shape {dataset.shape}, {size} bytes, of which {stored} are stored in "
            "this file"
        )


# --- attributes --------------------------------------------------------------------------


def attributes_of(group: h5py.Group, where: str) -> dict[str, Any]:
    """A group's attributes as they are."""
    return {_text(name, f"{where} has"): value for name, value in group.attrs.items()}


def values_of(attributes: h5py.Group | Mapping[str, Any], where: str) -> dict[str, Value]:
    """Attributes, or those of a group, as texts and numbers."""
    if isinstance(attributes, h5py.Group):
        attributes = attributes_of(attributes, where)
    return {name: _value(value, f"{name} of {where}") for name, value in attributes.items()}


def _value(value: Any, where: str) -> Value:
    """An attribute as text or number."""
    if isinstance(value, str):
        return value
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    if isinstance(value, np.floating) and np.isfinite(value):
        return float(value)
    raise RefusalError(f"the attribute {where} is {value!r:.60}: expected text or a number")


def texts(attributes: Mapping[str, Any], name: str, where: str) -> tuple[str, ...]:
    """An attribute that is a list of texts."""
    if name not in attributes:
        raise RefusalError(f"the attribute {name} of {where} is missing")
    found = np.asarray(attributes[name], dtype=object)
    if found.ndim != 1 or not all(isinstance(text, str) for text in found):
        raise RefusalError(
            f"the attribute {name} of {where} is {attributes[name]!r:.60}: expected a list of texts"
        )
    return tuple(found)


def check_types(values: Mapping[str, Value], wanted: Mapping[str, type], where: str) -> None:
    """Attributes that must be there, and of which type; integers pass for floats."""
    for name, kind in wanted.items():
        if name not in values:
            raise RefusalError(f"the attribute {name} of {where} is missing")
        if not isinstance(values[name], (int, float) if kind is float else kind):
            raise RefusalError(
                f"the attribute {name} of {where} is {values[name]!r:.60}: expected {kind.__name__}"
            )

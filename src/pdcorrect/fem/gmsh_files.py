"""Gmsh files of versions 2.2 and 4.1, text and binary, with their physical groups.

Sections as in "MSH file format" of Gmsh's reference manual.  meshio reads fewer of them: no
partitions, no parametric nodes, one group an entity, and none with ``Mesh.SaveAll``.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import MeshError
from pdcorrect.fem.mesh_content import Block, Content, Integers, places

_TYPES = {
    1: ("line", 1, 2), 2: ("triangle", 2, 3), 3: ("quad", 2, 4), 4: ("tetra", 3, 4),
    5: ("hexahedron", 3, 8), 6: ("wedge", 3, 6), 7: ("pyramid", 3, 5), 8: ("line3", 1, 3),
    9: ("triangle6", 2, 6), 10: ("quad9", 2, 9), 11: ("tetra10", 3, 10),
    12: ("hexahedron27", 3, 27), 13: ("wedge18", 3, 18), 14: ("pyramid14", 3, 14),
    15: ("vertex", 0, 1), 16: ("quad8", 2, 8), 17: ("hexahedron20", 3, 20),
    18: ("wedge15", 3, 15), 19: ("pyramid13", 3, 13),
}  # fmt: skip
"""Name, dimension and number of nodes of Gmsh's element types of first and second order."""

_ENTITIES = ("point", "curve", "surface", "volume")
"""By dimension."""
_EDGES = [8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15]
_VTK_ORDER = {
    "hexahedron20": [*range(8), *_EDGES],
    "hexahedron27": [*range(8), *_EDGES, 22, 23, 21, 24, 20, 25, 26],
}
"""Gmsh's nodes in VTK's order."""

_SECTION = re.compile(rb"^\$(\w+)[ \t]*\r?\n", re.MULTILINE)

_MOST_ALIKE = 4096
"""Elements of a text file of version 2.2 that are read at a time."""

_Entity = tuple[int, int]
"""Dimension and number of a point, curve, surface or volume."""


def read_gmsh(path: Path) -> Content:
    """Read points, elements of all dimensions and physical groups.

    Raises
    ------
    MeshError
        If the version is another, or the file is damaged; names the section or Gmsh's option.
    """
    sections = _sections(path, path.read_bytes())
    if b"MeshFormat" not in sections:
        raise MeshError(f"{path}: has no section $MeshFormat: expected a mesh saved by Gmsh.")
    header = sections[b"MeshFormat"].split(maxsplit=3)
    version, binary, size, one = (*header, b"", b"", b"", b"")[:4]
    if not (version == b"4.1" or version.startswith(b"2")) or size != b"8":
        raise _other_version(path, version.decode("latin-1"))
    order = "" if binary == b"0" else "<" if one[:4] == b"\1\0\0\0" else ">"
    names = _names(sections.get(b"PhysicalNames", b""))
    old = version != b"4.1"
    parametric = old and b"ParametricNodes" in sections
    nodes = _Numbers(path, sections, b"ParametricNodes" if parametric else b"Nodes", order)
    elements = _Numbers(path, sections, b"Elements", order)
    if old:
        numbers, points = _nodes_2(nodes, parametric)
        found = _elements_2(elements)
    else:
        groups: dict[_Entity, list[int]] = {}
        for name in (b"Entities", b"PartitionedEntities"):
            if name in sections:
                groups |= _entities(_Numbers(path, sections, name, order))
        numbers, points = _nodes_4(nodes)
        found = _elements_4(elements, groups)
    nodes.check_end()
    elements.check_end()
    return _content(path, numbers, points, found, names)


def _other_version(path: Path, version: str) -> MeshError:
    return MeshError(
        f"{path}: Gmsh format {version}: expected 2.2 or 4.1. Save it again with Gmsh's option "
        "Mesh.MshFileVersion = 4.1."
    )


def _sections(path: Path, data: bytes) -> dict[bytes, bytes]:
    """What stands between ``$Name`` and ``$EndName``, by name; the last of each name."""
    out: dict[bytes, bytes] = {}
    start = 0
    while match := _SECTION.search(data, start):
        name = match[1]
        if name in (b"NOD", b"ELM"):
            raise _other_version(path, "1")
        end = data.find(b"$End" + name, match.end())
        if end < 0:
            raise MeshError(f"{path}: its section ${name.decode('latin-1')} has no end.")
        if name in out and name in (b"Nodes", b"Elements", b"ParametricNodes"):
            raise MeshError(f"{path}: has two sections ${name.decode()}: expected one.")
        out[name] = data[match.end() : end]
        start = end + len(name) + 4
    return out


def _names(section: bytes) -> dict[_Entity, str]:
    """Names of physical groups; those that are not UTF-8 are read as Latin-1."""
    try:
        text = section.decode()
    except UnicodeDecodeError:
        text = section.decode("latin-1")
    rows = re.findall(r'^\s*(\d+)\s+(\d+)\s+"(.*)"\s*$', text, re.MULTILINE)
    return {(int(dimension), int(number)): name for dimension, number, name in rows}


class _Numbers:
    """The numbers of a section, text or binary, taken one after the other."""

    def __init__(self, path: Path, sections: dict[bytes, bytes], name: bytes, order: str) -> None:
        self.text = not order
        self.name = f"{path}: its section ${name.decode()}"
        if name not in sections:
            raise MeshError(f"{self.name} is missing: expected a mesh saved by Gmsh.")
        self._at, self._order = 0, order
        self._data: NDArray[np.float64] | bytes = sections[name]
        if self.text:
            try:
                self._data = np.array(sections[name].split(), dtype=np.float64)
            except ValueError as error:
                raise MeshError(f"{self.name} holds no numbers ({error}).") from None

    def take(self, kind: str, *shape: int) -> NDArray[Any]:
        """The next numbers: "i" of 4 bytes, "q" or "d" of 8 in a binary file."""
        values = self.records((kind,), int(np.prod(shape, dtype=object)))[0]
        return values.reshape(shape)

    def records(self, kinds: tuple[str, ...], count: int) -> list[NDArray[Any]]:
        """Columns (count,) of the next rows, which have numbers of some kinds."""
        row = np.dtype([(str(k), self._order + kind) for k, kind in enumerate(kinds)])
        size = count * (len(kinds) if self.text else row.itemsize)
        start, self._at = self._at, self._at + size
        if count < 0 or self._at > len(self._data):
            raise self._early()
        if isinstance(self._data, bytes):
            rows = np.frombuffer(self._data, row, count, start)
            columns = [rows[name] for name in row.names or ()]
        else:
            columns = list(self._data[start : self._at].reshape(count, len(kinds)).T)
        types = [np.float64 if kind == "d" else np.int64 for kind in kinds]
        with np.errstate(invalid="ignore"):
            out = [column.astype(kind) for column, kind in zip(columns, types, strict=True)]
        if any(
            (a != b).any() for a, b, kind in zip(out, columns, kinds, strict=True) if kind != "d"
        ):
            raise MeshError(f"{self.name} has numbers that are not whole: expected whole ones.")
        return out

    def alike(self) -> tuple[int, int, int]:
        """Type, number of tags and count of the next elements of version 2.2, which are alike."""
        if isinstance(self._data, bytes):
            number, several, tags = (int(x) for x in self.take("i", 3))
            return number, max(tags, 0), max(several, 0)
        _, number, tags = (max(int(x), 0) for x in self.take("i", 3))
        self._at -= 3
        stride = 3 + tags + self.type_of(number)[2]
        ahead = self._data[self._at : self._at + _MOST_ALIKE * stride]
        ahead = ahead[: len(ahead) // stride * stride].reshape(-1, stride)
        other = (ahead[:, 1] != number) | (ahead[:, 2] != tags)
        return number, tags, int(other.argmax()) if other.any() else max(len(ahead), 1)

    def line(self) -> int:
        """A whole number that stands on a line of its own, as text also in binary files."""
        if isinstance(self._data, bytes):
            text, _, _ = self._data.partition(b"\n")
            self._at = len(text) + 1
            if not text.strip().isdigit():
                raise MeshError(f"{self.name} does not begin with the number of its entries.")
            count = int(text)
        else:
            count = self.whole("q")
        if count > len(self._data):
            raise self._early()
        return count

    def _early(self) -> MeshError:
        return MeshError(
            f"{self.name} ends too early: expected the number of entries that it says."
        )

    def whole(self, kind: str) -> int:
        """The next number, a whole one."""
        return int(self.take(kind, 1)[0])

    def check_end(self) -> None:
        """Refuse numbers that are left, of nodes or elements that were not read."""
        left = self._data[self._at :]
        if left.strip() if isinstance(left, bytes) else len(left):
            raise MeshError(f"{self.name} goes on after the number of entries that it says.")

    def type_of(self, number: int) -> tuple[str, int, int]:
        """Name, dimension and number of nodes of an element type."""
        if number not in _TYPES:
            raise MeshError(
                f"{self.name} has elements of type {number}: expected first or second order. "
                "Mesh again with Gmsh's option Mesh.ElementOrder = 1."
            )
        return _TYPES[number]


def _nodes_2(take: _Numbers, parametric: bool) -> tuple[Integers, NDArray[np.float64]]:
    count = take.line()
    if not parametric:
        numbers, *axes = take.records(("i", "d", "d", "d"), count)
        return numbers, np.stack(axes, axis=1)
    numbers, points = np.zeros(count, np.int64), np.zeros((count, 3))
    for k in range(count):
        numbers[k], points[k] = take.whole("i"), take.take("d", 3)
        dimension, _ = take.take("i", 2)
        take.take("d", int(dimension) % 3)  # u of a curve, u and v of a surface
    return numbers, points


class _Found(NamedTuple):
    """Elements (n, K) of one type, and by physical group which of them are in it."""

    type: tuple[str, int, int]
    nodes: Integers
    groups: dict[int, Integers]


def _elements_2(take: _Numbers) -> list[_Found]:
    """Elements by type; those that come once for each of their groups are brought together."""
    count = take.line()
    blocks: dict[int, list[tuple[Integers, Integers]]] = defaultdict(list)
    while count > 0:
        number, tags, several = take.alike()
        ahead = 3 if take.text else 1  # the element's number, and in text files type and tags
        size = take.type_of(number)[2]
        rows = take.take("i", min(several, count), ahead + tags + size)
        group = np.abs(rows[:, ahead]) if tags else np.zeros(len(rows), np.int64)
        blocks[number].append((rows[:, ahead + tags :], group))
        count -= max(several, 1)
    out = []
    for number, parts in blocks.items():
        nodes, group = (np.concatenate(column) for column in zip(*parts, strict=True))
        keyed = np.column_stack([nodes, group])
        _, first, element = np.unique(nodes, axis=0, return_index=True, return_inverse=True)
        if len(first) == len(nodes) or len(np.unique(keyed, axis=0)) < len(nodes):
            first = element = np.arange(len(nodes))  # none, or a group's own, refused later
        kept = np.sort(first)
        place = np.searchsorted(kept, first[element.ravel()])
        groups = {int(k): np.unique(place[group == k]) for k in np.unique(group) if k}
        out.append(_Found(_TYPES[number], nodes[kept], groups))
    return out


def _entities(take: _Numbers) -> dict[_Entity, list[int]]:
    """Physical groups of each entity, of the whole mesh or of its partitions."""
    out = {}
    partitioned = "Partitioned" in take.name
    if partitioned:
        take.whole("q")
        take.take("i", take.whole("q"), 2)  # ghosts
    for dimension, count in enumerate(take.take("q", 4)):
        for _ in range(int(count)):
            entity = take.whole("i")
            if partitioned:
                take.take("i", 2)
                take.take("i", take.whole("q"))
            take.take("d", 6 if dimension else 3)
            out[dimension, entity] = [abs(int(x)) for x in take.take("i", take.whole("q"))]
            if dimension:
                take.take("i", take.whole("q"))
    return out


def _nodes_4(take: _Numbers) -> tuple[Integers, NDArray[np.float64]]:
    blocks, count, _, _ = (int(x) for x in take.take("q", 4))
    numbers, points = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for _ in range(blocks):
        dimension, _, parametric = (int(x) for x in take.take("i", 3))
        columns = 3 + abs(dimension) * bool(parametric)
        size = take.whole("q")
        numbers.append(take.take("q", size))
        points.append(take.take("d", size, columns)[:, :3])
    if sum(map(len, numbers)) != count:
        raise MeshError(f"{take.name} has {sum(map(len, numbers))} nodes: expected {count}.")
    return np.concatenate(numbers), np.concatenate(points)


def _elements_4(take: _Numbers, groups: dict[_Entity, list[int]]) -> list[_Found]:
    blocks, count, _, _ = (int(x) for x in take.take("q", 4))
    out = []
    for _ in range(blocks):
        dimension, entity, number = (int(x) for x in take.take("i", 3))
        rows = take.take("q", take.whole("q"), 1 + take.type_of(number)[2])
        every = dict.fromkeys(groups.get((dimension, entity), ()), np.arange(len(rows)))
        out.append(_Found(_TYPES[number], rows[:, 1:], every))
    found = sum(len(each.nodes) for each in out)
    if found != count:
        raise MeshError(f"{take.name} has {found} elements: expected {count}.")
    return out


def _content(
    path: Path,
    numbers: Integers,
    points: NDArray[np.float64],
    found: list[_Found],
    names: dict[_Entity, str],
) -> Content:
    """Elements in VTK order, and groups by name, or by number where they have none.

    Before a number that groups of several dimensions have stands "surface" and the like.
    """
    blocks, members, start = [], defaultdict(list), 0
    every = {(each.type[1], group) for each in found for group in each.groups}
    dimensions = Counter(group for _, group in every - set(names))
    placed = places(numbers, [each.nodes for each in found], str(path))
    for ((kind, dimension, _), _, groups), nodes in zip(found, placed, strict=True):
        nodes = nodes[:, _VTK_ORDER[kind]] if kind in _VTK_ORDER else nodes
        blocks.append(Block(kind, dimension, nodes))
        for group, own in groups.items():
            number = f"{_ENTITIES[dimension]} {group}" if dimensions[group] > 1 else str(group)
            members[names.get((dimension, group), number)].append(start + own)
        start += len(nodes)
    return Content(points, blocks, {k: np.concatenate(v) for k, v in members.items()}, {})

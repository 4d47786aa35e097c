"""Abaqus input files: nodes, elements, sets, parts and their instances.

Keywords as in the "Abaqus Keywords Guide".  meshio fails on trailing commas, blank fields and
elements of unknown types, and passes over systems and instances.
"""

from __future__ import annotations

import itertools
import re
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pdcorrect.errors import MeshError, PdcorrectWarning
from pdcorrect.fem.mesh_content import (
    Block,
    Content,
    Integers,
    check_once,
    chosen,
    nodes_of,
    places,
)

Array = NDArray[np.float64]

_UNREAD = {"SYSTEM", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "IMPORT", "INCLUDE"}
"""Keywords that change the mesh and are not read; *INCLUDE if not on one line."""

_PARAMETERS = {
    "NODE": {"NSET", "SYSTEM", "INPUT"},
    "ELEMENT": {"TYPE", "ELSET", "INPUT"},
    "INSTANCE": {"NAME", "PART"},
}
"""What is read of keywords that make the mesh."""

_DIGITS = 18
"""Of the largest number of a node or element."""

_HEXAHEDRON = re.compile(r"(?:C|DC|Q)3D(8|20|27)(?!\d).*")
_OTHER_SOLID = re.compile(r"(C|DC|DCC|Q|AC|EC|EMC|COH|GK|CIN)3D\d.*|SC[68].*|CSS8.*|CCL\d.*|V?U\d+")
_SKIN = re.compile(r"(?:S|DS|CPS|CPE|CAX|M3D|SFM3D|R3D|F3D)([489])(?!\d).*")
_KINDS = {
    (3, 8): "hexahedron", (3, 20): "hexahedron20", (3, 27): "hexahedron27",
    (2, 4): "quad", (2, 8): "quad8", (2, 9): "quad9",
}  # fmt: skip
"""By dimension and number of nodes; their order is VTK's but for the last seven of 27."""


_SIDES = {
    "S1": [0, 1, 2, 3], "S2": [4, 7, 6, 5], "S3": [0, 4, 5, 1], "S4": [1, 5, 6, 2],
    "S5": [2, 6, 7, 3], "S6": [3, 7, 4, 0],
}  # fmt: skip
"""Corners of a hexahedron's faces."""


class _Line(NamedTuple):
    path: Path
    number: int
    text: str

    def error(self, told: str) -> MeshError:
        return MeshError(f"{self.path}: line {self.number}, {self.text[:60]!r}: {told}")


class _Keyword(NamedTuple):
    """A keyword in capitals with its parameters, and its data lines."""

    name: str
    parameters: dict[str, str]
    line: _Line
    data: list[_Line]


class _Set(NamedTuple):
    """A set of "NSET", "ELSET" or "SURFACE": numbers, and names of sets, in an instance or here.

    They are of the kind ``of``; of a surface each has a side.
    """

    kind: str
    name: str
    instance: str
    members: list[str | range]
    of: str
    sides: tuple[str, ...] = ()


@dataclass
class _Part:
    """Nodes, elements and sets that are numbered together."""

    nodes: list[tuple[Integers, Array]] = field(default_factory=list)
    elements: list[tuple[int, Integers, Integers]] = field(default_factory=list)
    sets: list[_Set] = field(default_factory=list)


class _Instance(NamedTuple):
    """A part, what is added to it, and where it goes: x -> R x + b."""

    name: str
    parts: tuple[_Part, ...]
    rotation: Array
    offset: Array


def read_abaqus(path: Path) -> Content:
    """Read the instances of a file's parts, or its nodes and elements if it has none.

    Raises
    ------
    MeshError
        If the file is damaged, or holds what is not read; names the line.
    """
    parts: dict[str, _Part] = {"": _Part()}
    """By name; that without one is of the assembly, or of a file without parts."""
    instances: list[_Instance] = []
    here = parts[""]
    for keyword in _keywords(path):
        name, parameters = keyword.name, keyword.parameters
        if name == "PART":
            here = parts.setdefault(parameters.get("NAME", "").upper(), _Part())
        elif name in ("ASSEMBLY", "END INSTANCE", "END PART"):
            here = parts[""]
        elif name == "INSTANCE":
            instances.append(_instance(keyword, parts))
            here = instances[-1].parts[-1]
        elif name == "NODE":
            numbers, points = _nodes(keyword)
            here.nodes.append((numbers, points))
            here.sets.append(_own_set("NSET", keyword, numbers))
        elif name == "ELEMENT":
            _add_elements(here, keyword)
        elif name in ("NSET", "ELSET"):
            _add_set(here, keyword)
        elif name == "SURFACE" and parameters.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            _add_surface(here, keyword)
    used = {id(instance.parts[0]) for instance in instances}
    unused = [name for name, part in parts.items() if name and id(part) not in used]
    if not instances:
        instances = [_placed(name, parts[name]) for name in unused]
    elif unused:
        warnings.warn(
            f"{path}: the parts {', '.join(unused)} have no *INSTANCE and are left out",
            PdcorrectWarning,
            stacklevel=4,
        )
    return _Joined(path, [*instances, _placed("", parts[""])]).content()


def _keywords(path: Path) -> Iterator[_Keyword]:
    keyword: _Keyword | None = None
    lines = _lines(path, ())
    while line := next(lines, None):
        if not line.text.startswith("*"):
            if keyword is not None:
                keyword.data.append(line)
            continue
        if keyword is not None:
            yield keyword
        text = line.text
        while text.endswith(",") and (ahead := next(lines, None)):
            if not ahead.text[0].isalpha():  # a data line, not more of the keyword
                lines = itertools.chain([ahead], lines)
                break
            text += ahead.text
        name, *fields = (part.strip() for part in text[1:].split(","))
        pairs = (part.partition("=") for part in fields if part)
        parameters = {k.strip().upper(): v.strip().strip('"') for k, _, v in pairs}
        name = " ".join(name.upper().split())
        keyword = _Keyword(name, parameters, line, [])
        unknown = set(parameters) - _PARAMETERS.get(name, set(parameters))
        if name in _UNREAD or unknown:
            raise line.error(
                f"{' and '.join(sorted(unknown)) or '*' + name} is not read: expected all nodes "
                "and elements written out, in Cartesian or cylindrical coordinates."
            )
        if name in ("NODE", "ELEMENT", "NSET", "ELSET") and "INPUT" in parameters:
            keyword.data.extend(_included(line, parameters["INPUT"], ()))
    if keyword is not None:
        yield keyword


def _lines(path: Path, above: tuple[Path, ...]) -> Iterator[_Line]:
    """Lines that are not blank, without comments, with those of included files in place."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    for number, content in enumerate(text.splitlines(), 1):
        line = _Line(path, number, content.strip())
        if not line.text or line.text.startswith("**"):
            continue
        if include := re.match(r'\*INCLUDE\s*,\s*INPUT\s*=\s*"?([^",]+)', line.text, re.I):
            yield from _included(line, include[1].strip(), above)
        else:
            yield line


def _included(line: _Line, name: str, above: tuple[Path, ...]) -> Iterator[_Line]:
    path = (line.path.parent / name).resolve()
    if path in (line.path.resolve(), *above):
        raise line.error("the file includes itself.")
    try:
        yield from _lines(path, (*above, line.path.resolve()))
    except OSError as error:
        raise line.error(f"its file cannot be read ({error.strerror}).") from None


def _numbers(line: _Line) -> list[int]:
    """Whole numbers of a line, which may end with commas."""
    try:
        found = [int(text) for text in line.text.rstrip(", \t").split(",")]
        np.array(found, dtype=np.int64)
    except (ValueError, OverflowError):
        raise line.error("expected whole numbers between commas.") from None
    return found


def _reals(line: _Line, least: int, most: int) -> list[float]:
    """Numbers of a line, zero where it is blank or ends early."""
    fields = [text.strip().upper().replace("D", "E") for text in line.text.split(",")]
    try:
        found = [float(text) if text else 0.0 for text in fields[:most]]
    except ValueError:
        found = [np.nan]
    if not np.isfinite(found).all():
        raise line.error("expected numbers between commas.")
    return found + [0.0] * (least - len(found))


def _nodes(keyword: _Keyword) -> tuple[Integers, Array]:
    system = keyword.parameters.get("SYSTEM", "R").upper()
    if system not in ("R", "C"):
        raise keyword.line.error("expected SYSTEM = R (Cartesian) or C (cylindrical).")
    numbers = [_numbers(line._replace(text=line.text.partition(",")[0])) for line in keyword.data]
    points = np.array([_reals(line, 4, 4)[1:] for line in keyword.data]).reshape(-1, 3)
    if system == "C":
        radius, angle = points[:, 0], np.deg2rad(points[:, 1])
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), points[:, 2]], axis=1)
    return np.array(numbers, dtype=np.int64).reshape(-1), points


def _add_elements(part: _Part, keyword: _Keyword) -> None:
    kind = keyword.parameters.get("TYPE", "").upper()
    if not kind:
        raise keyword.line.error("expected TYPE =.")
    hexahedron, skin = _HEXAHEDRON.fullmatch(kind), _SKIN.fullmatch(kind)
    if not hexahedron and _OTHER_SOLID.fullmatch(kind):
        raise keyword.line.error(f"solid cells of type {kind}: expected C3D8, C3D20 or C3D27.")
    match = hexahedron or skin
    if match:
        rows = _rows(keyword, 1 + int(match[1]))
        part.elements.append((3 if hexahedron else 2, rows[:, 0], rows[:, 1:]))
        part.sets.append(_own_set("ELSET", keyword, rows[:, 0]))


def _rows(keyword: _Keyword, size: int) -> Integers:
    """Elements as rows of their number and nodes; one goes on after a comma at a line's end."""
    rows, row = [], []
    for line in keyword.data:
        row += _numbers(line)
        if len(row) > size or (len(row) < size and not line.text.endswith(",")):
            raise _wrong_count(keyword, line, row, size)
        if len(row) == size:
            rows.append(row)
            row = []
    if row:
        raise _wrong_count(keyword, keyword.data[-1], row, size)
    return np.array(rows, dtype=np.int64).reshape(-1, size)


def _wrong_count(keyword: _Keyword, line: _Line, row: list[int], size: int) -> MeshError:
    kind = keyword.parameters["TYPE"]
    return line.error(f"element {row[0]} has {len(row) - 1} nodes: expected {size - 1} of {kind}.")


def _own_set(kind: str, keyword: _Keyword, numbers: Integers) -> _Set:
    """The set that the parameter of *NODE or *ELEMENT names."""
    name = keyword.parameters.get(kind, "")
    return _Set(kind, name, "", list(map(str, numbers)) if name else [], kind)


def _add_set(part: _Part, keyword: _Keyword) -> None:
    name, own = keyword.name, keyword.parameters
    members: list[str | range] = []
    for line in keyword.data:
        if "GENERATE" in own:
            first, *rest = _numbers(line)
            if not rest:
                raise line.error("expected the first and the last number, and the step.")
            members.append(range(first, rest[0] + 1, max([1, *rest[1:2]])))
        else:
            members += (text.strip() for text in line.text.split(",") if text.strip())
    of = name
    if name == "NSET" and "ELSET" in own:  # the nodes of its elements
        of, members = "ELSET", [own["ELSET"]]
    part.sets.append(_Set(name, own.get(name, ""), own.get("INSTANCE", "").upper(), members, of))


def _add_surface(part: _Part, keyword: _Keyword) -> None:
    """A surface of faces: an element or a set of them, and the side, in each line."""
    pairs = [[text.strip() for text in line.text.split(",")] for line in keyword.data]
    members: list[str | range] = [first for first, *_ in pairs]
    sides = tuple("".join(rest[:1]).upper() for _, *rest in pairs)
    name = keyword.parameters.get("NAME", "")
    part.sets.append(_Set("SURFACE", name, "", members, "ELSET", sides))


def _instance(keyword: _Keyword, parts: dict[str, _Part]) -> _Instance:
    """A part moved and then turned, as its data lines say."""
    part = keyword.parameters.get("PART", "").upper()
    if part not in parts:
        raise keyword.line.error(f"there is no *PART of the name {part}.")
    rotation, offset = np.eye(3), np.zeros(3)
    if keyword.data:
        offset = np.array(_reals(keyword.data[0], 3, 3))
    if len(keyword.data) > 1:
        turn = np.array(_reals(keyword.data[1], 7, 7))
        start, axis = turn[:3], turn[3:6] - turn[:3]
        if not axis.any():
            raise keyword.data[1].error("expected two points on an axis, and an angle.")
        axis *= np.deg2rad(turn[6]) / np.linalg.norm(axis)
        rotation = Rotation.from_rotvec(axis).as_matrix()
        offset = rotation @ (offset - start) + start
    name = keyword.parameters.get("NAME", part)
    return _Instance(name, (parts[part], _Part()), rotation, offset)


def _placed(name: str, part: _Part) -> _Instance:
    return _Instance(name, (part,), np.eye(3), np.zeros(3))


class _Joined:
    """All instances numbered through, with their sets."""

    def __init__(self, path: Path, instances: list[_Instance]) -> None:
        self._path, self._instances = path, instances
        self._blocks: list[Block] = []
        self._numbers: dict[tuple[str, str], tuple[Integers, int]] = {}
        self._sets: dict[tuple[str, str, str], Integers] = {}
        self._groups: dict[str, dict[str, list[Integers]]] = {"NSET": {}, "ELSET": {}}
        self._surfaces: dict[str, list[Block]] = defaultdict(list)
        self._spelled: dict[str, str] = {}

    def content(self) -> Content:
        """Points, elements and sets; those of one of several instances as ``instance.set``."""
        points, start, elements = [np.zeros((0, 3))], 0, 0
        for name, parts, rotation, offset in self._instances:
            nodes = [each for part in parts for each in part.nodes]
            numbers = np.concatenate([np.zeros(0, np.int64), *(own for own, _ in nodes)])
            points += [own @ rotation.T + offset for _, own in nodes]
            labels = [np.zeros(0, np.int64)]
            found = [each for part in parts for each in part.elements]
            placed = places(numbers, [rows for _, _, rows in found], str(self._path))
            for (dimension, own, _), place in zip(found, placed, strict=True):
                kind = _KINDS[dimension, place.shape[1]]
                self._blocks.append(Block(kind, dimension, start + place))
                labels.append(own)
            check_once(np.concatenate(labels), f"{self._path}: element")
            self._numbers["NSET", name.upper()] = numbers, start
            self._numbers["ELSET", name.upper()] = np.concatenate(labels), elements
            start, elements = start + len(numbers), elements + sum(map(len, labels))
            prefix = f"{name}." if name and len(self._instances) > 2 else ""
            for each in (each for part in parts for each in part.sets if each.name):
                self._add(each, each.instance or name.upper(), prefix + each.name)
        for name, faces in self._surfaces.items():
            own = elements + np.arange(sum(len(block.nodes) for block in faces))
            unlike = f"surface {name}" if name in self._groups["ELSET"] else name
            self._groups["ELSET"].setdefault(unlike, []).append(own)
            self._blocks += faces
            elements += len(own)
        groups = {
            kind: {name: np.unique(np.concatenate(own)) for name, own in found.items()}
            for kind, found in self._groups.items()
        }
        return Content(np.concatenate(points), self._blocks, groups["ELSET"], groups["NSET"])

    def _add(self, added: _Set, scope: str, name: str) -> None:
        """Keep a set, unless it names what is not read."""
        if added.kind == "SURFACE":
            self._add_faces(added, scope, self._spelled.setdefault(name.upper(), name))
            return
        members = self._members(added.of, added.members, scope)
        if members is not None and added.kind != added.of:
            members = nodes_of(self._blocks, members)
        if members is not None and len(members):
            key = added.kind, scope, added.name.upper()
            self._sets[key] = np.append(self._sets.get(key, members[:0]), members)
            name = self._spelled.setdefault(name.upper(), name)
            self._groups[added.kind].setdefault(name, []).append(members)

    def _add_faces(self, added: _Set, scope: str, name: str) -> None:
        """Keep a surface as quadrilaterals, unless it names what is not read."""
        faces = []
        for member, side in zip(added.members, added.sides, strict=True):
            members = self._members(added.of, [member], scope)
            if members is None or side not in _SIDES:
                return
            solids = (block for block in chosen(self._blocks, members) if block.dimension == 3)
            faces += [Block("quad", 2, block.nodes[:, _SIDES[side]]) for block in solids]
        if faces:
            self._surfaces[name] += faces

    def _members(self, kind: str, members: list[str | range], scope: str) -> Integers | None:
        """Places of nodes or elements, by their numbers and sets; None if one is not known."""
        found = [np.zeros(0, np.int64)]
        labels: dict[str, list[int]] = defaultdict(list)
        for member in members:
            if isinstance(member, range):
                numbers, start = self._numbers.get((kind, scope), (found[0], 0))
                inside = (numbers >= member.start) & (numbers < member.stop)
                inside &= (numbers - member.start) % member.step == 0
                found.append(start + np.flatnonzero(inside))
                continue
            owner, _, label = member.rpartition(".")
            owner = owner.upper() or scope
            if label.isdecimal() and len(label) <= _DIGITS:
                labels[owner].append(int(label))
            elif (known := self._sets.get((kind, owner, label.upper()))) is not None:
                found.append(known)
            else:
                return None
        for owner, wanted in labels.items():
            numbers, start = self._numbers.get((kind, owner), (found[0], 0))
            found.append(start + np.flatnonzero(np.isin(numbers, wanted)))
        return np.concatenate(found)

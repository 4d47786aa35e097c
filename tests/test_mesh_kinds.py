"""Kinds of mesh files that programs write: two cubes in a row, whatever stands beside them."""

import itertools
import subprocess
import sys
import tracemalloc

import meshio
import numpy as np
import pytest

from pdcorrect.errors import MeshError, PdcorrectWarning
from pdcorrect.fem.hexahedron import VTK_FACES
from pdcorrect.fem.mesh_files import read_hex_mesh

POINTS = 0.1 * np.array(list(itertools.product(range(3), range(2), range(2))))
"""Of two cubes along x, z fastest, m."""

CELLS = np.array([[0, 4, 6, 2, 1, 5, 7, 3], [4, 8, 10, 6, 5, 9, 11, 7]])
"""In VTK order."""


def assert_two_cubes(mesh, order=(0, 1)):
    assert mesh.positions.shape == (12, 3)
    np.testing.assert_allclose(
        mesh.positions[mesh.cells], POINTS[CELLS[list(order)]], rtol=0, atol=1e-12
    )


def read(tmp_path, name, text, **options):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode(**options))
    return read_hex_mesh(path)


def sizes(mesh):
    """Cells, faces and nodes of each group."""
    return {
        name: (len(group.cells), len(group.faces), len(group.nodes))
        for name, group in mesh.groups.items()
    }


# --- Gmsh ------------------------------------------------------------------------------------


def rows(*tables):
    return "\n".join(" ".join(map(str, row)) for table in tables for row in table) + "\n"


def section(name, *tables):
    return f"${name}\n{rows(*tables)}$End{name}\n"


def nodes_41(first=1, dimension=3, extra=()):
    tags = np.arange(first, first + 12)
    return section(
        "Nodes", [(1, 12, first, first + 11), (dimension, 1, int(bool(extra)), 12)],
        tags[:, None], [(*point, *extra) for point in POINTS],
    )  # fmt: skip


def elements_41(*blocks):
    """Of (dimension, entity, type, nodes)."""
    number = itertools.count(1)
    count = sum(len(nodes) for *_, nodes in blocks)
    tables = [[(len(blocks), count, 1, count)]]
    for dimension, entity, kind, nodes in blocks:
        tables += [[(dimension, entity, kind, len(nodes))]]
        tables += [[(next(number), *row) for row in nodes]]
    return section("Elements", *tables)


FORMAT_41 = section("MeshFormat", [(4.1, 0, 8)])
FORMAT_22 = section("MeshFormat", [(2.2, 0, 8)])
BOX = (0, 0, 0, 0.2, 0.1, 0.1)
NAMES = section("PhysicalNames", [(2,), (2, 3, '"left side"'), (3, 7, '"Körper"')])
VOLUME = section("Entities", [(0, 0, 0, 1), (1, *BOX, 0, 0)])
NODES_22 = section("Nodes", [(12,)], [(k, *point) for k, point in enumerate(POINTS, 1)])
ELEMENTS_22 = section(
    "Elements", [(2,)], [(k + 1, 5, 2, 7, 1, *row) for k, row in enumerate(CELLS + 1)]
)
QUAD = np.array([[1, 3, 4, 2]])


@pytest.mark.parametrize(
    ("entities", "groups"),
    [
        ([(0, 0, 1, 1), (1, *BOX, 0, 0), (1, *BOX, 1, 7, 1, 1)], {"Körper": (2, 0, 0)}),
        ([(0, 0, 1, 1), (1, *BOX, 1, 3, 0), (1, *BOX, 0, 1, 1)], {"left side": (0, 1, 0)}),
        ([(0, 0, 1, 1), (1, *BOX, 2, 3, 4, 0), (1, *BOX, 2, -7, 8, 1, 1)],
         {"left side": (0, 1, 0), "4": (0, 1, 0), "Körper": (2, 0, 0), "8": (2, 0, 0)}),
        ([(0, 0, 1, 1), (1, *BOX, 1, 1, 0), (1, *BOX, 1, 1, 1, 1)],
         {"surface 1": (0, 1, 0), "volume 1": (2, 0, 0)}),
        ([(0, 0, 1, 1), (1, *BOX, 1, 7, 0), (1, *BOX, 1, 7, 1, 1)],
         {"7": (0, 1, 0), "Körper": (2, 0, 0)}),
        ([(0, 0, 1, 1), (1, *BOX, 0, 0), (1, *BOX, 0, 0)], {}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("coding", ["utf-8", "latin-1"])
def test_groups_of_some_of_all_saved_entities(tmp_path, entities, groups, coding):
    elements = elements_41((2, 1, 3, QUAD), (3, 1, 5, CELLS + 1))
    text = FORMAT_41 + NAMES + section("Entities", entities) + nodes_41() + elements
    mesh = read(tmp_path, "all.msh", text, encoding=coding)
    assert_two_cubes(mesh)
    assert sizes(mesh) == groups


@pytest.mark.parametrize("group", [(0,), (1, 7)])
@pytest.mark.parametrize("ghosts", [[(0,)], [(2,), (8, 1), (9, 2)]])
@pytest.mark.parametrize("entities", [VOLUME, ""])
def test_partitions_of_gmsh(tmp_path, group, ghosts, entities):
    parts = [(2, 3, 1, 1, 1, *BOX, *group, 0), (3, 3, 1, 2, 1, 2, *BOX, *group, 1, -4)]
    partitioned = section("PartitionedEntities", [(2,)], ghosts, [(0, 0, 0, 2)], parts)
    elements = elements_41((3, 2, 5, CELLS[:1] + 1), (3, 3, 5, CELLS[1:] + 1))
    mesh = read(tmp_path, "parts.msh", FORMAT_41 + entities + partitioned + nodes_41() + elements)
    assert_two_cubes(mesh)
    assert sizes(mesh) == ({"7": (2, 0, 0)} if group[0] else {})


@pytest.mark.parametrize(("dimension", "extra"), [(1, (0.5,)), (2, (0.5, 1)), (3, (1, 2, 3))])
def test_parametric_nodes_of_gmsh(tmp_path, dimension, extra):
    elements = elements_41((3, 1, 5, CELLS + 1))
    text = FORMAT_41 + VOLUME + nodes_41(1, dimension, extra) + elements
    assert_two_cubes(read(tmp_path, "new.msh", text))
    table = [
        (k, *point, dimension, 1, *extra[: dimension % 3]) for k, point in enumerate(POINTS, 1)
    ]
    old = FORMAT_22 + section("ParametricNodes", [(12,)], table) + ELEMENTS_22
    assert_two_cubes(read(tmp_path, "old.msh", old))


@pytest.mark.parametrize("several", [[(7,), (7, 8)], [(7, 8), (7, 8)], [(7, 8, 9), (9,)]])
def test_volumes_in_several_groups_of_gmsh_2(tmp_path, several):
    table = [
        (5, 5, 2, group, 1, *row)
        for group in (7, 8, 9)
        for row, groups in zip(CELLS + 1, several, strict=True)
        if group in groups
    ]
    mesh = read(
        tmp_path, "a.msh", FORMAT_22 + NODES_22 + section("Elements", [(len(table),)], table)
    )
    assert_two_cubes(mesh)
    assert {name: count for name, (count, _, _) in sizes(mesh).items()} == {
        str(k): sum(k in own for own in several) for k in (7, 8, 9) if any(k in s for s in several)
    }
    table.append(table[0])
    with pytest.raises(MeshError, match="same eight"):
        read(tmp_path, "a.msh", FORMAT_22 + NODES_22 + section("Elements", [(len(table),)], table))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_binary_gmsh_files_of_either_byte_order(tmp_path, order, version):
    def pack(kind, *values):
        return b"".join(np.asarray(each, order + kind).tobytes() for each in values)

    tags = np.arange(1, 13)
    if version == "2.2":
        nodes = b"12\n" + b"".join(
            pack("i", tag) + pack("d", point) for tag, point in zip(tags, POINTS, strict=True)
        )
        elements = b"2\n" + pack(
            "i", [5, 2, 2], *([k, 7, 1, *row] for k, row in enumerate(CELLS + 1))
        )
    else:
        nodes = pack("q", [1, 12, 1, 12]) + pack("i", [3, 1, 0]) + pack("q", [12], tags)
        nodes += pack("d", POINTS)
        elements = pack("q", [1, 2, 1, 2]) + pack("i", [3, 1, 5])
        elements += pack("q", [2], *([k, *row] for k, row in enumerate(CELLS + 1)))
    head = version.encode() + b" 1 8\n" + pack("i", [1])
    parts = {b"MeshFormat": head, b"Nodes": nodes, b"Elements": elements}
    data = b"".join(b"$%s\n%s\n$End%s\n" % (name, own, name) for name, own in parts.items())
    mesh = read(tmp_path, "a.msh", data)
    assert_two_cubes(mesh)
    assert sizes(mesh) == ({"7": (2, 0, 0)} if version == "2.2" else {})
    for cut in (data.replace(nodes, nodes[:-8]), data.replace(elements, elements + bytes(8))):
        with pytest.raises(MeshError, match="section"):
            read(tmp_path, "b.msh", cut)


@pytest.mark.parametrize("first", [2_000_000_000, 3_000_000_000, 10**15])
def test_large_node_numbers_take_the_memory_of_few(tmp_path, first):
    text = FORMAT_41 + VOLUME + nodes_41(first) + elements_41((3, 1, 5, CELLS + first))
    tracemalloc.start()
    mesh = read(tmp_path, "large.msh", text)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert_two_cubes(mesh)
    assert peak < 10e6


@pytest.mark.parametrize(
    ("text", "option"),
    [
        ("$NOD\n" + rows([(12,)]) + "$ENDNOD\n$ELM\n0\n$ENDELM\n", "Mesh.MshFileVersion = 4.1"),
        (section("MeshFormat", [(4, 0, 8)]) + NODES_22, "Mesh.MshFileVersion = 4.1"),
        (section("MeshFormat", [(3, 0, 8)]) + NODES_22, "Mesh.MshFileVersion = 4.1"),
        (FORMAT_22 + NODES_22 + section("Elements", [(1,)], [(1, 92, 0, *range(64))]),
         "Mesh.ElementOrder = 1"),
        (FORMAT_22 + NODES_22 + section("Elements", [(1,)], [(1, 4, 0, 1, 2, 3, 5)]), "tetra"),
        ("no mesh\n", "MeshFormat"),
    ],
)  # fmt: skip
def test_other_gmsh_files_are_refused_by_the_option_to_change(tmp_path, text, option):
    with pytest.raises(MeshError, match=f"other.msh.*{option}"):
        read(tmp_path, "other.msh", text)


GOOD_41 = FORMAT_41 + VOLUME + nodes_41() + elements_41((3, 1, 5, CELLS + 1))


@pytest.mark.parametrize(
    ("good", "old", "new", "place"),
    [
        (GOOD_41, "1 2 1 2\n", "1 3 1 2\n", "Elements"),
        (GOOD_41, "3 1 5 2\n", "3 1 5 1\n", "Elements"),
        (GOOD_41, "1 12 1 12\n", "1 13 1 12\n", "Nodes"),
        (GOOD_41, "$EndNodes", "$", "Nodes"),
        (
            GOOD_41,
            "$EndElements\n",
            "$EndElements\n" + elements_41((3, 1, 5, CELLS[1:] + 1)),
            "two",
        ),
        (GOOD_41, "\n12\n", "\n11\n", "node 11"),
        (GOOD_41, "\n12\n", "\n11.5\n", "Nodes"),
        (FORMAT_22 + NODES_22 + ELEMENTS_22, "s\n2\n", "s\n1\n", "Elements"),
        (FORMAT_22 + NODES_22 + ELEMENTS_22, "s\n2\n", "s\n3\n", "Elements"),
        (FORMAT_22 + NODES_22 + ELEMENTS_22, "s\n12\n", "s\n11\n", "Nodes"),
        (FORMAT_22 + NODES_22 + ELEMENTS_22, "s\n12\n", "s\n99999999999\n", "Nodes"),
        (FORMAT_22 + NODES_22 + ELEMENTS_22, "0.1", "O.1", "Nodes"),
    ],
)
def test_no_node_or_cell_of_a_damaged_gmsh_file_is_left_out(tmp_path, good, old, new, place):
    assert_two_cubes(read(tmp_path, "good.msh", good))
    with pytest.raises(MeshError, match=f"bad.msh.*{place}"):
        read(tmp_path, "bad.msh", good.replace(old, new, 1))


@pytest.fixture(scope="module")
def by_gmsh(tmp_path_factory):
    """Files of two stacked blocks of 4 cells, written by Gmsh in many ways, by name."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        pytest.skip(f"gmsh: {error}")
    folder = tmp_path_factory.mktemp("gmsh")
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    geo = gmsh.model.geo
    corners = [geo.addPoint(x, y, 0) for x, y in [(0, 0), (0.2, 0), (0.2, 0.1), (0, 0.1)]]
    lines = [geo.addLine(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    base = geo.addPlaneSurface([geo.addCurveLoop(lines)])
    for line, count in zip(lines, [3, 2, 3, 2], strict=True):
        geo.mesh.setTransfiniteCurve(line, count)
    geo.mesh.setTransfiniteSurface(base)
    geo.mesh.setRecombine(2, base)
    top, lower, *_ = geo.extrude([(2, base)], 0, 0, 0.1, [2], recombine=True)
    _, upper, *_ = geo.extrude([top], 0, 0, 0.1, [2], recombine=True)
    geo.synchronize()
    gmsh.model.addPhysicalGroup(3, [lower[1]], name="lower")
    gmsh.model.addPhysicalGroup(3, [lower[1], upper[1]], name="all")
    gmsh.model.addPhysicalGroup(2, [base], name="foot")
    gmsh.model.addPhysicalGroup(0, [corners[0]], name="corner")
    files = []
    for order, incomplete, parts in [(1, 0, 0), (2, 1, 0), (2, 0, 0), (1, 0, 2)]:
        gmsh.option.setNumber("Mesh.ElementOrder", order)
        gmsh.option.setNumber("Mesh.SecondOrderIncomplete", incomplete)
        gmsh.model.mesh.clear()
        gmsh.model.mesh.generate(3)
        if parts:
            gmsh.model.mesh.partition(parts)
        for version, binary, parametric, suffix in [
            (2.2, 0, 0, "msh"), (2.2, 1, 1, "msh"), (4.1, 0, 0, "msh"), (4.1, 1, 0, "msh"),
            (4.1, 0, 1, "msh"), (4.1, 1, 1, "msh"), (4.1, 0, 0, "inp"),
        ]:  # fmt: skip
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.option.setNumber("Mesh.Binary", binary)
            gmsh.option.setNumber("Mesh.SaveParametric", parametric)
            gmsh.option.setNumber("Mesh.SaveGroupsOfElements", 1)
            files.append(folder / f"{len(files)}.{suffix}")
            gmsh.write(str(files[-1]))
    gmsh.finalize()
    return files


def test_files_written_by_gmsh(by_gmsh):
    for path in by_gmsh:
        mesh = read_hex_mesh(path)
        assert (len(mesh.positions), len(mesh.cells)) == (30, 8)
        np.testing.assert_allclose(np.ptp(mesh.positions, axis=0), [0.2, 0.1, 0.2], rtol=1e-12)
        assert len(mesh.groups["all"].cells) == 8
        assert mesh.positions[mesh.cells[mesh.groups["lower"].cells]].max(axis=(0, 1))[2] == 0.1
        assert len(mesh.groups["foot"].faces) == 2
        assert (mesh.groups["foot"].faces[:, 1] == 4).all()


# --- Abaqus ----------------------------------------------------------------------------------

NODE_LINES = "\n".join(f"{k}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(POINTS, 1))
ELEMENT_LINES = "\n".join(f"{k}, " + ", ".join(map(str, row)) for k, row in enumerate(CELLS + 1, 1))
FLAT = f"*NODE\n{NODE_LINES}\n*ELEMENT, TYPE=C3D8\n{ELEMENT_LINES}\n"


def blank_zeros(text):
    return text.replace(" 0.0", " ").replace(", ,", ",,")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("*NODE", " *Node").replace("*ELEMENT", "\t* element"),
        lambda text: "\n".join(
            line if line[0] == "*" else f"{line}," for line in text.split("\n") if line
        ),
        blank_zeros,
        lambda text: text.replace("0.1", "1.D-1").replace("0.2", "2d-01"),
        lambda text: text.replace("TYPE=C3D8", "\n  TYPE = C3D8 ,\n** remark\n ELSET=A"),
        lambda text: text.replace("C3D8", "C3D8,").replace("NODE", "NODE,"),
        lambda text: text.replace(", 7, 3, 2", ",\n7, 3,\n2"),
        lambda text: text.replace(", 0.1\n", ", 0.1, 0., 0., 1.\n"),
        lambda text: (
            text + "*NSET, NSET=All, GENERATE\n1, 12\n*ELSET, ELSET=E, generate\n1, 2, 1\n"
        ),
        lambda text: text + "*NSET, NSET=bad\n what, is this\n*STEP\n*STATIC\n1., 1.\n*END STEP\n",
    ],
)
def test_spellings_of_abaqus(tmp_path, change):
    assert change(FLAT) != FLAT
    assert_two_cubes(read(tmp_path, "a.inp", change(FLAT)))


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("MASS", "1"), ("SPRINGA", "1, 2"), ("S4R", "1, 3, 4, 2"), ("S4R5", "1, 3, 4, 2"),
        ("SFM3D4R", "1, 3, 4, 2"), ("S3", "1, 3, 4"), ("B31", "1, 2"), ("CONN3D2", "1, 2"),
        ("CPS8", "1, 3, 4, 2, 9, 10, 11, 12"), ("WHAT", "1, any, thing"), ("DCOUP3D", "1"),
    ],
)  # fmt: skip
def test_what_stands_beside_hexahedra_in_abaqus_files(tmp_path, kind, line):
    extra = f"*ELEMENT, TYPE={kind}, ELSET=EXTRA\n9, {line}\n*{kind}, ELSET=EXTRA\n1.\n"
    assert_two_cubes(read(tmp_path, "a.inp", FLAT + extra))
    before = FLAT.replace("*ELEMENT", extra + "*ELEMENT", 1)
    assert_two_cubes(read(tmp_path, "b.inp", before))


@pytest.mark.parametrize("keyword", ["NODE", "ELEMENT"])
@pytest.mark.parametrize("how", ["input", "include"])
def test_parts_of_abaqus_files_in_other_files(tmp_path, keyword, how):
    (tmp_path / "meshes").mkdir()
    lines = NODE_LINES if keyword == "NODE" else ELEMENT_LINES
    (tmp_path / "meshes" / "lines.txt").write_text(lines)
    name = ", INPUT=meshes/lines.txt"
    text = FLAT.replace(f"\n{lines}\n", "\n" if how == "input" else f"\n*include{name}\n")
    text = (
        text.replace("C3D8", f"C3D8{name}").replace("NODE", f"NODE{name}")
        if how == "input"
        else text
    )
    if how == "input":
        other = "C3D8" if keyword == "NODE" else "NODE"
        text = text.replace(f"{other}{name}", other)
    assert_two_cubes(read(tmp_path, "a.inp", text))
    (tmp_path / "meshes" / "lines.txt").unlink()
    with pytest.raises(MeshError, match=r"a\.inp: line \d+.*lines\.txt"):
        read_hex_mesh(tmp_path / "a.inp")
    (tmp_path / "meshes" / "lines.txt").write_text("*INCLUDE, INPUT=../a.inp")
    with pytest.raises(MeshError, match=r"line \d+"):
        read_hex_mesh(tmp_path / "a.inp")


@pytest.mark.parametrize(
    "lines", ["*NSET, NSET=A, GENERATE\n5", "*INCLUDE,\nINPUT=lines.txt", "*INCLUDE"]
)
def test_lines_of_abaqus_that_say_too_little_are_named(tmp_path, lines):
    with pytest.raises(MeshError, match=r"a\.inp: line \d+"):
        read(tmp_path, "a.inp", f"{FLAT}\n{lines}\n")


def test_a_name_of_many_digits_is_no_number(tmp_path):
    mesh = read(tmp_path, "a.inp", f"{FLAT}\n*NSET, NSET=A\n{'9' * 5000}\n")
    assert_two_cubes(mesh)
    assert "A" not in mesh.groups


def test_cylindrical_nodes_of_abaqus(tmp_path):
    radius, angle = np.hypot(*POINTS[:, :2].T), np.rad2deg(np.arctan2(POINTS[:, 1], POINTS[:, 0]))
    lines = [f"{k}, {r!r}, {a!r}, {z!r}" for k, (r, a, z) in
             enumerate(np.stack([radius, angle, POINTS[:, 2]], axis=1).tolist(), 1)]  # fmt: skip
    text = FLAT.replace(NODE_LINES, "\n".join(lines)).replace("*NODE", "*NODE, SYSTEM=C, NSET=ALL")
    mesh = read(tmp_path, "a.inp", text)
    assert_two_cubes(mesh)
    assert sizes(mesh) == {"ALL": (0, 0, 12)}
    half = FLAT.replace("*NODE", "*NODE, SYSTEM=R")
    assert_two_cubes(read(tmp_path, "b.inp", half))


ONE = FLAT.split("2, 5, 9")[0].replace("TYPE=C3D8", "TYPE=C3D8, ELSET=Cube")
PART = f"*PART, NAME=P\n{ONE}*NSET, NSET=Left, GENERATE\n1, 4\n*END PART\n*ASSEMBLY, NAME=A\n"
PART = PART.replace("\n".join(NODE_LINES.split("\n")[8:]) + "\n", "")
"""A part of the first cube."""


@pytest.mark.parametrize(
    "places",
    [
        ("", "5., 0., 0.\n"),
        ("0., 0., 0.\n", "0., 0., 0.\n0.2, 0., 0., 0.2, 0., 1., 180.\n"),
        ("1., 2., 3.\n", "1., 2.3, 3.\n1., 2.3, 3., 5., 2.3, 3., 90.\n"),
    ],
)
def test_instances_of_abaqus_are_moved_and_turned(tmp_path, places):
    text = PART
    for k, lines in enumerate(places, 1):
        text += f"*INSTANCE, NAME=I-{k}, PART=p\n{lines}*END INSTANCE\n"
    text += "*NODE\n1, 7., 7., 7.\n*NSET, NSET=Point\n1\n"
    text += "*NSET, NSET=Both, INSTANCE=I-1\nLeft\n*NSET, NSET=Both, INSTANCE=I-2\nLeft,\n"
    text += "*NSET, NSET=Dotted\nI-1.1, I-2.Left\n*END ASSEMBLY\n"
    mesh = read(tmp_path, "a.inp", text)
    assert (len(mesh.positions), len(mesh.cells)) == (16, 2)
    start, second = mesh.positions[mesh.cells]
    cube = POINTS[CELLS[0]]
    offset = np.array([1, 2, 3]) if places[0].startswith("1.") else np.zeros(3)
    np.testing.assert_allclose(start, cube + offset, atol=1e-14)
    expected = {
        "5": cube + np.array([5, 0, 0]),
        "0": cube * [-1, -1, 1] + [0.4, 0, 0],
        "1": np.stack([cube[:, 0], -cube[:, 2], cube[:, 1]], axis=1) + np.array([1, 2.3, 3]),
    }[places[1][0]]
    np.testing.assert_allclose(second, expected, atol=1e-14)
    assert sizes(mesh) == {
        "I-1.Cube": (1, 0, 0), "I-1.Left": (0, 0, 4), "I-2.Cube": (1, 0, 0),
        "I-2.Left": (0, 0, 4), "Point": (0, 0, 0), "Both": (0, 0, 8), "Dotted": (0, 0, 5),
    }  # fmt: skip


def test_a_part_without_instance_is_left_out_with_a_word(tmp_path):
    other = PART.partition("*ASSEMBLY")[0].replace("NAME=P", "NAME=Q")
    assembly = "*INSTANCE, NAME=I, PART=P\n*END INSTANCE\n*END ASSEMBLY\n"
    with pytest.warns(PdcorrectWarning, match="Q"):
        mesh = read(tmp_path, "a.inp", other + PART + assembly)
    assert (len(mesh.cells), set(mesh.groups)) == (1, {"Cube", "Left"})
    only = read(tmp_path, "b.inp", PART.partition("*ASSEMBLY")[0])
    assert sizes(only) == sizes(mesh)


def test_sets_of_abaqus(tmp_path):
    text = FLAT + (
        "*ELEMENT, TYPE=S4, ELSET=Skin\n7, 1, 3, 4, 2\n8, 9, 10, 12, 11\n"
        "*ELSET, ELSET=First\n1\n*ELSET, ELSET=Mixed\nFIRST, 8\n"
        "*NSET, NSET=Line, GENERATE\n1, 9, 4\n*nset, nset=LINE\n12, 99\n"
        "*NSET, NSET=Unread\n1, nowhere\n"
    )
    mesh = read(tmp_path, "a.inp", text)
    assert sizes(mesh) == {
        "Skin": (0, 2, 0), "First": (1, 0, 0), "Mixed": (1, 1, 0), "Line": (0, 0, 4),
    }  # fmt: skip
    assert mesh.groups["Line"].nodes.tolist() == [0, 4, 8, 11]
    assert mesh.groups["Skin"].faces.tolist() == [[0, 0], [1, 1]]


def test_nodes_of_element_sets_and_surfaces_of_faces_are_read(tmp_path):
    text = FLAT + (
        "*ELSET, ELSET=Left\n1\n*NSET, NSET=Corners, ELSET=left\n"
        "*SURFACE, TYPE=ELEMENT, NAME=Ends\nLEFT, S6\n 2, s4\n"
        "*SURFACE, NAME=Outside, TYPE=ELEMENT\nLeft,\n"  # all its free faces: not read
        "*SURFACE, NAME=Points, TYPE=NODE\nCorners,\n"
        "*SURFACE, NAME=Both, COMBINE=UNION\nEnds, Outside\n"
    )
    mesh = read(tmp_path, "a.inp", text)
    assert_two_cubes(mesh)
    assert sizes(mesh) == {"Left": (1, 0, 0), "Corners": (0, 0, 8), "Ends": (0, 2, 0)}
    assert mesh.groups["Corners"].nodes.tolist() == list(range(8))
    corners = mesh.cells[mesh.groups["Ends"].faces[:, 0]]
    sides = [c[VTK_FACES[s]] for c, s in zip(corners, mesh.groups["Ends"].faces[:, 1], strict=True)]
    assert [set(mesh.positions[side][:, 0]) for side in sides] == [{0.0}, {0.2}]


@pytest.mark.parametrize("side", range(1, 7))
def test_every_side_of_an_abaqus_element(tmp_path, side):
    mesh = read(tmp_path, "a.inp", FLAT + f"*SURFACE, NAME=A\n1, S{side}\n")
    ((_, face),) = mesh.groups["A"].faces
    numbers = {1: "1234", 2: "5678", 3: "1265", 4: "2376", 5: "3487", 6: "4158"}  # of Abaqus
    assert {f"{k + 1}" for k in VTK_FACES[face]} == set(numbers[side])


# --- VTK -------------------------------------------------------------------------------------


def written(tmp_path, how):
    """A file of the two cubes as VTK writes it."""
    pyvista = pytest.importorskip("pyvista")
    vtk = pytest.importorskip("vtkmodules.vtkIOXML")
    image = pyvista.ImageData(dimensions=(3, 2, 2), spacing=(0.1, 0.1, 0.1))
    structured = image.cast_to_structured_grid()
    path = tmp_path / f"cubes.{how.rpartition('.')[2]}"
    if how.startswith("XML"):
        _, compressor, mode, _ = how.split(" ", 3)
        writer = vtk.vtkXMLUnstructuredGridWriter()
        writer.SetFileName(str(path))
        writer.SetInputData(structured.cast_to_unstructured_grid())
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetEncodeAppendedData("encoded" in how)
        writer.Write()
        return path
    data = {
        "image": image, "rectilinear": image.cast_to_rectilinear_grid(), "structured": structured,
        "voxels": image.cast_to_unstructured_grid(),
        "hexahedra": structured.cast_to_unstructured_grid(),
        "Lagrange": pyvista.UnstructuredGrid({72: CELLS}, POINTS),
    }[how.split()[0]]  # fmt: skip
    if "text data" in how:
        data.field_data["title"] = ["cubes"]
    data.save(path, binary="ascii" not in how)
    return path


@pytest.mark.parametrize(
    "how",
    [
        *(f"XML {compressor} {mode} .vtu" for compressor in ("None", "ZLib", "LZMA")
          for mode in ("Ascii", "Binary", "Appended", "Appended encoded")),
        "XML LZ4 Binary .vtu", "XML LZ4 Appended .vtu", "image .vti", "image .vtk",
        "rectilinear .vtr", "rectilinear .vtk", "structured .vts",
        "structured .vtk", "structured ascii .vtk", "voxels .vtu", "voxels .vtk",
        "hexahedra .vtk", "hexahedra ascii .vtk", "hexahedra text data .vtu", "Lagrange .vtu",
        "Lagrange .vtk",
    ],
)  # fmt: skip
def test_files_written_by_vtk(tmp_path, how):
    assert_two_cubes(read_hex_mesh(written(tmp_path, how)))


@pytest.mark.parametrize("how", ["XML LZ4 Binary .vtu", "structured .vts", "voxels .vtu"])
def test_without_pyvista_what_to_do_is_said(tmp_path, how, monkeypatch):
    path = written(tmp_path, how)
    monkeypatch.setitem(__import__("sys").modules, "vtkmodules", None)
    with pytest.raises(MeshError, match=r"pdcorrect\[view\]"):
        read_hex_mesh(path)


def pieces(*parts):
    """A VTU of several pieces, each points and cells."""
    text = '<VTKFile type="UnstructuredGrid" version="0.1"><UnstructuredGrid>'
    for points, cells in parts:
        ends = 8 * np.arange(1, len(cells) + 1)
        text += (
            f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="{len(cells)}"><Points>'
            f'<DataArray type="Float64" NumberOfComponents="3" format="ascii">{rows(points)}'
            '</DataArray></Points><Cells><DataArray type="Int64" Name="connectivity" '
            f'format="ascii">{rows(cells)}</DataArray><DataArray type="Int64" Name="offsets" '
            f'format="ascii">{rows([ends])}</DataArray><DataArray type="UInt8" Name="types" '
            f'format="ascii">{rows([0 * ends + 12])}</DataArray></Cells></Piece>'
        )
    return text + "</UnstructuredGrid></VTKFile>"


FIRST = (POINTS[:8], CELLS[:1])
SECOND = (POINTS[4:], CELLS[1:] - 4)
NOTHING = (np.zeros((0, 3)), np.zeros((0, 8), np.int64))


@pytest.mark.parametrize(
    ("parts", "order"),
    [((FIRST, SECOND), (0, 1)), ((SECOND, NOTHING, FIRST, NOTHING), (1, 0))],
)
def test_pieces_are_joined_at_their_seams(tmp_path, parts, order):
    pytest.importorskip("pyvista")
    assert_two_cubes(read(tmp_path, "a.vtu", pieces(*parts)), order)


@pytest.mark.parametrize("count", [1, 2])
def test_pvtu_files_are_read_by_their_pieces(tmp_path, count):
    pytest.importorskip("pyvista")
    parts = ((POINTS, CELLS),) if count == 1 else (FIRST, SECOND)
    head = '<VTKFile type="PUnstructuredGrid" version="0.1"><PUnstructuredGrid GhostLevel="0">'
    head += '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
    for k, part in enumerate(parts):
        (tmp_path / f"a{k}.vtu").write_text(pieces(part))
        head += f'<Piece Source="a{k}.vtu"/>'
    whole = head + "</PUnstructuredGrid></VTKFile>"
    assert_two_cubes(read(tmp_path, "a.pvtu", whole))
    with pytest.raises(MeshError, match="b.vtu: cannot be read"):
        read(tmp_path, "a.pvtu", whole.replace("a0.vtu", "b.vtu"))


def test_a_file_at_which_vtk_dies_is_refused(tmp_path):
    path = written(tmp_path, "structured ascii .vtk")
    text = path.read_text()
    assert "DIMENSIONS 3 2 2" in text
    path.write_text(text.replace("DIMENSIONS 3 2 2", "DIMENSIONS 30000 30000 30000"))
    child = [sys.executable, "-m", "pdcorrect.fem.vtk_process", path, tmp_path / "grid.npz", ""]
    assert subprocess.run(child, capture_output=True).returncode != 0
    with pytest.raises(MeshError, match="cubes.vtk: cannot be read by VTK"):
        read_hex_mesh(path)


@pytest.mark.parametrize("shift", [1e-7, 3.0])
def test_pieces_that_do_not_meet_exactly(tmp_path, shift):
    pytest.importorskip("pyvista")
    apart = (POINTS[4:] + np.array([shift, 0, 0]), CELLS[1:] - 4)
    if shift < 1:
        with pytest.raises(MeshError, match="same place"):
            read(tmp_path, "a.vtu", pieces(FIRST, apart))
    else:
        assert len(read(tmp_path, "a.vtu", pieces(FIRST, apart)).positions) == 16


def test_a_piece_that_is_cut_stays_cut(tmp_path):
    pytest.importorskip("pyvista")
    cut = (np.concatenate([POINTS[:8], POINTS[4:]]), np.stack([CELLS[0], CELLS[1] + 4]))
    with pytest.raises(MeshError, match="same place"):
        read(tmp_path, "a.vtu", pieces(cut, (POINTS + 5, CELLS)))


@pytest.mark.parametrize(("suffix", "ghost"), [("vtu", 1), ("vtk", 32), ("vtu", 33)])
def test_ghost_and_blanked_cells_are_left_out(tmp_path, suffix, ghost):
    pyvista = pytest.importorskip("pyvista")
    grid = pyvista.UnstructuredGrid({12: CELLS[[0, 1, 1]]}, POINTS)
    grid.cell_data["vtkGhostType"] = np.array([0, ghost, 0], np.uint8)
    grid.cell_data["part"] = np.array([6, 5, 6])
    grid.save(tmp_path / f"a.{suffix}")
    mesh = read_hex_mesh(tmp_path / f"a.{suffix}")
    assert_two_cubes(mesh)
    assert sizes(mesh) == {"part=6": (2, 0, 0)}


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_whole_numbers_of_vtk_cells_are_groups(tmp_path, suffix):
    data = {"part": [np.array([4, 7, 4, 4])], "size": [np.ones(4)], "number": [np.arange(4)]}
    points = np.concatenate([POINTS, POINTS + 1])
    mesh = meshio.Mesh(
        points, [("hexahedron", np.concatenate([CELLS, CELLS + 12]))], cell_data=data
    )
    meshio.write(tmp_path / f"a.{suffix}", mesh)
    groups = read_hex_mesh(tmp_path / f"a.{suffix}").groups
    assert {name: group.cells.tolist() for name, group in groups.items()} == {
        "part=4": [0, 2, 3], "part=7": [1],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new"),
    [('NumberOfCells="1"', 'NumberOfCells="2"'), ('NumberOfPoints="8"', 'NumberOfPoints="9"')],
)
def test_damaged_pieces_are_refused(tmp_path, old, new):
    text = pieces(FIRST, SECOND)
    assert old in text
    with pytest.raises(MeshError, match="a.vtu"):
        read(tmp_path, "a.vtu", text.replace(old, new, 1))


# --- any damage ------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["msh", "inp"])
def test_any_damage_is_a_mesh_error(tmp_path, suffix):
    rng = np.random.default_rng(1)
    good = {"msh": GOOD_41, "inp": PART + "*INSTANCE, NAME=I, PART=P\n0,1,2\n1,2,3,4,5,6,7\n"}[
        suffix
    ]
    for _ in range(150):
        data = bytearray(good.encode())
        start, end = np.sort(rng.integers(len(data), size=2))
        data[start : min(end, start + 9)] = rng.choice(list(b"0123456789-.,*$\n e="), 3).tolist()
        try:
            mesh = read(tmp_path, f"a.{suffix}", bytes(data))
        except MeshError as error:
            assert f"a.{suffix}" in str(error)
        else:
            assert np.isfinite(mesh.positions).all()

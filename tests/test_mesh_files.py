"""Mesh files: what other programs write is read, what cannot be used is refused by name."""

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from block_meshes import o_grid, warped
from conftest import beam
from pdcorrect.errors import MeshError, PdcorrectWarning
from pdcorrect.fem.hexahedron import corner_jacobians
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.fem.mesh_files import read_hex_mesh, write_vtu
from test_mesh import distorted_mesh, volumes

FORMATS = {
    "Gmsh 2.2": (".msh", {"file_format": "gmsh22", "binary": False}),
    "Gmsh 2.2 binary": (".msh", {"file_format": "gmsh22", "binary": True}),
    "Gmsh 4.1": (".msh", {"file_format": "gmsh", "binary": False}),
    "Gmsh 4.1 binary": (".msh", {"file_format": "gmsh", "binary": True}),
    "Abaqus": (".inp", {}),
    "VTU": (".vtu", {}),
    "VTU text": (".vtu", {"binary": False}),
}

every_format = pytest.mark.parametrize(("suffix", "options"), FORMATS.values(), ids=FORMATS)

VTK_MIDDLES = [
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
    (0, 3, 7, 4), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 1, 2, 3), (4, 5, 6, 7), range(8),
]  # fmt: skip
"""Corners between which the nodes 8 to 26 of VTK's cells lie (vtkTriQuadraticHexahedron)."""

GMSH_MIDDLES = [
    (0, 1), (0, 3), (0, 4), (1, 2), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 7), (5, 6), (6, 7),
    (0, 1, 2, 3), (0, 1, 5, 4), (0, 3, 7, 4), (1, 2, 6, 5), (2, 3, 7, 6), (4, 5, 6, 7), range(8),
]  # fmt: skip
"""The same for Gmsh's element types 17 and 12 (reference manual, "Node ordering")."""

ABAQUS_MIDDLES = VTK_MIDDLES[:12]
"""The same for Abaqus's C3D20 (nodes 9 to 20: round the bottom, round the top, upright)."""

CORNERS = np.array(
    [[0, 0, 0], [2, 0.1, 0], [2.2, 3, 0.2], [0, 2.9, 0.1],
     [0.1, 0, 4], [2, 0.3, 4.1], [2.3, 3.3, 4.4], [0.2, 3, 3.8]]
)  # fmt: skip
"""One cell without symmetry."""


def with_middles(corners, middles, count):
    """Corners (8, 3) followed by the middles that a cell of ``count`` nodes has."""
    return np.array([*corners, *(corners[list(m)].mean(axis=0) for m in middles[: count - 8])])


def second_order(mesh, count):
    """Points and cells of a straight-sided mesh with 20 or 27 nodes a cell in VTK order."""
    points = [with_middles(corners, VTK_MIDDLES, count) for corners in mesh.positions[mesh.cells]]
    _, first, cells = np.unique(
        np.round(np.concatenate(points), 9), axis=0, return_index=True, return_inverse=True
    )
    return np.concatenate(points)[first], cells.reshape(-1, count)


def assert_same_cells(found, mesh):
    np.testing.assert_allclose(volumes(found), volumes(mesh), rtol=1e-8)  # VTU text has 11 digits
    np.testing.assert_allclose(
        corner_jacobians(found.positions, found.cells),
        corner_jacobians(mesh.positions, mesh.cells),
        rtol=1e-7,
    )
    assert corner_jacobians(found.positions, found.cells).min() > 0
    np.testing.assert_allclose(
        found.positions[found.cells], mesh.positions[mesh.cells], rtol=0, atol=1e-10
    )


@every_format
def test_distorted_cells_keep_their_volumes_and_corners(tmp_path, suffix, options):
    for mesh in (distorted_mesh(), warped(o_grid())):
        path = tmp_path / f"mesh{suffix}"
        meshio.write(path, meshio.Mesh(mesh.positions, [("hexahedron", mesh.cells)]), **options)
        assert_same_cells(read_hex_mesh(path), mesh)


@every_format
@pytest.mark.parametrize("count", [20, 27])
def test_second_order_cells_are_read_by_their_corners(tmp_path, suffix, options, count):
    mesh = warped(o_grid())
    points, cells = second_order(mesh, count)
    path = tmp_path / f"mesh{suffix}"
    if (suffix, count) == (".inp", 27):  # meshio has no such cell for Abaqus
        path.write_text(abaqus(points, {"C3D27": cells}))
    else:
        meshio.write(path, meshio.Mesh(points, [(f"hexahedron{count}", cells)]), **options)
    assert_same_cells(read_hex_mesh(path), mesh)


@pytest.mark.parametrize("count", [20, 27])
def test_of_curved_cells_the_corners_are_read_with_a_warning(tmp_path, count):
    mesh = o_grid()
    points, cells = second_order(mesh, count)
    points[cells[7, 13]] += [0, 0, 1e-3]
    path = tmp_path / "curved.vtu"
    meshio.write(path, meshio.Mesh(points, [(f"hexahedron{count}", cells)]))
    with pytest.warns(PdcorrectWarning, match=r"curved.vtu: .*curved.* 0\.001 m") as told:
        assert_same_cells(read_hex_mesh(path), mesh)
    assert len(told) == 1


@pytest.mark.parametrize("count", [20, 27])
def test_nodes_in_another_order_are_refused_with_the_cell_named(tmp_path, count):
    mesh = o_grid()
    points, cells = second_order(mesh, count)
    moved = points.copy()
    moved[cells[7, 13]] = points[cells[7, 15]]
    path = tmp_path / "curved.vtu"
    blocks = [("hexahedron", cells[:5, :8])]
    blocks += [(f"hexahedron{count}", cells[5:])]
    meshio.write(path, meshio.Mesh(moved, blocks))
    with pytest.raises(MeshError, match=r"curved.vtu: .*cell \d+ around .* node \d+ 0.\d+ m"):
        read_hex_mesh(path)
    first = next(c for c in range(5, len(cells)) if cells[7, 13] in cells[c])
    with pytest.raises(MeshError, match=f"cell {first} around"):
        read_hex_mesh(path)
    meshio.write(path, meshio.Mesh(points, blocks))
    assert_same_cells(read_hex_mesh(path), mesh)


def abaqus(points, elements):
    """An input file with nodes from 1 and elements (n, K) by type."""
    lines = ["*NODE", *(f"{k}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(points, 1))]
    for kind, nodes in elements.items():
        lines.append(f"*ELEMENT, TYPE={kind}")
        lines += [f"{k}, " + ", ".join(map(str, row + 1)) for k, row in enumerate(nodes, 1)]
    return "\n".join(lines) + "\n"


def gmsh_22(points, kind, nodes):
    """A text file of version 2.2; node numbers 11, 21, 31... and a quadrilateral before."""
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(points))]
    lines += [f"{10 * k + 11} {x} {y} {z}" for k, (x, y, z) in enumerate(points)]
    lines += ["$EndNodes", "$Elements", "2", "1 3 2 0 1 11 21 31 41"]
    lines += [f"5 {kind} 2 0 1 " + " ".join(str(10 * k + 11) for k in nodes), "$EndElements"]
    return "\n".join(lines) + "\n"


def gmsh_41(points, kind, nodes):
    """A text file of version 4.1 with one volume; node numbers 11, 21, 31..."""
    count, last = len(points), 10 * len(points) + 1
    lines = ["$MeshFormat", "4.1 0 8", "$EndMeshFormat"]
    lines += ["$Entities", "0 0 0 1", "1 0 0 0 3 4 5 0 0", "$EndEntities"]
    lines += ["$Nodes", f"1 {count} 11 {last}", f"3 1 0 {count}"]
    lines += [str(10 * k + 11) for k in range(count)]
    lines += [f"{x} {y} {z}" for x, y, z in points]
    lines += ["$EndNodes", "$Elements", "1 1 5 5", f"3 1 {kind} 1"]
    lines += ["5 " + " ".join(str(10 * k + 11) for k in nodes), "$EndElements"]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("text", [gmsh_22, gmsh_41])
@pytest.mark.parametrize(("kind", "count"), [(5, 8), (17, 20), (12, 27)])
def test_gmsh_files_as_its_manual_describes_them(tmp_path, text, kind, count):
    points = with_middles(CORNERS, GMSH_MIDDLES, count)
    shuffled = np.random.default_rng(count).permutation(count)
    path = tmp_path / "cell.msh"
    path.write_text(text(points[shuffled], kind, np.argsort(shuffled)))
    found = read_hex_mesh(path)
    np.testing.assert_array_equal(found.positions[found.cells[0]], CORNERS)
    if count > 8:
        points[8:10] = points[[9, 8]]
        path.write_text(text(points, kind, range(count)))
        with pytest.raises(MeshError, match="cell 0 around"):
            read_hex_mesh(path)


@pytest.mark.parametrize("text", [gmsh_22, gmsh_41])
def test_gmsh_cells_with_missing_nodes_are_refused(tmp_path, text):
    path = tmp_path / "cell.msh"
    path.write_text(text(CORNERS, 5, range(8)).replace(" 71 81\n", " 71 80\n"))
    with pytest.raises(MeshError, match="cell.msh: .*nodes"):
        read_hex_mesh(path)


def test_cells_without_nodes_are_refused(tmp_path, monkeypatch):
    """As meshio makes of some damaged files."""
    empty = meshio.Mesh(np.array(CORNERS, float), [("hexahedron", np.empty((6, 0), np.int64))])
    monkeypatch.setattr(meshio, "read", lambda path: empty)
    with pytest.raises(MeshError, match="cell.med: .*hexahedron"):
        read_hex_mesh(tmp_path / "cell.med")


ABAQUS = """*Heading
** Job name: block Model name: Model-1
*Preprint, echo=NO, model=NO, history=NO, contact=NO
**
** PARTS
**
*Part, name=Block
*Node
     17,           0.,           0.,           0.
     18,           2.,           0.,           0.
** the far end
     20,           5.,           0.,           0.
    117,           0.,           1.,           0.
    118,           2.,           1.,           0.
    120,           5.,           1.,          0.5
   2017,           0.,           0.,           1.
   2018,           2.,           0.,           1.
   2020,           5.,           0.,           1.
   2117,           0.,           1.,           1.
   2118,           2.,           1.,           1.
   2120,           5.,           1.,          1.5
*Element, type=C3D8R, elset=All
  3,   17,   18,  118,  117, 2017, 2018, 2118, 2117
** another comment
 12,   18,   20,  120,  118, 2018, 2020, 2120, 2118
*Nset, nset=Ends, generate
   17,  20,  3
*Elset, elset=Last
 12,
** Section: soft
*Solid Section, elset=All, material=Soft
,
*End Part
*Assembly, name=Assembly
*Instance, name=Block-1, part=Block
*End Instance
*End Assembly
*Material, name=Soft
*Elastic
1e5, 0.3
"""


@pytest.mark.parametrize("kind", ["C3D8R", "C3D8", "c3d8h"])
def test_an_abaqus_file_as_abaqus_writes_it(tmp_path, kind):
    path = tmp_path / "block.inp"
    path.write_text(ABAQUS.replace("C3D8R", kind))
    mesh = read_hex_mesh(path)
    assert len(mesh.positions) == 12
    np.testing.assert_allclose(volumes(mesh), [2, 3], rtol=1e-14)
    np.testing.assert_array_equal(
        mesh.positions[mesh.cells[1]],
        [[2, 0, 0], [5, 0, 0], [5, 1, 0.5], [2, 1, 0],
         [2, 0, 1], [5, 0, 1], [5, 1, 1.5], [2, 1, 1]],
    )  # fmt: skip


def test_abaqus_cells_of_twenty_nodes_on_two_lines(tmp_path):
    points = with_middles(CORNERS, ABAQUS_MIDDLES, 20)
    numbers = np.random.default_rng(1).permutation(np.arange(5, 205, 10))
    lines = ["*NODE"] + [
        f"{n}, {x}, {y}, {z}" for n, (x, y, z) in zip(numbers, points, strict=True)
    ]
    lines += ["*ELEMENT, TYPE=C3D20R", "9, " + ", ".join(map(str, numbers[:15])) + ","]
    lines += [", ".join(map(str, numbers[15:]))]
    path = tmp_path / "cell.inp"
    path.write_text("\n".join(lines) + "\n")
    found = read_hex_mesh(path)
    np.testing.assert_array_equal(found.positions[found.cells[0]], CORNERS)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("*End Part", "*Node\n17, 9., 9., 9.\n*End Part", "node 17"),
        ("*Instance,", "*Instance, name=Block-2, part=Block\n*Instance,", "same place"),
        ("part=Block", "part=Brick", "line 35,.*BRICK"),
        ("*Element,", "*Include, input=more.inp\n*Element,", "line 22,.*Include"),
        ("*Element,", "*Ngen\n1, 9\n*Element,", r"line 22,.*\*NGEN"),
        ("*Node\n", "*Node, system=S\n", "line 8,.*SYSTEM"),
        ("*Node\n", "*Node, file=part.odb\n", "line 8,.*FILE"),
        ("*Element,", "*Element, offset=3,", "line 22,.*OFFSET"),
        ("120,           5.", "120,           5,,x", "line 15,"),
        (" 12,   18,   20,", " 12,   18,   2O,", "line 25,"),
        ("*Node\n", "*System\n1., 0., 0.\n*Node\n", r"\*SYSTEM"),
        ("   17,   18,  118,", "   17,   19,  118,", "19"),
        ("C3D8R", "C3D27", "C3D27"),
        ("C3D8R", "C3D6", "C3D6"),
        ("C3D8R", "SC8R", "SC8R"),
        ("C3D8R", "U8", "U8"),
        (" 12,   18,   20,", " 12,   18,", "line 25,.* 7 nodes"),
        ("12,   18,   20", " 3,   18,   20", "element 3"),
    ],
)
def test_abaqus_files_that_would_be_misread_are_refused(tmp_path, old, new, named):
    assert old in ABAQUS
    path = tmp_path / "block.inp"
    path.write_text(ABAQUS.replace(old, new))
    with pytest.raises(MeshError, match=named) as refused:
        read_hex_mesh(path)
    assert "block.inp" in str(refused.value)


VTU = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">
<UnstructuredGrid><Piece NumberOfPoints="8" NumberOfCells="2">
<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1
</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">
0 1 2 3 4 5 6 7 0 1 3 2 4 5 7 6
</DataArray><DataArray type="Int64" Name="offsets" format="ascii">8 16</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">12 TYPE</DataArray></Cells>
</Piece></UnstructuredGrid></VTKFile>
"""


@pytest.mark.parametrize(
    ("kind", "named"),
    [(11, "same eight"), (72, "same eight"), (33, "hexahedron24"), (79, "BEZIER")],
)
def test_solid_cells_of_other_types_are_never_left_out(tmp_path, kind, named):
    path = tmp_path / "cells.vtu"
    path.write_text(VTU.replace("TYPE", str(kind)))
    with pytest.raises(MeshError, match=f"cells.vtu.*{named}"):
        read_hex_mesh(path)


def test_other_solid_cells_are_counted_and_placed(tmp_path):
    mesh = distorted_mesh()
    path = tmp_path / "mixed.vtu"
    tetra = mesh.cells[4:7][:, [0, 1, 3, 4]]
    blocks = [("quad", mesh.cells[:1, :4]), ("hexahedron", mesh.cells[:4]), ("tetra", tetra[:1])]
    blocks += [("hexahedron", mesh.cells[7:9]), ("tetra", tetra[1:])]
    meshio.write(path, meshio.Mesh(mesh.positions, blocks))
    with pytest.raises(MeshError, match="6 of type hexahedron, 3 of type tetra") as refused:
        read_hex_mesh(path, scale=2.0)
    assert f"{2 * mesh.positions[tetra[0]].mean(axis=0)} m" in str(refused.value)


@pytest.mark.parametrize("suffix", ["msh", "inp", "vtu", "vtk"])
def test_hexahedra_survive_every_format(tmp_path, suffix):
    mesh = distorted_mesh()
    stray = np.vstack([[9.0, 9.0, 9.0], 1e3 * mesh.positions])  # mm, and a node without a cell
    blocks = [("hexahedron", mesh.cells + 1)]
    if suffix != "inp":
        blocks.insert(0, ("quad", mesh.cells[:2, :4] + 1))
    path = tmp_path / f"mesh.{suffix}"
    options = {"file_format": "gmsh22", "binary": False} if suffix == "msh" else {}
    meshio.write(path, meshio.Mesh(stray, blocks), **options)
    read = read_hex_mesh(path, scale=1e-3)
    np.testing.assert_allclose(read.positions, mesh.positions, atol=1e-12)
    np.testing.assert_array_equal(read.cells, mesh.cells)


def test_a_scene_with_a_mesh_file_runs(tmp_path):
    problem = pc.discretise(beam((3, 2, 1)))
    write_vtu(tmp_path / "beam.vtu", problem.positions, problem.cells)
    text = beam((3, 2, 1)).to_toml()
    start, end = text.index("[body]"), text.index("[material]")
    body = '[body]\nshape = "file"\npath = "beam.vtu"\n\n'
    (tmp_path / "scene.toml").write_text(text[:start] + body + text[end:])
    scene = pc.Scene.load(tmp_path / "scene.toml")
    from_file = pc.discretise(scene, refine=2)
    direct = pc.discretise(beam((3, 2, 1)), refine=2)
    a, b = (pc.rollout(pc.ProjectiveDynamics(p, 1e-8), 3) for p in (from_file, direct))
    np.testing.assert_allclose(
        pc.restrict(a, to=problem).positions, pc.restrict(b, to=problem).positions, atol=1e-9
    )


def test_unusable_files_are_refused_by_name(tmp_path):
    mesh = distorted_mesh()
    tetra = tmp_path / "tetra.vtu"
    meshio.write(tetra, meshio.Mesh(mesh.positions, [("tetra", mesh.cells[:, :4])]))
    mixed = tmp_path / "mixed.vtu"
    blocks = [("tetra", mesh.cells[:1, :4]), ("hexahedron", mesh.cells)]
    meshio.write(mixed, meshio.Mesh(mesh.positions, blocks))
    (tmp_path / "text.vtu").write_text("not a mesh")
    (tmp_path / "what.xyz9").write_text("?")
    write_vtu(tmp_path / "inverted.vtu", mesh.positions * [1, 1, -1], mesh.cells)
    good = o_grid()
    apart = HexMesh.create(good.positions[good.cells[:1]].reshape(8, 3), np.arange(8)[None])
    cells = np.concatenate([good.cells[1:], apart.cells + len(good.positions)])
    points = np.concatenate([good.positions, apart.positions])
    write_vtu(tmp_path / "twice.vtu", points, cells)  # nodes at one place
    for name, told in {
        "tetra.vtu": "tetra",
        "mixed.vtu": "tetra",
        "text.vtu": "",
        "what.xyz9": "",
        "none.vtu": "",
        "inverted.vtu": "",
        "twice.vtu": r"nodes \d+",
    }.items():
        with pytest.raises(MeshError, match=rf"{name}.*{told}"):
            read_hex_mesh(tmp_path / name)

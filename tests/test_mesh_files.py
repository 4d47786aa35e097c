"""Mesh files: what other programs write is read, what cannot be used is refused by name."""

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import MeshError
from pdcorrect.fem.mesh_files import read_hex_mesh, write_vtu
from test_mesh import distorted_mesh


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
    for name, words in {
        "tetra.vtu": "tetra",
        "mixed.vtu": "tetra",
        "text.vtu": "text.vtu",
        "what.xyz9": "what.xyz9",
        "none.vtu": "none.vtu",
        "inverted.vtu": "inverted or flat",
    }.items():
        with pytest.raises(MeshError, match=words):
            read_hex_mesh(tmp_path / name)


def test_damaged_files_never_escape_as_other_errors(tmp_path, rng):
    mesh = distorted_mesh()
    path = tmp_path / "mesh.vtu"
    write_vtu(path, mesh.positions, mesh.cells)
    data = path.read_bytes()
    for _ in range(60):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), size=3):
            broken[place] = rng.integers(0, 256)
        path.write_bytes(
            bytes(broken[: rng.integers(1, len(data))] if rng.random() < 0.5 else broken)
        )
        try:
            read_hex_mesh(path)
        except MeshError as error:
            assert str(error)

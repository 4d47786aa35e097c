"""Random scene files, mesh files and calls of the program: done, or refused by name.

Slow tests take 8300 inputs here and 5500 in test_fuzz_learning.py (data sets, settings, models),
together 13 800; the others take 565 and 415.  Each input has bounds of time and memory, and all
are the same ones at every run, see `fuzzing`.
"""

import datetime
import os
import re
import tomllib
from pathlib import Path

import meshio
import numpy as np
import pytest
import tomli_w
from hypothesis import strategies as st

import pdcorrect as pc
from conftest import beam, box_mesh
from fuzzing import (
    altered,
    counts,
    damaged,
    for_all,
    places,
    renumbered,
    within_memory,
    within_seconds,
)
from pdcorrect.cli.common import BAD_INPUT, FAILED
from pdcorrect.errors import MeshError, PdcorrectError, SceneError
from pdcorrect.fem.hexahedron import corner_jacobians
from pdcorrect.fem.mesh_files import read_hex_mesh
from test_mesh_files import ABAQUS, FORMATS

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.toml"))

MOST_CELLS = 2000
"""Of bodies that are discretised."""

KEY = re.compile(r"\b(body|materials?|time|damping|clamps|loads|solver|name)\b")


def assert_named(error, *paths):
    """One paragraph that says which file, or which key of a scene, is to blame."""
    message = str(error)
    assert any(str(path) in message for path in paths) or KEY.search(message), message
    for path in paths:
        message = message.replace(str(path), "")
    assert "\n" not in message


# --- scenes ------------------------------------------------------------------------------

SNIPPETS = (
    b'"', b"'", b"[", b"]", b"{", b"}", b"=", b".", b"#", b"\n", b"\r", b"nan", b"-inf", b"1e999",
    b"[[", b"[" * 3000, b"x = " + b"{a=" * 3000, b"9" * 5000, b"0x" + b"f" * 5000, b"\xff",
    "\u202e\U0001f600".encode(), b"a.b.c", b'"""', b"1979-05-27T07:32:00Z", b"__class__ = 1\n",
)  # fmt: skip

EXTREMES = (
    0.0, -0.0, 5e-324, 1e-300, 1e-30, 1e-9, 1e9, 1e30, -1e30, 1.7e308, float("nan"), float("inf"),
    0, 1, 2, 3, -1, 50, 1000, 10**6, 10**9, 2**31, 2**63, -(2**63), 10**30,
)  # fmt: skip

number = st.sampled_from(EXTREMES) | st.floats(-10, 10) | st.integers(-3, 30)

TEXTS = (
    "x", "z", "min", "max", "file", "weight", "hex27", "consistent", "a\0b", "\n", "/", "..",
    "." * 999,
)  # fmt: skip

OTHERS = (
    [], {}, [[[]]], [0, 0], [1.0, 2.0, 3.0], {"everywhere": True}, {"plane": "x", "at": "max"},
    {"nodes": [0, 1, 2]}, 10**4000, datetime.date(1979, 5, 27), datetime.time(7, 32),
)  # fmt: skip

value = (
    number
    | st.booleans()
    | st.text(max_size=8)
    | st.sampled_from(TEXTS + OTHERS)
    | st.lists(number, max_size=4)
)


def check_scene(path, content, *others):
    path.write_bytes(content)
    try:
        scene = pc.Scene.load(path)
        if cells(scene) <= MOST_CELLS:
            pc.discretise(scene)
    except PdcorrectError as error:
        assert_named(error, path, *others)


def cells(scene):
    """Number of cells of a scene's body; few if it comes from a file."""
    return 0 if scene.body.shape == "file" else np.count_nonzero(scene.body.occupancy()[0])


@counts(100, 2000)
def test_damaged_scene_files_are_read_or_refused_by_name(tmp_path, count):
    texts = st.sampled_from([path.read_bytes() for path in EXAMPLES])
    inputs = texts.flatmap(lambda text: damaged(text, SNIPPETS) | renumbered(text))
    for_all(inputs, lambda content: check_scene(tmp_path / "scene.toml", content), count)


@counts(100, 2000)
def test_altered_scenes_are_discretised_or_refused_by_name(tmp_path, count):
    trees = st.sampled_from([tomllib.loads(path.read_text()) for path in EXAMPLES])
    inputs = trees.flatmap(lambda tree: altered(tree, value)).map(as_toml)
    for_all(inputs, lambda content: check_scene(tmp_path / "scene.toml", content), count)


def as_toml(tree):
    return tomli_w.dumps(tree).encode("utf-8", errors="replace")


SMALL = beam(
    (3, 1, 1),
    materials=[{"region": {"sphere": [0.05, 0.0, 0.0], "radius": 0.03}, "young": 2e6}],
    damping={"mass": 0.1, "stiffness": 1e-3},
    time={"integrator": "generalised-alpha"},
    clamps=[
        {"region": {"plane": "x", "at": "min"}},
        {
            "region": {"plane": "x", "at": "max"},
            "components": ["y"],
            "motion": {"times": [0.0, 1.0], "displacement": [[0, 0, 0], [0, 0.1, 0]]},
        },
    ],
    loads=[
        {"kind": "gravity", "acceleration": [0.1, 0.2, -9.81], "ramp": 0.1},
        {"kind": "torsion", "strength": 1e3, "stretch": 0.1, "follower": True},
        {"kind": "pressure", "pressure": 50.0, "region": {"plane": "z", "at": 0.0}},
        {"kind": "force", "force": [1.0, 0, 0], "region": {"plane": "x", "at": "max"}},
    ],
)

CHOICES = {
    "element": ["hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex27"],
    "mass": ["lumped", "averaged", "consistent", "per-node"],
    "energy": [
        "corotated", "corotated-only", "volume-only", "neo-hookean", "st-venant-kirchhoff",
        "linear-corotated",
    ],
    "integrator": ["backward-euler", "bdf2", "midpoint", "generalised-alpha", "quasi-static"],
}  # fmt: skip


@st.composite
def extreme(draw):
    """A valid small scene with other choices, and one or two numbers of any magnitude."""
    tree = tomllib.loads(SMALL.to_toml())
    for _ in range(draw(st.integers(1, 2))):
        parent, key = draw(st.sampled_from(list(numbers(tree))))
        sizes = [0.0, 1e-300, 1e-30, 1e-9, 1e-3, 0.4, 0.499999999, 1.0, 1e3, 1e9, 1e20, 1e30]
        size = draw(st.sampled_from(sizes))
        parent[key] = int(min(size, 8)) if isinstance(parent[key], int) else size
        if draw(st.booleans()):
            parent[key] = -parent[key]
    for section, key in (
        ("solver", "element"), ("solver", "mass"), ("material", "energy"), ("time", "integrator"),
    ):  # fmt: skip
        if draw(st.booleans()):
            tree[section][key] = draw(st.sampled_from(CHOICES[key]))
    return as_toml(tree), draw(st.sampled_from([pc.ProjectiveDynamics, pc.Newton]))


def numbers(tree):
    for parent, key in places(tree):
        if isinstance(parent[key], (int, float)) and not isinstance(parent[key], bool):
            yield parent, key


def check_step(path, content, method):
    path.write_bytes(content)
    try:
        problem = pc.discretise(pc.Scene.load(path))
    except PdcorrectError as error:
        assert_named(error, path)
        return
    try:
        run = pc.rollout(method(problem), 2)
    except PdcorrectError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(run.positions).all()


@counts(15, 200)
def test_numbers_of_any_magnitude_end_in_a_step_or_in_a_refusal(tmp_path, count):
    for_all(extreme(), lambda one: check_step(tmp_path / "scene.toml", *one), count)


# --- meshes ------------------------------------------------------------------------------


def check_mesh(path, content):
    path.write_bytes(content)
    try:
        mesh = read_hex_mesh(path)
    except MeshError as error:
        assert str(path) in str(error)
    else:
        assert np.isfinite(mesh.positions).all()
        assert corner_jacobians(mesh.positions, mesh.cells).min() > 0


@pytest.fixture(scope="module")
def mesh_files(tmp_path_factory):
    """Contents of sound mesh files by suffix."""
    folder, mesh = tmp_path_factory.mktemp("meshes"), box_mesh((3, 2, 1), (0.3, 0.2, 0.1))
    found = [(".inp", ABAQUS.encode())]
    for number, (suffix, options) in enumerate(FORMATS.values()):
        path = folder / f"{number}{suffix}"
        meshio.write(path, meshio.Mesh(mesh.positions, [("hexahedron", mesh.cells)]), **options)
        found.append((suffix, path.read_bytes()))
    return found


@counts(150, 2000)
def test_damaged_mesh_files_are_read_or_refused_by_name(tmp_path, mesh_files, count):
    def changed(file):
        suffix, data = file
        texts = damaged(data, (b"<", b"\n", b" ", b"$End", b"*", b"-1", b"999")) | renumbered(data)
        return st.tuples(st.just(suffix), texts)

    inputs = st.sampled_from(mesh_files).flatmap(changed)
    for_all(inputs, lambda one: check_mesh(tmp_path / f"mesh{one[0]}", one[1]), count)


COORDINATES = (0.0, -0.05, 0.1, 0.3, 1e-30, 1e9, 1e200, 1.7e308, np.nan, np.inf, -np.inf)


@st.composite
def wrong_arrays(draw):
    """Points and blocks of cells of a box, one to three numbers or cells of which are wrong."""
    mesh = box_mesh((2, 2, 1), (0.2, 0.2, 0.1))
    points, cells = mesh.positions.copy(), mesh.cells.copy()
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["point", "same", "node", "swap", "mirror", "copy"]))
        node, cell = draw(st.integers(0, len(points) - 1)), draw(st.integers(0, len(cells) - 1))
        corner, other = draw(st.integers(0, 7)), draw(st.integers(0, 7))
        if kind == "point":
            points[node, corner % 3] = draw(st.sampled_from(COORDINATES))
        elif kind == "same":
            points[node] = points[cells[cell, corner]]
        elif kind == "node":
            cells[cell, corner] = draw(st.sampled_from([-1, 0, 1, 17, 18, 999, 2**31 - 1]))
        elif kind == "swap":
            cells[cell, [corner, other]] = cells[cell, [other, corner]]
        elif kind == "mirror":
            cells[cell] = np.roll(cells[cell], 4)
        else:
            cells = np.concatenate([cells, cells[[cell]]])
    count = draw(st.integers(0, len(cells)))
    kind, width = draw(st.sampled_from([("hexahedron", 8)] * 3 + [("tetra", 4), ("quad", 4)]))
    blocks = [("hexahedron", cells[:count]), (kind, cells[count:, :width])]
    return points * draw(st.sampled_from([1.0, 1.0, -1.0, 1e-9])), blocks


@counts(150, 1500)
def test_wrong_meshes_are_read_or_refused_by_name(tmp_path, count):
    def check(one):
        (points, blocks), (suffix, options) = one
        path = tmp_path / f"mesh{suffix}"
        try:
            meshio.write(path, meshio.Mesh(points, blocks), **options)
        except Exception:  # what meshio does not write, nobody reads
            return
        check_mesh(path, path.read_bytes())

    for_all(st.tuples(wrong_arrays(), st.sampled_from(list(FORMATS.values()))), check, count)


@counts(25, 300)
def test_paths_of_meshes_in_scenes_are_read_or_refused_by_name(tmp_path, mesh_files, count):
    (tmp_path / "mesh.msh").write_bytes(mesh_files[1][1])
    names = st.sampled_from(["mesh.msh", ".", "", "..", "/", "a\0.msh", "~", "x" * 5000, "no.vtu"])
    scene = tomllib.loads(beam((3, 1, 1)).to_toml())

    def check(one):
        scene["body"] = {"shape": "file", "path": one[0], "scale": one[1]}
        found = Path(os.path.normpath(tmp_path / one[0].replace("\0", "")))
        check_scene(tmp_path / "scene.toml", as_toml(scene), found)

    for_all(st.tuples(names | st.text(max_size=9), number), check, count)


# --- sizes and the command line ----------------------------------------------------------


@pytest.mark.parametrize(
    ("cells", "refine", "element"),
    [([400, 500, 500], 1, "hex8"), ([4, 1, 1], 1000, "hex8"), ([90, 90, 90], 10, "hex27")],
)
def test_bodies_that_no_memory_holds_are_refused_at_once(cells, refine, element):
    scene = beam(cells, solver={"element": element})
    with within_seconds(60), within_memory(2**30), pytest.raises(SceneError, match="memory"):
        pc.discretise(scene, refine)


@counts(25, 300)
def test_damaged_scenes_leave_no_traceback_and_no_partial_output(program, tmp_path, count):
    path, output = tmp_path / "scene.toml", tmp_path / "run.h5"
    text, tree = SMALL.to_toml().encode(), tomllib.loads(SMALL.to_toml())

    def check(content):
        path.write_bytes(content)
        if is_large(path):
            return
        status, out, err = program("simulate", path, "-o", output, "--frames", 1)
        assert "Traceback" not in out + err
        assert status in (0, FAILED, BAD_INPUT)
        if status:
            assert err.startswith("error: ")
        if status == BAD_INPUT:
            assert not output.exists()
        elif output.exists():
            pc.load_trajectory(output)
        assert not list(tmp_path.glob("*.part"))
        output.unlink(missing_ok=True)

    texts = damaged(text, SNIPPETS) | renumbered(text) | altered(tree, value, most=1).map(as_toml)
    for_all(texts, check, count)


def is_large(path):
    """Whether a body is read that has more cells than a test has time for."""
    try:
        return cells(pc.Scene.load(path)) > 100
    except PdcorrectError:
        return False

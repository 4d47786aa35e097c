"""Scene files: what they mean, round trips, and messages for wrong ones."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pdcorrect as pc
from conftest import beam, cross
from pdcorrect.errors import SceneError

TEXT = """
name = "gravity beam"
[body]
shape = "beam"
cells = [24, 2, 2]
cell_size = 0.02
[material]
energy = "corotated"
volume_weight = "lame"
young = 1.0e6
poisson = 0.45
density = 1.0e3
[time]
step = 0.01
frames = 50
[[clamps]]
region = { plane = "x", at = 0.0 }
[[loads]]
kind = "gravity"
acceleration = [0.0, 0.0, -9.81]
[solver]
mass = "lumped"
element = "hex8"
tolerance = 1.0e-5
"""


def test_the_documented_scene_is_read():
    scene = pc.Scene.from_toml(TEXT)
    assert scene.body.cells == (24, 2, 2)
    assert scene.time.step == 0.01
    assert scene.loads[0].acceleration == (0, 0, -9.81)
    assert scene.clamps[0].components == ("x", "y", "z")
    assert scene.solver.mass == "lumped"


EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.toml"))


@pytest.mark.parametrize(
    "scene", [beam(), cross(), pc.Scene.from_toml(TEXT), *map(pc.Scene.load, EXAMPLES)]
)
def test_scenes_survive_toml(scene):
    again = pc.Scene.from_toml(scene.to_toml())
    assert again.to_toml() == scene.to_toml()
    assert again.model_dump() == scene.model_dump()


def test_effective_moduli_are_the_documented_ones():
    def effective(**material):
        return beam(
            material={"young": 1e6, **material}, poisson=material["poisson"]
        ).material.effective

    exact = effective(poisson=0.45)
    assert (exact.young, exact.poisson) == pytest.approx((1e6, 0.45))
    published = effective(poisson=0.45, volume_weight="published")
    assert published.poisson == pytest.approx(0.375)
    assert published.young == pytest.approx(0.948e6, rel=1e-3)
    alone = effective(poisson=0.45, energy="corotated-only")
    assert (alone.young, alone.poisson) == pytest.approx((2e6 / 2.9, 0.0))
    fluid = effective(poisson=0.45, energy="volume-only")
    assert (fluid.young, fluid.poisson) == pytest.approx((0.0, 0.5))


def changed(old, new):
    assert old in TEXT
    return TEXT.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (changed("poisson = 0.45", "poisson = 0.5"), ["material.poisson = 0.5", "less than 0.5"]),
        (changed("poisson = 0.45", "poisson = -0.1"), ["material.poisson = -0.1", "at least 0"]),
        (changed("density = 1.0e3", "density = -1.0"), ["material.density = -1.0", "more than 0"]),
        (changed("young = 1.0e6", "young = nan"), ["material.young = nan", "finite"]),
        (changed("young = 1.0e6", "young = inf"), ["material.young = inf", "finite"]),
        (changed("young = 1.0e6\n", ""), ["material.young: missing"]),
        (
            changed("young = 1.0e6", 'young = "soft"'),
            ['material.young = "soft": expected a number'],
        ),
        (changed("young = 1.0e6", "youngs = 1.0e6"), ["material.youngs: unknown key"]),
        (changed('"lame"', '"lambda"'), ['material.volume_weight = "lambda"', "'published'"]),
        (changed("cells = [24, 2, 2]", "cells = [24, 0, 2]"), ["body.cells[1] = 0", "at least 1"]),
        (changed("cells = [24, 2, 2]", "cells = [24, 2]"), ["body.cells[2]: missing"]),
        (changed('"beam"', '"bean"'), ['body.shape = "bean"', "'cross'"]),
        (changed("step = 0.01", "step = 0.0"), ["time.step = 0.0", "more than 0"]),
        (changed("frames = 50", "frames = 1.5"), ["time.frames = 1.5", "integer"]),
        (changed("at = 0.0 }", 'at = "middle" }'), ['clamps[0].region.at = "middle"', "'max'"]),
        (changed(", at = 0.0 }", " }"), ["clamps[0].region", "plane and at together"]),
        (changed('plane = "x", at = 0.0', ""), ["clamps[0].region", "exactly one of plane"]),
        (changed('"gravity"', '"gravty"'), ['loads[0].kind = "gravty"', "'body-force'"]),
        (changed("[0.0, 0.0, -9.81]", "[0.0, nan, -9.81]"), ["loads[0].acceleration[1]", "finite"]),
        (changed("[solver]", "[solver]\nspeed = 9"), ["solver.speed: unknown key"]),
        (changed("tolerance = 1.0e-5", "tolerance = 0.0"), ["solver.tolerance = 0.0"]),
        (changed('"hex8"', '"hex9"'), ['solver.element = "hex9"', "'hex8'"]),
        (changed("kind = ", "window = [0.2, 0.1]\nkind = "), ["window", "start < end"]),
        (changed("kind = ", "table = [[0, 1], [0, 2]]\nkind = "), ["table", "increasing"]),
        (changed("kind = ", "ramp = 1.0\ntable = [[0, 1], [1, 2]]\nkind = "), ["not both"]),
        (changed("name = ", "name = ["), ["not valid TOML"]),
        (changed('"gravity beam"', '" "'), ["name", "not empty"]),
        (changed("poisson = 0.45", "poisson = false"), ["material.poisson = false", "number"]),
        (changed("young = 1.0e6", 'young = "1e6"'), ['material.young = "1e6"', "number"]),
        (changed("frames = 50", "frames = true"), ["time.frames = true", "integer"]),
        (changed("step = 0.01", "step = 1e300"), ["time.step", "1e+30"]),
        (changed("name = ", "self = 1\nname = "), ["self: unknown key"]),
        (changed("name = ", "__source__ = 1\nname = "), ["__source__: unknown key"]),
        (changed("kind = ", "window = [-2, -1]\nkind = "), ["ends after time 0"]),
        (
            changed("young = 1.0e6", "yung = 1.0e6"),
            ["material.yung: unknown key; did you mean young?"],
        ),
        (
            changed('plane = "x", at', 'everywhere = true, plane = "x", at'),
            ['{ everywhere = true, plane = "x", at = 0.0 }: ', "got plane, everywhere."],
        ),
        (changed("kind = ", "window = [2, 1]\nkind = "), ["start < end, got [2.0, 1.0]."]),
        (
            changed("name = ", "frames = 3\nname = "),
            ["frames: unknown key; it belongs to [time]."],
        ),
        (changed("[time]", "[time]\nname = 3"), ["it belongs to the top, above all tables."]),
        (
            changed("[time]", "[time]\ntolerence = 1"),
            ["time.tolerence: unknown key; did you mean tolerance, which belongs to [solver]?"],
        ),
        (
            changed("[body]", "[body]\narm_length = 3"),
            ['body.arm_length: unknown key; it goes with shape = "cross".'],
        ),
        (
            changed("kind = ", "strength = 3\nkind = "),
            ['loads[0].strength: unknown key; it goes with kind = "torsion".'],
        ),
        (
            changed("[[clamps]]", "[[clamps]]\nat = 0.0"),
            ["clamps[0].at: unknown key; it belongs to [clamps.region]."],
        ),
        (
            changed("[time]", "[time]\nyoung = 3"),
            ["time.young: unknown key; it belongs to [material] or to [[materials]]."],
        ),
        (changed("[24, 2, 2]", "[24, 2, 2, 2]"), ["expected a list of at most 3, got 4."]),
        (changed("[solver]", "[dampings]\nmass = 1.0\n\n[solver]"), ["did you mean damping?"]),
        (
            changed('"gravity"', '"gravty"'),
            ["loads[0].kind = \"gravty\": expected one of 'gravity',"],
        ),
        (changed('kind = "gravity"\n', ""), ["loads[0].kind: missing"]),
        (changed("24", "9" * 5000), ["not valid TOML", "digits"]),
        (changed("24", "0x" + "f" * 5000), ["not valid TOML", "integer of more than 1024 bits"]),
        (changed("24", "[" * 3000), ["not valid TOML", "nested more than 100 deep"]),
        (changed("[body]", "a." * 3000 + "a = 1\n[body]"), ["nested more than 100 deep"]),
        (
            changed('"beam"\ncells = [24, 2, 2]\ncell_size = 0.02', '"file"\npath = "a\\u0000b"'),
            ["body.path", "NUL"],
        ),
    ],
)
def test_wrong_scenes_are_refused_in_one_paragraph(text, words):
    with pytest.raises(SceneError) as caught:
        pc.Scene.from_toml(text, source="beam.toml")
    message = str(caught.value)
    assert message.startswith("beam.toml: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_keys_of_loads_and_bodies_are_named_as_written():
    with pytest.raises(SceneError, match=r"loads\[0\]\.force\[1\]"):
        beam(loads=[{"kind": "force", "force": [1, "a", 2], "region": {"everywhere": True}}])
    with pytest.raises(SceneError, match=r"body\.arm_length: missing"):
        beam(body={"shape": "cross", "arm_start": 1})
    with pytest.raises(SceneError, match=r"motion.displacement to have the 2 entries"):
        beam(
            clamps=[
                {
                    "region": {"everywhere": True},
                    "motion": {"times": [0, 1], "displacement": [[0, 0, 0]]},
                }
            ]
        )


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(SceneError, match="nowhere.toml: cannot be read"):
        pc.Scene.load(tmp_path / "nowhere.toml")
    with pytest.raises(SceneError, match="is a folder: expected a scene in a TOML file; none is"):
        pc.Scene.load(tmp_path)
    with pytest.raises(SceneError, match=r"cannot be read \(embedded null byte\)"):
        pc.Scene.load(tmp_path / "a\0b")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match="not a UTF-8"):
        pc.Scene.load(tmp_path / "binary.toml")


def test_numpy_numbers_are_numbers():
    plain = beam((3, 2, 1))
    numbers = np.array([3, 2, 1])
    scene = beam((3, 2, 1), body={"cells": numbers}, time={"frames": np.int64(20)})
    assert scene.to_toml() == plain.to_toml()


def test_absurd_grids_are_refused_by_name():
    for cells in ([10**20, 1, 1], [10**6, 10**6, 1]):
        with pytest.raises(SceneError, match="cells"):
            pc.discretise(beam(cells))


@pytest.mark.parametrize("change", [{"origin": [1e20, 0.0, 0.0]}, {"cell_size": 1e-150}])
def test_cells_that_rounding_leaves_no_volume_are_refused_by_the_keys(change):
    with pytest.raises(SceneError, match=r"body.cell_size = .* with body.origin = .*no volume"):
        pc.discretise(beam().with_changes(body=change))


def test_changes_keep_the_rest():
    scene = beam()
    other = scene.with_changes(material={"poisson": 0.1}, loads=[])
    assert other.material.young == scene.material.young
    assert other.material.poisson == 0.1
    assert other.loads == ()
    with pytest.raises(SceneError, match=r"material\.poisson = 0\.6"):
        scene.with_changes(material={"poisson": 0.6})


def test_a_scene_is_immutable():
    with pytest.raises(ValueError, match="frozen"):
        beam().material.young = 1.0


leaf = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
tree = st.recursive(
    leaf,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(["body", "material", "time", "clamps", "loads", "solver", "x"]), tree)
def test_any_value_anywhere_gives_a_scene_or_a_scene_error(section, value):
    data = tomllib.loads(TEXT)
    data[section] = value
    try:
        scene = pc.Scene(**data)
    except SceneError as error:
        assert "\n" not in str(error)
    else:
        assert math.isfinite(scene.material.young)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_any_leaf_anywhere_gives_a_scene_or_a_scene_error(data):
    scene = tomllib.loads(TEXT)
    node = scene
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = data.draw(st.sampled_from(keys))
        if isinstance(node[key], (dict, list)) and node[key] and data.draw(st.booleans()):
            node = node[key]
            continue
        node[key] = data.draw(tree)
        break
    try:
        pc.Scene(**scene)
    except SceneError as error:
        assert len(str(error)) < 4000


@settings(max_examples=150, deadline=None)
@given(st.text(max_size=200) | st.builds(lambda i, c: TEXT[:i] + c + TEXT[i + 1 :],
       st.integers(0, len(TEXT) - 1), st.characters()))  # fmt: skip
def test_any_text_gives_a_scene_or_a_scene_error(text):
    try:
        pc.Scene.from_toml(text)
    except SceneError as error:
        assert str(error)


def test_best_coarse_changes_element_and_mass_only():
    scene = cross(solver={"tolerance": 1e-3})
    best = pc.best_coarse(scene)
    assert (best.solver.element, best.solver.mass) == ("hex8-bubble-mean", "averaged")
    assert best.with_changes(solver=scene.solver.model_dump()) == scene
    assert pc.best_coarse(best) == best
    assert (scene.solver.element, scene.solver.mass) == ("hex8", "lumped")


@pytest.mark.parametrize(
    ("cells", "element"), [([6, 2, 2], "hex8-bubble-mean"), ([6, 2, 1], "hex8-bubble")]
)
def test_best_coarse_looks_at_the_thickness(cells, element):
    assert pc.best_coarse(beam(cells)).solver.element == element

"""Scene files: what they mean, round trips, and messages for wrong ones."""

import re
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, cross
from pdcorrect.errors import SceneError
from pdcorrect.scene import trained_coarse

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
    assert (scene.time.integrator, scene.time.spectral_radius) == ("generalised-alpha", 0.8)
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


MOVING = """
[[clamps]]
region = { everywhere = true }
motion = { times = [0, 1], displacement = [[0, 0, 0]] }
"""


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (changed("poisson = 0.45", "poisson = 0.5"), "material.poisson = 0.5"),
        (changed("poisson = 0.45", "poisson = -0.1"), "material.poisson = -0.1"),
        (changed("poisson = 0.45", "poisson = false"), "material.poisson = false"),
        (changed("density = 1.0e3", "density = -1.0"), "material.density = -1.0"),
        (changed("young = 1.0e6", "young = nan"), "material.young = nan"),
        (changed("young = 1.0e6", "young = inf"), "material.young = inf"),
        (changed("young = 1.0e6", 'young = "1e6"'), 'material.young = "1e6"'),
        (changed("young = 1.0e6\n", ""), "material.young: missing"),
        (changed("young = 1.0e6", "youngs = 1.0e6"), "material.youngs: unknown key"),
        (changed('"lame"', '"lambda"'), 'material.volume_weight = "lambda"'),
        (changed("cells = [24, 2, 2]", "cells = [24, 0, 2]"), "body.cells[1] = 0"),
        (changed("cells = [24, 2, 2]", "cells = [24, 2]"), "body.cells[2]: missing"),
        (changed("[24, 2, 2]", "[24, 2, 2, 2]"), "body.cells = [24, 2, 2, 2]"),
        (changed('"beam"', '"bean"'), 'body.shape = "bean"'),
        (changed('"beam"', '"cross"\narm_start = 1'), "body.arm_length: missing"),
        (changed("[body]", "[body]\narm_length = 3"), "body.arm_length: unknown key"),
        (changed("step = 0.01", "step = 0.0"), "time.step = 0.0"),
        (changed("step = 0.01", "step = 1e300"), "time.step = 1e+300"),
        (changed("frames = 50", "frames = 1.5"), "time.frames = 1.5"),
        (changed("frames = 50", "frames = true"), "time.frames = true"),
        (changed("[time]", "[time]\nyoung = 3"), "time.young: unknown key"),
        (changed("at = 0.0 }", 'at = "middle" }'), 'clamps[0].region.at = "middle"'),
        (changed(", at = 0.0 }", " }"), 'clamps[0].region = { plane = "x" }'),
        (changed('plane = "x", at = 0.0', ""), "clamps[0].region = { }"),
        (
            changed('plane = "x", at', 'everywhere = true, plane = "x", at'),
            'clamps[0].region = { everywhere = true, plane = "x", at = 0.0 }',
        ),
        (
            changed('plane = "x", at = 0.0', "box = [[0, 0, 1], [1, 1, 0]]"),
            "clamps[0].region.box = [[0, 0, 1], [1, 1, 0]]",
        ),
        (changed("[[clamps]]", "[[clamps]]\nat = 0.0"), "clamps[0].at: unknown key"),
        (f"{TEXT}{MOVING}", "clamps[1].motion = { times = [0, 1], displacement = [[0, 0, 0]] }"),
        (changed('"gravity"', '"gravty"'), 'loads[0].kind = "gravty"'),
        (changed('kind = "gravity"\n', ""), "loads[0].kind: missing"),
        (changed("[0.0, 0.0, -9.81]", "[0.0, nan, -9.81]"), "loads[0].acceleration[1] = nan"),
        (changed("kind = ", "strength = 3\nkind = "), "loads[0].strength: unknown key"),
        (changed("kind = ", "window = [0.2, 0.1]\nkind = "), "loads[0] = { window = [0.2, 0.1]"),
        (changed("kind = ", "window = [-2, -1]\nkind = "), "loads[0] = { window = [-2, -1]"),
        (changed("kind = ", "table = [[0, 1], [0, 2]]\nkind = "), "table = [[0, 1], [0, 2]]"),
        (
            changed("kind = ", "ramp = 1.0\ntable = [[0, 1], [1, 2]]\nkind = "),
            "loads[0] = { ramp = 1.0, table = [[0, 1], [1, 2]]",
        ),
        (changed("[solver]", "[solver]\nspeed = 9"), "solver.speed: unknown key"),
        (changed("tolerance = 1.0e-5", "tolerance = 0.0"), "solver.tolerance = 0.0"),
        (changed('"hex8"', '"hex9"'), 'solver.element = "hex9"'),
        (changed('"gravity beam"', '" "'), 'name = " "'),
        (changed("name = ", "self = 1\nname = "), "self: unknown key"),
        (changed("name = ", "__source__ = 1\nname = "), "__source__: unknown key"),
        (changed("name = ", "name = ["), "not valid TOML"),
        (changed("24", "9" * 5000), "not valid TOML"),
        (changed("24", "0x" + "f" * 5000), "not valid TOML"),
        (changed("24", "[" * 3000), "not valid TOML"),
        (changed("[body]", "a." * 3000 + "a = 1\n[body]"), "not valid TOML"),
        (
            changed('"beam"\ncells = [24, 2, 2]\ncell_size = 0.02', '"file"\npath = "a\\u0000b"'),
            'body.path = "a\\u0000b"',
        ),
    ],
)
def test_wrong_scenes_are_refused_by_key_and_value_in_one_paragraph(text, told):
    with pytest.raises(SceneError, match=f"^beam.toml: .*{re.escape(told)}") as caught:
        pc.Scene.from_toml(text, source="beam.toml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        (changed("young = 1.0e6", "yung = 1.0e6"), "young"),
        (changed("[time]", "[time]\ntolerence = 1"), "tolerance"),
        (changed("[solver]", "[dampings]\nmass = 1.0\n\n[solver]"), "damping"),
        (changed("name = ", "frames = 3\nname = "), "[time]"),
    ],
)
def test_of_an_unknown_key_it_is_said_which_may_be_meant(wrong, meant):
    with pytest.raises(SceneError, match=rf"unknown key.*{re.escape(meant)}"):
        pc.Scene.from_toml(wrong)


def test_unreadable_files_are_named(tmp_path):
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "nowhere.toml", tmp_path, tmp_path / "a\0b", tmp_path / "binary.toml"):
        with pytest.raises(SceneError, match=f"^{re.escape(str(path))}: cannot be read"):
            pc.Scene.load(path)


def test_numpy_numbers_are_numbers():
    plain = beam((3, 2, 1))
    numbers = np.array([3, 2, 1])
    scene = beam((3, 2, 1), body={"cells": numbers}, time={"frames": np.int64(20)})
    assert scene.to_toml() == plain.to_toml()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"cells": [10**20, 1, 1]}, "body.cells"),
        ({"cells": [10**6, 10**6, 1]}, "body: .*1000000 x 1000000 x 1"),
        ({"origin": [1e20, 0.0, 0.0]}, "body.origin"),
        ({"cell_size": 1e-150}, "body.cell_size = 1e-150"),
    ],
)
def test_bodies_that_memory_or_rounding_cannot_hold_are_refused_by_the_key(change, key):
    with pytest.raises(SceneError, match=key):
        pc.discretise(beam().with_changes(body=change))


def test_scenes_are_immutable_and_changes_keep_the_rest():
    scene = beam()
    other = scene.with_changes(material={"poisson": 0.1}, loads=[])
    assert other.material.young == scene.material.young
    assert other.material.poisson == 0.1
    assert other.loads == ()
    with pytest.raises(SceneError, match=r"material\.poisson = 0\.6"):
        scene.with_changes(material={"poisson": 0.6})
    with pytest.raises(ValueError, match="frozen"):
        scene.material.young = 1.0


def test_best_coarse_changes_element_and_mass_only():
    scene = cross(solver={"tolerance": 1e-3})
    best = pc.best_coarse(scene)
    assert (best.solver.element, best.solver.mass) == ("hex8-enhanced", "averaged")
    assert best.with_changes(solver=scene.solver.model_dump()) == scene
    assert pc.best_coarse(best) == best
    assert (scene.solver.element, scene.solver.mass) == ("hex8", "lumped")


def test_what_correctors_were_trained_on_keeps_its_elements():
    for cells, element in (([6, 2, 2], "hex8-bubble-mean"), ([6, 2, 1], "hex8-bubble")):
        solver = trained_coarse(beam(cells)).solver
        assert (solver.element, solver.mass) == (element, "averaged")
        assert pc.coarse_model(beam(cells), "best").element == element


@pytest.mark.parametrize(
    "path", ["C:\\Users\\me\\hook.msh", "C:\\temp\\new.msh", "..\\data\\a.msh"]
)
def test_paths_of_windows_in_double_quotes_are_explained(tmp_path, path):
    text = TEXT[: TEXT.index("[body]")] + f'[body]\nshape = "file"\npath = "{path}"\n'
    text += TEXT[TEXT.index("[material]") :]
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(SceneError, match="scene.toml: .*with / or between single quotes"):
        pc.Scene.load(tmp_path / "scene.toml")
    (tmp_path / "scene.toml").write_text(text.replace(f'"{path}"', f"'{path}'"))
    assert pc.Scene.load(tmp_path / "scene.toml").body.path.name == Path(path).name


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16", "latin-1"])
def test_scenes_in_other_codings(tmp_path, coding):
    path = tmp_path / "scene.toml"
    path.write_text("# Körper\n" + TEXT, encoding=coding)
    if coding == "utf-8-sig":
        assert pc.Scene.load(path) == pc.Scene.from_toml(TEXT)
        return
    with pytest.raises(SceneError, match="UTF-16" if coding == "utf-16" else "UTF-8"):
        pc.Scene.load(path)


def test_one_table_where_a_list_belongs_is_told_of_its_brackets():
    text = beam().to_toml()
    assert "[[loads]]" in text
    with pytest.raises(SceneError, match=r"\[\[loads\]\]"):
        pc.Scene.from_toml(text.replace("[[loads]]", "[loads]"))
    with pytest.raises(SceneError, match="origin = 5") as told:
        beam(body={"origin": 5})
    assert "[[" not in str(told.value)

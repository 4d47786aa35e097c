"""The learned element tuned to one body."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import pdcorrect as pc
from conftest import beam, problem_on
from pdcorrect.cli.program import app
from pdcorrect.elements.bodies import holds, nodes_of
from pdcorrect.elements.tuning import own_body, part, tune
from pdcorrect.errors import FileFormatError, InputError, OutputError
from pdcorrect.fem.mesh import HexMesh, voxel_mesh


def scene(**changes):
    return beam((5, 1, 2), solver={"element": "hex8-enhanced", "mass": "averaged"}, **changes)


@pytest.mark.slow  # a minute; freer bodies are learned below, and their weights read
def test_a_body_is_learned_and_the_scene_reads_its_weights(tmp_path):
    """Its two lowest frequencies come nearer to those of 4 x 4 x 4 cells."""
    ends = [{"region": {"plane": "x", "at": end}} for end in ("min", "max")]
    own = beam((8, 2, 2), clamps=ends, solver={"element": "hex8-enhanced", "mass": "averaged"})
    path = tmp_path / "own.safetensors"
    found = tune(pc.discretise(own), path, iterations=120, report=lambda _: None)
    assert found.after["frequencies"] < 0.7 * found.before["frequencies"]
    assert json.loads(path.with_suffix(".json").read_text())["from"] == "released"
    right = pc.modes(pc.discretise(pc.best_coarse(own), 4), 2).frequencies
    tuned = own.with_changes(solver={"element": "hex8-learned", "weights": path})
    errors = [
        np.abs(pc.modes(pc.discretise(s), 2).frequencies / right - 1.0).mean()
        for s in (pc.learned_coarse(own), tuned)
    ]
    assert errors[1] < 0.5 * errors[0], errors
    runs = [
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(s)), 1)
        for s in (pc.learned_coarse(own), tuned)
    ]
    assert runs[0].attributes["element_weights"] != runs[1].attributes["element_weights"]


def test_the_command_and_a_path_beside_the_scene(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(scene().to_toml())
    result = CliRunner().invoke(
        app, ["tune-element", str(file), "-o", str(tmp_path / "w.safetensors"), "--iterations", "2"]
    )
    assert result.exit_code == 0, result.output
    assert 'weights = "w.safetensors"' in result.output  # from the scene's folder
    again = CliRunner().invoke(
        app, ["tune-element", str(file), "-o", str(tmp_path / "w.safetensors")]
    )
    assert isinstance(again.exception, OutputError)
    file.write_text(
        scene().to_toml().split("[solver]")[0]
        + '\n[solver]\nelement = "hex8-learned"\nweights = "w.safetensors"\n'
    )
    loaded = pc.Scene.load(file)
    assert loaded.solver.weights == tmp_path / "w.safetensors"
    assert pc.discretise(loaded).correction.learned.all()
    more = ["-o", str(tmp_path / "more.safetensors"), "--iterations", "2"]
    assert CliRunner().invoke(app, ["tune-element", str(file), *more]).exit_code == 0
    card = json.loads((tmp_path / "more.json").read_text())
    assert card["from"] == str(loaded.solver.weights)
    with pytest.raises(FileFormatError, match="gone"):
        pc.discretise(loaded.with_changes(solver={"weights": tmp_path / "gone"}))


def test_the_body_is_the_problem_s():
    problem = pc.discretise(
        scene(materials=[{"region": {"box": [[0.0, 0.0, 0.0], [0.05, 1.0, 1.0]]}, "young": 5e6,
                          "poisson": scene().material.poisson, "density": 2e3}])
    )  # fmt: skip
    body = own_body(problem)
    assert body.solid.shape == (5, 1, 2)
    assert body.held[0].all()
    assert not body.held[1:].any()
    materials = problem.materials
    assert np.unique(body.young) == pytest.approx(np.unique(materials.young) / materials.young[0])
    assert np.unique(body.density) == pytest.approx(
        np.unique(materials.density / materials.density[0])
    )


def test_a_body_may_be_free_and_so_are_its_parts(tmp_path):
    free = pc.discretise(beam((8, 4, 4), clamps=[], loads=[]))
    assert not part(own_body(free), np.random.default_rng(0)).held.any()
    small = pc.discretise(scene(clamps=[], loads=[]))
    found = tune(small, tmp_path / "own.safetensors", iterations=30, report=lambda _: None)
    assert found.after["frequencies"] < found.before["frequencies"]


def test_bodies_in_several_pieces_are_refused():
    solid = np.ones((3, 2, 2), dtype=bool)
    solid[1] = False
    with pytest.raises(InputError, match="pieces"):
        own_body(problem_on(voxel_mesh(solid, (0, 0, 0), 0.1), "hex8-enhanced"))


def test_parts_of_a_large_body_are_held_and_hang_together():
    body = own_body(pc.discretise(beam((12, 6, 4))))
    rng = np.random.default_rng(0)
    for _ in range(20):
        found = part(body, rng)
        assert 20 < found.solid.sum() <= 110
        assert holds(found.held, nodes_of(found.solid))
        assert found.young.shape == found.solid.shape


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clamps": [{"region": {"box": [[0, 0, 0], [0, 0, 1]]}}]}, "no face"),
        ({"clamps": [{"region": {"plane": "x", "at": "min"}, "components": ["x"]}]}, "components"),
        ({"materials": [{"region": {"box": [[0.0, 0.0, 0.0], [0.05, 1.0, 1.0]]}, "young": 1e6,
                         "poisson": 0.1, "density": 1e3}]}, "poisson"),
        ({"material": {"young": 1e5, "poisson": 0.499, "density": 1e3}}, "0.499"),
    ],
)  # fmt: skip
def test_bodies_that_cannot_be_learned_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        own_body(pc.discretise(scene(**changes)))


def test_other_names_of_the_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="safetensors"):
        tune(pc.discretise(scene()), tmp_path / "own.json")
    (tmp_path / "own.safetensors").write_text("precious")
    with pytest.raises(OutputError, match="exists"):
        tune(pc.discretise(scene()), tmp_path / "own.safetensors")
    assert (tmp_path / "own.safetensors").read_text() == "precious"


def test_cells_off_the_grid_are_refused():
    mesh = voxel_mesh(np.ones((3, 2, 2), dtype=bool), (0, 0, 0), 0.1)
    x = mesh.positions.copy()
    x[-1] += 0.03
    with pytest.raises(InputError, match="1 of 12"):
        own_body(problem_on(HexMesh.create(x, mesh.cells), "hex8-enhanced"))

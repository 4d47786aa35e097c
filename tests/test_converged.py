"""The converged motion: what it is, how exact it says that it is, and its cache."""

import dataclasses

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import InputError, SceneError
from pdcorrect.evaluation import converged as module

RAMP = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81], "window": [0.0, 9.0], "ramp": 0.05}]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PDCORRECT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "converged"


@pytest.fixture
def scene():
    return beam((3, 1, 1), loads=RAMP, time={"frames": 3})


@pytest.fixture
def computed(monkeypatch):
    """How often runs were computed, by their refinement and the divisor of the step."""
    real, calls = module._computed, []

    def counted(scene, refine, divisor, on_step):
        calls.append((refine, divisor))
        return real(scene, refine, divisor, on_step)

    monkeypatch.setattr(module, "_computed", counted)
    return calls


def same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("positions", "velocities", "times", "points", "cells")
    )


def test_it_is_the_best_element_on_4x4x4_cells_at_a_quarter_of_the_step(scene):
    run = pc.converged(scene)
    fine = pc.best_coarse(scene).with_changes(
        time={"step": 0.0025, "frames": 12, "integrator": "generalised-alpha"},
        solver={"tolerance": 1e-9},
    )
    coarse = pc.discretise(scene)
    by_hand = pc.rollout(pc.ProjectiveDynamics(pc.discretise(fine, 4)))
    expected = pc.restrict(by_hand, to=coarse)
    assert np.abs(run.positions - expected.positions[::4]).max() < 1e-7
    np.testing.assert_allclose(run.times, 0.01 * np.arange(4), atol=1e-12)
    np.testing.assert_array_equal(run.points, coarse.positions)
    assert pc.metrics.relative_error(by_hand.positions[::4], by_hand.positions[::4]) == 0
    assert (run.stats["status"] == "CONVERGED").all()
    assert pc.Scene.from_toml(run.scene_toml) == scene


def test_runs_of_every_mesh_and_element_are_compared_with_it(scene):
    run = pc.converged(scene, 2)
    errors = [
        pc.metrics.relative_error(pc.rollout(pc.ProjectiveDynamics(problem), 2), run)
        for problem in (
            pc.discretise(scene.with_changes(time={"integrator": "generalised-alpha"}), *choice)
            for choice in ((1,), (2,), (1, "lumped", "hex27"))
        )
    ]
    assert errors[0] > errors[1] > 0
    assert errors[0] > errors[2] > 0


def test_quasi_static_scenes_are_not_refined_in_time(computed):
    scene = beam((3, 1, 1), time={"frames": 2, "integrator": "quasi-static"})
    run = pc.converged(scene, error=True)
    assert run.attributes["integrator"] == "quasi-static"
    np.testing.assert_allclose(run.times, [0.0, 0.01, 0.02])
    assert module.TIME_ERROR not in run.attributes
    assert 0 < float(run.attributes[module.MESH_ERROR]) < 0.1


def test_its_own_error_is_an_upper_estimate_that_shrinks(scene, computed, monkeypatch):
    run = pc.converged(scene, error=True)
    assert computed == [(4, 4), (4, 8), (8, 4)]
    time, mesh = (float(run.attributes[key]) for key in (module.TIME_ERROR, module.MESH_ERROR))
    assert run.attributes[module.MESH_CHECK] == "8x8x8 cells"
    truth = module._computed(scene, 4, 32, None)
    assert pc.metrics.relative_error(run, truth) < time < 0.05
    assert mesh < 0.05
    monkeypatch.setattr(module, "_MOST_CELLS", 1)
    coarser = module._own_error(scene, run, None)
    assert coarser[module.MESH_CHECK] == "2x2x2 cells"
    assert float(coarser[module.MESH_ERROR]) > mesh / 2
    monkeypatch.setattr(module, "DIVISOR", 8)
    half = module._own_error(scene, module._computed(scene, 4, 8, None), None)
    assert float(half[module.TIME_ERROR]) < 0.6 * time


def test_the_cache_is_hit_by_the_same_scene_only(scene, computed, cache, tmp_path):
    first = pc.converged(scene)
    assert same(pc.converged(scene.with_changes(name="other")), first)
    assert computed == [(4, 4)]
    assert len(list(cache.iterdir())) == 1
    for section, key, value in (
        ("material", "young", 2e6),
        ("time", "frames", 2),
        ("solver", "tolerance", 2e-5),
    ):
        pc.converged(scene.with_changes(**{section: {key: value}}))
    assert len(computed) == 4
    assert len(pc.converged(scene, 2)) == 2
    assert len(computed) == 4


def test_an_error_is_added_to_a_kept_run_and_kept(scene, computed):
    first = pc.converged(scene)
    assert module.MESH_ERROR not in first.attributes
    again = pc.converged(scene, error=True)
    assert same(again, first)
    assert computed == [(4, 4), (4, 8), (8, 4)]
    assert pc.converged(scene, error=True).attributes == again.attributes
    assert pc.converged(scene).attributes == again.attributes
    assert len(computed) == 3


def test_what_a_mesh_file_holds_counts_and_not_its_name(tmp_path, computed):
    import meshio

    problem = pc.discretise(beam((2, 1, 1)))

    def written(name, scale=1.0):
        cells = [("hexahedron", problem.cells)]
        meshio.write(tmp_path / name, meshio.Mesh(scale * problem.positions, cells))
        body = {"shape": "file", "path": str(tmp_path / name)}
        return beam(time={"frames": 1}).model_dump(by_alias=True, exclude_none=True) | {
            "body": body
        }

    first = pc.converged(pc.Scene(**written("one.vtu")))
    assert same(pc.converged(pc.Scene(**written("two.vtu"))), first)
    assert len(computed) == 1
    other = pc.converged(pc.Scene(**written("one.vtu", 1.5)))
    assert len(computed) == 2
    np.testing.assert_allclose(other.points, 1.5 * first.points)


def test_what_an_included_file_holds_counts(tmp_path):
    mesh = pc.discretise(beam((2, 1, 1)))
    lines = [f"{k}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(mesh.positions, 1)]
    cells = [f"{k}, " + ", ".join(map(str, cell + 1)) for k, cell in enumerate(mesh.cells, 1)]
    (tmp_path / "nodes.txt").write_text("\n".join(lines))
    text = "*NODE, INPUT=nodes.txt\n*ELEMENT, TYPE=C3D8\n" + "\n".join(cells)
    (tmp_path / "a.inp").write_text(text)
    scene = pc.Scene(
        **beam().model_dump(by_alias=True, exclude_none=True)
        | {"body": {"shape": "file", "path": str(tmp_path / "a.inp")}}
    )
    first = module._key(scene)
    assert module._key(scene) == first
    (tmp_path / "a.inp").write_text(text + "\n*NSET, NSET=Held\n1, 2\n")
    second = module._key(scene)
    (tmp_path / "nodes.txt").write_text("\n".join(lines).replace("0.02", "0.03"))
    assert len({first, second, module._key(scene)}) == 3


def test_what_an_earlier_run_holds_counts(tmp_path):
    path, found = tmp_path / "run.h5", set()
    scene = beam(initial={"run": str(path)})
    for content in (b"one", b"another"):
        path.write_bytes(content)
        found |= {module._key(scene), module._key(scene)}
    assert len(found) == 2


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "folder", "short"])
def test_damaged_entries_are_made_anew(scene, computed, cache, damage):
    first = pc.converged(scene)
    (entry,) = cache.iterdir()
    whole = entry.read_bytes()
    if damage == "folder":
        entry.unlink()
        entry.mkdir()
    elif damage == "short":
        entry.unlink()
        pc.save_trajectory(entry, dataclasses.replace(
            first, positions=first.positions[:2], velocities=first.velocities[:2],
            times=first.times[:2], stats={k: x[:1] for k, x in first.stats.items()},
        ))  # fmt: skip
    else:
        entry.write_bytes(
            {"empty": b"", "cut": whole[: len(whole) // 2], "text": b"x" * 500}[damage]
        )
    assert same(pc.converged(scene), first)
    assert len(computed) == 2
    assert same(pc.converged(scene), first)
    assert len(computed) == (3 if damage == "folder" else 2)  # in whose place nothing can be put
    assert not list(cache.glob("*.part"))


def test_a_cache_that_cannot_be_written_is_done_without(scene, computed, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PDCORRECT_CACHE", str(tmp_path / "file"))
    assert same(pc.converged(scene), pc.converged(scene))
    assert len(computed) == 2


def test_the_cache_lies_where_the_environment_says(monkeypatch, tmp_path):
    assert module.cache_folder("x") == tmp_path / "cache" / "x"
    monkeypatch.delenv("PDCORRECT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert module.cache_folder("x") == tmp_path / "xdg" / "pdcorrect" / "x"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert module.cache_folder("x") == tmp_path / ".cache" / "pdcorrect" / "x"


def test_two_writers_leave_one_whole_entry(scene, computed, cache, fork):
    writers = [fork(lambda _: pc.converged(scene)) for _ in range(2)]
    assert [writer.join() for writer in writers] == [0, 0]
    assert [path.suffix for path in cache.iterdir()] == [".h5"]
    pc.converged(scene)
    assert computed == []


def test_wrong_input_is_refused(scene):
    with pytest.raises(InputError, match="Scene"):
        pc.converged({"body": 1})
    with pytest.raises(SceneError, match=r"time\.frames"):
        pc.converged(scene, 0)
    with pytest.raises(InputError, match="3 frames.*2"):
        pc.compare(scene, 2, converged=pc.converged(scene))

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


@pytest.mark.parametrize("levels", [(2, 4, 8), (2, 4, 6), (1, 3, 4)])
@pytest.mark.parametrize("order", [0.5, 1.0, 1.6, 2.0])
def test_errors_of_one_power_are_found_with_their_order(levels, order):
    truth, error = np.zeros((3, 2, 3)), np.ones((3, 2, 3))
    truth[1:], error[0] = 2.0, 0.0
    runs = {n: truth + error * n**-order for n in levels}
    share, found = module.richardson(runs, 4)
    assert found == pytest.approx(order)
    size = 2.0 + levels[-1] ** -order  # of the finest
    assert share == pytest.approx(4**-order / size)


def test_orders_outside_theory_are_not_believed():
    truth, error = np.zeros((2, 1, 3)), np.ones((2, 1, 3))
    truth[1], error[0] = 1.0, 0.0
    quick = {n: truth + error * n**-6.0 for n in (2, 4, 8)}
    share, order = module.richardson(quick, 4)
    assert order == 2.0
    assert share > pc.metrics.relative_error(quick[4], truth)
    slow = {n: truth + error * n**-0.1 for n in (2, 4, 8)}
    assert module.richardson(slow, 4)[1] == 0.5
    apart = {2: truth, 4: truth + 0.1 * error, 8: truth}
    assert module.richardson(apart, 4)[1] == 0.5
    assert module.richardson(dict.fromkeys((2, 4, 8), truth), 4) == (0.0, 2.0)


def test_its_own_error_is_near_the_true_one_and_shrinks(scene, computed, monkeypatch):
    run = pc.converged(scene, error=True)
    assert computed == [(4, 4), (4, 2), (4, 8), (2, 4), (8, 4)]
    time, mesh = (float(run.attributes[key]) for key in (module.TIME_ERROR, module.MESH_ERROR))
    assert run.attributes[module.MESH_LEVELS] == "2, 4, 8"
    true = pc.metrics.relative_error(run, module._computed(scene, 4, 32, None))
    assert 0.9 * true < time < 1.5 * true
    assert 0.0 < mesh < 0.05
    monkeypatch.setattr(module, "_MOST_CELLS", 1)
    coarser = module._own_error(scene, run, None)
    assert coarser[module.MESH_LEVELS] == "1, 2, 4"
    assert mesh < float(coarser[module.MESH_ERROR]) < 3.0 * mesh  # of no order that is seen
    monkeypatch.setattr(module, "DIVISOR", 8)
    half = module._own_error(scene, module._computed(scene, 4, 8, None), None)
    assert float(half[module.TIME_ERROR]) < 0.4 * time


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
    assert computed == [(4, 4), (4, 2), (4, 8), (2, 4), (8, 4)]
    assert pc.converged(scene, error=True).attributes == again.attributes
    assert pc.converged(scene).attributes == again.attributes
    assert len(computed) == 5


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
    first = module.cache_key(scene)
    assert module.cache_key(scene) == first
    (tmp_path / "a.inp").write_text(text + "\n*NSET, NSET=Held\n1, 2\n")
    second = module.cache_key(scene)
    (tmp_path / "nodes.txt").write_text("\n".join(lines).replace("0.02", "0.03"))
    assert len({first, second, module.cache_key(scene)}) == 3


def test_what_an_earlier_run_holds_counts(tmp_path):
    path, found = tmp_path / "run.h5", set()
    scene = beam(initial={"run": str(path)})
    for content in (b"one", b"another"):
        path.write_bytes(content)
        found |= {module.cache_key(scene), module.cache_key(scene)}
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

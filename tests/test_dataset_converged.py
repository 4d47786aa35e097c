"""The setting "converged": its plan, its runs against independent ones, and its files."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import h5py
import numpy as np
import pytest

import pdcorrect as pc
from dataset_configs import small
from pdcorrect.data.check import check_dataset
from pdcorrect.data.configuration import CONVERGED_DIVISOR, DatasetConfig
from pdcorrect.data.export import export_meshgraphnet, export_vtu
from pdcorrect.data.generate import generate
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.data.schema import MANIFEST, read_shard, write_shard
from pdcorrect.data.simulate import simulate
from pdcorrect.data.summary import dataset_info
from pdcorrect.data.workers import make_engines
from pdcorrect.errors import InputError
from pdcorrect.evaluation import converged as evaluation

STRENGTHS = {"torsion": 10.0, "impulse": 0.4, "stretch": 5.0, "body-force": 2.0}
MIXED = [
    {"kind": kind, "strength": [0.5 * strength, 1.5 * strength], "duration": 0.02}
    for kind, strength in STRENGTHS.items()
]
FIRST = "training/mesh-0000"


def mixed(**changes):
    """A small data set of all motions."""
    return small(setting="converged", **{"mixed": MIXED, **changes})


CONFIG = mixed(name="mixed", frames=4, converged_steps=8, tolerance=1e-7)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("converged")
    assert generate(CONFIG, folder)
    return folder


@pytest.fixture
def dataset(original, tmp_path):
    """A copy to spoil."""
    return shutil.copytree(original, tmp_path / "mixed")


def hashes(folder):
    return json.loads((folder / MANIFEST).read_text())["files"]


def motion_of(load):
    """The motion of which a load was drawn."""
    if load.kind == "force":
        return "stretch" if load.window is None else "impulse"
    return {"gravity": "body-force"}.get(load.kind, load.kind)


# --- configuration and plan ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"motion": {"kind": "torsion", "strength": [1.0, 2.0]}}, "motion or mixed"),
        ({"mixed": None}, "motion or mixed"),
        ({"mixed": MIXED[:1]}, r"mixed has kinds \[\"torsion\"\]"),
        ({"mixed": [MIXED[1], MIXED[1]]}, r"mixed has kinds \[\"impulse\", \"impulse\"\]"),
        ({"converged_steps": CONVERGED_DIVISOR}, "converged_steps = 4"),
    ],
)
def test_wrong_configurations_are_refused_by_key(changes, told):
    content = {**CONFIG.model_dump(exclude_none=True), **changes}
    with pytest.raises(InputError, match=told):
        DatasetConfig(**content)


def test_configurations_without_mixed_motions_keep_their_hashes():
    """Those that the committed set and the cards of all others hold."""
    folder = Path(__file__).parents[1] / "datasets" / "tiny"
    manifest = json.loads((folder / MANIFEST).read_text())
    assert DatasetConfig.load(folder / "config.toml").hash() == manifest["config_hash"]
    assert DatasetConfig.from_toml(CONFIG.to_toml()).hash() == CONFIG.hash()
    assert mixed(mixed=MIXED[:2]).hash() != mixed().hash()


@pytest.mark.parametrize("motion", ["torsion", "impulse", "stretch"])
def test_bodies_materials_and_loads_are_those_of_the_exact_setting(motion):
    exact, converged = (small(motion, setting) for setting in ("exact", "converged"))
    assert make_plan(exact) == make_plan(converged)
    for plan in make_plan(exact):
        before, after = (draw_scene(config, plan, 0) for config in (exact, converged))
        assert before.time.integrator == "backward-euler"
        assert after == before.with_changes(time={"integrator": "generalised-alpha"})


def test_each_simulation_has_one_or_two_of_the_mixed_motions():
    config = mixed(training={"meshes": 2, "simulations": 400})
    plan = make_plan(config)[0]
    scenes = [draw_scene(config, plan, k) for k in range(plan.simulations)]
    assert {len(scene.loads) for scene in scenes} == {1, 2}
    drawn = Counter(tuple(map(motion_of, scene.loads)) for scene in scenes)
    assert drawn.keys() == set(combinations(STRENGTHS, 1)) | set(combinations(STRENGTHS, 2))
    alone, pairs = ([n for each, n in drawn.items() if len(each) == k] for k in (1, 2))
    assert min(alone) > 12  # of 25 on average
    assert min(pairs) > 6  # of 17
    assert len({scene.model_dump_json() for scene in scenes}) == len(scenes)
    for scene in scenes:
        for load in scene.loads:
            if load.kind == "gravity":
                assert 1.0 <= np.linalg.norm(load.acceleration) <= 3.0
                assert load.ramp == 0.02


# --- runs ----------------------------------------------------------------------------------------


def test_runs_are_those_that_a_user_gets(original):
    shard = read_shard(original / "evaluation/mesh-0000.h5")
    (simulation,) = shard.simulations
    scene = pc.Scene.from_toml(simulation.scene_toml)
    best, coarse = pc.best_coarse(scene), pc.discretise(scene)
    for name, refine, divisor in (
        ("plain", 1, 1), ("best", 1, 1), ("reference", 2, 4), ("time-converged", 2, 8),
    ):  # fmt: skip
        problem = pc.discretise(scene if name == "plain" else best, refine)
        h = scene.time.step / divisor
        stepper = pc.ProjectiveDynamics(problem, 1e-7, time_step=h)
        run = pc.restrict(pc.rollout(stepper, frames=divisor * CONFIG.frames), to=coarse)
        kept = simulation.runs[name]
        assert kept.predictions is None
        assert (kept.velocities is None) == (name != "reference")
        own = run.positions[::divisor]
        assert np.abs(own - coarse.positions).max() > 0.01 * CONFIG.cell_size
        np.testing.assert_allclose(kept.positions, own, atol=3e-6 * CONFIG.cell_size + 1e-7)
        if name == "reference":
            speed = np.abs(run.velocities).max()
            own = run.velocities[::divisor]
            np.testing.assert_allclose(kept.velocities, own, atol=1e-3 * speed)
            assert kept.velocities.dtype == np.float32
    assert set(simulation.runs) == {"plain", "best", "reference", "time-converged"}


def test_the_reference_is_what_errors_are_measured_from(monkeypatch, tmp_path):
    """By `pc.converged`, which is found by other code."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = mixed(frames=2, reference={}, training={"meshes": 1, "simulations": 1})
    assert (config.reference.refine, CONVERGED_DIVISOR) == (evaluation.REFINE, evaluation.DIVISOR)
    plan = make_plan(config)[0]
    (shard,) = simulate(config, [plan], make_engines(config, "cpu"))
    run = pc.converged(draw_scene(config, plan, 0))
    kept = shard.simulations[0].runs["reference"]
    np.testing.assert_allclose(kept.positions, run.positions, atol=1e-6 * config.cell_size)
    size = np.abs(run.velocities).max()
    np.testing.assert_allclose(kept.velocities, run.velocities, atol=1e-4 * size)


@pytest.mark.slow  # test_dataset_generate compares batches of smaller runs
def test_batches_compute_the_same(original):
    pytest.importorskip("torch")
    from pdcorrect.data.batch_engine import Batched
    from pdcorrect.data.simulate import Engines

    plan = make_plan(CONFIG)[-1]
    engine = Batched("cpu", CONFIG.tolerance, adds_up=True)
    (found,) = simulate(CONFIG, [plan], Engines(engine, engine))
    wanted = read_shard(original / f"{plan.name}.h5")
    for mine, other in zip(found.simulations, wanted.simulations, strict=True):
        assert mine.runs.keys() == other.runs.keys()
        for name, run in mine.runs.items():
            np.testing.assert_allclose(
                run.positions, other.runs[name].positions, atol=3e-6 * CONFIG.cell_size + 1e-7
            )


# --- files ---------------------------------------------------------------------------------------


def test_an_interrupted_generation_goes_on_to_the_same_files(original, tmp_path):
    class Interrupted(Exception):
        pass

    def stop(*row):
        raise Interrupted

    folder = tmp_path / "again"
    with pytest.raises(Interrupted):
        generate(CONFIG, folder, on_file=stop)
    (kept,) = folder.rglob("*.h5")
    before = kept.stat()
    assert generate(CONFIG, folder)
    assert (kept.stat().st_ino, kept.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert hashes(folder) == hashes(original)


def test_it_is_sound_and_summarised(original):
    assert check_dataset(original, repeat=2) == []
    runs = dataset_info(original).whole.runs
    assert runs["best"].rms_error < runs["plain"].rms_error
    assert runs["best"].step_error is None


def changed(path, run, **changes):
    """Rewrite a file with changes to a run of its first simulation."""
    shard = read_shard(path)
    first, *others = shard.simulations
    first = replace(first, runs={**first.runs, run: replace(first.runs[run], **changes)})
    content = write_shard(path, replace(shard, simulations=(first, *others)), overwrite=True)
    return content


@pytest.mark.parametrize("name", ["plain", "best"])
def test_a_step_that_is_not_the_solver_s_is_found(dataset, name):
    path = dataset / f"{FIRST}.h5"
    positions = read_shard(path).simulations[0].runs[name].positions.copy()
    positions[2:, -1] += 1e-3 * CONFIG.cell_size
    changed(path, name, positions=positions)
    (dataset / MANIFEST).unlink()
    assert not [f for f in check_dataset(dataset, repeat=1) if f.path == path]
    (finding,) = (f for f in check_dataset(dataset, repeat=2) if f.path == path)
    assert f"{name}: step 2" in finding.message


def test_velocities_that_cannot_be_are_found(dataset):
    path = dataset / f"{FIRST}.h5"
    shard = read_shard(path)
    velocities = shard.simulations[0].runs["reference"].velocities.copy()
    velocities[0, -1] = 0.1
    velocities[2, ~shard.free] = 0.2
    changed(path, "reference", velocities=velocities)
    (dataset / MANIFEST).unlink()
    told = " ".join(f.message for f in check_dataset(dataset, repeat=0) if f.path == path)
    assert "0.1 m/s in frame 0" in told
    assert "0.2 m/s" in told
    changed(path, "reference", velocities=None)
    told = " ".join(f.message for f in check_dataset(dataset, repeat=0) if f.path == path)
    assert "velocities of run 'reference'" in told


def test_windows_have_the_stored_velocities(original):
    reader = pytest.importorskip("pdcorrect.data.reader")
    stored = read_shard(original / f"{FIRST}.h5").simulations[0].runs["reference"]
    dataset = reader.TrajectoryDataset(original, "training", base=None)
    found = dataset.decoded(0).motions[0].velocities.numpy()
    np.testing.assert_array_equal(found, stored.velocities[:-1])
    differences = np.diff(stored.positions, axis=0) / 0.01
    assert np.abs(found[1:] - differences[:-1]).max() > 0.05 * np.abs(differences).max()


def test_other_programs_get_it_without_single_steps(original, tmp_path):
    export_meshgraphnet(original, tmp_path / "graphs")
    with h5py.File(tmp_path / "graphs/train.h5") as file:
        assert "base_pos" not in file["0"]
        assert file["0/world_pos"].shape[0] == CONFIG.frames + 1
    meta = json.loads((tmp_path / "graphs/meta.json").read_text())
    assert "base_pos" not in meta["field_names"]
    pyvista = pytest.importorskip("pyvista")
    export_vtu(original, tmp_path / "vtu", "training", 0, 0)
    last = sorted((tmp_path / "vtu").glob("*reference*.vtu"))[-1]
    stored = read_shard(original / f"{FIRST}.h5").simulations[0].runs["reference"].velocities[-1]
    np.testing.assert_allclose(pyvista.read(last).point_data["velocity"], stored, rtol=1e-6)


def test_a_step_corrector_is_not_trained_on_it(original):
    pytest.importorskip("torch")
    from pdcorrect.training.scenes import load_recordings

    with pytest.raises(InputError, match="no single steps of run 'best'"):
        load_recordings(original, "training", "best")

"""The coarse model with the reference's total mass: the problem, its runs, trainings on it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import cross
from pdcorrect.errors import InputError
from pdcorrect.evaluation.comparison_cases import cases_for
from pdcorrect.scene import trained_coarse

ROOT = Path(__file__).parents[1]
PER_NODE = {"mass": "per-node"}


def heavy():
    """A scene by whose mass rule a mesh is the heavier the coarser it is."""
    return cross().with_changes(solver=PER_NODE)


# --- the problem ---------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["lumped", "averaged", "consistent", "per-node"])
def test_a_total_mass_is_reached_by_one_factor_on_the_density(rule):
    problem = pc.discretise(cross().with_changes(solver={"mass": rule}))
    found = problem.with_total_mass(12.5)
    assert found.mass.sum() == pytest.approx(12.5, rel=1e-12)
    factor = 12.5 / problem.mass.sum()
    np.testing.assert_allclose(found.mass, factor * problem.mass, rtol=1e-12)
    np.testing.assert_allclose(found.materials.density, factor * problem.materials.density)
    np.testing.assert_array_equal(found.materials.mu, problem.materials.mu)
    assert found.density_changed
    assert not found.material_changed  # its moduli, and so its stresses, are the scene's
    assert problem.mass.sum() != pytest.approx(12.5)


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_a_total_mass_that_is_none_is_refused(mass):
    with pytest.raises(InputError):
        pc.discretise(cross()).with_total_mass(mass)


@pytest.mark.parametrize("refine", [2, 4])
def test_the_coarse_model_by_total_mass_weighs_what_the_refined_scene_does(refine):
    found = pc.coarse_model(heavy(), "total-mass", refine)
    fine, plain = pc.discretise(heavy(), refine), pc.coarse_model(heavy())
    assert found.mass.sum() == pytest.approx(fine.mass.sum(), rel=1e-12)
    assert plain.mass.sum() > 1.2 * fine.mass.sum()
    assert len(found.positions) == len(plain.positions)


@pytest.mark.parametrize("rule", ["lumped", "averaged", "consistent"])
def test_where_masses_are_of_volumes_the_total_mass_changes_nothing(rule):
    scene = cross().with_changes(solver={"mass": rule})
    found = pc.coarse_model(scene, "total-mass")
    np.testing.assert_allclose(found.mass, pc.discretise(scene).mass, rtol=1e-12)


def test_coarse_models_are_known_by_name():
    assert pc.coarse_model(cross(), "best").element == trained_coarse(cross()).solver.element
    assert pc.coarse_model(cross()).element == "hex8"
    with pytest.raises(InputError, match="finest"):
        pc.coarse_model(cross(), "finest")


# --- trainings -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A small data set as published, with its validation split."""
    pytest.importorskip("torch_geometric")
    from training_samples import published

    return published(tmp_path_factory.mktemp("published") / "data")


def settings(**changes):
    import training_samples as samples

    return samples.config(samples.one_step(), base="total-mass", **changes)


def save_silent(published, folder):
    """A model of it that corrects nothing."""
    import training_samples as samples
    from pdcorrect.corrector.model_io import ModelRecord, save_model

    record = ModelRecord(dataset="d", dataset_hash="0", training={"base": "total-mass"})
    save_model(samples.fitted(published, settings(), silent=True), folder, record=record)


def test_single_steps_are_shown_the_masses_that_rollouts_have(published):
    """What the network sees of a stored step is what it sees when the scene is stepped."""
    import torch

    import training_samples as samples
    from pdcorrect.corrector.bodies import BodyGraph
    from pdcorrect.training.recordings import make_problems

    windows, recordings = samples.windows(published, settings())
    problems = make_problems(recordings, "total-mass")
    for problem, recording in zip(problems, recordings, strict=True):
        assert problem.mass.sum() == pytest.approx(recording.total_mass, rel=1e-12)
        assert problem.mass.sum() < 0.9 * pc.discretise(problem.scene).mass.sum()
    first = [0, 4 * len(recordings) - 1]  # of the first and of the last simulation
    bodies = windows.batch(first).bodies
    own = BodyGraph.of([problems[0], problems[-1]], dtype=torch.float64)
    for name in ("mass", "density", "rest", "young"):
        torch.testing.assert_close(getattr(bodies, name), getattr(own, name), rtol=1e-6, atol=0.0)


def test_a_silent_corrector_of_it_has_its_omega(published):
    pytest.importorskip("torch_geometric")
    import training_samples as samples
    from pdcorrect.data.shard_reader import read_shard
    from pdcorrect.training.recordings import load_recordings
    from pdcorrect.training.validation import Validation

    recordings = load_recordings(published, "validation", "total-mass")
    scores = Validation(recordings, "total-mass")(
        samples.fitted(published, settings(), silent=True)
    )
    (path,) = published.glob("validation/*.h5")
    names = ("total-mass", "plain", "reference")
    expected = [
        pc.metrics.error_corrected(*(s.runs[name].positions for name in names))
        for s in read_shard(path).simulations
    ]
    np.testing.assert_allclose(scores.omegas, expected, atol=0.01)
    assert scores.mean > 30.0  # it is nearer than the plain mesh


def test_a_model_of_it_is_compared_beside_it(published, tmp_path):
    pytest.importorskip("torch_geometric")
    save_silent(published, tmp_path / "silent")
    scene = heavy().with_changes(time={"frames": 2})
    cases = cases_for(scene, [str(tmp_path / "silent")])
    assert [case.label for case in cases[-2:]] == ["coarse PD, total mass", "hybrid silent"]
    chosen = (cases[0], cases[2], *cases[-2:])
    rows = {row.label: row for row in pc.compare(scene, cases=chosen).rows}
    base, hybrid = rows["coarse PD, total mass"], rows["hybrid silent"]
    assert hybrid.rms_error == base.rms_error < 0.7 * rows["coarse PD"].rms_error


def without(shard, name, predictions_only):
    """A file as earlier versions made it: without a run, or without its single steps."""
    from dataclasses import replace

    def fewer(runs):
        if predictions_only:
            return {**runs, name: replace(runs[name], predictions=None)}
        return {key: run for key, run in runs.items() if key != name}

    return replace(
        shard, simulations=tuple(replace(s, runs=fewer(s.runs)) for s in shard.simulations)
    )


@pytest.mark.parametrize("predictions_only", [False, True])
def test_files_without_its_runs_are_told_and_made_again(published, tmp_path, predictions_only):
    from pdcorrect.data.check import check_dataset
    from pdcorrect.data.configuration import DatasetConfig
    from pdcorrect.data.generate import generate
    from pdcorrect.data.schema import write_shard
    from pdcorrect.data.shard_reader import read_shard
    from pdcorrect.training.recordings import load_recordings

    folder = tmp_path / "old"
    shutil.copytree(published, folder)
    config = DatasetConfig.load(folder / "config.toml")
    path = folder / "validation" / "mesh-0000.h5"
    before = read_shard(path)
    old = without(before, "total-mass", predictions_only)
    write_shard(path, old, config.dtype, overwrite=True)
    assert any("total-mass" in str(fault) for fault in check_dataset(folder))
    with pytest.raises(InputError, match="total-mass"):
        load_recordings(folder, "validation", "total-mass")
    assert generate(config, folder, splits=["validation"])
    for made, first in zip(read_shard(path).simulations, before.simulations, strict=True):
        run, known = made.runs["total-mass"], first.runs["total-mass"]
        np.testing.assert_array_equal(run.predictions, known.predictions)
        np.testing.assert_array_equal(run.positions, known.positions)


def test_regions_that_end_inside_of_cells_may_weigh_otherwise_when_refined():
    region = {"box": [[-1.0, -1.0, -1.0], [0.12, 1.0, 1.0]]}
    scene = pc.Scene.load(ROOT / "examples" / "short_cross.toml").with_changes(
        materials=[{"region": region, "density": 3000.0}]
    )
    plain = pc.discretise(scene)
    found = pc.coarse_model(scene, "total-mass")
    assert found.mass.sum() == pytest.approx(pc.discretise(scene, 4).mass.sum())
    assert abs(found.mass.sum() / plain.mass.sum() - 1.0) > 0.01


def test_a_silent_model_of_it_is_evaluated_as_its_run(published, tmp_path):
    pytest.importorskip("torch_geometric")
    from pdcorrect.evaluation.evaluation import evaluate, saved_candidates

    save_silent(published, tmp_path / "silent")
    (saved,) = saved_candidates([str(tmp_path / "silent")])
    runs = evaluate([saved], published).runs
    for measure in ("omega", "step_omega", "energy_error", "rms_error"):
        own, base = (runs[name].values(measure)[0] for name in ("silent", "total-mass"))
        np.testing.assert_allclose(own, base, rtol=1e-3, atol=0.02)
    np.testing.assert_allclose(runs["silent"].values("omega_base")[0], 0.0, atol=0.05)
    assert runs["silent"].values("step_omega")[0] != [0.0]

"""The coarse model with the reference's total mass: the problem, its runs, trainings on it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc
from conftest import cross
from pdcorrect.errors import InputError
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


# --- data sets -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A small data set as published, with its validation split."""
    pytest.importorskip("torch_geometric")
    from training_samples import published

    return published(tmp_path_factory.mktemp("published") / "data")


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
    from pdcorrect.data.schema import read_shard, write_shard

    folder = tmp_path / "old"
    shutil.copytree(published, folder)
    config = DatasetConfig.load(folder / "config.toml")
    path = folder / "validation" / "mesh-0000.h5"
    before = read_shard(path)
    old = without(before, "total-mass", predictions_only)
    write_shard(path, old, config.dtype, overwrite=True)
    assert any("total-mass" in str(fault) for fault in check_dataset(folder))
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

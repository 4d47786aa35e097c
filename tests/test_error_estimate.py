"""The estimated error of a run."""

from dataclasses import replace

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, cross
from pdcorrect.fem.element_network import MODEL


def rms(x):
    return float(np.sqrt((x[1:] ** 2).mean()))


def distances(run, truth):
    return np.linalg.norm(pc.restrict(run, truth).positions - truth.positions, axis=2)


@pytest.mark.parametrize("choose", [pc.best_coarse, pc.learned_coarse])
@pytest.mark.parametrize("make", [beam, cross], ids=["beam", "cross"])
def test_is_within_a_factor_of_two(choose, make):
    scene = make(time={"step": 0.01, "frames": 12}, poisson=0.4)
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(choose(scene))))
    estimate = pc.error_estimate(run)
    assert estimate.shape == run.positions.shape[:2]
    assert (estimate[0] == 0.0).all()
    assert (estimate[:, run.points[:, 0] == 0.0] == 0.0).all()  # clamped
    assert 0.5 < rms(estimate) / rms(distances(run, pc.converged(scene))) < 2.0


def test_sees_the_error_of_the_time_step():
    scene = pc.learned_coarse(beam(time={"step": 0.01, "frames": 8}))
    fast = scene.with_changes(time={"substeps": 4})
    slow = scene.with_changes(time={"integrator": "backward-euler"})
    found = [
        rms(pc.error_estimate(pc.rollout(pc.ProjectiveDynamics(pc.discretise(s)))))
        for s in (fast, scene, slow)
    ]
    assert found[0] < found[1] < 0.3 * found[2]


def test_of_statics_and_finer_meshes_and_files(tmp_path):
    scene = beam(time={"integrator": "quasi-static", "step": 1.0, "frames": 1})
    coarse, fine = (
        pc.rollout(pc.Newton(pc.discretise(pc.best_coarse(scene), refine))) for refine in (1, 2)
    )
    assert rms(pc.error_estimate(fine)) < 0.5 * rms(pc.error_estimate(coarse))
    pc.save_trajectory(tmp_path / "run.h5", coarse)
    again = pc.error_estimate(pc.load_trajectory(tmp_path / "run.h5"))
    assert (again == pc.error_estimate(coarse)).all()
    tuned = pc.learned_coarse(scene).with_changes(solver={"weights": MODEL})
    learned, same = (
        pc.rollout(pc.Newton(pc.discretise(s))) for s in (pc.learned_coarse(scene), tuned)
    )
    assert (pc.error_estimate(learned) == pc.error_estimate(same)).all()
    hex27 = scene.with_changes(solver={"element": "hex27", "mass": "consistent"})
    run = pc.rollout(pc.Newton(pc.discretise(hex27)))
    assert pc.error_estimate(run).shape == run.positions.shape[:2]


def test_refuses_runs_that_their_scene_does_not_tell(tmp_path):
    problem = pc.discretise(beam(time={"step": 0.01, "frames": 2}))
    run = pc.rollout(pc.ProjectiveDynamics(problem))
    with pytest.raises(pc.errors.InputError, match="expected a Trajectory"):
        pc.error_estimate(run.positions)
    with pytest.raises(pc.errors.InputError, match="begins with another state"):
        pc.error_estimate(pc.rollout(pc.ProjectiveDynamics(problem), state=run.state(-1)))
    moving = replace(problem.initial_state(), velocities=1.0 * problem.free)
    with pytest.raises(pc.errors.InputError, match="begins with another state"):
        pc.error_estimate(pc.rollout(pc.ProjectiveDynamics(problem), state=moving))
    for other in (problem.with_material(2e6, 0.4), problem.with_total_mass(0.1)):
        with pytest.raises(pc.errors.InputError, match="material"):
            pc.error_estimate(pc.rollout(pc.ProjectiveDynamics(other)))
    with pytest.raises(pc.errors.InputError, match="the run's scene"):
        pc.error_estimate(replace(run, scene_toml=""))

"""The lagged Hessian: same answers as G, renewed when it pays, and exactly resumable."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, cross, disturbed
from pdcorrect.solvers.resume import continue_from


@pytest.mark.parametrize("element", ["hex8", "hex8-mean", "hex8-bubble", "hex27"])
def test_it_reaches_the_same_answer_in_fewer_iterations(element):
    problem = pc.discretise(cross(), element=element)
    runs = {
        kind: pc.rollout(pc.ProjectiveDynamics(problem, 1e-8, first_hessian=kind), 5)
        for kind in ("G-scaled", "lagged")
    }
    for run in runs.values():
        assert set(run.stats["status"]) == {"CONVERGED"}
    by_g, lagged = runs.values()
    assert np.abs(by_g.positions - lagged.positions).max() < 1e-8
    assert lagged.stats["iterations"].sum() < 0.5 * by_g.stats["iterations"].sum()


def test_it_is_kept_for_several_frames_and_renewed_when_iterations_grow():
    problem = pc.discretise(beam((24, 2, 2)))
    run = pc.rollout(pc.ProjectiveDynamics(problem, first_hessian="lagged"), 20)
    ages = run.stats["hessian_age"]
    assert ages[0] == 0
    assert ages.max() >= 2
    renewals = np.flatnonzero(ages == 0)[1:]
    assert len(renewals)
    before, after = run.stats["iterations"][renewals - 1], run.stats["iterations"][renewals]
    assert after.mean() < before.mean()


def test_at_rest_it_is_never_renewed():
    problem = pc.discretise(beam(loads=[]))
    run = pc.rollout(pc.ProjectiveDynamics(problem, first_hessian="lagged"), 10)
    np.testing.assert_array_equal(run.stats["hessian_age"], np.arange(10))


@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "generalised-alpha"])
@pytest.mark.parametrize("stop", [1, 4, 9])
def test_a_resumed_run_equals_the_uninterrupted_one_bit_by_bit(integrator, stop):
    scene = cross(time={"integrator": integrator})
    problem = pc.discretise(scene, element="hex8-bubble")

    def stepper():
        return pc.ProjectiveDynamics(problem, first_hessian="lagged")

    whole = pc.rollout(stepper(), 12)
    assert whole.stats["hessian_age"].max() > 0
    first = pc.rollout(stepper(), stop)
    again = stepper()
    rest = pc.rollout(again, 12 - stop, state=continue_from(again, first))
    np.testing.assert_array_equal(rest.positions, whole.positions[stop:])
    np.testing.assert_array_equal(rest.velocities, whole.velocities[stop:])
    for name in ("iterations", "hessian_age", "elastic_energy"):
        np.testing.assert_array_equal(rest.stats[name], whole.stats[name][stop:])


def test_a_hessian_that_does_not_serve_is_renewed_within_the_step():
    """From random positions the tangent at the start says little about the minimum."""
    problem = pc.discretise(beam((12, 2, 2)))
    state = pc.State(disturbed(problem, 1.0), np.zeros_like(problem.positions))
    result = pc.ProjectiveDynamics(problem, first_hessian="lagged", recover=False)(state)
    assert result.status is pc.Status.CONVERGED
    exact = pc.ProjectiveDynamics(problem, 1e-8, first_hessian="G")(state)
    assert np.abs(result.state.positions - exact.state.positions).max() < 2e-5 * problem.cell_size


def test_auto_takes_it_where_the_factor_is_small():
    small = pc.ProjectiveDynamics(pc.discretise(beam()))
    assert small.describe()["first_hessian"] == "true Hessian of an earlier frame"
    assert small.describe()["factorisation"] == "band"

"""Omega and the other measures, on numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect import metrics
from pdcorrect.errors import InputError, MeshError


def shifted(reference, distance):
    return reference + np.array([0.0, distance, 0.0])


@pytest.fixture
def reference(rng):
    return rng.normal(size=(5, 7, 3))


def test_omega_is_the_share_of_the_squared_error(reference):
    coarse = shifted(reference, 0.2)
    assert metrics.error_corrected(reference, coarse, reference) == 100
    assert metrics.error_corrected(coarse, coarse, reference) == 0
    half = metrics.error_corrected(shifted(reference, 0.1), coarse, reference)
    assert half == pytest.approx(75)
    assert metrics.error_corrected(shifted(reference, 0.4), coarse, reference) == pytest.approx(
        -300
    )
    mean = metrics.error_corrected([reference, coarse], [coarse, coarse], [reference, reference])
    assert mean == pytest.approx(50)


def test_frame_zero_and_units_do_not_matter(reference):
    coarse, model = shifted(reference, 0.2), shifted(reference, 0.1)
    other = coarse.copy()
    other[0] += 5.0
    assert metrics.error_corrected(model, other, reference) == pytest.approx(75)
    assert metrics.error_corrected(1e3 * model, 1e3 * coarse, 1e3 * reference) == pytest.approx(75)


def test_distances(reference):
    run = reference.copy()
    run[2, 3] += [0.3, 0.0, 0.4]
    assert metrics.largest_error(run, reference) == pytest.approx(0.5)
    assert metrics.rms_error(run, reference) == pytest.approx(np.sqrt(0.25 / (4 * 7)))
    over_time = metrics.error_over_time(run, reference)
    np.testing.assert_allclose(over_time, [0, 0, np.sqrt(0.25 / 7), 0, 0], atol=1e-15)
    assert metrics.mean_squared_error(run, reference) == pytest.approx(0.25 / 4)
    assert metrics.largest_displacement(shifted(reference, 0)[:1]) == 0
    moved = np.stack([reference[0], reference[0] + [3, 0, 4]])
    assert metrics.largest_displacement(moved) == pytest.approx(5)


def test_momenta_of_a_turning_pair():
    positions = np.array([[[1.0, 0, 0], [-1.0, 0, 0]]])
    velocities = np.array([[[0, 2.0, 0], [0, -2.0, 0]]])
    mass = np.array([3.0, 3.0])
    np.testing.assert_allclose(metrics.linear_momentum(velocities, mass), [[0, 0, 0]])
    np.testing.assert_allclose(
        metrics.angular_momentum(positions, velocities, mass), [[0, 0, 12.0]]
    )
    assert metrics.relative_drift([[1.0, 0], [1.0, 0.1]]) == pytest.approx(0.1, rel=1e-2)
    assert metrics.relative_drift([0.0, 0.0]) == 0


def test_wrong_input_is_named(reference):
    with pytest.raises(InputError, match="7.*3"):
        metrics.rms_error(reference, reference[:, :3])
    with pytest.raises(InputError, match="5 and 3 frames"):
        metrics.rms_error(reference, reference[:3])
    with pytest.raises(InputError, match="1.*2"):
        metrics.error_corrected([reference], [reference, reference], [reference])
    with pytest.raises(InputError, match="reference"):
        metrics.error_corrected(reference, reference, reference)


# --- to the converged motion -------------------------------------------------------------


def test_relative_error_is_zero_for_itself_and_has_no_units(reference):
    run = shifted(reference, 0.2)
    assert metrics.relative_error(reference, reference) == 0
    error = metrics.relative_error(run, reference)
    size = np.sqrt(((reference[1:] - reference[0]) ** 2).sum(axis=2).mean())
    assert error == pytest.approx(0.2 / size)
    assert metrics.relative_error(1e3 * run, 1e3 * reference) == pytest.approx(error)
    assert metrics.relative_error(run + 7.0, reference + 7.0) == pytest.approx(error)
    still = np.broadcast_to(reference[0], reference.shape)
    assert metrics.relative_error(still, reference) == pytest.approx(1)


def test_relative_error_restricts_finer_runs_and_starts_from_rest_positions():
    scene = beam((3, 1, 1), time={"frames": 2})
    coarse, fine = (
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine))) for refine in (1, 2)
    )
    here = pc.restrict(fine, to=coarse)
    error = metrics.relative_error(coarse, here)
    assert 0 < error < 1
    size = metrics.rms_error(coarse.points[None].repeat(3, 0), coarse)
    expected = metrics.rms_error(here, coarse) / size
    assert metrics.relative_error(fine, coarse) == pytest.approx(expected)
    assert metrics.relative_error(here, here) == 0
    moved = dataclasses.replace(coarse, points=coarse.points - [1e-3, 0, 0])
    with pytest.raises(MeshError, match="node"):
        metrics.relative_error(coarse, moved)


def test_relative_error_of_what_cannot_be_compared_is_refused(reference):
    with pytest.raises(InputError, match="5 and 4 frames"):
        metrics.relative_error(reference[:5], reference[:4])
    with pytest.raises(InputError, match="converged"):
        metrics.relative_error(reference, np.broadcast_to(reference[0], reference.shape))

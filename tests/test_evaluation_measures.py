"""Measures of trajectories by hand, and intervals by resampling."""

import numpy as np
import pytest

import pdcorrect as pc
from pdcorrect.evaluation.measures import (
    EvaluationCase,
    Outcome,
    TrajectoryMeasures,
    measure,
)
from pdcorrect.evaluation.tables import mean_interval, summarise
from pdcorrect.metrics import mean_squared_error

FRAMES, STEP = 5, 0.01

# --- measures by hand ------------------------------------------------------------------


def scene(**changes):
    values = {
        "body": {"shape": "beam", "cells": [2, 1, 1], "cell_size": 0.1},
        "material": {"young": 1e5, "poisson": 0.3, "density": 1e3},
        "time": {"step": STEP, "frames": FRAMES},
        "clamps": [{"region": {"plane": "x", "at": 0.0}}],
        **changes,
    }
    return pc.Scene(**values)


def case_of(problem, reference, **runs):
    return EvaluationCase(0, 0, {"plain": problem}, reference, runs, {})


def translated(problem, way):
    """All nodes at distances ``way`` (T+1,) along x."""
    return problem.positions + np.multiply.outer(way, np.array([[1.0, 0.0, 0.0]]))


@pytest.fixture(scope="module")
def beam():
    return pc.discretise(scene())


def test_shares_and_errors_are_those_computed_by_hand(beam):
    way = 0.01 * np.arange(FRAMES + 1.0)  # to 0.05 m
    errors = 1e-4 * np.array([0, 4, 6, 20, 30, 10])
    reference = translated(beam, way)
    plain, model = translated(beam, way + 2 * errors), translated(beam, way - errors)
    model[2, 3] += [0.0, 0.01, 0.0]
    case = case_of(beam, reference, plain=plain, **{"time-converged": translated(beam, way + 1e-3)})
    found = measure(case, Outcome(model, base="plain")).measures
    n = len(beam.positions)
    total = n * (errors**2).sum() + 0.01**2
    assert found.omega == pytest.approx(100 * (1 - total / (4 * n * (errors**2).sum())))
    assert found.omega_base == found.omega
    assert found.rms_error == pytest.approx(np.sqrt(total / n / FRAMES))
    assert found.worst_node == pytest.approx(np.hypot(6e-4, 0.01))
    speeds = np.diff(np.concatenate([[0.0], -errors])) / STEP
    at_node = beam.mass[3] * np.array([0, 0, 1, -1, 0, 0]) * 0.01 / STEP
    momentum = np.sqrt((beam.mass.sum() * speeds) ** 2 + at_node**2)
    size = beam.mass.sum() * 0.01 / STEP
    assert found.linear_momentum_error == pytest.approx(np.sqrt((momentum**2).mean()) / size)
    converged = mean_squared_error(model, case.runs["time-converged"])
    assert found.converged_rms_error == pytest.approx(np.sqrt(converged / n))


def test_stress_errors_are_the_excess_of_strain_and_do_not_see_rigid_motion(beam):
    x = beam.positions
    pulled = 1e-5 * x * [1.0, -0.3, -0.3]
    factors = np.linspace(0, 1, FRAMES + 1)[:, None, None]
    reference = x + factors * pulled
    case = case_of(beam, reference)
    found = measure(case, Outcome(x + 1.1 * factors * pulled)).measures
    assert found.stress_error == pytest.approx(0.1, rel=1e-3)
    assert measure(case, Outcome(reference)).measures.stress_error == 0.0

    reference = translated(beam, np.zeros(FRAMES + 1))
    reference[1:, :, 0] *= 1.001
    moved = reference + 0.02 * np.arange(FRAMES + 1)[:, None, None]
    found = measure(case_of(beam, reference), Outcome(moved)).measures
    assert found.stress_error == pytest.approx(0.0, abs=1e-9)
    assert found.linear_momentum_error > 1.0


def test_backward_euler_in_free_fall_loses_what_it_must_and_damped_bodies_tell_nothing():
    gravity = [{"kind": "gravity", "acceleration": [9.0, 0.0, 0.0]}]
    falling = pc.discretise(scene(clamps=[], loads=gravity))
    count = np.arange(FRAMES + 1)
    motion = translated(falling, 9.0 * STEP**2 * count * (count + 1) / 2)
    found = measure(case_of(falling, motion), Outcome(motion, base="plain")).measures
    assert found.energy_loss == pytest.approx(1 / FRAMES, rel=1e-6)
    damped = pc.discretise(scene(damping={"mass": 1.0}))
    motion = translated(damped, 0.01 * np.arange(FRAMES + 1.0))
    found = measure(case_of(damped, motion), Outcome(motion)).measures
    assert found.energy_loss is None


def test_what_is_not_defined_is_none(beam):
    reference = translated(beam, np.zeros(FRAMES + 1))
    found = measure(case_of(beam, reference, plain=reference), Outcome(reference)).measures
    assert found.omega is None  # the plain run has no error to remove
    assert found.omega_base is None
    assert found.converged_rms_error is None
    assert found.gate_rate is None
    assert found.stress_error is found.energy_error is found.linear_momentum_error is None
    assert measure(case_of(beam, reference), Outcome()).measures == TrajectoryMeasures(0, 0)


# --- resampling ------------------------------------------------------------------------


def test_summaries_are_those_of_the_values():
    found = summarise(np.arange(101.0), np.arange(101))
    assert (found.mean, found.median, found.smallest, found.largest) == (50, 50, 0, 100)
    assert (found.q05, found.q95) == (5.0, 95.0)
    assert (found.count, found.meshes) == (101, 101)


def test_intervals_are_the_same_every_time_and_differ_by_seed():
    values = np.random.default_rng(3).normal(size=30)
    clusters = np.arange(30) // 3
    assert mean_interval(values, clusters, 5) == mean_interval(values, clusters, 5)
    assert mean_interval(values, clusters, 5) != mean_interval(values, clusters, 6)
    values, clusters = [0.0] * 9 + [10.0], [0] * 9 + [1]
    low, high = mean_interval(values, clusters, resamples=4000)
    assert (low, high) == (0.0, 10.0)  # one mesh drawn twice, either one


def test_intervals_cover_the_true_mean_about_as_often_as_they_say():
    rng = np.random.default_rng(0)
    clusters = np.repeat(np.arange(25), 4)
    hits = by_value = 0
    for trial in range(200):
        values = rng.normal(size=25)[clusters] + 0.1 * rng.normal(size=100)
        low, high = mean_interval(values, clusters, trial, resamples=400)
        hits += low <= 0.0 <= high
        low, high = mean_interval(values, np.arange(100), trial, resamples=400)
        by_value += low <= 0.0 <= high
    assert 0.88 <= hits / 200 <= 0.99
    assert by_value / 200 < 0.8  # as if trajectories on one mesh told as much as others


@pytest.mark.parametrize(("count", "least"), [(5, 0.9), (10, 0.93), (20, 0.93)])
def test_intervals_of_few_meshes_cover_nearly_as_often_as_those_of_many(count, least):
    rng = np.random.default_rng(1)
    trials = 1000
    hits = 0
    for trial in range(trials):
        low, high = mean_interval(rng.normal(size=count), range(count), trial, resamples=1000)
        hits += low <= 0.0 <= high
    assert least <= hits / trials <= 0.97


def test_an_interval_of_equal_values_is_a_point_and_of_one_mesh_unknown():
    assert mean_interval([2.0] * 6, [0, 0, 1, 1, 2, 2]) == (2.0, 2.0)
    assert mean_interval([1.0, 2.0], [4, 4]) is None

"""Generation on GPUs: what is computed together, in which order, and on which GPU."""

import os

import numpy as np
import pytest

from dataset_configs import small
from pdcorrect.data import batch_engine, engines, generate, workers
from pdcorrect.data.engines import OneByOne
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.data.simulate import work_per_node
from pdcorrect.data.workers import Workers
from pdcorrect.fem.problem import discretise

SHARED = small(
    coarse_nodes=None,
    frames=10,
    converged_steps=16,
    reference={"refine": 4},
    training={"meshes": 30, "simulations": 120},
    evaluation={"meshes": 10, "simulations": 30},
    extra=[{"name": "long", "meshes": 2, "simulations": 2, "frames_factor": 5}],
)


def units(batch=40):
    plans = make_plan(SHARED)
    return plans, generate._units(SHARED, plans, Workers(2, None, "cuda", batch))


def work(unit):
    return generate.unit_work(SHARED, unit)


def test_every_mesh_is_in_one_unit_of_its_split_and_many_steps_make_small_units():
    plans, found = units()
    names = [plan.name for unit in found for plan in unit]
    assert sorted(names) == sorted(plan.name for plan in plans)
    assert all(len({plan.split for plan in unit}) == 1 for unit in found)
    sums = [work(unit) for unit in found]
    assert sums == sorted(sums, reverse=True)
    for batch in (8, 40):
        sizes = [sum(plan.simulations for plan in unit) for unit in units(batch)[1]]
        assert 0.8 * batch < max(sizes) <= batch

    found = units()[1]
    longest = {
        name: max(sum(p.simulations for p in unit) for unit in found if unit[0].split == name)
        for name in ("training", "evaluation")
    }
    assert longest["training"] == 40
    assert 3 <= longest["evaluation"] <= 12  # 16 times the steps, 4 times the work
    usual = max(work(unit) for unit in found if unit[0].split == "training")
    assert max(map(work, found)) < 4.5 * usual


def test_work_counts_the_refined_nodes_of_all_steps_and_a_cpu_takes_meshes_in_order():
    by_split = {plan.split: plan for plan in make_plan(SHARED)}
    models = 2 * 2  # plain and best, each a rollout and single steps
    assert work_per_node(SHARED, by_split["training"]) == 10 * (64 + models)
    assert work_per_node(SHARED, by_split["evaluation"]) == 10 * (64 + models + 8 + 16 * 64)
    assert work_per_node(SHARED, by_split["long"]) == 50 * (64 + models + 8)

    plans = make_plan(SHARED)
    assert generate._units(SHARED, plans, Workers(2)) == [[plan] for plan in plans]


def test_a_worker_sees_its_own_gpu_alone_or_takes_it_by_number_if_cuda_has_begun(monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)

    def count():
        named = os.environ.get("CUDA_VISIBLE_DEVICES")
        return len(named.split(",")) if named else 4

    monkeypatch.setattr(torch.cuda, "device_count", count)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: False)
    for _ in range(2):  # the next unit finds what the first one set
        assert workers._own_gpu(6) == "cuda"
        assert os.environ["CUDA_VISIBLE_DEVICES"] == "2"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    assert workers._own_gpu(3) == "cuda"
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "7"
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    assert workers._own_gpu(6) == "cuda:2"
    assert "CUDA_VISIBLE_DEVICES" not in os.environ


def one_problem(frames):
    config = small(frames=frames)
    return config, discretise(draw_scene(config, make_plan(config)[0], 0))


def test_a_step_of_too_many_iterations_fails_alike_one_by_one_and_in_batches(monkeypatch):
    pytest.importorskip("torch")
    config, problem = one_problem(2)
    for module in (engines, batch_engine):
        monkeypatch.setattr(module, "MOST_ITERATIONS", 1)
    told = set()
    for engine in (OneByOne("pd", config.tolerance), batch_engine.Batched("cpu", config.tolerance)):
        (found,) = engine.rollouts([problem], 2)
        told.add(found.failure)
    (failure,) = told
    assert failure.startswith("step 1")


def test_a_rollout_of_one_problem_is_that_among_others():
    pytest.importorskip("torch")
    from pdcorrect.data.batch_engine import Batched

    config, problem = one_problem(2)
    engine = Batched("cpu", config.tolerance)
    (alone,), (first, _) = engine.rollouts([problem], 2), engine.rollouts([problem, problem], 2)
    np.testing.assert_array_equal(alone.positions, first.positions)
    np.testing.assert_array_equal(alone.iterations, first.iterations)
    assert alone.failure == ""

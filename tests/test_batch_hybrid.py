"""Corrected steps of many scenes at once: those of each scene alone."""

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import disturbed
from hybrid_samples import (
    CELL,
    PRESSURE,
    TORSION,
    fitted,
    problems,
    shaken,
    silent,
    soft_beam,
)
from pdcorrect.corrector.batch_hybrid import (
    BatchBodies,
    BatchHybrid,
    HybridLayer,
    external_forces,
)
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import preset
from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.hybrid import HybridStepper


def test_a_network_that_gives_nothing_leaves_a_batch_bit_for_bit():
    scenes = problems((3, 1, 1), (2, 2, 1))
    stepper = pc.BatchStepper(scenes)
    hybrid = BatchHybrid(stepper, silent(fitted(scenes)), gate=Gate())
    state = plain = stepper.rest_state()
    for _ in range(3):
        state, plain = hybrid(state).state, stepper(plain).state
        assert torch.equal(state.positions, plain.positions)
        assert torch.equal(state.velocities, plain.velocities)


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
def test_scenes_of_a_batch_are_corrected_as_single_ones_are(element):
    scenes = [pc.discretise(p.scene, element=element) for p in problems((3, 1, 1), (2, 2, 1))]
    names = (*preset("compact").node_features, "previous-correction")
    corrector = fitted(scenes, node_features=names)
    gate = Gate(outside=None)
    stepper = pc.BatchStepper(scenes, 1e-12)
    many = BatchHybrid(stepper, corrector, gate=gate)
    alone = [HybridStepper(pc.ProjectiveDynamics(p, 1e-12), corrector, gate=gate) for p in scenes]
    state, states, previous = stepper.rest_state(), [p.rest_state() for p in scenes], None
    for _ in range(4):
        result = many(state, previous)
        state, previous = result.state, result.correction
        states = [one(s).state for one, s in zip(alone, states, strict=True)]
        assert result.correction.abs().max() > 1e-5 * CELL
        for found, expected in zip(stepper.states(state), states, strict=True):
            size = np.abs(expected.positions - scenes[0].positions.min()).max()
            assert np.abs(found.positions - expected.positions).max() < 1e-9 * size
            speed = np.abs(expected.velocities).max()
            assert np.abs(found.velocities - expected.velocities).max() < 1e-9 * speed


def test_padding_and_flat_order_are_inverse():
    scenes = problems((3, 1, 1), (2, 2, 1))
    stepper = pc.BatchStepper(scenes)
    nodes = BatchBodies(stepper)
    x = torch.arange(3.0 * len(nodes.graph.rest), dtype=torch.float64).reshape(-1, 3)
    assert torch.equal(nodes.flat(nodes.padded(x)), x)
    assert not nodes.padded(x)[~stepper.node_mask].any()
    assert torch.equal(nodes.flat(stepper.rest_state().positions), nodes.graph.rest)


@pytest.mark.parametrize("load", [TORSION, PRESSURE, {**TORSION, "window": [0.0, 0.015]}])
def test_the_network_is_told_all_loads_of_the_step(load):
    problem = pc.discretise(soft_beam(loads=[load]))
    stepper = pc.BatchStepper([problem])
    state = pc.State(disturbed(problem, 0.05), shaken(problem).velocities, 0.01)
    ahead = state.positions + 0.01 * state.velocities
    expected = problem.external_forces(0.01, 0.02, ahead)
    found = external_forces(stepper, stepper.state([state]))[0].numpy()
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("mass", ["lumped", "averaged", "per-node"])
def test_the_network_knows_the_material_that_the_stepper_has_now(mass):
    scenes = [pc.discretise(p.scene, mass=mass) for p in problems((3, 1, 1), (2, 2, 1))]
    stepper = pc.BatchStepper(scenes)
    layer = HybridLayer(stepper, fitted(scenes), through_solver=False)
    nodes, own = BatchBodies(stepper), BodyGraph.of(scenes, dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    young, poisson, density = (
        low + (high - low) * torch.rand(2, 4, generator=random, dtype=torch.float64)
        for low, high in ((1e4, 1e5), (0.1, 0.4), (500.0, 2000.0))
    )
    known = nodes.graph.rest_frames
    stepper.set_material(young, poisson, density)
    changed = [
        p.with_material(*(m[i, : len(p.cells)].numpy() for m in (young, poisson, density)))
        for i, p in enumerate(scenes)
    ]
    expected = BodyGraph.of(changed, dtype=torch.float64)
    late = BatchBodies(stepper)
    for found in (nodes.graph, layer.nodes.graph, late.graph):
        for name in ("mass", "young", "poisson", "density"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name))
            assert not torch.allclose(getattr(found, name), getattr(own, name))
        assert torch.equal(found.rest_frames, own.rest_frames)
    assert nodes.graph is nodes.graph
    assert nodes.graph.rest_frames is known
    stepper.set_material()
    for found in (nodes.graph, layer.nodes.graph, late.graph):
        for name in ("mass", "young", "poisson", "density"):
            assert torch.equal(getattr(found, name), getattr(own, name))


def test_a_batch_of_another_material_is_corrected_as_scenes_of_that_material():
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes)
    stepper = pc.BatchStepper(scenes, 1e-11)
    hybrid = BatchHybrid(stepper, corrector)
    before = hybrid(stepper.rest_state())
    stepper.set_material(young=2e5, density=700.0)
    other = pc.BatchStepper([stepper.problem_now(i) for i in range(2)], 1e-11)
    found, expected = (
        hybrid(stepper.rest_state()),
        BatchHybrid(other, corrector)(other.rest_state()),
    )
    torch.testing.assert_close(found.correction, expected.correction, rtol=1e-6, atol=1e-12)
    size = float(before.correction.abs().max())
    assert float((found.correction - before.correction).abs().max()) > 1e-2 * size

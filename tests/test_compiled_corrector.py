"""Compiled correctors give what torch gives, and know when they may not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numba.core.errors import TypingError

import pdcorrect as pc
from conftest import rotation
from hybrid_samples import TORSION, Prescribed, fitted, soft_beam
from network_samples import body, corrector, moving, turned_and_moved
from pdcorrect.corrector.architecture import preset
from pdcorrect.corrector.compiled import CompiledCorrector, CompiledFeatures, compilable
from pdcorrect.corrector.compiled_network import Groups, product, strips
from pdcorrect.corrector.features import FeatureView, Snapshot
from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.hybrid import HybridStepper

CROSS = {
    "shape": "cross", "cells": [6, 2, 2], "cell_size": 0.05, "arms": 4, "arm_start": 2,
    "arm_width": 2, "arm_length": 2,
}  # fmt: skip
REMEMBERING = (*preset("compact").node_features, "previous-correction")


def views(cells=(3, 2, 1), **changes):
    """Bodies that are bent, less bent, and held nowhere."""
    for seed, strength, clamped in ((0, 0.15, True), (1, 1e-3, True), (2, 0.4, False)):
        bodies = body(cells, seed=seed, clamped=clamped, **changes)
        yield FeatureView(bodies, moving(bodies, seed, strength))


def inverted(bodies):
    """A snapshot with cells turned inside out, and one flat."""
    step = moving(bodies, 3, 0.3)
    proposed = step.proposed.clone()
    cell = bodies.cells[0]
    proposed[cell[:4]], proposed[cell[4:]] = step.proposed[cell[4:]], step.proposed[cell[:4]]
    proposed[bodies.cells[-1]] = proposed[bodies.cells[-1]].mean(dim=0)
    return replace(step, proposed=proposed)


def inputs(made, view):
    """Features of nodes and edges by compiled loops, and their object."""
    bodies = view.bodies
    groups = Groups(bodies.edge_index.numpy(), len(bodies.rest))
    nodes, edges = made.inputs(view)
    x, e = np.zeros((groups.nodes, nodes.shape[1])), np.zeros((groups.edges, edges.shape[1]))
    found = CompiledFeatures(made, bodies, groups, x, e)
    found(view.snapshot)
    return x[: len(nodes)], e[groups.place], found


def relative(found, expected):
    expected = np.asarray(expected)
    return np.abs(np.asarray(found) - expected).max() / np.abs(expected).max()


def both(made, view):
    """The compiled correction and torch's, (n, 3) each."""
    with torch.no_grad():
        return CompiledCorrector(made, view.bodies).of_view(view), made.of_view(view)


# --- products --------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("sizes", [(8, 1, 16), (16, 37, 16), (24, 48, 96), (16, 5, 64)])
def test_products_are_those_of_matrices(sizes, dtype):
    m, a, b = sizes
    rng = np.random.default_rng(0)
    x, factor, bias = (rng.normal(size=s).astype(dtype) for s in ((m, a + 3), (a, b), b))
    out = np.full((m, b + 5), 7.0, dtype)
    product(x, strips(factor), bias, -np.inf, out)
    expected = x[:, :a].astype(float) @ factor + bias
    assert np.abs(out[:, :b] - expected).max() < 50 * a * np.finfo(dtype).eps
    assert (out[:, b:] == 7.0).all()
    product(x, strips(factor), bias, 0.0, out)
    assert np.abs(out[:, :b] - np.maximum(expected, 0.0)).max() < 50 * a * np.finfo(dtype).eps


def test_what_is_not_a_number_stays_in_its_row_of_products():
    x, out = np.ones((8, 2)), np.zeros((8, 16))
    x[3, 1] = np.nan
    product(x, strips(np.ones((2, 16))), np.zeros(16), 0.0, out)
    assert np.array_equal(np.isnan(out).all(axis=1), np.arange(8) == 3)


def test_arrays_that_vectors_would_misread_are_refused():
    x = np.ones((8, 32))
    factor, bias = strips(np.ones((32, 16))), np.zeros(16)
    with pytest.raises(TypingError, match="one type"):
        product(x.astype(np.float32), factor, bias, 0.0, np.empty((8, 16)))
    with pytest.raises(TypingError, match="C-contiguous"):
        product(x, factor, bias, 0.0, np.empty((8, 32))[:, :16])
    assert (x == 1.0).all()


# --- features --------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [10.0, 0.3, None])
def test_features_are_those_of_torch(clip):
    for view in views():
        made = corrector(view=view, clip=clip, node_features=REMEMBERING)
        nodes, edges = made.inputs(view)
        x, e, found = inputs(made, view)
        assert np.abs(x - nodes.numpy()).max() < 1e-10 * np.abs(nodes.numpy()).max()
        assert np.abs(e - edges.numpy()).max() < 1e-10 * np.abs(edges.numpy()).max()
        assert found.deformation == pytest.approx(float(view.deformation), rel=1e-12)
        assert np.abs(found.frames - view.frames.numpy()).max() < 1e-14


@pytest.mark.parametrize(
    "names", [(("strain", "load"), ("turn",)), (("node-type",), ("motion", "rest-edge"))]
)
def test_features_come_in_the_order_that_they_are_named_in(names):
    for nodes, edges in (names, (names[0][::-1], names[1][::-1])):
        view = next(views())
        made = corrector(view=view, node_features=nodes, edge_features=edges)
        expected = made.inputs(view)
        x, e, _ = inputs(made, view)
        assert relative(x, expected[0]) < 1e-10
        assert relative(e, expected[1]) < 1e-10


def test_how_far_outside_the_training_data_a_body_is_agrees_with_torch():
    for view in views():
        other = body(seed=7)
        made = corrector(view=FeatureView(other, moving(other, 7)), node_features=REMEMBERING)
        compiled = CompiledCorrector(made, view.bodies)
        compiled.of_view(view)
        found = compiled.score(view)
        assert found[0] > 0.0
        torch.testing.assert_close(found, made.score(view), rtol=1e-12, atol=0.0)
        made.envelope.shape_high -= 3e4  # of the body, too, as it is then
        assert compiled.score(view) > 10.0 + found
        assert torch.equal(compiled.rest_score(view.bodies), made.rest_score(view.bodies))


def test_inputs_that_are_not_numbers_are_outside_the_training_data():
    view = next(views())
    made = corrector(view=view)
    view.snapshot.velocities[4, 0] = np.nan
    for answers in (made, CompiledCorrector(made, view.bodies)):
        anew = FeatureView(view.bodies, view.snapshot)
        assert answers.score(anew).item() == np.inf


# --- corrections -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mlp_layers": 3},
        {"mlp_layers": 4},
        {"layers": 1},
        {"width": 20},
        {"width": 2},
        {"clip": None},
        {"momentum_neutral": True},
        {"node_features": REMEMBERING},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_corrections_are_those_of_torch(changes, dtype):
    for view in views():
        made = corrector(view=view, dtype=dtype, **changes)
        found, expected = both(made, view)
        assert found.dtype == expected.dtype == torch.float64
        assert relative(found, expected) < (1e-5 if dtype == torch.float32 else 1e-12)
        assert not found[~view.bodies.free].any()


@pytest.mark.parametrize("name", ["compact", "equivariant"])
def test_presets_are_those_of_torch_on_a_bent_cross(name):
    problem = pc.discretise(
        pc.Scene(
            body=CROSS, material={"young": 2e5, "poisson": 0.35, "density": 1e3},
            time={"step": 0.01, "frames": 1}, clamps=[{"region": {"plane": "x", "at": 0.0}}],
        )
    )  # fmt: skip
    bodies = HybridStepper(pc.ProjectiveDynamics(problem), corrector()).bodies
    view = FeatureView(bodies, moving(bodies))
    config = preset(name)
    made = corrector(name, view, dtype=torch.float32, layers=config.layers, width=config.width)
    found, expected = both(made, view)
    assert relative(found, expected) < 1e-5


def test_inverted_and_flat_cells_are_seen_and_corrected_as_by_torch():
    bodies = body((3, 1, 1))
    view = FeatureView(bodies, inverted(bodies))
    assert (torch.linalg.det(view.gradients) < 0.0).any()
    made = corrector(node_features=REMEMBERING)
    nodes, edges = made.inputs(view)
    x, e, _ = inputs(made, view)
    assert relative(x, nodes) < 1e-10
    assert relative(e, edges) < 1e-10
    found, expected = both(corrector(dtype=torch.float32), FeatureView(bodies, inverted(bodies)))
    assert relative(found, expected) < 1e-5


def test_a_body_that_moves_rigidly_is_not_corrected_at_all():
    bodies = body(clamped=False)
    R, shift = torch.tensor(rotation(4)), torch.tensor([0.3, -0.2, 1.0])
    there = bodies.rest @ R.T + shift
    still = torch.zeros_like(there)
    compiled = CompiledCorrector(corrector(dtype=torch.float32), bodies)
    for proposed in (bodies.rest, there):
        found = compiled.of_view(FeatureView(bodies, Snapshot(bodies.rest, still, proposed, still)))
        assert not found.any()


def test_corrections_turn_with_the_scene():
    bodies = body()
    made = corrector(dtype=torch.float32)
    R = rotation(5)
    step = moving(bodies)
    turned_bodies, turned_step = turned_and_moved(bodies, step, R, [0.5, -1.0, 2.0])
    here = CompiledCorrector(made, bodies).of_view(FeatureView(bodies, step))
    there = CompiledCorrector(made, turned_bodies).of_view(FeatureView(turned_bodies, turned_step))
    assert relative(there, here.numpy() @ R.T) < 1e-5


def test_numbers_of_threads_do_not_change_corrections():
    import numba

    view = next(views((6, 3, 3)))
    compiled = CompiledCorrector(corrector(view=view, dtype=torch.float32), view.bodies)
    before, found = numba.get_num_threads(), []
    try:
        for count in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(count)
            found.append(compiled.of_view(FeatureView(view.bodies, view.snapshot)))
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(one, found[0]) for one in found)


def test_answers_do_not_depend_on_what_was_asked_before():
    bodies = body()
    compiled = CompiledCorrector(corrector(dtype=torch.float32), bodies)
    first = FeatureView(bodies, moving(bodies, 0))
    before = compiled.of_view(first)
    compiled.of_view(FeatureView(bodies, moving(bodies, 1)))
    assert torch.equal(compiled.of_view(first), before)


# --- what may change -------------------------------------------------------------------------


def step_of(made):
    optimiser = torch.optim.SGD(made.network.parameters(), lr=0.1)
    for weight in made.network.parameters():
        weight.grad = torch.ones_like(weight)
    optimiser.step()


def other_weights(made):
    made.load_state_dict(corrector(seed=1, dtype=torch.float32).state_dict())


def another_layer(made):
    torch.manual_seed(3)
    made.network.decoder[-1] = torch.nn.Linear(16, 3)


def another_weight(made):
    made.network.decoder[-1].weight = torch.nn.Parameter(torch.ones(3, 16))


def other_data(made):
    made.network.decoder[-1].bias.data = torch.ones(3)


def other_normaliser(made):
    made.normaliser.output_scale.mul_(2.0)


def other_clip(made):
    made.config = made.config.model_copy(update={"clip": 0.5})


@pytest.mark.parametrize(
    "change",
    [
        step_of, other_weights, another_layer, another_weight, other_data, other_normaliser,
        other_clip,
    ],
)  # fmt: skip
def test_changed_correctors_are_noticed(change):
    bodies = body()
    made = corrector(dtype=torch.float32)
    compiled, view = CompiledCorrector(made, bodies), FeatureView(bodies, moving(bodies))
    before = compiled.of_view(view)
    change(made)
    with torch.no_grad():
        expected = made.of_view(FeatureView(bodies, view.snapshot))
    assert relative(compiled.of_view(view), expected) < 1e-5
    assert relative(before, expected) > 1e-3


def test_a_change_of_precision_is_noticed():
    bodies = body()
    made = corrector(dtype=torch.float32)
    compiled, view = CompiledCorrector(made, bodies), FeatureView(bodies, moving(bodies))
    made.network.double()
    with torch.no_grad():
        assert relative(compiled.of_view(view), made.of_view(view)) < 1e-12


@pytest.mark.parametrize(
    "changes",
    [
        {"node_features": ("strain", "velocity")},
        {"edge_features": ("position",)},
        {"output": "world"},
        {"kind": Prescribed},
    ],
    ids=str,
)
def test_torch_answers_where_loops_cannot(changes):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    made = fitted([problem], **changes)
    made.answer = np.zeros_like(problem.positions)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), made)
    assert not hybrid.compiled
    assert hybrid.describe()["corrector_code"] == "torch"
    assert hybrid(problem.rest_state()).status.ok


def test_only_single_bodies_in_double_precision_are_compiled():
    """The question draws no random numbers."""
    made, bodies = corrector(), body()
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    assert compilable(made, bodies)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert not compilable(made, bodies.to(dtype=torch.float32))
    made.network.half()
    assert not compilable(made, bodies)


def _tanh(network):
    network.node_encoder[1] = torch.nn.Tanh()


def _dropout(network):
    network.decoder.insert(1, torch.nn.Dropout(0.5))


def _epsilon(network):
    network.rounds[0].node[-1].eps = 1e-3


def _hooked(network):
    network.decoder.register_forward_hook(lambda *_: None)


@pytest.mark.parametrize("change", [_tanh, _dropout, _epsilon, _hooked])
def test_networks_that_were_changed_are_not_compiled(change):
    made = corrector()
    assert compilable(made, body())
    change(made.network)
    assert not compilable(made, body())


def test_edges_receive_in_groups_of_their_own():
    bodies = body((5, 3, 2))
    index = bodies.edge_index.numpy()
    groups = Groups(index, len(bodies.rest))
    assert len(set(groups.place)) == index.shape[1]
    assert np.array_equal(groups.sender[groups.place], index[1])
    for n in range(len(bodies.rest)):
        rows = np.arange(groups.first[n], groups.last[n])
        assert np.array_equal(rows, groups.place[index[0] == n])
    assert not (groups.first[::16] % 8).any()


# --- in steps --------------------------------------------------------------------------------


@pytest.mark.parametrize("gate", [None, Gate(), Gate(outside=0.0), Gate(outside=None, energy=0.0)])
def test_steps_and_decisions_are_those_of_torch(gate, monkeypatch):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    made = fitted([problem], node_features=REMEMBERING)
    made.network.float()
    compiled = HybridStepper(pc.ProjectiveDynamics(problem, 1e-12), made, gate=gate)
    monkeypatch.setattr("pdcorrect.corrector.hybrid.compilable", lambda *_: False)
    plain = HybridStepper(pc.ProjectiveDynamics(problem, 1e-12), made, gate=gate)
    assert compiled.compiled
    assert not plain.compiled
    state = problem.rest_state()
    for _ in range(4):
        found, expected = compiled(state), plain(state)
        assert found.stats["gate"] == expected.stats["gate"]
        assert found.stats["correction"] == pytest.approx(expected.stats["correction"], rel=1e-5)
        moved = np.abs(expected.state.positions - problem.positions).max()
        assert np.abs(found.state.positions - expected.state.positions).max() < 1e-5 * moved
        state = expected.state


def test_preparing_copies_weights_that_were_written_behind_torch():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    made = fitted([problem])
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), made)
    for weight in made.network.decoder[-1].parameters():
        weight.data.zero_()
    assert hybrid.prepare()(problem.rest_state()).stats["correction"] == 0.0

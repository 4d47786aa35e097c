"""Symmetries, derivatives, network and cost of the corrector."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from torch.utils.flop_counter import FlopCounterMode  # noqa: E402

import network_samples as samples  # noqa: E402
from block_meshes import o_grid  # noqa: E402
from conftest import rotation  # noqa: E402
from network_samples import SIZE, STEP, tensor  # noqa: E402
from pdcorrect.corrector.corrector import (  # noqa: E402  # noqa: E402
    MLP,
    PRESETS,
    Corrector,
    MeshGraphNetwork,
    MessageLayer,
    preset,
    without_momentum,
)
from pdcorrect.corrector.features import (  # noqa: E402
    FeatureView,
    Snapshot,
)


def largest(x):
    return float(x.detach().abs().max())


def sample(**options):
    bodies = samples.body(**options)
    return bodies, samples.moving(bodies)


# --- symmetry of the correction ----------------------------------------------------------------


SHIFT, EYE = (0.7, -0.4, 0.9), np.eye(3)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("name", ["equivariant", "compact"])
def test_a_turned_scene_gets_the_turned_correction(name, neutral, dtype, bound):
    model = samples.corrector(name, dtype=dtype, momentum_neutral=neutral)
    bodies, step = sample()
    with torch.no_grad():
        expected = model(bodies, step)
        size = largest(expected)
        assert size > 1e-3 * SIZE
        for R, shift in ((rotation(), (0, 0, 0)), (EYE, SHIFT), (rotation(8), SHIFT)):
            found = model(*samples.turned_and_moved(bodies, step, R, shift))
            assert largest(found - expected @ tensor(R).T) < bound * size
        *other, old = samples.renumbered(bodies, step)
        assert largest(model(*other) - expected[old]) < bound * size
    assert expected.dtype == torch.float64


def test_the_thesis_keeps_its_correction_when_moved_or_renumbered_but_not_when_turned():
    model = samples.corrector("thesis")
    bodies, step = sample()
    expected = model(bodies, step)
    size = largest(expected)
    moved = model(*samples.turned_and_moved(bodies, step, EYE, SHIFT))
    assert largest(moved - expected) < 1e-10 * size
    *other, old = samples.renumbered(bodies, step)
    assert largest(model(*other) - expected[old]) < 1e-10 * size
    R = rotation()
    turned = model(*samples.turned_and_moved(bodies, step, R, (0, 0, 0)))
    assert largest(turned - expected @ tensor(R).T) > 0.1 * size


# --- what holds for any weights ----------------------------------------------------------------


def resting(bodies):
    still = torch.zeros_like(bodies.rest)
    return Snapshot(bodies.rest, still, bodies.rest, still)


def flying(bodies, spin=(3.0, -2.0, 5.0)):
    """A rigid body that turns and flies fast, far from where it was."""
    R, shift, velocity = tensor(rotation()), tensor([2.0, 3.0, -1.0]), tensor([5.0, -4.0, 3.0])
    x = bodies.rest @ R.T + shift
    turn = torch.linalg.matrix_exp(STEP * torch.linalg.cross(
        tensor(spin).expand(3, 3), torch.eye(3, dtype=torch.float64)).T)  # fmt: skip
    speed = velocity + torch.linalg.cross(tensor(spin).expand(len(x), 3), x)
    pull = 9.81 * bodies.mass[:, None] * tensor([0.0, 0.0, -1.0])
    return Snapshot(x, speed, x @ turn.T + STEP * velocity, pull)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("motion", [resting, flying])
@pytest.mark.parametrize("name", ["equivariant", "compact"])
def test_bodies_that_are_not_deformed_are_not_corrected(name, motion, dtype):
    model = samples.corrector(name, dtype=dtype)
    for mesh in (None, o_grid()):
        bodies = samples.body(clamped=False, mesh=mesh)
        assert largest(bodies.rest - motion(bodies).proposed) > 1.0 or motion is resting
        assert torch.equal(model(bodies, motion(bodies)), torch.zeros_like(bodies.rest))


@pytest.mark.parametrize("name", list(PRESETS))
def test_held_components_are_not_corrected(name):
    bodies, step = sample()
    bodies.free[-1, 1] = False
    correction = samples.corrector(name)(bodies, step)
    assert not correction[~bodies.free].any()
    assert (correction[bodies.free] != 0).all()


def momenta(bodies, step, correction):
    """Of the wholly free nodes."""
    impulse = bodies.mass[:, None] * correction * bodies.free.all(dim=1, keepdim=True)
    return impulse.sum(0), torch.linalg.cross(step.proposed, impulse).sum(0)


@pytest.mark.parametrize("output", ["frame", "world"])
@pytest.mark.parametrize("held", ["nothing", "an end", "a component", "components"])
def test_neutral_corrections_have_no_momenta(held, output):
    bodies = samples.body((4, 2, 1), clamped=held == "an end")
    if held == "a component":
        bodies.free[3, 1] = False
    if held == "components":
        bodies.free[:10, 2] = False
    step = samples.moving(bodies)
    found = {}
    for neutral in (True, False):
        model = samples.corrector(momentum_neutral=neutral, output=output)
        found[neutral] = model(bodies, step)
    size = largest(found[False])
    for before, after in zip(
        *(momenta(bodies, step, found[k]) for k in (False, True)), strict=True
    ):
        assert largest(before) > 1e-2 * size * SIZE
        assert largest(after) < 1e-11 * largest(before)
    assert not found[True][~bodies.free].any()
    assert torch.equal(*(found[k][~bodies.free.all(dim=1)] for k in (False, True)))
    again = without_momentum(FeatureView(bodies, step), found[True])
    assert largest(again - found[True]) < 1e-10 * size


def test_a_neutral_correction_differs_by_a_rigid_motion_of_the_free_nodes():
    bodies, step = sample()
    x = samples.moving(bodies, seed=4).correction
    motion = (x - without_momentum(FeatureView(bodies, step), x))[bodies.free.all(1)]
    r = step.proposed[bodies.free.all(1)]
    along = (motion[:, None] - motion) * (r[:, None] - r)
    assert largest(along.sum(dim=2)) < 1e-12 * SIZE * largest(motion) * 100
    assert largest(motion) > 1e-4 * SIZE


@pytest.mark.parametrize("free", [0, 1, 2])
def test_bodies_with_hardly_a_free_node_keep_finite_corrections(free):
    bodies, step = sample(clamped=False)
    bodies.free[free:] = False
    bodies.free[free:, 0] = True
    found, plain = (
        samples.corrector(momentum_neutral=neutral)(bodies, step) for neutral in (True, False)
    )
    assert torch.equal(found[free:], plain[free:])
    assert all(largest(x) > 1e-4 * SIZE for x in plain)
    before, after = momenta(bodies, step, plain), momenta(bodies, step, found)
    for one, other in zip(before, after, strict=True):
        assert largest(other) <= 1e-11 * largest(one)
    if free == 1:
        assert not found[0].any()


@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("name", list(PRESETS))
def test_bodies_in_one_graph_do_not_see_each_other(name, neutral):
    pairs = [sample(), sample(cells=(2, 2, 2), seed=3, size=0.25), sample(cells=(1, 1, 1), seed=7)]
    model = samples.corrector(name, momentum_neutral=neutral)
    bodies = samples.joined(*(b for b, _ in pairs))
    together = model(bodies, samples.together(*(s for _, s in pairs)))
    alone = torch.cat([model(b, s) for b, s in pairs])
    assert largest(together - alone) < 1e-12 * largest(alone)


# --- derivatives -------------------------------------------------------------------------------


def gradients(model, bodies, step):
    positions = step.proposed.clone().requires_grad_()
    found = model(bodies, replace(step, proposed=positions))
    weights = torch.arange(found.numel(), dtype=found.dtype).reshape(found.shape).sin()
    inputs = [positions, *model.network.parameters()]
    return torch.autograd.grad((found * weights).sum(), inputs)  # all of them are used


@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("motion", [resting, flying])
@pytest.mark.parametrize("name", list(PRESETS))
def test_derivatives_are_finite_where_nothing_is_deformed(name, motion, neutral):
    model = samples.corrector(name, momentum_neutral=neutral)
    bodies = samples.body(clamped=False)
    for gradient in gradients(model, bodies, motion(bodies)):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("name", list(PRESETS))
def test_derivatives_are_finite_where_cells_are_collapsed(name):
    model = samples.corrector(name)
    bodies, step = sample()
    for squashed in (torch.zeros_like(step.proposed), step.proposed * tensor([1.0, 1.0, 0.0])):
        for gradient in gradients(model, bodies, replace(step, proposed=squashed)):
            assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("name", list(PRESETS))
def test_derivatives_by_positions_are_those_of_differences(name):
    model = samples.corrector(name, momentum_neutral=True)
    bodies, step = sample(cells=(2, 1, 1))
    direction = samples.moving(bodies, seed=9).velocities

    def along(t):
        return model(bodies, replace(step, proposed=step.proposed + t * direction))

    eps = 1e-6 * SIZE
    _, exact = torch.autograd.functional.jvp(along, torch.zeros((), dtype=torch.float64),
                                             torch.ones((), dtype=torch.float64))  # fmt: skip
    with torch.no_grad():
        slope = (along(eps) - along(-eps)) / (2 * eps)
    assert largest(slope - exact) < 1e-4 * largest(exact)  # ReLU has kinks
    assert largest(exact) > 0.0


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
def test_bodies_first_used_without_derivatives_serve_with_them_later(mode):
    model = samples.corrector()
    bodies, step = sample()
    expected = gradients(model, *sample())
    with mode():
        model(bodies, step)
    for _ in range(2):
        for one, other in zip(gradients(model, bodies, step), expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-14)


# --- network -----------------------------------------------------------------------------------


def apply(linears, norm, x):
    """ReLU networks by hand."""
    for i, (weight, bias) in enumerate(linears):
        x = x @ weight.T + bias
        if i < len(linears) - 1:
            x = x.clamp_min(0.0)
    mean = x.mean(dim=1, keepdim=True)
    variance = (x - mean).square().mean(dim=1, keepdim=True)
    return (x - mean) / (variance + 1e-5).sqrt() * norm[0] + norm[1]


def parts(module):
    linears = [(m.weight, m.bias) for m in module if isinstance(m, torch.nn.Linear)]
    norms = [(m.weight, m.bias) for m in module if isinstance(m, torch.nn.LayerNorm)]
    return linears, norms[0]


@pytest.mark.parametrize("layers", [2, 4])
def test_a_round_is_the_textbook_formula(layers):
    torch.manual_seed(0)
    layer, width = MessageLayer(6, layers).double(), 6
    for p in layer.parameters():
        torch.nn.init.normal_(p, std=0.5)
    bodies = samples.body()
    to, start = bodies.edge_index
    x = torch.randn(len(bodies.rest), width, dtype=torch.float64)
    e = torch.randn(len(to), width, dtype=torch.float64)
    first = torch.cat([layer.of_edge.weight, layer.of_receiver.weight, layer.of_sender.weight], 1)
    rest, edge_norm = parts(layer.edge_rest)
    edges = e + apply(
        [(first, layer.of_edge.bias), *rest], edge_norm, torch.cat([e, x[to], x[start]], dim=1)
    )
    sums = torch.zeros_like(x)
    for i, receiver in enumerate(to.tolist()):
        sums[receiver] += edges[i]
    nodes = x + apply(*parts(layer.node), torch.cat([x, sums], dim=1))
    found = layer(x, e, bodies.edge_index)
    assert largest(found[0] - nodes) < 1e-12
    assert largest(found[1] - edges) < 1e-12


@pytest.mark.parametrize("layers", [2, 3, 4])
def test_an_mlp_has_relu_between_its_layers_and_a_norm_at_the_end(layers):
    kinds = [type(m) for m in MLP(3, 8, 5, layers, True)]
    middle = [torch.nn.Linear, torch.nn.ReLU] * (layers - 1)
    assert kinds == [*middle, torch.nn.Linear, torch.nn.LayerNorm]
    assert [type(m) for m in MLP(3, 8, 5, layers, False)] == kinds[:-1]
    layer, width = MessageLayer(64, layers), 64  # its first map is one from all three
    bound = (3 * width) ** -0.5
    for part in (layer.of_edge.weight, layer.of_receiver.weight, layer.of_sender.weight,
                 layer.of_edge.bias):  # fmt: skip
        assert 0.9 * bound < largest(part) <= bound


def test_norms_are_at_the_end_of_all_networks_but_the_decoder():
    network = MeshGraphNetwork(4, 5, layers=2, width=8, mlp_layers=3)
    for module in (network.node_encoder, network.edge_encoder, network.rounds[0].node,
                   network.rounds[1].node, *(r.edge_rest for r in network.rounds)):  # fmt: skip
        assert sum(isinstance(m, torch.nn.LayerNorm) for m in module) == 1
        assert isinstance(module[-1], torch.nn.LayerNorm)
    assert not any(isinstance(m, torch.nn.LayerNorm) for m in network.decoder)
    assert len({id(r) for r in network.rounds}) == 2


@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_a_node_is_reached_from_as_many_edges_as_there_are_rounds(rounds):
    bodies = samples.body((5, 1, 1))
    torch.manual_seed(0)
    network = MeshGraphNetwork(1, 5, layers=rounds, width=8, mlp_layers=2).double()
    x = torch.zeros(len(bodies.rest), 1, dtype=torch.float64)
    e = torch.zeros(bodies.edge_index.shape[1], 5, dtype=torch.float64)
    before = network(x, e, bodies.edge_index)
    x[0] = 1.0
    reached = (network(x, e, bodies.edge_index) != before).any(dim=1)
    distance = torch.full((len(x),), 99)
    distance[0] = 0
    for step in range(1, 9):
        near = torch.zeros_like(reached)
        near[bodies.edge_index[0][distance[bodies.edge_index[1]] == step - 1]] = True
        distance[near & (distance == 99)] = step
    assert torch.equal(reached, distance <= rounds)


# --- cost --------------------------------------------------------------------------------------


@pytest.fixture
def cost(monkeypatch):
    """The benchmark's module that counts operations."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    return importlib.import_module("network_cost")


def test_the_thesis_has_the_parameters_of_its_description():
    w, L = 128, 4

    def mlp(inputs, outputs, norm):
        maps = inputs * w + w + (L - 2) * (w * w + w) + w * outputs + outputs
        return maps + (2 * outputs if norm else 0)

    nodes, edges = 1 + 1 + 3 + 3 + 2, 4 + 4
    by_hand = mlp(nodes, w, True) + mlp(edges, w, True) + mlp(w, 3, False)
    by_hand += 15 * (mlp(3 * w, w, True) + mlp(2 * w, w, True))
    model = Corrector(PRESETS["thesis"])
    assert sum(p.numel() for p in model.parameters()) == by_hand == 2_878_467


CONFIGS = {**PRESETS, "small": preset("thesis", layers=3, width=20)}


@pytest.mark.parametrize("name", list(CONFIGS))
def test_operations_are_those_counted(cost, name):
    config = CONFIGS[name]
    model = Corrector(config)
    bodies, step = sample()
    samples.fit(model, FeatureView(bodies, step))
    nodes, edges = model.inputs(FeatureView(bodies, step))
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model.network(nodes.float(), edges.float(), bodies.edge_index)
    n, E = len(bodies.rest), bodies.edge_index.shape[1]
    assert cost.flops(config, n, E) == counter.get_total_flops()

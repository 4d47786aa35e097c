"""The normaliser, graphs of bodies, and settings of correctors."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")


import network_samples as samples  # noqa: E402
from block_meshes import o_grid  # noqa: E402
from conftest import beam, problem_on  # noqa: E402
from network_samples import SIZE, tensor  # noqa: E402
from pdcorrect import discretise  # noqa: E402
from pdcorrect.corrector import features  # noqa: E402
from pdcorrect.corrector.bodies import BodyGraph  # noqa: E402
from pdcorrect.corrector.corrector import PRESETS, CorrectorConfig, preset  # noqa: E402
from pdcorrect.corrector.features import (  # noqa: E402
    NODE_FEATURES,
    FeatureView,
)
from pdcorrect.corrector.normaliser import (  # noqa: E402
    Envelope,
    Normaliser,
    RunningMoments,
)
from pdcorrect.data.reader import TrajectoryDataset  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from reader_samples import shard, write  # noqa: E402


def largest(x):
    return float(x.detach().abs().max())


def sample(**options):
    bodies = samples.body(**options)
    return bodies, samples.moving(bodies)


# --- normaliser --------------------------------------------------------------------------------


def test_moments_that_come_in_parts_are_those_of_the_whole():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(500, 3)) * [1.0, 1e-3, 1e6] + [5.0, 1e3, -2.0]
    moments = RunningMoments()
    for part in np.split(values, [0, 1, 4, 100, 480]):
        moments.add(tensor(part))
    assert moments.count == 500
    for found, expected in (
        (moments.mean, values.mean(0)), (moments.square, (values**2).mean(0)),
        (moments.deviation, values.std(0)),
    ):  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert torch.equal(moments.low, tensor(values.min(0)))
    assert torch.equal(moments.high, tensor(values.max(0)))


def fitted(**columns):
    """A normaliser of features given by their values, and targets of mean square 4."""
    normaliser = Normaliser({name: x.shape[1] for name, x in columns.items()}, {})
    moments = {}
    for name, x in columns.items():
        moments[name] = RunningMoments()
        for part in x.split(7):
            moments[name].add(part)
    target = RunningMoments()
    target.add(torch.tensor([[2.0], [-2.0]]))
    normaliser.fit(moments, target)
    return normaliser


def excess(columns, values):
    """How far values of features lie outside of those in columns."""
    normaliser, envelope = (
        fitted(**columns),
        Envelope({n: x.shape[1] for n, x in columns.items()}, {}),
    )
    seen = {name: RunningMoments() for name in columns}
    for name, moments in seen.items():
        moments.add(columns[name])
    envelope.fit(seen)
    x = torch.cat(list(values.values()), dim=1)
    return envelope.excess(tuple(values), x, *normaliser.rows(values))


def test_normalised_features_have_zero_mean_and_unit_deviation():
    rng = np.random.default_rng(1)
    a, b = tensor(rng.normal(3.0, 2.0, (100, 2))), tensor(rng.normal(-1e5, 10.0, (100, 1)))
    normaliser = fitted(a=a, b=b)
    assert normaliser.fitted
    assert float(normaliser.output_scale) == 2.0
    found = normaliser.joined({"a": a, "b": b}, None)
    assert largest(found.mean(0)) < 1e-9
    assert largest(found.std(0, correction=0) - 1.0) < 1e-9
    assert not Normaliser({"a": 1}, {}).fitted
    stored = tensor((1.0 + 1e-7 * rng.normal(size=1000))[:, None])  # whose rounding does not grow
    assert largest(fitted(a=stored).joined({"a": stored}, None)) < 1e-6
    types = tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # which stay as they are
    assert torch.equal(fitted(**{"node-type": types}).joined({"node-type": types}, None), types)


@pytest.mark.parametrize("constant", [0.1, -3e5, 0.01, 1e-12, 0.0])
def test_components_that_never_change_become_zero_and_are_known_to_a_hundredth(constant):
    x = torch.full((1000, 1), constant, dtype=torch.float64)
    normaliser = fitted(a=x)
    assert largest(normaliser.joined({"a": x}, None)) < 1e-12
    other = normaliser.joined({"a": 2 * x}, None)
    assert largest(other) == pytest.approx(1.0 if constant else 0.0)
    unit = 0.01 * (abs(constant) or 1.0)
    near = constant + unit * tensor([[0.0], [2.0], [-60.0]])
    assert excess({"a": x}, {"a": near}).flatten().tolist() == pytest.approx([0.0, 2.0, 60.0])


def averaged(*rows):
    """An envelope of two components that has seen bodies with these mean inputs."""
    envelope, averages = Envelope({"a": 2}, {"b": 3}), RunningMoments()
    averages.add(tensor(rows))
    envelope.fit({"average": averages})
    return envelope


def test_out_of_distribution_scores_of_bodies_are_deviations_of_their_mean_inputs():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(4000, 2)) * [1.0, 3.0] + [5.0, -2.0]
    envelope = averaged(*rows)
    found = envelope.average_excess(tensor([[5.0, -2.0], [7.0, -2.0], [5.0, 10.0], [9.0, -11.0]]))
    expected = [[0.0, 0.0], [2.0, 0.0], [0.0, 4.0], [4.0, 3.0]]
    np.testing.assert_allclose(found.numpy(), expected, rtol=0.12, atol=0.1)
    assert Envelope({"a": 1}, {}).average_excess(tensor([[0.0]])).isposinf().all()
    cancelled = averaged([0.0, 0.0], [1e-9, -1e-9])
    assert largest(cancelled.average_excess(tensor([[0.1, -0.3]])) - tensor([[1.0, 3.0]])) < 1e-6
    rows = np.zeros((1000, 2))  # with a rare extreme
    rows[0] = 30.0, -7.0
    envelope = averaged(*rows)
    assert largest(envelope.average_excess(tensor(rows[:1])) - 3.5) < 1e-9
    beyond = envelope.average_excess(tensor([[36.0, 0.0], [-6.0, 0.0]]))
    assert 4.1 < float(beyond[0, 0]) < 4.3  # by a fifth
    assert float(beyond[1, 0]) > 6.0  # on the other side, where none was


def test_mean_inputs_of_further_data_widen_the_range():
    envelope = averaged([0.0, 0.0], [1.0, 1.0], [0.5, 0.2])
    further, averages = tensor([[9.0, 0.5]]), RunningMoments()
    averages.add(further)
    assert float(envelope.average_excess(further)[0, 0]) > 10.0
    envelope.widen({"average": averages})
    assert float(envelope.average_excess(further)[0, 0]) <= 3.5 + 1e-12
    assert float(envelope.average_excess(-further)[0, 0]) > 10.0


def test_inputs_bend_towards_the_clip():
    x = tensor(np.linspace(-1.0, 1.0, 50)[:, None])
    normaliser = fitted(a=x)
    far = normaliser.joined({"a": tensor([[1e6], [-1e6], [0.0]])}, 5.0)
    assert largest(far - tensor([[5.0], [-5.0], [0.0]])) < 1e-14
    plain, bent = (normaliser.joined({"a": x}, clip) for clip in (None, 5.0))
    assert largest(bent - 5.0 * torch.tanh(plain / 5.0)) < 1e-14
    assert (bent.diff(dim=0) > 0).all()


def test_excess_counts_deviations_outside_the_range_seen_of_which_the_farthest_is_3_5_at_most():
    x = tensor([[0.0, -1.0], [4.0, 1.0]])  # deviations 2 and 1
    found = excess({"a": x}, {"a": tensor([[2.0, 0.0], [-3.0, 1.0], [5.0, -1.5], [4.0, 3.0]])})
    assert torch.equal(found, tensor([[0.0, 0.0], [1.5, 0.0], [0.5, 0.5], [0.0, 2.0]]))
    kicks = torch.zeros(100, 1).double()
    kicks[0] = 7.0  # ten deviations from the mean
    unit = (7.0 - 0.07) / 3.5
    usual = float(kicks.std(correction=0))
    assert usual < 0.4 * unit
    found = excess({"a": kicks}, {"a": tensor([[7.0 + unit], [-usual]])})
    assert found.flatten().tolist() == pytest.approx([1.0, 1.0])


def test_a_normaliser_needs_values_to_be_fitted_to():
    full, empty, zero = RunningMoments(), RunningMoments(), RunningMoments()
    full.add(torch.ones(3, 1))
    empty.add(torch.ones(0, 1))
    zero.add(torch.zeros(3, 1))
    for found, target, told in (
        ({}, full, "features a"),
        ({"a": empty}, full, "features a"),
        ({"a": full}, empty, "targets"),
        ({"a": full}, zero, "targets"),
    ):
        normaliser = Normaliser({"a": 1}, {})
        with pytest.raises(InputError, match=told):
            normaliser.fit(found, target)
        assert not normaliser.fitted


@pytest.mark.parametrize("name", list(PRESETS))
def test_targets_are_what_gives_the_correction_back(name):
    bodies, step = sample()
    view, model = FeatureView(bodies, step), samples.corrector(name)
    correction = samples.moving(bodies, seed=4).correction
    x = model.target(view, correction) / model.normaliser.output_scale
    assert largest(model.in_metres(view, x) - correction) < 1e-14
    assert largest(correction) > 0.001 * SIZE


# --- graphs of problems ------------------------------------------------------------------------


def test_a_graph_of_problems_has_what_each_one_has():
    scenes = [beam((3, 2, 1)), beam((2, 2, 2), cell_size=0.03, material={"young": 2e6})]
    problems = [discretise(scene) for scene in scenes]
    graph = BodyGraph.of(problems, dtype=torch.float64)
    assert graph.bodies == 2
    first = 0
    for i, problem in enumerate(problems):
        here = graph.graph == i
        n = len(problem.positions)
        assert torch.equal(here.nonzero()[:, 0], torch.arange(first, first + n))
        assert torch.equal(graph.rest[here], tensor(problem.positions))
        assert torch.equal(graph.free[here], tensor(problem.free))
        assert torch.equal(graph.mass[here], tensor(problem.mass))
        assert torch.allclose(graph.young[here], tensor(problem.materials.young[:1]))
        cells = graph.cells[(graph.graph[graph.cells] == i).all(dim=1)]
        assert torch.equal(cells - first, tensor(problem.cells.astype(np.int64)))
        edges = graph.edge_index[:, graph.graph[graph.edge_index[0]] == i]
        assert torch.equal(edges - first, BodyGraph.of([problem]).edge_index)
        first += n
    assert torch.equal(graph.graph[graph.edge_index[0]], graph.graph[graph.edge_index[1]])
    assert graph.cell_size.tolist() == pytest.approx([0.02, 0.03])
    assert graph.time_step.tolist() == [0.01, 0.01]
    assert BodyGraph.of(problems, 0.5).time_step.tolist() == [0.5, 0.5]
    single = graph.to(dtype=torch.float32)
    assert single.rest.dtype == single.cell_size.dtype == torch.float32
    assert single.edge_index.dtype == torch.int64
    assert single.free.dtype == torch.bool


def test_sums_and_means_are_of_each_body():
    graph = samples.joined(samples.body(), samples.body((1, 1, 1)))
    x = torch.arange(2.0 * len(graph.rest)).reshape(-1, 2)
    n = int((graph.graph == 0).sum())
    expected = torch.stack([x[:n].sum(0), x[n:].sum(0)])
    assert torch.equal(graph.node_sums(x), expected)
    assert torch.allclose(graph.body_means(x), expected / tensor([[n], [8.0]]).float())
    assert torch.equal(graph.by_node(expected)[n - 1 : n + 1], expected)


def test_a_batch_of_samples_is_the_same_graph(tmp_path):
    write(tmp_path, [shard(), shard(1, cells=(2, 2, 2))])
    dataset = TrajectoryDataset(tmp_path, "training", dtype=torch.float64)
    batch = dataset.batch([0, 15])
    graph = BodyGraph.of_batch(batch)
    assert graph.bodies == 2
    assert torch.equal(graph.rest, batch.rest)
    assert torch.equal(graph.cells, batch.cells)
    assert largest(graph.cell_size - 0.1) < 1e-12
    assert largest(graph.time_step - 0.02) < 1e-12
    apart = [BodyGraph.of_batch(dataset.batch([i])) for i in (0, 15)]
    assert torch.equal(samples.joined(*apart).edge_index, graph.edge_index)


def test_cell_sizes_of_distorted_bodies_are_roots_of_mean_volumes(tmp_path):
    problem = problem_on(o_grid())
    bodies = samples.body(mesh=problem.mesh)

    class Batch:
        num_graphs, batch, time_step = 1, bodies.graph, bodies.time_step
        edge_index, cells = bodies.edge_index, bodies.cells
        rest, free, mass, young = bodies.rest, bodies.free, bodies.mass, bodies.young
        poisson, density = bodies.poisson, bodies.density

    assert float(BodyGraph.of_batch(Batch).cell_size) == pytest.approx(problem.cell_size, rel=0.02)


# --- bad input ---------------------------------------------------------------------------------


def test_bodies_that_have_no_graph_are_refused():
    with pytest.raises(InputError, match="problems"):
        BodyGraph.of([])
    with pytest.raises(InputError, match="27 nodes"):
        BodyGraph.of([discretise(beam((2, 1, 1)), element="hex27")])


@pytest.mark.parametrize(
    ("name", "changes", "told"),
    [
        ("compact", {"node_features": ["colour"]}, "'colour'"),
        ("compact", {"edge_features": ["strain"]}, "'strain'"),
        ("compact", {"node_features": ["load", "load"]}, "load, load"),
        ("compact", {"layers": 0}, "layers = 0"),
        ("compact", {"width": 0}, "width = 0"),
        ("compact", {"mlp_layers": 1}, "mlp_layers = 1"),
        ("compact", {"clip": 0.0}, "clip = 0.0"),
        ("compact", {"depth": 3}, "'compact': depth: unknown key"),
        ("compact", {"widths": 3}, "'compact': widths: unknown key.*width"),
        ("large", {}, "'large'.*thesis, equivariant, compact"),
    ],
)
def test_wrong_settings_are_refused_by_name(name, changes, told):
    with pytest.raises(InputError, match=told):
        preset(name, **changes)


def test_presets_survive_json():
    for name, config in PRESETS.items():
        assert preset(name) == config
        assert CorrectorConfig.model_validate_json(config.model_dump_json()) == config
    assert features.width(NODE_FEATURES, PRESETS["thesis"].node_features) == 10

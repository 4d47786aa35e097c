"""Windows of data sets: what samples hold, batches, loaders, samplers."""

import itertools
import json
import pickle
import shutil

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from torch_geometric.data import Batch  # noqa: E402
from torch_geometric.loader import DataLoader  # noqa: E402

import reader_samples as samples  # noqa: E402
from pdcorrect.data.reader import TrajectoryDataset, TrajectoryLoader  # noqa: E402
from pdcorrect.data.schema import read_shard  # noqa: E402
from pdcorrect.errors import FileFormatError, InputError  # noqa: E402
from pdcorrect.fem.graph import mesh_edges, node_means  # noqa: E402

STEPS = 12  # of a mesh: simulations of 7 and 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("set"))


def opened(folder, split="training", **options):
    return TrajectoryDataset(folder, split, dtype=torch.float64, **options)


def same(one, other):
    """Equal fields and equal ways to take batches apart."""
    assert set(one.keys()) == set(other.keys())
    for name in one.keys():  # noqa: SIM118
        a, b = one[name], other[name]
        if isinstance(a, torch.Tensor):
            assert a.dtype == b.dtype, name
            assert torch.equal(a, b), name
        else:
            assert a == b, name


def places(batches):
    """Mesh, simulation and frame of each sample."""
    return [
        tuple(row)
        for batch in batches
        for row in torch.stack([batch.mesh, batch.simulation, batch.frame], 1).tolist()
    ]


# --- samples ---------------------------------------------------------------------------


@pytest.mark.parametrize("window", [1, 3])
def test_a_sample_holds_the_window_of_its_simulation(folder, window):
    dataset = opened(folder, window=window, base="best", runs=("plain",))
    assert len(dataset) == 4 * (STEPS - 2 * (window - 1))
    index = 7 - window + 1 + 2  # the first mesh's second simulation, frame 2
    found = dataset[index]
    shard = samples.shard(0, cells=samples.SHAPES[0])
    simulation = shard.simulations[1]
    truth, plain = (simulation.runs[name].positions for name in ("reference", "plain"))
    steps = slice(2, 2 + window)
    for name, expected in {
        "positions": truth[2],
        "velocities": (truth[2] - truth[1]) / samples.STEP,
        "targets": truth[3 : 3 + window].swapaxes(0, 1),
        "predictions": simulation.runs["best"].predictions[steps].swapaxes(0, 1),
        "forces": simulation.forces[steps].swapaxes(0, 1),
        "run_plain": plain[2 : 3 + window].swapaxes(0, 1),
        "rest": shard.points,
        "mass": shard.mass,
        "cell_poisson": shard.poisson,
        "young": node_means(shard.young, shard.cells, len(shard.points)),
        "time": [2 * samples.STEP],
        "time_step": [samples.STEP],
    }.items():
        np.testing.assert_allclose(found[name].numpy(), expected, rtol=1e-12, err_msg=name)
    assert (found.free.numpy() == shard.free).all()
    assert (found.cells.numpy() == shard.cells).all()
    assert [int(found[name]) for name in ("mesh", "simulation", "frame")] == [0, 1, 2]
    assert found.num_nodes == len(shard.points)
    assert not dataset[0].velocities.any()  # a body starts without


@pytest.mark.parametrize("window", [1, 5, 6, 7])
def test_windows_reach_the_last_frame_and_no_further(folder, window):
    found = list(opened(folder, window=window))
    frames = {}
    for sample in found:
        frames.setdefault((int(sample.mesh), int(sample.simulation)), []).append(int(sample.frame))
    expected = {}
    for mesh, (k, steps) in itertools.product(range(4), enumerate((7, 5))):
        if steps >= window:
            expected[mesh, k] = list(range(steps - window + 1))
    assert frames == expected
    assert all(sample.targets.shape[1] == window for sample in found)
    with pytest.raises(InputError, match=" 8 steps"):
        opened(folder, window=8)


def test_edges_are_those_of_the_cells_and_values_of_nodes_are_means_over_cells(folder):
    found = opened(folder)[0]
    expected = set()
    for a, b in itertools.combinations(range(len(found.rest)), 2):
        if (found.rest[a] - found.rest[b]).norm() < 0.11:  # neighbours of a grid of 0.1 m
            expected |= {(a, b), (b, a)}
    edges = list(map(tuple, found.edge_index.T.tolist()))
    assert len(edges) == len(set(edges))
    assert set(edges) == expected
    assert edges == sorted(edges)
    assert mesh_edges(np.arange(8)[None]).shape == (2, 24)
    cells = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [1, 8, 9, 2, 5, 10, 11, 6]])
    means = node_means(np.array([1.0, 3.0]), cells, 12)
    assert means[[0, 1, 8]].tolist() == [1.0, 2.0, 3.0]


def test_numbers_come_in_the_type_asked_for_and_are_stored_in_the_files_own(folder, tmp_path):
    found = TrajectoryDataset(folder, "training")[0]
    assert {found[n].dtype for n in ("positions", "velocities", "rest", "young", "time")} == {
        torch.float32
    }
    assert found.edge_index.dtype == found.cells.dtype == torch.int64
    samples.write(tmp_path, [samples.shard()], "float32")
    runs = read_shard(tmp_path / "training" / "mesh-0000.h5").simulations[0].runs
    assert runs["reference"].positions.dtype == runs["plain"].predictions.dtype == np.float32


def test_what_is_not_there_is_named(folder, tmp_path):
    for options, words in (
        ({"split": "test"}, "'test'"),
        ({"base": "fine"}, "'fine'"),
        ({"runs": ["fine"]}, "'fine'"),
        ({"window": 0}, "window = 0"),
        ({"window": 2.5}, r"window = 2\.5"),
    ):
        with pytest.raises(InputError, match=words):
            opened(folder, **options)
    with pytest.raises(InputError, match=tmp_path.name):
        opened(tmp_path)
    samples.write(tmp_path, [samples.shard(models=())])
    with pytest.raises(InputError, match="'validation'"):
        opened(tmp_path, "validation")
    with pytest.raises(InputError, match="'plain'"):
        opened(tmp_path)
    assert "predictions" not in opened(tmp_path, base=None)[0]
    with pytest.raises(IndexError):
        opened(folder).get(4 * STEPS)


# --- batches ---------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"window": 3, "base": "best", "runs": ("plain", "best")}])
def test_a_batch_is_what_pytorch_geometric_makes_of_the_samples(folder, options):
    dataset = opened(folder, **options)
    chosen = [0, 30, 3, 3, len(dataset) - 1]
    ours = dataset.batch(chosen)
    theirs = Batch.from_data_list([dataset[i] for i in chosen])
    assert type(ours) is type(theirs)
    same(ours, theirs)
    for parts in ("_slice_dict", "_inc_dict"):
        a, b = getattr(ours, parts), getattr(theirs, parts)
        assert a.keys() == b.keys()
        assert all(torch.equal(a[name], b[name]) for name in a)
    assert ours.num_graphs == len(chosen)
    for i, sample in zip(chosen, ours.to_data_list(), strict=True):
        same(sample, dataset[i])


def test_cells_and_edges_of_a_batch_stay_within_their_graphs(folder):
    dataset = opened(folder)
    batch = dataset.batch([0, 20, 40])
    assert (batch.batch[batch.edge_index[0]] == batch.batch[batch.edge_index[1]]).all()
    assert (batch.batch[batch.cells] == batch.batch[batch.cells[:, :1]]).all()
    assert torch.equal(batch.cells.unique(), torch.arange(batch.num_nodes))
    part = dataset[[40, 2, 17]]  # has numbers of its own
    same(part.batch([0, 2]), dataset.batch([40, 17]))
    assert part.shard_numbers().tolist() == [3, 0, 1]
    assert sorted(TrajectoryLoader(part, 2).order()) == [0, 1, 2]


@pytest.mark.parametrize(
    ("method", "count"), [(None, 0), ("fork", 2), pytest.param("spawn", 1, marks=pytest.mark.slow)]
)
def test_the_loader_of_pytorch_geometric_hands_out_the_same(folder, method, count):
    dataset = opened(folder)
    dataset[0]  # the parent has read something
    theirs = DataLoader(dataset, 7, num_workers=count, multiprocessing_context=method)
    for number, batch in enumerate(theirs):
        same(batch, dataset.batch(range(7 * number, min(7 * number + 7, len(dataset)))))


def test_samples_are_copies_and_neither_files_nor_memory_are_passed_on(folder, tmp_path):
    dataset = opened(folder)
    expected = dataset.batch([0, 40])
    blob = pickle.dumps(dataset)
    assert len(blob) < 20_000
    copy = pickle.loads(blob)
    assert not copy._kept
    same(copy.batch([0, 40]), expected)

    dataset = opened(folder)
    before = dataset[3].positions.clone()
    dataset[3].positions.zero_()
    dataset.batch([3]).positions.zero_()
    assert torch.equal(dataset[3].positions, before)

    shutil.copytree(folder, tmp_path / "set")
    dataset = opened(tmp_path / "set")
    expected = dataset.batch([0, 40])
    shutil.rmtree(tmp_path / "set")
    same(dataset.batch([0, 40]), expected)
    with pytest.raises(FileFormatError, match=r"mesh-0001\.h5"):
        dataset[20]


def test_memory_keeps_to_its_bound_and_the_least_recently_used_file_goes_first(folder):
    sizes = opened(folder).shard_bytes()
    bound = sizes[0] + sizes[2]
    dataset = opened(folder, cache_bytes=bound)
    for number in np.random.default_rng(0).integers(4, size=60):
        dataset[int(number) * STEPS]
        assert number in dataset._kept
        assert sizes[list(dataset._kept)].sum() <= bound
    tiny = opened(folder, cache_bytes=1)
    for number in (0, 1, 0):
        tiny[number * STEPS]
        assert list(tiny._kept) == [number]
    dataset = opened(folder, cache_bytes=sizes[0] + sizes[1])
    for number, kept in ((0, [0]), (1, [0, 1]), (0, [1, 0]), (3, [0, 3]), (0, [3, 0]), (1, [0, 1])):
        dataset[number * STEPS]
        assert list(dataset._kept) == kept


# --- order -----------------------------------------------------------------------------


def test_an_epoch_has_every_window_once_and_the_next_one_another_order(folder):
    dataset = opened(folder)
    loader = TrajectoryLoader(dataset, 5, seed=1)
    orders = []
    for epoch in range(3):
        assert loader.epoch == epoch
        orders.append(loader.order().tolist())
        batches = list(loader)
        assert len(batches) == len(loader) == 10
        assert sorted(orders[-1]) == list(range(len(dataset)))
        same(batches[-1], dataset.batch(orders[-1][45:]))
    assert len(set(map(tuple, orders))) == 3
    loader.set_epoch(1)
    assert loader.order().tolist() == orders[1]
    assert TrajectoryLoader(dataset, 5, seed=2).order().tolist() != orders[0]


@pytest.mark.parametrize("block", [1, 2])
def test_files_are_read_block_by_block(folder, block):
    dataset = opened(folder)
    order = TrajectoryLoader(dataset, 1, block=block).order()
    shards = dataset.shard_numbers()[order]
    blocks = [set(shards[i : i + block * STEPS]) for i in range(0, len(shards), block * STEPS)]
    assert [len(each) for each in blocks] == [block] * (4 // block)
    assert set.union(*blocks) == {0, 1, 2, 3}
    assert (np.diff(order[:STEPS]) < 0).any()
    assert TrajectoryLoader(dataset, 1).block == 4  # all that memory holds
    assert TrajectoryLoader(opened(folder, cache_bytes=1), 1).block == 1


def test_impossible_loaders_and_states_of_another_order_are_refused(folder):
    dataset = opened(folder)
    for options, words in (
        ({"rank": 2, "world_size": 2}, "rank = 2 of 2"),
        ({"world_size": 49}, "48 windows for 49 ranks"),
    ):
        with pytest.raises(InputError, match=words):
            TrajectoryLoader(dataset, 5, **options)
    state = TrajectoryLoader(dataset, 5, seed=5).state_dict()
    for other, words in (
        (TrajectoryLoader(dataset, 5, seed=6), "seed = 5, .* 6"),
        (TrajectoryLoader(dataset, 5, seed=5, world_size=2), "world_size = 1"),
        (TrajectoryLoader(opened(folder, window=2), 5, seed=5), "windows = 48, .* 40"),
    ):
        with pytest.raises(InputError, match=words):
            other.load_state_dict(state)


@pytest.mark.parametrize("ranks", [2, 3, 5])
def test_ranks_get_disjoint_parts_of_equal_size(folder, ranks):
    dataset = opened(folder)
    for epoch in (0, 4):
        together = []
        for rank in range(ranks):
            loader = TrajectoryLoader(dataset, 7, seed=7, block=2, rank=rank, world_size=ranks)
            loader.set_epoch(epoch)
            together += (own := loader.order().tolist())
            assert len(own) == len(dataset) // ranks
        assert len(set(together)) == len(together)


@pytest.mark.parametrize("stop", [1, 4, 10])
def test_training_goes_on_exactly_where_it_stopped(folder, stop):
    dataset = opened(folder)

    def loader():
        return TrajectoryLoader(dataset, 5, seed=5, block=2)

    whole = loader()
    whole.set_epoch(2)
    expected, following = places(whole), places(whole)

    first = loader()
    first.set_epoch(2)
    before = places(itertools.islice(first, stop))
    state = json.loads(json.dumps(first.state_dict()))
    second = loader()
    second.load_state_dict(state)
    second.set_epoch(state["epoch"])
    assert second.state_dict() == state
    assert before + places(second) == expected
    assert places(second) == following

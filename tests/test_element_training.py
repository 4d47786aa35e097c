"""What the learned element is trained on, and its training."""

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save
from torch.nn.functional import silu
from torch_geometric.nn import RGCNConv

import pdcorrect as pc
from pdcorrect.elements import collection, training
from pdcorrect.elements.answers import VoxelMesh, answers
from pdcorrect.elements.bodies import draw, nodes_of
from pdcorrect.elements.linear import collate, errors, loss, sample
from pdcorrect.elements.network import ElementNetwork
from pdcorrect.errors import ConvergenceError, FileFormatError, FileVersionError, InputError
from pdcorrect.fem.element_network import (
    SCALARS,
    STRAINS,
    read_network,
    write_network,
)
from pdcorrect.fem.neighbourhood import NEIGHBOURS, SIZE, cell_graph, neighbours_of, permutations


def small(seed, most=14):
    """A random body of few cells, and a generator to go on with."""
    while True:
        rng = np.random.default_rng(seed)
        body = draw(rng)
        if body.solid.sum() <= most:
            return body, rng
        seed += 1000


@pytest.fixture(scope="module")
def found():
    """Bodies with their answers."""
    pairs = [small(seed) for seed in range(3)]
    return [(body, answers(body, rng)) for body, rng in pairs]


def test_bodies_hang_together_and_are_held():
    kinds = set()
    for seed in range(60):
        body = draw(np.random.default_rng(seed))
        kinds.add(body.kind)
        nodes = nodes_of(body.solid)
        assert 4 <= body.solid.sum() <= 150
        assert not (body.held & ~nodes).any()
        assert 4 <= body.held.sum() <= 0.6 * nodes.sum()
        mesh = VoxelMesh.of(body.solid)
        steps = np.abs(np.argwhere(body.solid)[:, None] - np.argwhere(body.solid)[None]).sum(axis=2)
        reach = np.linalg.matrix_power((steps <= 1).astype(float), 150) > 0
        assert reach.all()
        assert len(mesh.places) == nodes.sum()
        again = draw(np.random.default_rng(seed))
        assert (again.solid == body.solid).all()
        assert again.poisson == body.poisson
    assert len(kinds) == 9


def test_cells_may_be_cut_in_eight():
    for seed in range(5):
        solid = draw(np.random.default_rng(seed), cut=True).solid
        halves = solid.reshape(*(x for n in solid.shape for x in (n // 2, 2)))
        assert (halves.any(axis=(1, 3, 5)) == halves.all(axis=(1, 3, 5))).all()
        assert solid.sum() <= 192


def test_free_bodies_are_under_loads_in_balance():
    """They stand on weak springs, which leave the shapes of their modes as they are."""
    rng = np.random.default_rng(1)
    body = draw(rng, free=True)
    while body.solid.sum() > 20:
        body = draw(rng, free=True)
    found = answers(body, rng)
    assert not found.held.any()
    assert found.squares[0] == pytest.approx(21.0 * found.foundation, rel=1e-3)
    F, x = found.forces, found.places - found.places.mean(axis=0)
    size = np.abs(F).sum(axis=(1, 2))
    assert np.abs(F.sum(axis=1)).max() < 1e-9 * size.max()
    assert np.abs(np.cross(x, F).sum(axis=1)).max() < 1e-9 * size.max()
    base = errors(collate([sample(found)]), None, None)
    assert 0.0 < float(base.squares[0, 0].sqrt()) < 0.5
    assert float(base.displacements[0, : len(F)].sqrt().mean()) < 0.5


def test_the_coarse_model_without_corrections_is_the_best_coarse_one(found):
    """Its errors are those of `pdcorrect.best_coarse` in statics, to the network's eyes too."""
    body, answer = found[0]
    scene = pc.Scene(
        body={"shape": "voxels", "occupancy": body.solid.astype(int).tolist(), "cell_size": 1.0},
        material={"young": 1.0, "poisson": body.poisson, "density": 1.0},
        time={"step": 1.0, "frames": 1}, solver={"element": "hex8-enhanced", "mass": "averaged"},
    )  # fmt: skip
    problem = pc.discretise(scene)
    order = np.lexsort(problem.positions.round(6).T[::-1])
    assert problem.positions[order].round(6) == pytest.approx(answer.places.astype(float))
    problem = problem.with_material(young=body.young[body.solid], poisson=body.poisson)
    K = problem.stiffness(problem.positions).toarray()
    rows = (3 * order[:, None] + np.arange(3)).ravel()
    K = K[np.ix_(rows, rows)]
    free = ~np.repeat(answer.held, 3)
    expected = []
    for F, U in zip(answer.forces, answer.displacements, strict=True):
        u = np.where(free, 0.0, U.ravel())
        u[free] = np.linalg.solve(K[np.ix_(free, free)], (F.ravel() - K @ u)[free])
        expected.append(((u - U.ravel()) ** 2).sum() / (U**2).sum())
    got = errors(collate([sample(answer)]), None, None).displacements[0]
    assert got[: len(expected)].numpy() == pytest.approx(np.array(expected), rel=1e-4)


def test_fine_modes_are_orthonormal_and_balance(found):
    _, answer = found[1]
    assert (np.diff(answer.squares) >= 0.0).all()
    assert answer.squares[0] > 0.0
    base = errors(collate([sample(answer)]), None, None)
    assert float(base.squares[0, 0]) < 0.2


def test_bodies_of_a_batch_do_not_touch(found):
    samples = [sample(answer) for _, answer in found]
    together = errors(collate(samples), None, None)
    for i, one in enumerate(samples):
        alone = errors(collate([one]), None, None)
        for a, b in zip(together, alone, strict=True):
            assert a[i].numpy() == pytest.approx(b[0].numpy(), rel=1e-8, abs=1e-12)


def test_the_loss_has_right_derivatives(found):
    batch = collate([sample(answer) for _, answer in found])
    base = errors(batch, None, None)
    rng = np.random.default_rng(3)
    count = len(batch.numbers)

    def symmetric(size):
        x = 0.2 * torch.as_tensor(rng.normal(size=(count, size, size)))
        return x + x.mT

    N, H, dN, dH = (symmetric(n) for n in (STRAINS, SCALARS, STRAINS, SCALARS))
    N.requires_grad_()
    H.requires_grad_()
    value = loss(errors(batch, N, H), base).sum()
    assert not torch.isclose(value, loss(base, base).sum())
    gradients = torch.autograd.grad(value, (N, H))
    slope = sum(float((g * d).sum()) for g, d in zip(gradients, (dN, dH), strict=True))
    with torch.no_grad():
        ahead, behind = (
            loss(errors(batch, N + e * dN, H + e * dH), base).sum() for e in (1e-5, -1e-5)
        )
    assert slope == pytest.approx(float(ahead - behind) / 2e-5, rel=1e-6)


def random_network(seed=0, **sizes):
    torch.manual_seed(seed)
    network = ElementNetwork(**sizes)
    torch.nn.init.normal_(network.last.weight, std=0.1)
    return network


def numpy_of(network):
    return {k: v.numpy() for k, v in network.state_dict().items()}


def body_graph(answer):
    index = answer.places[answer.cells[:, 0]]
    poisson = np.full(len(index), float(answer.poisson))
    held = answer.held[answer.cells].astype(float)
    return cell_graph(neighbours_of(answer.cells, index), answer.young, poisson, held)


def test_a_round_is_a_relational_graph_convolution(found):
    """That of PyTorch Geometric, with a relation for each place of a neighbour."""
    network = random_network(width=6, rounds=1).double()
    graph = body_graph(found[1][1])
    numbers, neighbours = (torch.as_tensor(x) for x in graph)
    own, around = (torch.as_tensor(p[5]) for p in permutations())
    table = neighbours[:, around]
    target, relation = (table < len(table)).nonzero().T
    convolution = RGCNConv(6, 6, NEIGHBOURS, aggr="sum", root_weight=False).double()
    linear = network.rounds[0]
    with torch.no_grad():
        convolution.weight.copy_(linear.weight.T.reshape(NEIGHBOURS, 6, 6))
        convolution.bias.copy_(linear.bias)
        x = silu(network.first(numbers[:, own]))
        edges = torch.stack([table[target, relation], target])
        expected = x + silu(convolution(network.norms[0](x), edges, relation))
        kept = []
        network.hidden.register_forward_hook(lambda _, given, out: kept.append(given[0][:, 0, :6]))
        network(numbers, neighbours, torch.tensor([5]))
    assert kept[0].numpy() == pytest.approx(expected.numpy(), abs=1e-12)


def test_inference_without_torch_agrees(found, tmp_path):
    network = random_network(width=20, rounds=2)
    write_network(tmp_path / "weights.safetensors", numpy_of(network))
    graph = body_graph(found[0][1])
    with torch.no_grad():
        expected = network(*(torch.as_tensor(x) for x in (graph.numbers.astype("f4"), graph[1])))
    got = read_network(tmp_path / "weights.safetensors")(graph)
    for a, b in zip(got, expected, strict=True):
        assert a == pytest.approx(b.numpy(), abs=1e-6)


def test_files_that_are_no_weights_are_refused(tmp_path):
    path = tmp_path / "weights.safetensors"
    for unread in (path, tmp_path):
        with pytest.raises(FileFormatError, match=unread.name):
            read_network(unread)
    write_network(path, numpy_of(random_network(width=8, rounds=1)))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(FileFormatError):
        read_network(path)
    network = random_network(width=8, rounds=1)
    network.hidden = torch.nn.Linear(3, 3)  # whose sizes do not fit the others
    write_network(path, numpy_of(network))
    with pytest.raises(FileFormatError, match=path.name):
        read_network(path)
    network = random_network(width=8, rounds=1)
    network.last.bias.data[3] = float("nan")
    write_network(path, numpy_of(network))
    with pytest.raises(FileFormatError, match="not finite"):
        read_network(path)
    torch.manual_seed(0)
    network = ElementNetwork(8, 1)
    network.first = torch.nn.Linear(SIZE - 1, 8)
    write_network(path, numpy_of(network))
    with pytest.raises(FileFormatError, match=path.name):
        read_network(path)
    arrays = {"other": np.zeros(3, dtype=np.float32)}
    for kind in (None, {"element": "hex8-learned 0"}):  # numbers that mean something else
        path.write_bytes(save(arrays, metadata=kind))
        with pytest.raises(FileVersionError, match="hex8-learned 1"):
            read_network(path)


@pytest.fixture
def few(monkeypatch):
    """Two small bodies in a file, and a line for each epoch."""
    monkeypatch.setattr(training, "_REPORTS", 0.0)
    monkeypatch.setattr(collection, "A_FILE", 2)
    monkeypatch.setattr(collection, "draw", lambda rng, **_: small(int(rng.integers(100)))[0])


RECIPE = training.ElementRecipe(bodies=4, width=8, rounds=2, iterations=6, batch=2, symmetries=4)


def run(recipe, folder, **options):
    torch.set_num_threads(1)
    return training.train(recipe, folder, report=lambda _: None, **options)


def test_training_learns_and_writes_what_the_element_reads(few, tmp_path):
    recipe = training.ElementRecipe(**{**vars(RECIPE), "iterations": 30})
    lines = []
    assert training.train(recipe, tmp_path, report=lines.append)
    card = json.loads((tmp_path / training.CARD).read_text())
    assert card["recipe"]["bodies"] == 4
    network = read_network(tmp_path / training.WEIGHTS)
    assert network.shape[0] == SIZE
    losses = [float(line.split("loss ")[1].split(",")[0]) for line in lines if "loss" in line]
    assert losses[-1] < 0.9 * losses[0]


def test_an_interrupted_training_goes_on_as_if_it_had_not_been(few, tmp_path, monkeypatch):
    assert run(RECIPE, tmp_path / "whole")
    epoch = training.Trainer.epoch

    def stops(self, seconds=None):
        if self.iteration >= 2:
            raise KeyboardInterrupt
        return epoch(self, seconds)

    with monkeypatch.context() as patch:
        patch.setattr(training.Trainer, "epoch", stops)
        with pytest.raises(KeyboardInterrupt):
            run(RECIPE, tmp_path / "parts")
    before = torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)["seconds"]
    assert run(RECIPE, tmp_path / "parts")
    assert 0.0 < before < json.loads((tmp_path / "parts" / training.CARD).read_text())["seconds"]
    whole, parts = (
        (tmp_path / name / training.WEIGHTS).read_bytes() for name in ("whole", "parts")
    )
    assert whole == parts


def test_time_that_is_up_and_other_recipes(few, tmp_path):
    assert not run(RECIPE, tmp_path, seconds=0.0)
    assert run(RECIPE, tmp_path)
    other = training.ElementRecipe(**{**vars(RECIPE), "rate": 1e-4})
    with pytest.raises(InputError, match="recipe"):
        run(other, tmp_path)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="of a GPU's graphs")
def test_recorded_steps_learn_what_others_do(found, monkeypatch):
    samples, ends = [sample(answer) for _, answer in found], []
    for replaced in (training.Recorded, lambda work, pool: work):
        monkeypatch.setattr(training, "Recorded", replaced)
        trainer = training.Trainer(RECIPE, samples, samples, "cuda")
        for _ in range(4):
            trainer.epoch()
        ends.append(trainer.measured()["loss"])
    assert ends[0] == pytest.approx(ends[1], rel=1e-3)
    assert ends[0] < 0.99


def test_a_loss_that_is_not_finite_ends_the_training(few, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "loss", lambda found, base: found.squares[:, 0] * float("nan"))
    with pytest.raises(ConvergenceError, match="loss"):
        run(RECIPE, tmp_path)
    assert not (tmp_path / "checkpoint.pt").exists()


def test_bodies_of_another_seed_are_refused(few, tmp_path):
    assert run(RECIPE, tmp_path)
    (tmp_path / "checkpoint.pt").unlink()
    other = training.ElementRecipe(**{**vars(RECIPE), "seed": 1})
    with pytest.raises(InputError, match="seed"):
        run(other, tmp_path)
    (tmp_path / "training" / "bodies.json").unlink()
    with pytest.raises(InputError, match="drawn"):
        run(RECIPE, tmp_path)


def test_damaged_bodies_are_named(few, tmp_path):
    assert run(RECIPE, tmp_path)
    path = collection.file_paths(tmp_path / "training", 4)[1]
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 400] = bytes(400)
    path.write_bytes(content)
    (tmp_path / "checkpoint.pt").unlink()
    with pytest.raises(InputError, match=path.name):
        run(RECIPE, tmp_path)

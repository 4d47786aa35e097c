"""`models/surrogate.py`: a network without a solver."""

import json
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.batch.stepper import BatchStepper  # noqa: E402
from pdcorrect.corrector.config import preset  # noqa: E402
from pdcorrect.corrector.corrector import Corrector  # noqa: E402
from pdcorrect.evaluation.cases import read_cases  # noqa: E402
from pdcorrect.evaluation.rollouts import roll_out  # noqa: E402
from pdcorrect.training.config import Stage  # noqa: E402
from pdcorrect.training.fitting import fit_normaliser  # noqa: E402
from pdcorrect.training.recordings import load_recordings  # noqa: E402
from test_model_scripts import script  # noqa: E402

STAGE = Stage(kind="one-step", seconds=1.0)
CONFIG = preset("compact", layers=1, width=8, placement="guess")


@pytest.fixture(scope="module")
def alone():
    return script("surrogate")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("set"), frames=6)


@pytest.fixture(scope="module")
def recordings(folder):
    return load_recordings(folder, "training", "plain", scenes=False)


@pytest.fixture
def corrector(alone, folder, recordings):
    torch.manual_seed(0)
    found = Corrector(CONFIG)
    fit_normaliser(found, alone.AloneWindows(folder, recordings, CONFIG, "plain"), 50)
    return found


def silent(corrector):
    with torch.no_grad():
        corrector.network.decoder[-1].weight.zero_()
        corrector.network.decoder[-1].bias.zero_()
    return corrector


@pytest.mark.parametrize("resident", [True, False])
def test_all_of_a_step_is_the_networks(alone, folder, recordings, resident):
    windows = alone.AloneWindows(folder, recordings, CONFIG, "plain", resident=resident)
    batch = windows.batch([0, 3, 7])
    expected = torch.cat([windows.dataset[i].targets[:, 0] for i in (0, 3, 7)]).double()
    torch.testing.assert_close(batch.snapshot.proposed + batch.target, expected)
    h = batch.bodies.by_node(batch.bodies.time_step)[:, None]
    fall = h**2 * batch.snapshot.forces / batch.bodies.mass[:, None]
    free = batch.bodies.free
    flown = batch.snapshot.positions + h * batch.snapshot.velocities + fall
    torch.testing.assert_close(batch.snapshot.proposed[free], flown[free])


def test_a_silent_network_flies_and_holds_the_clamps(alone, folder, corrector):
    cases = read_cases(folder, "validation", skip_damaged=False).cases
    stepper = BatchStepper([case.problems["plain"] for case in cases])
    runs = roll_out(alone.Alone(stepper, silent(corrector)), stepper, [3] * len(cases))
    for run, case in zip(runs, cases, strict=True):
        problem = case.problems["plain"]
        x, h = run.positions, problem.time_step
        free = problem.free
        np.testing.assert_allclose(x[1:][:, ~free], case.reference[1:4][:, ~free], atol=1e-6)
        second = (x[2:] - 2.0 * x[1:-1] + x[:-2])[:, free] / h**2
        loads = np.stack([problem.external_forces(x[k], (k + 1) * h) for k in (1, 2)])
        np.testing.assert_allclose(
            second, (loads / problem.mass[:, None])[:, free], rtol=1e-5, atol=1e-6
        )
        assert run.failed is None


def test_the_loss_of_one_step_is_that_of_the_network_on_a_window(
    alone, folder, recordings, corrector
):
    windows = alone.Windows(folder, recordings, 1, torch.device("cpu"), seed=0)
    stored, scale = windows.draw(5, 0.0)
    found = alone.unrolled_loss(corrector, stored, scale, STAGE)
    batch = alone.AloneWindows(folder, recordings, CONFIG, "plain").step_batch(stored)
    torch.testing.assert_close(batch.scale, scale)
    errors = corrector(batch.bodies, batch.snapshot) - batch.target
    squares = batch.bodies.node_sums(errors.square().sum(dim=1)) / batch.bodies.node_counts
    torch.testing.assert_close(found, (squares / scale).mean())


def test_steps_follow_each_other_and_errors_count_by_how_far_they_carry(
    alone, folder, recordings, corrector
):
    windows = alone.Windows(folder, recordings, 3, torch.device("cpu"), seed=1)
    stored, scale = windows.draw(4, 0.0)
    whole = alone.unrolled_loss(silent(corrector), stored, scale, STAGE)
    bodies, h = stored.bodies, stored.bodies.by_node(stored.bodies.time_step)[:, None]
    x, v, total = stored.positions, stored.velocities, 0.0
    for j, carried in enumerate((1.0, 9.0, 36.0)):
        y = x + h * v + h**2 * stored.forces[j] / bodies.mass[:, None]
        y = torch.where(bodies.free, y, stored.targets[j])
        squares = (y - stored.targets[j]).square().sum(dim=1)
        total += (bodies.node_sums(squares) / bodies.node_counts / (carried * scale)).mean()
        x, v = y, (y - x) / h
    torch.testing.assert_close(whole, total / 3)


def test_noise_makes_free_velocities_wrong_by_its_size(alone, folder, recordings):
    drawn = [
        alone.Windows(folder, recordings, 1, torch.device("cpu"), seed=2).draw(40, noise)
        for noise in (0.0, 2.0)
    ]
    (without, scale), (wrong, _) = drawn
    bodies = without.bodies
    off = wrong.velocities - without.velocities
    assert not off[~bodies.free].any()
    expected = 2.0 * bodies.by_node((scale / 3.0).sqrt() / bodies.time_step)[:, None]
    assert (off / expected)[bodies.free].std().item() == pytest.approx(1.0, rel=0.05)


def test_derivatives_go_through_all_steps(alone, folder, recordings, corrector):
    windows = alone.Windows(folder, recordings, 2, torch.device("cpu"), seed=0)
    stored, scale = windows.draw(2, 0.0)
    corrector = corrector.double()
    weight = corrector.network.decoder[-1].bias
    alone.unrolled_loss(corrector, stored, scale, STAGE).backward()
    found, step = weight.grad[0].item(), 1e-6
    sides = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            weight[0] += sign * step
            sides.append(alone.unrolled_loss(corrector, stored, scale, STAGE).item())
            weight[0] -= sign * step
    assert found == pytest.approx((sides[0] - sides[1]) / (2.0 * step), rel=1e-5)


def test_the_program_trains_and_measures(alone, folder, tmp_path, monkeypatch, capsys):
    whole = samples.dataset(tmp_path / "set", frames=4)
    arguments = [
        "surrogate.py", str(whole), "-o", str(tmp_path / "out"), "--split", "validation",
        "--preset", "compact", "--changes", "layers=1", "width=8", "--seconds", "2",
        "--batch", "4", "--steps", "1", "2",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", arguments)
    alone.main()
    record = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert {"network alone", "plain"} <= record["runs"].keys()
    assert record["history"][-1]["iterations"] > 1
    assert record["command"].startswith("python models/surrogate.py ")
    assert "network alone: preset compact" in capsys.readouterr().out
    assert record["data"]["trajectories"] == record["runs"]["network alone"]["trajectories"]


def test_the_best_weights_by_validation_are_kept(alone, folder, monkeypatch):
    seen = iter([3.0, 9.0, *[5.0] * 20])
    kept = []

    def told(cases, corrector, device, batch):
        kept.append([x.clone() for x in corrector.network.parameters()])
        return [next(seen)]

    monkeypatch.setattr(alone, "omegas", told)
    options = alone.argparse.Namespace(
        data=folder, preset="compact", changes=[("layers", 1), ("width", 8)], seconds=1.0,
        steps=[1], batch=2, noise=1.0, amp="none", fit=20, validation=1, seed=0, device="cpu",
    )  # fmt: skip
    corrector, history = alone.train(options)
    assert len(history) > 2
    found = list(corrector.network.parameters())
    assert all(map(torch.equal, found, kept[1]))
    assert not all(map(torch.equal, found, kept[-1]))

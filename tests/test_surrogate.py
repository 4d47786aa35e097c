"""`models/surrogate.py`: a network without a solver."""

import json
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from safetensors.torch import load_file  # noqa: E402

import training_samples as samples  # noqa: E402
from pdcorrect.batch.stepper import BatchStepper  # noqa: E402
from pdcorrect.corrector.config import preset  # noqa: E402
from pdcorrect.corrector.corrector import Corrector  # noqa: E402
from pdcorrect.errors import ConvergenceError, InputError  # noqa: E402
from pdcorrect.evaluation.measures import read_cases  # noqa: E402
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
def published(tmp_path_factory):
    return samples.published(tmp_path_factory.mktemp("published") / "data")


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


def draws(alone, folder, recordings, steps, noise=0.0, at_rest=0.0, seed=0):
    windows = alone.AloneWindows(folder, recordings, CONFIG, "plain", steps=steps)
    return windows, alone.Draws(windows, noise, at_rest, seed)


def test_steps_alone_are_those_of_training(alone, folder, corrector):
    cases = read_cases(folder, "training", skip_damaged=False).cases
    recordings = load_recordings(folder, "training", "plain", scenes=False)
    stepper = BatchStepper([case.problems["plain"] for case in cases])
    runs = roll_out(alone.Alone(stepper, corrector), stepper, [3] * len(cases))
    windows, _ = draws(alone, folder, recordings, 3)
    numbers = np.arange(len(windows.dataset))
    first = numbers[windows.dataset.places(numbers)[2] == 0]
    with torch.no_grad():
        trained = list(alone.unrolled(corrector, windows.windows(first.tolist())))
    assert trained[0].shape[0] == sum(stepper.node_counts)
    for k, positions in enumerate(trained, start=1):
        rolled = np.concatenate([run.positions[k] for run in runs])
        size = np.abs(rolled - np.concatenate([run.positions[0] for run in runs])).max()
        np.testing.assert_allclose(positions.numpy(), rolled, rtol=0.0, atol=1e-4 * size)


def test_the_loss_of_one_step_is_that_of_the_network_on_a_window(
    alone, folder, recordings, corrector
):
    windows, drawn = draws(alone, folder, recordings, 1)
    stored, errors = drawn(5)
    found = alone.unrolled_loss(corrector, stored, errors, STAGE)
    batch = windows.step_batch(stored)
    torch.testing.assert_close(batch.scale, errors.after(1))
    wrong = corrector(batch.bodies, batch.snapshot) - batch.target
    squares = batch.bodies.node_sums(wrong.square().sum(dim=1)) / batch.bodies.node_counts
    torch.testing.assert_close(found, (squares / batch.scale).mean())


def test_steps_follow_each_other_and_count_as_in_correctors(alone, folder, recordings, corrector):
    stored, errors = draws(alone, folder, recordings, 3, seed=1)[1](4)
    whole = alone.unrolled_loss(silent(corrector), stored, errors, STAGE)
    bodies, h = stored.bodies, stored.bodies.by_node(stored.bodies.time_step)[:, None]
    x, v, total = stored.positions, stored.velocities, 0.0
    for j, carried in enumerate((1.0, 9.0, 36.0)):
        y = x + h * v + h**2 * stored.forces[j] / bodies.mass[:, None]
        y = torch.where(bodies.free, y, stored.targets[j])
        squares = (y - stored.targets[j]).square().sum(dim=1)
        scale = torch.minimum(carried * errors.one_step, errors.largest)
        total += (bodies.node_sums(squares) / bodies.node_counts / scale).mean()
        x, v = y, (y - x) / h
    torch.testing.assert_close(whole, total / 3)


def test_noise_makes_free_states_wrong_by_its_size(alone, folder, recordings):
    (without, errors), (wrong, _) = (
        draws(alone, folder, recordings, 1, noise, seed=2)[1](40) for noise in (0.0, 2.0)
    )
    bodies, h = without.bodies, without.bodies.by_node(without.bodies.time_step)[:, None]
    expected = 2.0 * bodies.by_node((errors.one_step / 3.0).sqrt())[:, None]
    for off in (wrong.positions - without.positions, h * (wrong.velocities - without.velocities)):
        assert not off[~bodies.free].any()
        assert (off / expected)[bodies.free].std().item() == pytest.approx(1.0, rel=0.05)


def test_a_share_of_windows_begins_at_rest(alone, folder, recordings):
    stored, _ = draws(alone, folder, recordings, 1, at_rest=0.99)[1](200)
    moving = stored.bodies.node_sums(stored.velocities.square().sum(dim=1)) > 0.0
    assert 0 < moving.sum() < 20
    assert draws(alone, folder, recordings, 1)[1](200)[0].velocities.any()


def test_masses_are_those_of_the_base(alone, published):
    recordings = load_recordings(published, "training", "total-mass", scenes=False)
    windows = alone.AloneWindows(published, recordings, CONFIG, "total-mass", steps=2)
    mass = windows.windows([0]).bodies.mass
    assert mass.sum().item() == pytest.approx(recordings[0].total_mass, rel=1e-12)
    cases = read_cases(published, "validation", ["total-mass"], skip_damaged=False).cases
    silent_one = silent(Corrector(CONFIG))
    fit_normaliser(silent_one, windows, 10)
    for case in cases:
        problem = case.problems["total-mass"]
        assert problem.mass.sum() < 0.9 * case.problems["plain"].mass.sum()
        stepper = BatchStepper([problem])
        (run,) = roll_out(alone.Alone(stepper, silent_one), stepper, [1])
        h, free, x = problem.time_step, problem.free, run.positions
        force = (x[1] - x[0])[free] / h**2 * problem.mass[:, None].repeat(3, axis=1)[free]
        np.testing.assert_allclose(
            force, problem.external_forces(x[0], h)[free], rtol=1e-6, atol=1e-9
        )


def test_derivatives_go_through_all_steps(alone, folder, recordings, corrector):
    stored, errors = draws(alone, folder, recordings, 2)[1](2)
    corrector = corrector.double()
    weight = corrector.network.decoder[-1].bias
    alone.unrolled_loss(corrector, stored, errors, STAGE).backward()
    found, step = weight.grad[0].item(), 1e-6
    sides = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            weight[0] += sign * step
            sides.append(alone.unrolled_loss(corrector, stored, errors, STAGE).item())
            weight[0] -= sign * step
    assert found == pytest.approx((sides[0] - sides[1]) / (2.0 * step), rel=1e-5)


def arguments(folder, output, *more):
    return [
        "surrogate.py", str(folder), "-o", str(output), "--split", "validation",
        "--preset", "compact", "--changes", "layers=1", "width=8", "--seconds", "2",
        "--batch", "4", "--steps", "1", "2", *more,
    ]  # fmt: skip


def test_the_program_trains_and_measures(alone, tmp_path, monkeypatch, capsys):
    whole, output = samples.dataset(tmp_path / "set", frames=4), tmp_path / "out"
    monkeypatch.setattr(sys, "argv", arguments(whole, output))
    alone.main()
    record = json.loads((output / "summary.json").read_text())
    assert {"network alone", "plain"} <= record["runs"].keys()
    assert record["history"][-1]["iterations"] > 1
    assert record["command"].startswith("python models/surrogate.py ")
    assert "network alone: preset compact" in capsys.readouterr().out
    again = Corrector(CONFIG)
    again.load_state_dict(load_file(output / "weights.safetensors"))
    cases = read_cases(whole, "validation", skip_damaged=False).cases
    found, failed = alone.Looks(cases, "plain", "cpu")(again)
    assert failed == 0
    best = min(row["error_over_plain"] for row in record["history"])
    assert np.exp(np.log(found).mean()) == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (("--split", "nowhere"), "no split 'nowhere'"),
        (("--steps", "1", "7"), "expected 1 to 6"),
        (("--steps", "0"), "expected 1 to 6"),
        (("--seconds", "0"), "expected more than 0"),
        (("--workers", "0"), "expected 1 or more"),
    ],
)
def test_what_cannot_work_is_refused_before_the_training(
    alone, folder, tmp_path, monkeypatch, more, told
):
    monkeypatch.setattr(sys, "argv", arguments(folder, tmp_path / "out", *more))
    monkeypatch.setattr(alone, "Learner", None)
    with pytest.raises(InputError, match=told):
        alone.main()


def learner(alone, folder, monkeypatch):
    options = alone.argparse.Namespace(
        data=folder, base="plain", preset="compact", changes=[("layers", 1), ("width", 8)],
        seconds=20.0, steps=[1, 2], batch=2, noise=1.0, at_rest=0.0, amp="none", fit=20,
        validation=1, seed=0, device="cpu",
    )  # fmt: skip
    clock = iter(range(10**6))
    monkeypatch.setattr(alone.time, "perf_counter", lambda: 0.5 * next(clock))
    return alone.Learner(options)


def test_the_best_weights_by_validation_are_kept(alone, folder, monkeypatch):
    seen, kept = iter([(9.0, 0), (3.0, 0), (1.0, 1), *[(5.0, 0)] * 20]), []

    def told(corrector):
        kept.append([x.clone() for x in corrector.network.parameters()])
        error, failed = next(seen)
        return np.array([error]), failed

    training = learner(alone, folder, monkeypatch)
    training._looks = told
    training.run()
    assert len(training.history) == alone.LOOKS
    assert [row["steps"] for row in training.history] == sorted(
        row["steps"] for row in training.history
    )
    assert {row["steps"] for row in training.history} == {1, 2}
    found = list(training.best.network.parameters())
    assert all(map(torch.equal, found, kept[1]))
    assert not all(map(torch.equal, found, kept[-1]))


def test_a_training_without_finite_gradients_ends_with_an_error(alone, folder, monkeypatch):
    monkeypatch.setattr(alone, "LOOKS", 1)
    training = learner(alone, folder, monkeypatch)
    with torch.no_grad():
        training._corrector.network.decoder[-1].bias.fill_(torch.nan)
    monkeypatch.setattr(alone, "MOST_SKIPPED", 5)
    with pytest.raises(ConvergenceError, match="batches in a row"):
        training.run()

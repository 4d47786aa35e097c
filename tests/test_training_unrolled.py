"""Unrolled steps, and rollouts of a validation split."""

import itertools
import shutil
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.data.schema import read_shard, write_shard  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from pdcorrect.metrics import error_corrected  # noqa: E402
from pdcorrect.scene import Scene  # noqa: E402
from pdcorrect.training.distributed import ProcessGroup, joined  # noqa: E402
from pdcorrect.training.scenes import SceneGroup, SceneGroups, base_errors, load_recordings  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402
from pdcorrect.training.unrolled import Rollouts, UnrolledBatches, unroll  # noqa: E402
from pdcorrect.training.validation import Validation  # noqa: E402


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("tiny"))


pytestmark = pytest.mark.usefixtures("few_threads")

# --- scenes ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def group(folder):
    recordings = load_recordings(folder, "training", "plain")
    return SceneGroup(recordings, "plain", "cpu")


def started(group, frames):
    positions, velocities = group.states(frames)
    none = torch.zeros(int(group.counts.sum()), 3, dtype=torch.float64)
    return Rollouts(positions, velocities, none, frames, np.zeros_like(frames))


def test_groups_hold_all_simulations_once_and_states_have_backward_differences(group):
    recordings = load_recordings(samples.TINY, "training", "plain")
    every = [
        group
        for rank in (0, 1)
        for group in SceneGroups(recordings, "plain", seed=5, world=ProcessGroup(rank, 2)).of(3, 1)
    ]
    assert sorted(r.name for g in every for r in g) == sorted(r.name for r in recordings)
    meshes, others = (
        [r.path for g in SceneGroups(recordings, "plain", seed=seed).of(3, 1) for r in g]
        for seed in (5, 6)
    )
    assert len([1 for a, b in itertools.pairwise(meshes) if a != b]) == 5
    assert meshes != others

    frames = np.array([0, 4, 20])
    positions, velocities = group.states(frames)
    truth = group.recordings[1].reference.astype(float)
    count = truth.shape[1]
    np.testing.assert_array_equal(positions[1, :count].numpy(), truth[4])
    np.testing.assert_allclose(velocities[1, :count].numpy(), (truth[4] - truth[3]) / 0.01)
    assert not velocities[0].any()
    assert not positions[0, group.stepper.node_counts[0] :].any()


def test_one_unrolled_step_without_correction_has_the_loss_of_the_stored_prediction(group, folder):
    settings = samples.config(samples.unrolled())
    silent = samples.fitted(folder, settings, silent=True)
    frames = np.array([2, 7, 11])
    found = unroll(group, silent, started(group, frames), 1, settings.stages[0])
    windows, _ = samples.windows(folder, settings)
    batch = windows.batch([2, 20 + 7, 40 + 11])
    squares = batch.bodies.body_means(batch.target.square().sum(dim=1)) / batch.scale
    assert found.alive.all()
    torch.testing.assert_close(found.losses, squares, rtol=2e-3, atol=0)


def test_unrolled_losses_are_means_over_steps_and_ages_count(group, folder):
    settings = samples.config(samples.unrolled(steps=2))
    silent = samples.fitted(folder, settings, silent=True)
    start = replace(started(group, np.array([2, 7, 11])), ages=np.array([0, 3, 0]))
    both = unroll(group, silent, start, 2, settings.stages[0])
    first = unroll(group, silent, start, 1, settings.stages[0])
    second = unroll(group, silent, first.end, 1, settings.stages[0])
    torch.testing.assert_close(both.losses, (first.losses + second.losses) / 2)
    assert both.end.ages.tolist() == [2, 5, 2]
    assert both.end.frames.tolist() == [4, 9, 13]
    errors = base_errors(group.recordings).after(torch.tensor([2, 5, 2]))
    truth = group.truth(np.array([4, 9, 13]))
    squares = group.sums((both.end.positions - truth).square().sum(dim=2)) / group.counts
    torch.testing.assert_close(second.losses, squares / errors)


@pytest.mark.parametrize("through_solver", [False, True])
def test_weights_get_the_derivative_of_the_unrolled_loss(group, folder, through_solver):
    settings = samples.config(samples.unrolled(through_solver=through_solver))
    corrector = samples.fitted(folder, settings)
    start = started(group, np.array([5, 6, 7]))
    steps = 2 if through_solver else 1  # what is left out without is only what is earlier
    bias = corrector.network.decoder[-1].bias

    def loss():
        return unroll(group, corrector, start, steps, settings.stages[0]).losses.mean()

    loss().backward()
    slope, h = float(bias.grad[1]), 1e-3
    values = []
    with torch.no_grad():
        for sign in (1, -1):
            bias[1] += sign * h
            values.append(loss().item())
            bias[1] -= sign * h
    assert slope == pytest.approx((values[0] - values[1]) / (2 * h), rel=2e-3)


def test_scenes_whose_step_fails_are_left_out(group, folder, monkeypatch):
    settings = samples.config(samples.unrolled(batch=3))
    corrector = samples.fitted(folder, settings)
    fine = unroll(group, corrector, started(group, np.array([5, 6, 7])), 2, settings.stages[0])
    start = started(group, np.array([5, 6, 7]))
    start.positions[1, 20] = torch.nan
    found = unroll(group, corrector, start, 2, settings.stages[0])
    assert found.alive.tolist() == [True, False, True]
    assert found.losses[1] == 0.0
    torch.testing.assert_close(found.losses[[0, 2]], fine.losses[[0, 2]])
    batches = UnrolledBatches(SceneGroups(group.recordings, "plain"), settings.stages[0])
    monkeypatch.setattr("pdcorrect.training.unrolled.unroll", lambda *_: found)
    loss = batches.loss(corrector, 0, 2)
    assert loss.item() == pytest.approx(found.losses[[0, 2]].mean().item())
    assert batches.failed == 1


def test_a_pool_goes_on_where_it_was(folder, monkeypatch):
    recordings = load_recordings(folder, "training", "plain")
    stage = samples.unrolled(start="pool", restart=0.0, steps=2)
    corrector = samples.fitted(folder, samples.config(stage), silent=True)
    monkeypatch.setattr(SceneGroup, "lost", lambda self, *_: np.zeros(len(self), dtype=bool))
    batches = UnrolledBatches(SceneGroups(recordings, "plain"), stage)
    ages = []
    for iteration in range(3):
        batches.loss(corrector, iteration, 2)
        numbers, _ = batches.state_dict()
        ages.append(numbers["pool"]["0"]["ages"])
        assert all(f <= 20 for f in numbers["pool"]["0"]["frames"])
    assert ages[0] == [2, 2, 2]
    assert any(age == 4 for age in ages[1])
    always = UnrolledBatches(
        SceneGroups(recordings, "plain"), stage.model_copy(update={"restart": 1.0})
    )
    for iteration in range(2):
        always.loss(corrector, iteration, 2)
        assert always.state_dict()[0]["pool"]["0"]["ages"] == [2, 2, 2]


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_the_states_of_the_reference_is_at_rest(folder, share):
    recordings = load_recordings(folder, "training", "plain")
    groups = SceneGroups(recordings, "plain")
    batches = UnrolledBatches(groups, samples.unrolled(at_rest=share, steps=2))
    group = groups(recordings)
    starts = np.concatenate([
        batches._start(0, group, 2, np.random.default_rng(k)).frames for k in range(100)
    ])  # fmt: skip
    expected = share + (1.0 - share) / 19  # of the frames 0 to 18 in any case
    assert np.mean(starts == 0) == pytest.approx(expected, abs=0.08)


def test_rollouts_that_are_lost_by_their_squared_distance_go_back_to_the_reference(group, folder):
    frames = np.array([5, 6, 7])
    truth = group.truth(frames)
    rollout = torch.maximum(group.errors.rollout, group.errors.one_step)
    away = torch.tensor([0.9, 1.1, 0.3]).double()
    moved = truth.clone()
    moved[..., 0] += (away * rollout).sqrt()[:, None]
    assert group.lost(moved, frames).tolist() == [False, True, False]
    assert group.lost(moved * torch.nan, frames).all()
    recordings = load_recordings(folder, "training", "plain")
    stage = samples.unrolled(start="pool", restart=0.0, steps=2)
    corrector = samples.fitted(folder, samples.config(stage), silent=True)
    for rollout, expected in ((1e9, [False] * 3), (1e-30, [True] * 3)):
        own = [replace(r, one_step=1e-30, rollout=rollout) for r in recordings]
        batches = UnrolledBatches(SceneGroups(own, "plain"), stage)
        batches.loss(corrector, 0, 2)
        ages = batches.state_dict()[0]["pool"]["0"]["ages"]
        assert [age < 0 for age in ages] == expected


def test_scenes_that_failed_count_once_after_several_processes_resume(folder):
    recordings = load_recordings(folder, "training", "plain")
    stage = samples.unrolled(steps=1)
    numbers = {"failed": 3, "pool": {}}
    counts = []
    for rank in (0, 1):
        batches = UnrolledBatches(
            SceneGroups(recordings, "plain", world=ProcessGroup(rank, 2)),
            stage.model_copy(update={"batch": 1}),
        )
        batches.load_state_dict(numbers, {})
        counts.append(batches.failed)
    assert counts == [3, 0]
    with pytest.raises(InputError, match="21 steps"):
        UnrolledBatches(SceneGroups(recordings, "plain"), samples.unrolled(steps=21))


def test_stages_share_the_groups_that_are_alike(folder, tmp_path, monkeypatch):
    made = []

    class Counted(SceneGroup):
        def __init__(self, recordings, *others):
            made.append([r.name for r in recordings])
            super().__init__(recordings, *others)

    monkeypatch.setattr("pdcorrect.training.scenes.SceneGroup", Counted)
    settings = samples.config(
        samples.unrolled(steps=1, iterations=2), samples.unrolled(steps=2, iterations=2)
    )
    Training(settings, folder, tmp_path / "out").run()
    assert len(made) == len({tuple(names) for names in made}) == 1


# --- validation --------------------------------------------------------------------------


@pytest.mark.parametrize("base", ["plain", "best"])
def test_a_silent_corrector_has_the_omega_of_its_base_model(folder, base):
    settings = samples.config(samples.one_step(), base=base)
    recordings = load_recordings(folder, "validation", base)
    scores = Validation(recordings, base)(samples.fitted(folder, settings, silent=True))
    simulations = read_shard(folder / "validation" / "mesh-0001.h5").simulations
    names = (base, "plain", "reference")
    expected = [error_corrected(*(s.runs[name].positions for name in names)) for s in simulations]
    assert scores.failed == 0
    np.testing.assert_allclose(scores.omegas, expected, atol=0.01)
    assert scores.mean == pytest.approx(np.mean(scores.omegas))


def test_where_the_plain_model_has_no_error_there_is_only_error_to_add(folder, tmp_path):
    recordings = load_recordings(folder, "validation", "plain")
    perfect = [replace(r, plain=r.reference) for r in recordings]
    corrector = samples.fitted(folder, samples.config(samples.one_step()), silent=True)
    assert Validation(perfect, "plain")(corrector).omegas.tolist() == [-100.0] * len(perfect)
    for path in {recording.path for recording in recordings}:
        shard = read_shard(path)
        still = tuple(
            replace(s, forces=0.0 * s.forces, scene_toml=_unloaded(s)) for s in shard.simulations
        )
        (tmp_path / "validation").mkdir()
        write_shard(
            tmp_path / "validation" / path.name, replace(shard, simulations=still), "float32"
        )
    same = [
        replace(r, reference=rest, plain=rest)
        for r in load_recordings(tmp_path, "validation", "plain")
        for rest in [r.reference[:1].repeat(3, axis=0)]
    ]
    assert (Validation(same, "plain")(corrector).omegas >= 0.0).all()
    ruined = samples.fitted(folder, samples.config(samples.one_step()))
    ruined.normaliser.output_scale.fill_(1e9)
    assert Validation(recordings, "plain")(ruined).omegas.tolist() == [-100.0, -100.0]


def _unloaded(simulation):
    scene = Scene.from_toml(simulation.scene_toml)
    return scene.model_copy(update={"loads": ()}).to_toml()


def test_processes_that_are_to_share_a_gpu_are_refused(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="for 2 processes: expected 'cuda'"), joined("cuda:1"):
        pass


@pytest.mark.parametrize("split", ["training", "validation"])
def test_splits_of_which_files_are_missing_are_refused_unless_asked_for(split, tmp_path):
    data, output = tmp_path / "data", tmp_path / "out"
    shutil.copytree(samples.TINY, data)
    (data / split / "mesh-0001.h5").unlink()
    settings = samples.config(samples.one_step(iterations=1))
    with pytest.raises(InputError, match=rf"{split}: 1 .*mesh-0001\.h5"):
        Training(settings, data, output)
    assert not output.exists()
    Training(settings, data, output, incomplete=True)

"""Trainings that go on with a model: its weights, and ranges widened or left as they are."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.corrector.model_io import load_model, save_model  # noqa: E402
from pdcorrect.corrector.normaliser import RunningMoments  # noqa: E402
from pdcorrect.data.schema import read_shard, write_shard  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402
from training_samples import weights  # noqa: E402

pytestmark = pytest.mark.usefixtures("few_threads")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("data"), frames=5)


@pytest.fixture(scope="module")
def earlier(data, tmp_path_factory):
    """A model of the plain base that was trained for a moment."""
    output = tmp_path_factory.mktemp("earlier")
    Training(samples.config(samples.one_step()), data, output).run()
    return output / "model"


def settings(start, fitting, **changes):
    stage = samples.one_step(iterations=3)
    return samples.config(stage, start_from=str(start), fitting=fitting, **changes)


def test_a_start_of_another_architecture_or_base_or_that_is_not_there_is_refused(
    data, earlier, tmp_path
):
    other = {"preset": "compact", "changes": {"layers": 2, "width": 8}}
    for start, changes, words in (
        (earlier, {"corrector": other}, "layers = 1"),
        (earlier, {"base": "best"}, '"plain".*"best"'),
        (tmp_path / "nothing", {}, "nothing"),
    ):
        with pytest.raises(InputError, match=words):
            Training(settings(start, {}, **changes), data, tmp_path / "out")


# --- another time step -------------------------------------------------------------------------


def test_ranges_that_stay_and_data_of_another_time_step_are_refused(data, earlier, tmp_path):
    model = load_model(earlier)
    low, high = model.corrector.envelope.time_step_low, model.corrector.envelope.time_step_high
    step = float(low.exp())
    for shift in (np.log(2.0), -np.log(2.0)):
        for bound in (low, high):
            bound.fill_(np.log(step) + shift)
        start = save_model(model.corrector, tmp_path / "start", record=model.record)
        there = step * np.exp(shift)
        told = rf"fitting\.widen = false.* {step:.4g} s/m.* {there:.4g} s/m"
        with pytest.raises(InputError, match=told):
            Training(settings(start, {"widen": False}), data, tmp_path / "out")
        found = Training(settings(start, {}), data, tmp_path / "out").corrector
        assert found.envelope.time_steps == pytest.approx(sorted((step, there)))
    for bound in (low, high):
        bound.fill_(np.log(step) + 0.05)  # which a gate lets pass
    start = save_model(model.corrector, tmp_path / "start", record=model.record)
    found = Training(settings(start, {"widen": False}), data, tmp_path / "out").corrector
    assert found.envelope.time_steps == model.corrector.envelope.time_steps


# --- weights and ranges of the start ----------------------------------------------------------


def test_a_training_starts_from_a_models_weights_and_its_ranges_grow(earlier, tmp_path, data):
    new = samples.dataset(tmp_path / "data", training=(3,), validation=(1,), frames=4)
    config = samples.config(samples.one_step(), start_from=str(earlier))
    before = load_model(earlier).corrector
    training = Training(config, new, tmp_path / "out")
    assert torch.equal(weights(training.corrector), weights(before))
    assert training.corrector.normaliser.output_scale == before.normaliser.output_scale
    for name, known in before.named_buffers():
        found = training.corrector.get_buffer(name)
        if name.endswith("__low"):
            assert (found <= known).all()
        elif name.endswith("__high"):
            assert (found >= known).all()
        else:
            assert torch.equal(found, known), name
    training.run()
    assert not torch.equal(weights(training.corrector), weights(before))
    found = load_model(tmp_path / "out" / "model")
    assert found.record.training["config"]["start_from"] == str(earlier)
    assert found.data_sets == load_model(earlier).data_sets  # of one configuration

    config = samples.config(samples.one_step(), start_from=str(earlier))
    training = Training(config, data, tmp_path / "same")
    known = training.corrector.envelope
    fitted = known.get_buffer("deformation__high").clone()
    assert fitted == load_model(earlier).corrector.envelope.get_buffer("deformation__high")
    further = {name: RunningMoments() for name in known.names}
    for name, moments in further.items():
        width = len(known.get_buffer(f"{name.replace('-', '_')}__low"))
        moments.add(torch.full((1, width), 1e3))
    known.widen(further)
    assert known.get_buffer("deformation__high") == 1e3
    assert known.get_buffer("deformation__low") < fitted


def test_a_model_that_went_on_names_all_data_sets_that_it_has_learned(earlier, tmp_path):
    new = samples.dataset(tmp_path / "data", training=(3,), validation=(1,), frames=4)
    for path in new.rglob("*.h5"):
        shard = read_shard(path)
        other = {**shard.attributes, "dataset": "other", "config_hash": "0" * 64}
        path.unlink()
        write_shard(path, replace(shard, attributes=other), "float32")
    config = samples.config(samples.one_step(), start_from=str(earlier))
    Training(config, new, tmp_path / "out").run()
    (before,) = load_model(earlier).data_sets
    found = load_model(tmp_path / "out" / "model")
    assert found.data_sets == [before, ("other", "0" * 64)]
    assert found.record.dataset == "tiny+other"


def test_the_ranges_of_a_start_may_stay_and_the_weights_become_the_same(data, earlier, tmp_path):
    model = load_model(earlier)
    model.corrector.envelope.shape_high -= 1.0  # as of other bodies
    model.corrector.envelope.time_step_high += 1.0  # and of longer time steps, too
    start = save_model(model.corrector, tmp_path / "start", record=model.record)
    found = {}
    for widen in (True, False):
        config = samples.config(samples.one_step(), start_from=str(start), fitting={"widen": widen})
        Training(config, data, tmp_path / str(widen)).run()
        found[widen] = load_model(tmp_path / str(widen) / "model").corrector
    for name, known in model.corrector.named_buffers():
        assert torch.equal(found[False].get_buffer(name), known), name
    assert (found[True].envelope.shape_high > model.corrector.envelope.shape_high).all()
    assert torch.equal(weights(found[True]), weights(found[False]))
    assert not torch.equal(weights(found[True]), weights(model.corrector))


def test_a_start_that_training_only_worsens_is_what_is_kept(data, earlier, tmp_path):
    ruin = samples.one_step(iterations=3, rate={"peak": 1.0, "last": 1.0, "warmup": 0.0})
    config = samples.config(ruin, start_from=str(earlier))
    Training(config, data, tmp_path / "out").run()
    kept = load_model(tmp_path / "out" / "model").corrector
    assert torch.equal(weights(kept), weights(load_model(earlier).corrector))


def test_a_training_does_not_go_on_from_another_start(data, earlier, tmp_path):
    start = tmp_path / "start"
    shutil.copytree(earlier, start)
    often = {"checkpoint_every": {"iterations": 1}}
    from_start = samples.config(samples.one_step(), start_from=str(start), **often)
    Training(from_start, data, tmp_path / "started").run()
    assert Training(from_start, data, tmp_path / "started", resume=True).progress.stage == 1
    altered = load_model(start).corrector
    altered.network.decoder[0].bias.data += 1.0
    save_model(altered, start, record=load_model(earlier).record)
    with pytest.raises(InputError, match=r"start.* = "):
        Training(from_start, data, tmp_path / "started", resume=True)

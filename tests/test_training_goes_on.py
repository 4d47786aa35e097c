"""`fitting` of a training that goes on with a model: ranges widened, left as they are, or anew."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.corrector.corrector import Corrector  # noqa: E402
from pdcorrect.corrector.model_io import load_model, save_model  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from pdcorrect.training import training as training_module  # noqa: E402
from pdcorrect.training.config import TrainingConfig  # noqa: E402
from pdcorrect.training.fitting import fit_normaliser  # noqa: E402
from pdcorrect.training.training import Training  # noqa: E402

pytestmark = pytest.mark.usefixtures("few_threads")

STAGE = '[[stages]]\nkind = "one-step"\niterations = 1\n'
START = 'start_from = "tiny"\n'


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("data"), frames=5)


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """Another data set, of one mesh."""
    return samples.dataset(tmp_path_factory.mktemp("other"), training=(2,), frames=4)


@pytest.fixture(scope="module")
def earlier(data, tmp_path_factory):
    """A model of the plain base that was trained for a moment."""
    output = tmp_path_factory.mktemp("earlier")
    Training(samples.config(samples.one_step()), data, output).run()
    return output / "model"


def settings(start, fitting, **changes):
    stage = samples.one_step(iterations=3)
    return samples.config(stage, start_from=str(start), fitting=fitting, **changes)


# --- the configuration -------------------------------------------------------------------------


def test_choices_that_are_the_default_are_not_written():
    assert "fitting" not in TrainingConfig.from_toml(STAGE).model_dump(exclude_defaults=True)
    assert samples.config(samples.one_step()).model_dump()["fitting"] == {"windows": 10_000}
    for fitting in ({"anew": True}, {"widen": False}):
        config = settings("tiny", fitting)
        assert config.model_dump()["fitting"] == {"windows": 10_000, **fitting}
        assert TrainingConfig.from_toml(config.to_toml()) == config
    config = settings("tiny", {"anew": False, "widen": True})
    assert config == settings("tiny", {})
    assert "anew" not in config.to_toml()
    assert "widen" not in config.to_toml()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (START + "[fitting]\nanew = true\nwiden = false\n", "fitting .*expected one of both"),
        ("[fitting]\nanew = true\n", "fitting.anew = true is about .*expected start_from"),
        ("[fitting]\nwiden = false\n", "fitting.widen = false is about .*expected start_from"),
        (START + '[fitting]\nanew = "yes"\n', 'fitting.anew = "yes"'),
        (START + "[fitting]\nanew = 1\n", "fitting.anew = 1"),
        (START + '[fitting]\nwiden = "yes"\n', 'fitting.widen = "yes"'),
        (START + "[fitting]\nwiden = 0\n", "fitting.widen = 0"),
    ],
)
def test_choices_that_mean_nothing_are_refused(text, told):
    with pytest.raises(InputError, match=told):
        TrainingConfig.from_toml(text + STAGE)


# --- anew --------------------------------------------------------------------------------------


def test_a_start_of_another_base_is_let_pass_if_the_normalisation_is_fitted_anew(
    data, earlier, tmp_path
):
    for fitting, instead in (({}, ""), ({"widen": False}, " in place of fitting.widen = false")):
        with pytest.raises(InputError) as refusal:
            Training(settings(earlier, fitting, base="best"), data, tmp_path / "refused")
        assert str(refusal.value) == (
            f"start_from = {str(earlier)!r}: its base is 'plain': expected 'best', as here, or "
            f"fitting.anew = true{instead}, which takes over that model's weights alone."
        )
    both = settings(earlier, {}, base="best", velocity="kept")
    with pytest.raises(InputError, match=r"its velocity is .* expected 'kept', as here\.$"):
        Training(both, data, tmp_path / "refused")  # which anew = true would not let pass
    Training(settings(earlier, {"anew": True}, base="best"), data, tmp_path / "out").run()
    found = load_model(tmp_path / "out" / "model")
    assert found.base == "best"
    assert found.record.training["config"]["fitting"]["anew"] is True
    assert found.data_sets == load_model(earlier).data_sets


def test_a_start_of_another_velocity_is_refused_also_then(data, earlier, tmp_path):
    config = settings(earlier, {"anew": True}, velocity="kept")
    with pytest.raises(InputError, match="its velocity is 'recomputed': expected 'kept'"):
        Training(config, data, tmp_path / "out")


@pytest.mark.parametrize("base", ["plain", "best"])
def test_weights_are_those_of_the_start_and_the_normalisation_is_a_fresh_one(
    other, earlier, tmp_path, base
):
    config = settings(earlier, {"anew": True, "windows": 3}, base=base, seed=5)
    found, start = Training(config, other, tmp_path).corrector, load_model(earlier).corrector
    fresh = Corrector(config.architecture())
    fit_normaliser(fresh, samples.windows(other, config)[0], 3, seed=5)
    for name, x in start.network.state_dict().items():
        assert torch.equal(found.network.state_dict()[name], x), name
    for name, x in fresh.normaliser.state_dict().items():
        assert torch.equal(found.normaliser.state_dict()[name], x), name
    assert not torch.equal(found.normaliser.output_scale, start.normaliser.output_scale)


def test_such_a_training_goes_on_with_the_same_bits_and_does_not_fit_again(
    other, earlier, tmp_path, monkeypatch
):
    config = settings(earlier, {"anew": True}, base="best", checkpoint_every={"iterations": 1})
    Training(config, other, tmp_path / "whole").run()
    assert not Training(config, other, tmp_path / "broken").run(seconds=0.0)
    monkeypatch.setattr(training_module, "fit_normaliser", None)
    resumed = Training(config, other, tmp_path / "broken", resume=True)
    assert 0 < resumed.progress.total < 3
    assert resumed.run()
    one, two = (load_model(tmp_path / name / "model") for name in ("whole", "broken"))
    for name, x in one.corrector.state_dict().items():
        assert torch.equal(x, two.corrector.state_dict()[name]), name
    changed = settings(earlier, {"widen": False}, checkpoint_every={"iterations": 1})
    with pytest.raises(InputError, match="was begun with config.base"):
        Training(changed, other, tmp_path / "broken", resume=True)


# --- the record --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fitting", "expected"),
    [
        ({}, ["first", "tiny"]),
        ({"widen": False}, ["first"]),
        ({"anew": True}, ["tiny"]),
    ],
    ids=str,
)
def test_a_model_records_the_data_sets_that_its_ranges_were_fitted_to(
    data, earlier, tmp_path, fitting, expected
):
    model = load_model(earlier)
    assert model.fitted_to == model.record.training["fitted_to"] == ["tiny"]
    sets = [{"name": name, "config_hash": name[::-1]} for name in ("first", "second")]
    model.record.training.update(data_sets=sets, fitted_to=["first"])
    start = save_model(model.corrector, tmp_path / "start", record=model.record)
    Training(settings(start, fitting), data, tmp_path / "out").run()
    found = load_model(tmp_path / "out" / "model")
    assert [name for name, _ in found.data_sets] == ["first", "second", "tiny"]
    assert found.record.dataset == "first+second+tiny"
    assert found.fitted_to == found.record.training["fitted_to"] == expected
    again = settings(tmp_path / "out" / "model", {})
    Training(again, data, tmp_path / "again").run()
    further = load_model(tmp_path / "again" / "model").fitted_to
    assert further == [*expected, *({"tiny"} - set(expected))]  # each once


def test_ranges_of_a_model_that_does_not_record_it_count_as_fitted_to_all_that_it_learned(earlier):
    model = load_model(earlier)
    del model.record.training["fitted_to"]
    sets = [{"name": name, "config_hash": None} for name in ("b+a", "a", "c")]
    model.record.training["data_sets"] = sets
    assert model.fitted_to == ["b", "a", "c"]
    del model.record.training["data_sets"]
    assert model.fitted_to == ["tiny"]


# --- another time step -------------------------------------------------------------------------


def test_ranges_that_stay_and_data_of_another_time_step_are_refused(data, earlier, tmp_path):
    model = load_model(earlier)
    low, high = model.corrector.normaliser.time_step_low, model.corrector.normaliser.time_step_high
    step = float(low.exp())
    for shift in (np.log(2.0), -np.log(2.0)):
        for bound in (low, high):
            bound.fill_(np.log(step) + shift)
        start = save_model(model.corrector, tmp_path / "start", record=model.record)
        there = step * np.exp(shift)
        told = (
            "start_from = .* with fitting.widen = false: the data's time step over the cell size "
            f"is {step:.4g} s/m, that of the ranges that stay {there:.4g} s/m, so a gate would"
        )
        with pytest.raises(InputError, match=told):
            Training(settings(start, {"widen": False}), data, tmp_path / "out")
        for fitting, expected in (({}, sorted((step, there))), ({"anew": True}, [step, step])):
            found = Training(settings(start, fitting), data, tmp_path / "out").corrector
            assert found.normaliser.time_steps == pytest.approx(expected)


def test_ranges_that_stay_may_differ_by_what_a_gate_lets_pass(data, earlier, tmp_path):
    model = load_model(earlier)
    model.corrector.normaliser.time_step_low += 0.05
    model.corrector.normaliser.time_step_high += 0.05
    start = save_model(model.corrector, tmp_path / "start", record=model.record)
    found = Training(settings(start, {"widen": False}), data, tmp_path / "out").corrector
    assert found.normaliser.time_steps == model.corrector.normaliser.time_steps

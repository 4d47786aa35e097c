"""Windows of single steps, the normalisation that is fitted to them, and the optimiser."""

from dataclasses import fields

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

import training_samples as samples  # noqa: E402
from pdcorrect.corrector.bodies import KNOWN, BodyGraph  # noqa: E402
from pdcorrect.corrector.features import (  # noqa: E402
    EDGE_FEATURES,
    NODE_FEATURES,
    FeatureView,
    values,
)
from pdcorrect.data.schema import read_shard  # noqa: E402
from pdcorrect.training.distributed import ProcessGroup  # noqa: E402
from pdcorrect.training.fitting import fit_normaliser, widen_ranges  # noqa: E402
from pdcorrect.training.optimisation import Optimiser  # noqa: E402
from pdcorrect.training.windows import OneStepBatches, one_step_loss  # noqa: E402
from training_samples import weights  # noqa: E402


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return samples.dataset(tmp_path_factory.mktemp("tiny"))


pytestmark = pytest.mark.usefixtures("few_threads")

# --- windows -----------------------------------------------------------------------------


def test_a_window_asks_for_what_the_base_model_lacks(folder):
    settings = samples.config(samples.one_step())
    windows, recordings = samples.windows(folder, settings)
    batch = windows.batch([3, 20 + 5])  # frame 3 of the first mesh, 5 of the second's first
    runs = read_shard(folder / "training" / "mesh-0003.h5").simulations[0].runs
    nodes = recordings[0].reference.shape[1]
    predictions = runs["plain"].predictions
    wanted = runs["reference"].positions[6].astype(float) - predictions[5]
    np.testing.assert_allclose(batch.target[nodes:].numpy(), wanted, atol=1e-8)
    np.testing.assert_array_equal(batch.snapshot.proposed[nodes:].numpy(), predictions[5])
    assert batch.scale.tolist() == [r.one_step for r in recordings[:2]]
    assert batch.snapshot.correction is None


def remembering():
    """A configuration whose network sees the correction of the step before."""
    names = ("node-type", "previous-correction", "strain", "load", "acceleration")
    changes = {**samples.SMALL["changes"], "node_features": names}
    return samples.config(samples.one_step(), corrector={"preset": "compact", "changes": changes})


def test_a_network_that_remembers_sees_the_correction_of_the_step_before(folder):
    windows, _ = samples.windows(folder, remembering())
    plain, _ = samples.windows(folder, samples.config(samples.one_step()))
    first, begins = windows.batch([3], last=False), plain.batch([3])
    assert first.snapshot.correction is None
    for name in ("positions", "velocities", "proposed", "forces"):
        torch.testing.assert_close(getattr(first.snapshot, name), getattr(begins.snapshot, name))
    torch.testing.assert_close(first.target, begins.target)
    found, before, now = windows.batch([3]), plain.batch([3]), plain.batch([4])
    torch.testing.assert_close(found.snapshot.correction, before.target)
    torch.testing.assert_close(found.target, now.target)
    torch.testing.assert_close(found.snapshot.positions, now.snapshot.positions)
    torch.testing.assert_close(
        found.snapshot.velocities, now.snapshot.velocities, rtol=1e-5, atol=1e-5
    )


def test_noise_is_seen_and_to_be_corrected(folder):
    settings = samples.config(samples.one_step())
    batch = samples.windows(folder, settings)[0].batch(list(range(0, 60, 4)))
    generator = torch.Generator().manual_seed(1)
    tau = 0.5
    noisy = batch.with_noise(tau, generator)
    noise = noisy.snapshot.proposed - batch.snapshot.proposed
    torch.testing.assert_close(
        noisy.snapshot.proposed + noisy.target, batch.snapshot.proposed + batch.target
    )
    assert not noise[~batch.bodies.free].any()
    free = batch.bodies.free.all(dim=1)
    unit = batch.bodies.by_node((batch.scale / 3).sqrt())[:, None]
    sizes = (noise / unit)[free]
    assert float(sizes.square().mean().sqrt()) == pytest.approx(tau, rel=0.05)
    assert abs(float(sizes.mean())) < 0.1 * tau
    assert noisy.snapshot.positions is batch.snapshot.positions


def test_windows_are_those_of_the_files_and_know_their_bodies_at_rest(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    assert len(windows.dataset) == 60
    for index in (60, 10**6):
        with pytest.raises(IndexError, match=str(index)):
            windows.batch([0, index])
    chosen = [45, 3, 18, 45, 20, 56, 0]  # both meshes, all simulations, first and last windows
    batch, read = windows.batch(chosen), windows.dataset.batch(chosen)
    state, bodies = batch.snapshot, batch.bodies
    assert torch.equal(state.positions, read.positions.to(torch.float64))
    assert torch.equal(state.velocities, read.velocities.to(torch.float64))
    assert torch.equal(state.proposed, read.predictions[:, 0].to(torch.float64))
    assert torch.equal(state.forces, read.forces[:, 0].to(torch.float64))
    assert torch.equal(batch.target, read.targets[:, 0].to(torch.float64) - state.proposed)
    alone = BodyGraph.of_batch(read).to(dtype=torch.float64)
    for field in fields(bodies):
        x, y = getattr(bodies, field.name), getattr(alone, field.name)
        assert torch.equal(x, y) if not x.is_floating_point() else torch.allclose(x, y, rtol=1e-6)
    for name in KNOWN:
        torch.testing.assert_close(vars(bodies)[name], getattr(bodies.to(), name))


def test_batches_go_through_all_windows_in_an_order_of_their_number_alone(folder):
    windows, _ = samples.windows(folder, samples.config(samples.one_step()))
    stage = samples.one_step(batch=7)
    batches = OneStepBatches(windows, stage, 3, ProcessGroup())
    assert len(batches) == 60 // 7
    parts = [OneStepBatches(windows, stage, 3, ProcessGroup(rank, 2)) for rank in (0, 1)]
    assert [len(part) for part in parts] == [4, 4]
    seen = [batches.batch(k).target for k in range(2 * len(batches))]
    assert not torch.equal(seen[0], seen[len(batches)])
    again = OneStepBatches(windows, stage, 3, ProcessGroup())
    for k in (len(batches) + 1, 2):  # where a training goes on
        assert torch.equal(again.batch(k).target, seen[k])


# --- normalisation -----------------------------------------------------------------------


def test_the_normaliser_has_zero_mean_and_unit_deviation_on_the_training_split(folder):
    architecture = {"preset": "thesis", "changes": {"layers": 1, "width": 8}}
    settings = samples.config(samples.one_step(), corrector=architecture)
    corrector = samples.fitted(folder, settings)
    windows, _ = samples.windows(folder, settings)
    fit_normaliser(corrector, windows, 10**6)
    every = windows.batch(range(len(windows.dataset)))
    normaliser = corrector.normaliser
    np.testing.assert_allclose(
        normaliser.force__mean.numpy(), every.snapshot.forces.mean(dim=0).numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        normaliser.force__deviation.numpy(),
        every.snapshot.forces.std(dim=0, correction=0).numpy(),
    )
    target = every.target[every.bodies.free.all(dim=1)]
    assert float(normaliser.output_scale) == pytest.approx(float(target.square().mean().sqrt()))


def test_bodies_of_the_training_split_are_like_it_whatever_part_is_fitted_to(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    corrector = samples.fitted(folder, settings)
    fit_normaliser(corrector, windows, 10**6)
    every = windows.batch(range(len(windows.dataset)))
    view = FeatureView(every.bodies, every.snapshot)
    averages = every.bodies.body_means(corrector.inputs(view)[0])
    envelope = corrector.envelope
    np.testing.assert_allclose(
        envelope.average_mean.numpy(), averages.mean(dim=0).numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        envelope.average_low.numpy(), averages.amin(dim=0).numpy(), atol=1e-12
    )
    np.testing.assert_allclose(
        envelope.average_high.numpy(), averages.amax(dim=0).numpy(), atol=1e-12
    )
    assert 1.0 < float(envelope.average_excess(averages).max()) <= 3.5 + 1e-9
    assert not (corrector.score(view) > 1.0).any()

    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    corrector = samples.fitted(folder, settings)
    corrector.envelope.shape_low.fill_(torch.nan)
    fit_normaliser(corrector, windows, 1)
    bodies = windows.batch(range(len(windows.dataset))).bodies
    assert len(torch.unique(bodies.shapes, dim=0)) > 1
    envelope = corrector.envelope
    assert not envelope.shape_excess(bodies.shapes).any()
    assert torch.equal(envelope.shape_low, bodies.shapes.double().amin(dim=0))
    assert torch.equal(envelope.shape_high, bodies.shapes.double().amax(dim=0))
    envelope.shape_low += 1.0  # as of larger bodies
    assert (envelope.shape_excess(bodies.shapes) > 0.5).any()
    widen_ranges(corrector, windows, 1)
    assert not envelope.shape_excess(bodies.shapes).any()
    assert torch.equal(envelope.shape_high, bodies.shapes.double().amax(dim=0))


def test_the_time_step_of_the_training_data_is_fitted_and_widened(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    corrector, size = samples.fitted(folder, settings), 0.05
    step = windows.dataset.headers[0].time_step / size
    envelope = corrector.envelope
    envelope.time_step_low.fill_(torch.nan)
    fit_normaliser(corrector, windows, 1)
    assert envelope.time_steps == pytest.approx((step, step), rel=1e-6)
    bodies = windows.batch([0]).bodies
    assert bodies.time_steps.tolist() == pytest.approx([np.log(step)], abs=1e-6)
    assert envelope.time_step_excess(bodies.time_steps).tolist() == [0.0]
    for shift in (np.log(2.0), -np.log(2.0)):  # as of data with another step
        envelope.time_step_low += shift
        envelope.time_step_high += shift
        assert envelope.time_step_excess(bodies.time_steps).tolist() == pytest.approx(
            [np.log(2.0)], abs=1e-6
        )
        both = sorted((step, step * np.exp(shift)))
        widen_ranges(corrector, windows, 1)
        assert envelope.time_steps == pytest.approx(both, rel=1e-6)
        fit_normaliser(corrector, windows, 1)
        assert envelope.time_steps == pytest.approx((step, step), rel=1e-6)


def test_fitting_to_a_part_is_a_matter_of_the_seed_alone(folder):
    settings = samples.config(samples.one_step())
    windows, _ = samples.windows(folder, settings)
    found = []
    for seed in (0, 0, 1):
        corrector = samples.fitted(folder, settings)
        fit_normaliser(corrector, windows, 10, seed)
        found.append(corrector.normaliser.state_dict())
    for name, x in found[0].items():
        assert torch.equal(x, found[1][name])
    assert found[0]["output_scale"] != found[2]["output_scale"]


@pytest.mark.parametrize("remembers", [False, True])
def test_first_steps_are_within_the_ranges_of_a_fit_to_a_part(folder, remembers):
    settings = remembering() if remembers else samples.config(samples.one_step())
    # windows of one step, whatever the network asks for: what it sees when it begins
    windows, _ = samples.windows(folder, samples.config(samples.one_step()))
    corrector = samples.fitted(folder, settings)
    _, _, steps = windows.dataset.places(range(len(windows.dataset)))
    first, others = np.flatnonzero(steps == 0), np.flatnonzero(steps == 10)
    fit_normaliser(corrector, samples.windows(folder, settings)[0], len(first))

    def outside(numbers):
        batch = windows.batch(numbers.tolist())
        view = FeatureView(batch.bodies, batch.snapshot)
        config = corrector.config
        names = ((NODE_FEATURES, config.node_features), (EDGE_FEATURES, config.edge_features))
        return torch.cat([corrector.excess(values(*row, view)) for row in names])

    assert not outside(first).any()
    assert outside(others).any()  # so few windows do not hold all of the rest


# --- steps of the optimiser --------------------------------------------------------------


def test_batches_without_a_finite_gradient_change_nothing_and_are_counted(folder):
    settings = samples.config(samples.one_step())
    corrector = samples.fitted(folder, settings)
    optimiser = Optimiser(corrector, settings.stages[0], None, ProcessGroup())
    some = next(iter(corrector.network.parameters()))

    def loss(factor):
        return factor * sum(p.square().sum() for p in corrector.network.parameters())

    optimiser.step(loss(1.0), 0.5)
    before, moments = weights(corrector), optimiser.state_dict()
    moments = {n: x.clone() for n, x in moments.items() if n.startswith("adam")}
    optimiser.step(loss(torch.nan), 0.5)
    optimiser.step((some - some.detach()).abs().sqrt().sum(), 0.5)  # infinite derivatives only
    assert torch.equal(weights(corrector), before)
    for name, x in optimiser.state_dict().items():
        if name.startswith("adam"):
            assert torch.equal(x, moments[name]), name
    told = optimiser.take_report()
    assert (told["count"], told["skipped"], told["longest"]) == (1, 2, 2)
    optimiser.step(loss(1.0), 0.5)
    assert not torch.equal(weights(corrector), before)
    optimiser.step(loss(torch.inf), 0.5)
    told = optimiser.take_report()
    assert (told["count"], told["skipped"], told["longest"]) == (1, 1, 2)
    assert optimiser.take_report()["longest"] == 1


def test_gradients_are_clipped_and_averaged_weights_follow_by_their_decay(folder):
    settings = samples.config(samples.one_step(ema=0.75))
    corrector, averaged = samples.fitted(folder, settings), samples.fitted(folder, settings)
    before = weights(averaged)
    optimiser = Optimiser(corrector, settings.stages[0], averaged, ProcessGroup())
    optimiser.step(1e3 * sum(p.square().sum() for p in corrector.network.parameters()), 0.5)
    grads = [p.grad for p in corrector.network.parameters()]
    assert float(torch.nn.utils.get_total_norm(grads)) == pytest.approx(1.0, rel=1e-4)
    found = weights(averaged)
    torch.testing.assert_close(found, 0.75 * before + 0.25 * weights(corrector))
    assert not torch.equal(found, before)


def test_bfloat16_is_close_to_full_precision_but_not_the_same(folder):
    settings = samples.config(samples.one_step())
    corrector = samples.fitted(folder, settings)
    batch = samples.windows(folder, settings)[0].batch([3, 30])
    full, half = (
        one_step_loss(corrector, batch, samples.one_step(amp=amp)).item()
        for amp in ("none", "bf16")
    )
    assert half == pytest.approx(full, rel=0.05)
    assert half != full
    assert one_step_loss(corrector, batch, samples.one_step()).item() == full

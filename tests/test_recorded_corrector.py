"""`RecordedCorrector` and `RecordedMeasures`: the same answers, whatever changes between them."""

import copy
import pickle

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from torch._subclasses.fake_tensor import (  # noqa: E402
    DataDependentOutputException,
    FakeTensorMode,
)

import pdcorrect as pc  # noqa: E402
from hybrid_samples import fitted, problems  # noqa: E402
from pdcorrect.corrector import graph_replay  # noqa: E402
from pdcorrect.corrector.batch_hybrid import BatchBodies, BatchCoarseStep  # noqa: E402
from pdcorrect.corrector.features import FeatureView, Snapshot  # noqa: E402
from pdcorrect.corrector.gate import Reason  # noqa: E402
from pdcorrect.corrector.graph_replay import RecordedCorrector, recordable  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]
CELLS = ((3, 1, 1), (2, 2, 1))


@pytest.fixture(params=DEVICES)
def device(request):
    return request.param


@pytest.fixture
def made(device):
    corrector = fitted(problems(*CELLS), size=0.01, node_features=FEATURES)
    return corrector.to(device)


FEATURES = ("node-type", "stiffness", "strain", "acceleration", "load", "previous-correction")


class Motion:
    """Views of a batch that moves, and its step."""

    def __init__(self, device, corrector, steps=4):
        self.stepper = pc.BatchStepper(problems(*CELLS), device=device)
        self.parts = BatchBodies(self.stepper, recorded=True)
        state, self.steps = self.stepper.rest_state(), []
        for number in range(steps):
            previous = None
            if number:
                previous = 1e-4 * torch.sin(100.0 * self.parts.flat(state.positions))
            step = BatchCoarseStep(self.parts, state, previous)
            coarse = step.solved()
            self.steps.append((step, coarse, step.view(coarse)))
            state = coarse.state

    @property
    def views(self):
        return [view for _, _, view in self.steps]


def assert_same(answers, corrector, view):
    """Corrections and scores, at rounding of single precision at most."""
    with torch.no_grad():
        anew = FeatureView(view.bodies, view.snapshot)
        expected = corrector.of_view(anew)
        found = answers.of_view(view)
        size = expected.abs().max()
        assert size > 1e-8
        assert (found - expected).abs().max() < 1e-5 * size
        torch.testing.assert_close(answers.score(view), corrector.score(anew))


def test_answers_are_those_of_the_corrector_step_by_step_and_stay(device, made):
    motion = Motion(device, made)
    answers = RecordedCorrector(made)
    for view in (*motion.views, *motion.views[::-1]):
        assert_same(answers, made, view)
    first, second, *_ = motion.views
    with torch.no_grad():
        kept = answers.of_view(first)
        before = kept.clone()
        answers.of_view(second)
    assert torch.equal(kept, before)


def test_other_views_are_not_taken_for_those_recorded(device, made):
    first, second, *_ = Motion(device, made).views
    answers = RecordedCorrector(made)
    with torch.no_grad():
        answers.of_view(first)
        for view in (first, second):
            torch.testing.assert_close(answers.score(view), made.score(view))


def written(corrector):
    with torch.no_grad():
        corrector.network.decoder[-1].weight.mul_(2.0)


def loaded(corrector):
    weights = {name: 2 * x for name, x in corrector.network.state_dict().items()}
    corrector.network.load_state_dict(weights)


def replaced(corrector):
    last = corrector.network.decoder[-1]
    last.weight = torch.nn.Parameter(3.0 * last.weight.detach())


def moved(corrector):
    last = corrector.network.decoder[-1]
    last.weight.data = 3.0 * last.weight.detach()


def layered(corrector):
    corrector.network.decoder[0] = torch.nn.Linear(16, 16, dtype=torch.float64).to(
        corrector.network.decoder[0].weight
    )


def grown(corrector):
    corrector.network.register_buffer("unused", torch.zeros(1))


def scaled(corrector):
    corrector.normaliser.output_scale.mul_(2.0)


def clipped(corrector):
    corrector.config = corrector.config.model_copy(update={"clip": 0.5})


IN_PLACE, ANEW = [written, loaded, scaled], [replaced, moved, layered, grown, clipped]


@pytest.mark.parametrize("change", [*IN_PLACE, *ANEW])
def test_changes_of_the_corrector_count_at_once(device, made, change):
    motion = Motion(device, made)
    view = motion.views[-1]
    answers = Counted(made)
    with torch.no_grad():
        answers.of_view(motion.views[-2])
        before = answers.of_view(view)
    assert answers.recorded == 1
    change(made)
    again = FeatureView(view.bodies, view.snapshot)
    assert_same(answers, made, again)
    assert answers.recorded == (1 if change in IN_PLACE else 2)
    if change is not grown:
        with torch.no_grad():
            assert (answers.of_view(again) - before).abs().max() > 1e-3 * before.abs().max()


class Counted(RecordedCorrector):
    """Knows how often it recorded."""

    recorded = 0

    def _record(self, bodies):
        self.recorded += 1
        super()._record(bodies)


def test_a_recording_that_fails_leaves_nothing_behind(device, made, monkeypatch):
    motion = Motion(device, made)
    answers = RecordedCorrector(made)
    assert_same(answers, made, motion.views[1])
    replaced(made)

    def failing(device):
        raise MemoryError

    monkeypatch.setattr(graph_replay, "Recorder", failing)
    for _ in range(2):
        with pytest.raises(MemoryError):
            answers.of_view(motion.views[1])
    monkeypatch.undo()
    assert_same(answers, made, motion.views[1])


def test_what_is_recorded_stays_where_it_is(device, made):
    """A GPU replays work on addresses."""
    motion = Motion(device, made)
    answers = Counted(made)

    def places():
        kept = [answers._answer, answers._score]
        kept += [getattr(answers._snapshot, name) for name in ("positions", "correction")]
        measures, stepper = motion.parts.measures, motion.stepper
        kept += [measures._positions, measures._velocities, measures._y]
        kept += [measures._stored, measures._ratios, stepper.cells.point_weights]
        kept += [stepper.objective.mass.nodal, stepper.objective.mass.density]
        return [x.data_ptr() for x in kept]

    seen = []
    for number, (step, coarse, view) in enumerate(motion.steps):
        answers.of_view(view)
        step.measured(coarse)
        seen.append(places())
        if number == 1:
            motion.stepper.set_material(young=6e4, density=700.0)
    assert all(found == seen[0] for found in seen)
    assert answers.recorded == 1


def test_nothing_that_is_recorded_asks_for_a_value(made):
    """On tensors without values, as those of a graph that is being recorded."""
    motion = Motion("cpu", made.to("cpu"))
    view = motion.views[2]
    with torch.no_grad():
        made.of_view(view)  # what is known of the bodies at rest is there before
        made.rest_score(view.bodies)
    with FakeTensorMode(allow_non_fake_inputs=True) as fake, torch.no_grad():
        snapshot = Snapshot(*(fake.from_tensor(x) for x in vars(view.snapshot).values()))
        found = FeatureView(view.bodies, snapshot)
        vars(found)["turns"] = fake.from_tensor(view.turns)  # a loop on the CPU
        corrections = made.of_view(found)
        assert corrections.shape == view.bodies.rest.shape
        assert made.score(found).shape == (2,)
        with pytest.raises(DataDependentOutputException):
            float(corrections.sum())


def test_other_bodies_and_materials_are_recorded_anew(device, made):
    motion = Motion(device, made)
    answers = RecordedCorrector(made)
    assert_same(answers, made, motion.views[1])
    motion.stepper.set_material(young=8e4)
    state = motion.stepper.rest_state()
    step = BatchCoarseStep(motion.parts, state, None)
    assert_same(answers, made, step.view(step.solved()))
    assert_same(answers, made, Motion(device, made).views[2])


def test_measures_are_energies_and_volumes_of_the_material_of_now(device, made):
    motion = Motion(device, made)
    for young in (None, 2e5):
        if young:
            motion.stepper.set_material(young=young, density=500.0)
        for step, coarse, _ in motion.steps[1:]:
            measured = step.measured(coarse)
            for i, state in enumerate(motion.stepper.states(coarse.state)):
                problem = motion.stepper.problem_now(i)
                kinetic = 0.5 * (state.velocities * problem.mass_times(state.velocities)).sum()
                expected = kinetic + problem.energy(state.positions)
                assert float(measured.stored[i]) == pytest.approx(float(expected), rel=1e-9)
                ratios = problem.volume_ratios(state.positions)
                assert float(measured.ratios[i].min()) == pytest.approx(ratios.min(), rel=1e-12)


def hooked(corrector):
    corrector.network.decoder.register_forward_hook(lambda *_: None)


def patched(corrector):
    corrector.of_view = lambda view: torch.zeros_like(view.bodies.rest)


def tanh(corrector):
    corrector.network.node_encoder[1] = torch.nn.Tanh()


def neutral(corrector):
    corrector.config = corrector.config.model_copy(update={"momentum_neutral": True})


@pytest.mark.parametrize("change", [hooked, patched, tanh, neutral])
def test_code_that_would_not_run_is_not_recorded(device, made, change):
    stepper = pc.BatchStepper(problems(*CELLS), device=device)
    assert recordable(made)
    assert pc.BatchHybrid(stepper, made, recorded=True)(stepper.rest_state()).correction.any()
    change(made)
    assert not recordable(made)
    assert not pc.BatchHybrid(stepper, made)(stepper.rest_state()).refused.any()
    if change is not neutral:
        with pytest.raises(InputError, match="record"):
            RecordedCorrector(made).of_view(Motion(device, made).views[0])
    with pytest.raises(InputError, match="record"):
        pc.BatchHybrid(stepper, made, recorded=True)


def test_rollouts_are_those_without_recording(device):
    corrector = fitted(problems(*CELLS), size=0.01).to(device)
    gate = pc.Gate(outside=0.8)
    stepper = pc.BatchStepper(problems(*CELLS), device=device)
    runs = []
    for replayed in (False, True):
        hybrid = pc.BatchHybrid(stepper, corrector, gate=gate, recorded=replayed)
        state, reasons = stepper.rest_state(), []
        for _ in range(6):
            result = hybrid(state)
            state = result.state
            reasons.append(result.reasons)
        runs.append((state.positions, torch.stack(reasons)))
    (one, refused), (two, refused_too) = runs
    assert torch.equal(refused, refused_too)
    assert (refused == 0).any()  # some corrections count
    assert (one - two).abs().max() < 1e-8


def assert_equal(found, expected):
    """On a GPU to rounding, since sums over edges and corners add in any order there."""
    if found.device.type == "cpu":
        assert torch.equal(found, expected)
    else:
        assert (found - expected).abs().max() < 1e-6 * expected.abs().max()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_of_a_hybrid_in_use_record_for_themselves(device, made, copied):
    stepper = pc.BatchStepper(problems(*CELLS), device=device)
    gate = pc.Gate(outside=100.0)
    hybrid = pc.BatchHybrid(stepper, made, gate=gate, recorded=True)
    first = hybrid(stepper.rest_state())
    other = copied(hybrid)
    written(other.corrector)
    anew = pc.BatchHybrid(stepper, other.corrector, gate=gate, recorded=True)
    one, two, three = (h(h.stepper.rest_state()).correction for h in (hybrid, other, anew))
    assert_equal(one, first.correction)
    assert_equal(two, three)
    assert (two - one).abs().max() > 0.1 * one.abs().max()


def test_inference_mode_makes_no_difference(device, made):
    motion = Motion(device, made)
    hybrid = pc.BatchHybrid(motion.stepper, made, recorded=True)
    state = motion.steps[2][1].state
    with torch.inference_mode():
        found = hybrid(state).correction
    assert_equal(found, hybrid(state).correction)


def test_of_a_recorded_batch_the_out_of_distribution_body_is_refused(device, made):
    several = [*problems(*CELLS), *problems((14, 1, 1))]
    stepper = pc.BatchStepper(several, device=device)
    gate = pc.Gate(crushing=None, energy=None)
    hybrid, state = pc.BatchHybrid(stepper, made, gate=gate, recorded=True), stepper.rest_state()
    for _ in range(3):
        result = hybrid(state)
        state = result.state
        assert result.reasons.tolist() == [*[0] * len(CELLS), Reason.OUTSIDE]
    assert not result.correction[-len(several[-1].positions) :].any()
    assert result.correction.any()

"""`Gate.corners`: bodies that are folded at a corner, where quadrature points may not see it."""

import numpy as np
import pytest
import torch

import pdcorrect as pc
from hybrid_samples import PLACEMENTS, Prescribed, fitted, problems, soft_beam
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.bodies import BodyGraph, corner_jacobians
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import FeatureView, Snapshot
from pdcorrect.corrector.gate import Gate, Reason
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.fem import hexahedron

NOTHING = {
    "body": None, "margin": None, "average": None, "volume": None, "crushing": None, "energy": None,
}  # fmt: skip
"""Bounds of a gate that refuses only what is refused without one."""
INSTANT = {"step": 1e-7, "frames": 1}
"""A time step in which a body stays where it is."""


def graph(*scenes):
    return BodyGraph.of(scenes, dtype=torch.float64)


def folded(problem, by=0.4):
    """A free corner of the body pushed past the plane of its three neighbours, and not farther."""
    moved = problem.positions.copy()
    away = np.where(problem.free.all(axis=1), problem.positions.sum(axis=1), -np.inf)
    moved[int(away.argmax())] -= by * problem.cell_size
    return moved


def test_jacobians_are_those_of_the_mesh():
    rng = np.random.default_rng(0)
    problem = problems((3, 2, 1))[0]
    x = problem.positions + 0.6 * problem.cell_size * rng.normal(size=problem.positions.shape)
    found = corner_jacobians(torch.as_tensor(x), torch.tensor(problem.cells))
    expected = hexahedron.corner_jacobians(x, problem.cells)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12, atol=1e-20)
    assert (expected < 0.0).any()
    assert (expected > 0.0).any()


def test_each_body_has_its_own_least_corner():
    scenes = problems((3, 1, 1), (2, 2, 1), (1, 1, 2))
    rng = np.random.default_rng(1)
    moved = [s.positions + 0.1 * s.cell_size * rng.normal(size=s.positions.shape) for s in scenes]
    moved[1] = folded(scenes[1])
    found = graph(*scenes).least_corners(torch.as_tensor(np.concatenate(moved)))
    expected = [s.corner_volume_ratios(x).min() for s, x in zip(scenes, moved, strict=True)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)
    assert found[1] == pytest.approx(1.0 - 3 * 0.4)


def test_what_is_no_number_does_not_pass():
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector, bodies = fitted(scenes), graph(*scenes)
    positions = torch.as_tensor(np.concatenate([s.positions for s in scenes]))
    for spoilt, flags in ((None, [False, False]), (0, [True, False])):
        proposed = positions.clone()
        if spoilt is not None:
            proposed[spoilt] = torch.nan
        still = torch.zeros_like(positions)
        view = FeatureView(bodies, Snapshot(positions, still, proposed, still))
        assert Gate(corners=0.0).folded(corrector, view).tolist() == flags
    assert Gate().folded(corrector, view) is False


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("kind", [Corrector, Prescribed])
def test_a_folded_body_passes_by_default_and_not_with_a_bound_for_corners(kind, placement):
    """By the compiled corrector, which takes no other class's place, and by torch."""
    problem = pc.discretise(soft_beam((3, 2, 2), time=INSTANT))
    state = pc.State(folded(problem), np.zeros_like(problem.positions))
    coarse = pc.ProjectiveDynamics(problem)
    corrector = fitted([problem], kind=kind, placement=placement)
    if kind is Prescribed:
        corrector.answer = np.full(problem.positions.shape, 1e-6)
    plain = coarse(state).state.positions
    assert problem.volume_ratios(plain).min() > 0.0
    least = float(problem.corner_volume_ratios(plain).min())
    assert least == pytest.approx(1.0 - 3 * 0.4, abs=1e-3)
    for bound, reason in (
        (None, Reason.NONE),
        (0.0, Reason.FOLDED),
        (least + 1e-3, Reason.FOLDED),
        (least - 1e-3, Reason.NONE),
    ):
        hybrid = HybridStepper(coarse, corrector, gate=Gate(**NOTHING, corners=bound))
        assert hybrid.compiled == (kind is Corrector)
        found = hybrid(state)
        assert found.stats["gate"] == reason, bound
        assert found.stats["refused"] == float(reason != Reason.NONE)
        if placement == "state":
            assert np.array_equal(found.state.positions, plain) == (reason != Reason.NONE)


@pytest.mark.parametrize("recorded", [False, True])
def test_a_batch_refuses_the_folded_body_only(recorded):
    scenes = [pc.discretise(soft_beam(c, time=INSTANT)) for c in ((3, 1, 1), (2, 2, 1))]
    stepper, corrector = pc.BatchStepper(scenes), fitted(scenes)
    bent = pc.State(folded(scenes[0]), np.zeros_like(scenes[0].positions))
    state = stepper.state([bent, scenes[1].rest_state()])
    least = 1.0 - 3 * 0.4
    for bound, reasons in (
        (None, [Reason.NONE, Reason.NONE]),
        (least - 1e-3, [Reason.NONE, Reason.NONE]),
        (least + 1e-3, [Reason.FOLDED, Reason.NONE]),
        (1.1, [Reason.FOLDED, Reason.FOLDED]),
    ):
        gate = Gate(**NOTHING, corners=bound)
        hybrid = BatchHybrid(stepper, corrector, gate=gate, recorded=recorded)
        assert hybrid(state).reasons.tolist() == reasons, bound

"""Derivatives of corrected steps by the weights of the network."""

import pytest
import torch

import pdcorrect as pc
from hybrid_samples import (
    CELL,
    PRESSURE,
    TINY,
    TORSION,
    fitted,
    problems,
    soft_beam,
)
from pdcorrect.corrector.batch_hybrid import BatchHybrid, HybridLayer
from pdcorrect.corrector.corrector import preset


class Unrolled:
    """A loss over three corrected steps from a bent shape, by the network's weights."""

    def __init__(self, through_solver, cells=((2, 1, 1),)):
        scenes = [
            pc.discretise(
                soft_beam(c, loads=[TORSION, PRESSURE, {**PRESSURE, "window": [0, 0.02]}])
            )
            for c in cells
        ]
        self.corrector = fitted(scenes, size=0.5, seed=4, **TINY)
        self.stepper = pc.BatchStepper(scenes, 1e-13)
        self.layer = HybridLayer(self.stepper, self.corrector, through_solver=through_solver)
        self.layer.steps.tolerance = 1e-10
        self.start = self.stepper.rest_state()
        self.through, self.frames = through_solver, []

    def __call__(self, frames=None):
        """The loss; each step from its given frame where there are such."""
        p, v, d = self.start.positions, self.start.velocities, None
        total, rest = 0.0, self.start.positions
        self.frames = []
        for k in range(3):
            if frames is not None:
                p, v, d = frames[k]
            self.frames.append((p, v, d))
            times = [k * self.stepper.time_step] * len(self.stepper.problems)
            p, v, d = self.layer(p, v, times, d)
            total = total + ((p - rest) / CELL).square().sum() + (d / CELL).square().sum()
        return total


def frozen(unrolled):
    """The inputs of each step, if they count as given."""
    if unrolled.layer.through_solver:
        return None
    return [tuple(None if x is None else x.detach() for x in frame) for frame in unrolled.frames]


@pytest.mark.parametrize("through_solver", [True, False])
def test_derivatives_along_ways_through_all_weights_are_difference_quotients(through_solver):
    unrolled = Unrolled(through_solver)
    unrolled().backward()
    given, step = frozen(unrolled), 1e-6
    weights = list(unrolled.corrector.parameters())
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for _ in range(2):
            way = [torch.randn(w.shape, generator=random, dtype=w.dtype) for w in weights]
            expected = sum((w.grad * d).sum() for w, d in zip(weights, way, strict=True))
            losses = []
            for shift in (step, -2 * step):
                for w, d in zip(weights, way, strict=True):
                    w += shift * d
                losses.append(unrolled(given))
            for w, d in zip(weights, way, strict=True):
                w += step * d
            quotient = (losses[0] - losses[1]) / (2 * step)
            assert abs(quotient - expected) < 1e-5 * abs(expected)


@pytest.mark.slow
@pytest.mark.parametrize("through_solver", [True, False])
def test_derivatives_by_every_weight_are_difference_quotients(through_solver):
    unrolled = Unrolled(through_solver)
    unrolled().backward()
    given, step, found = frozen(unrolled), 1e-5, {}
    with torch.no_grad():
        for name, weights in unrolled.corrector.named_parameters():
            flat, quotients = weights.view(-1), torch.zeros(weights.numel(), dtype=torch.float64)
            for i, value in enumerate(flat.tolist()):
                flat[i] = value + step
                ahead = unrolled(given)
                flat[i] = value - step
                quotients[i] = (ahead - unrolled(given)) / (2 * step)
                flat[i] = value
            found[name] = quotients, weights.grad.view(-1)
    largest = max(q.abs().max() for q, _ in found.values())
    for name, (quotients, grad) in found.items():
        error = (grad - quotients).abs().max()
        assert error <= 1e-5 * quotients.abs().max() + 1e-8 * largest, name
    assert sum(int((q != 0.0).sum()) for q, _ in found.values()) > 100


def test_derivatives_through_the_solver_are_other_ones_than_without():
    both = [Unrolled(through) for through in (True, False)]
    for unrolled in both:
        unrolled().backward()
    a, b = (u.corrector.network.decoder[-1].weight.grad for u in both)
    assert (a - b).abs().max() > 1e-3 * a.abs().max()


def test_the_layer_takes_the_steps_of_the_hybrid():
    unrolled = Unrolled(True, ((2, 1, 1), (2, 2, 1)))
    hybrid = BatchHybrid(unrolled.stepper, unrolled.corrector)
    result, previous, state = None, None, unrolled.start
    p, v, d = state.positions, state.velocities, None
    for k in range(3):
        result = hybrid(state, previous)
        p, v, d = unrolled.layer(p, v, state.times, d)
        state, previous = result.state, result.correction
        assert torch.allclose(p, state.positions, rtol=0, atol=1e-12 * CELL), k
        assert torch.allclose(v, state.velocities, rtol=0, atol=1e-12)
    assert d.requires_grad
    assert not result.correction.requires_grad


def gradients_beside(scenes, corrector, through_solver, spoil=None):
    """Gradients of a loss on scene 0 after two steps; ``spoil`` changes the start of scene 1."""
    stepper = pc.BatchStepper(scenes, 1e-12)
    layer = HybridLayer(stepper, corrector, through_solver=through_solver, on_failure="zero")
    start = stepper.rest_state()
    p, v, given = start.positions.clone(), start.velocities.clone(), None
    if spoil is not None:
        spoil(p, v)
        given = torch.zeros_like(layer.nodes.graph.rest)
    loss, nodes = 0.0, len(scenes[0].positions)
    for k in range(2):
        p, v, given = layer(p, v, [k * stepper.time_step] * len(scenes), given)
        if spoil is not None and k == 0:
            assert not layer.steps.statuses[-1][1].ok
            assert not given[nodes:].any()
        assert layer.steps.statuses[-1][0].ok
        loss = loss + (p - start.positions)[0, :nodes].square().sum()
        loss = loss + given[:nodes].square().sum()
    return torch.autograd.grad(loss, list(corrector.parameters()))


def lost(p, v):
    v[1] = torch.nan


def far_away(p, v):
    v[1] = 1e200  # whose square is infinite


@pytest.mark.parametrize(("through_solver", "spoil"), [(True, lost), (False, far_away)])
def test_a_scene_whose_step_fails_has_no_part_in_the_derivatives(through_solver, spoil):
    scenes = problems((3, 1, 1), (2, 1, 1))
    names = (*preset("compact").node_features, "previous-correction")
    corrector = fitted(scenes, node_features=names)
    found = gradients_beside(scenes, corrector, through_solver, spoil)
    expected = gradients_beside(scenes[:1], corrector, through_solver)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, abs=1e-3 * float(other.abs().max()))
    assert any(g.any() for g in found)

"""Gradients of batches, and the layer."""

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import ConvergenceError, InputError
from test_batch import VARIANTS, moving_states, on_every_device, unlike

NAMES = (
    "positions", "velocities", "forces", "clamped_positions", "mu", "lam", "young", "poisson",
    "density",
)  # fmt: skip


@on_every_device
@pytest.mark.parametrize("element", VARIANTS)
@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "midpoint", "generalised-alpha"])
def test_gradients_of_a_batch_are_those_of_its_scenes(element, integrator, device):
    """The two homes of the adjoint, torch and NumPy."""
    changes = {"time": {"integrator": integrator}, "damping": {"mass": 0.7}}
    problems = [pc.discretise(unlike(seed, element, **changes)) for seed in range(3)]
    newton = [pc.Newton(p, 1e-12) for p in problems]
    states = moving_states(problems)
    for _ in range(2):
        states = [n(s).state for n, s in zip(newton, states, strict=True)]
    stepper = pc.BatchStepper(problems, 1e-10, device=device, storage=torch.float64, recover=False)
    nodes = stepper.cells.sizes.nodes

    def together(arrays):
        return stepper.cells.nodal(arrays)[:, :nodes]

    before = stepper.state(states)
    result = stepper(before)
    rng = np.random.default_rng(0)
    shapes = [p.positions.shape for p in problems]
    gp, gv = [[w * rng.normal(size=s) for s in shapes] for w in (100.0, 1.0)]
    memory = {
        name: [1e-3 * rng.normal(size=s) for s in shapes]
        for name in result.state.memory
        if name != "previous_times"
    }
    batch = pc.BatchGradients(
        stepper, before, result, together(gp), together(gv),
        grad_memory={name: together(g) for name, g in memory.items()}, tolerance=1e-11,
    )  # fmt: skip
    assert batch.ok.all()
    for i, (stepper_alone, state) in enumerate(zip(newton, states, strict=True)):
        single = pc.adjoint(
            stepper_alone, state, stepper_alone(state), gp[i], gv[i],
            grad_memory={name: g[i] for name, g in memory.items()}, tolerance=1e-12,
        )  # fmt: skip
        pairs = {n: (getattr(batch, n)[i], getattr(single, n)) for n in NAMES}
        pairs |= {n: (batch.memory[n][i], g) for n, g in single.memory.items()}
        for name, (found, exact) in pairs.items():
            error = np.abs(found.cpu().numpy()[: len(exact)] - exact).max()
            assert error <= 2e-8 * max(np.abs(exact).max(), 1e-30), name


def small_batch(**options):
    """Two tiny scenes of different size."""
    scenes = [
        beam((n, 1, 1), 0.05, 0.35, material={"young": 2e5}, solver={"element": "hex8-bubble"})
        for n in (1, 2)
    ]
    settings = {"storage": torch.float64, "recover": False, **options}
    return pc.BatchStepper([pc.discretise(s) for s in scenes], 1e-12, **settings)


def inputs(stepper):
    """Disturbed positions, velocities and forces."""
    torch.manual_seed(0)
    rest = stepper.rest_state()
    free = stepper.objective.free[:, : stepper.cells.sizes.nodes]
    p = rest.positions + 0.005 * torch.randn_like(rest.positions) * free
    v, f = (s * torch.randn_like(p) * free for s in (0.1, 0.01))
    return [t.detach().requires_grad_() for t in (p, v, f)]


@pytest.mark.parametrize(
    "fast", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["projected", "every entry"]
)
def test_gradcheck_passes_for_every_input_through_two_steps(fast):
    stepper = small_batch()
    layer = pc.PDLayer(stepper, steps=2, tolerance=1e-12)
    young, poisson, density = (m[:, :1].clone() for m in stepper.material)
    young, density = young / 1e5, density / 1e3
    material = [m.requires_grad_() for m in (young, poisson, density)]

    def function(p, v, f, young, poisson, density):
        a, b = layer(p, v, f, young=young * 1e5, poisson=poisson, density=density * 1e3)
        return 100 * a, b

    everything = (*inputs(stepper), *material)
    assert torch.autograd.gradcheck(
        function, everything, eps=1e-5, atol=1e-6, rtol=1e-5, fast_mode=fast
    )


def test_checkpointed_steps_have_the_same_gradients_and_detached_ones_those_of_the_last():
    stepper = small_batch()
    found = {}
    for mode in ("unrolled", "checkpointed", "detached"):
        p, v, f = inputs(stepper)
        layer = pc.PDLayer(stepper, steps=3, mode=mode, tolerance=1e-10)
        after, _ = layer(p, v, f)
        after.square().sum().backward()
        found[mode] = (p.grad, f.grad)
    for a, b in zip(found["unrolled"], found["checkpointed"], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=0)
    assert not found["detached"][0].any()
    assert found["detached"][1].any()
    assert not torch.allclose(found["detached"][1], found["unrolled"][1])


def test_a_layer_takes_the_steps_of_the_stepper():
    stepper = small_batch()
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper, steps=3)
    pushes = torch.stack([f, 2 * f, 0 * f])
    with torch.no_grad():
        frames, speeds = layer.trajectory(p, v, pushes)
    assert not frames.requires_grad
    assert frames.shape == (4, *p.shape)
    state = stepper.state(
        [
            pc.State(p[i, :n].detach().numpy(), v[i, :n].detach().numpy())
            for i, n in enumerate(stepper.cells.node_counts)
        ]
    )
    for k in range(3):
        state = stepper(state, pushes[k].detach()).state
        torch.testing.assert_close(frames[k + 1], state.positions, rtol=0, atol=1e-12)
    torch.testing.assert_close(speeds[-1], state.velocities, rtol=0, atol=1e-10)
    assert [len(row) for row in layer.statuses] == [2, 2, 2]


def test_one_scene_needs_no_batch_dimension():
    problem = pc.discretise(beam((2, 1, 1)))
    layer = pc.PDLayer(pc.BatchStepper([problem], 1e-9), steps=2)
    start = torch.as_tensor(problem.positions.copy()).requires_grad_()
    after, speed = layer(start, torch.zeros_like(start))
    assert after.shape == speed.shape == start.shape
    after.sum().backward()
    assert start.grad.shape == start.shape


def test_materials_given_are_the_materials_used():
    problem = pc.discretise(beam((3, 1, 1)))
    stepper = pc.BatchStepper([problem], 1e-10)
    layer = pc.PDLayer(stepper)
    rest = stepper.rest_state()
    values = {"young": 3e5, "poisson": 0.2, "density": 1500.0}
    given = {name: torch.tensor([[value]], dtype=torch.float64) for name, value in values.items()}
    after, _ = layer(rest.positions, rest.velocities, **given)
    other = pc.ProjectiveDynamics(problem.with_material(**values), 1e-10)
    exact = other(problem.rest_state()).state.positions
    np.testing.assert_allclose(after[0].numpy(), exact, atol=1e-10)


def test_a_call_does_not_see_the_material_of_another():
    """Neither forwards nor backwards, in whatever order they come."""
    stepper = small_batch()
    layer = pc.PDLayer(stepper, tolerance=1e-10)
    p, v, f = inputs(stepper)
    soft = torch.full((2, 1), 5e4, dtype=torch.float64)
    expected, _ = layer(p, v, f)
    (exact,) = torch.autograd.grad(expected.square().sum(), f)
    after, _ = layer(p, v, f)
    layer(p, v, f, young=soft)
    (found,) = torch.autograd.grad(after.square().sum(), f)
    torch.testing.assert_close(found, exact, rtol=1e-8, atol=1e-12)
    again, _ = layer(p, v, f)
    torch.testing.assert_close(again, expected, rtol=0, atol=1e-12)


def test_steps_that_were_taken_in_parts_have_no_derivative():
    stepper = small_batch()
    before = stepper.rest_state()
    result = stepper(before)
    result.statuses[1] = pc.Status.SUBSTEPPED
    g = torch.ones_like(before.positions)
    found = pc.BatchGradients(stepper, before, result, g)
    assert found.ok.tolist() == [True, False]


@on_every_device
def test_single_precision_gives_gradients_to_its_accuracy(device):
    found = []
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-3)):
        problems = [pc.discretise(beam((3, 1, 1), poisson=0.3))]
        stepper = pc.BatchStepper(problems, tolerance, dtype=dtype, device=device)
        layer = pc.PDLayer(stepper, tolerance=1e-4)
        rest = stepper.rest_state()
        p = rest.positions.clone().requires_grad_()
        after, _ = layer(p, rest.velocities)
        after.square().sum().backward()
        found.append(p.grad.to(torch.float64))
    assert found[1].device.type == device
    error = (found[0] - found[1]).abs().max() / found[0].abs().max()
    assert error < 1e-2


def test_a_failed_scene_raises_by_name_or_gives_no_gradient():
    absurd = [{"kind": "gravity", "acceleration": [0.0, 0.0, -1e12]}]
    scenes = [beam((2, 1, 1)), beam((2, 1, 1), loads=absurd)]
    problems = [pc.discretise(s) for s in scenes]
    stepper = pc.BatchStepper(problems, 1e-9, max_iterations=30, recover=False)
    rest = stepper.rest_state()
    p = rest.positions.clone().requires_grad_()
    with pytest.raises(ConvergenceError, match=r"the step of scenes 1 \("):
        pc.PDLayer(stepper)(p, rest.velocities)
    layer = pc.PDLayer(stepper, on_failure="zero")
    after, _ = layer(p, rest.velocities)
    assert [s.ok for s in layer.statuses[0]] == [True, False]
    after[0].square().sum().backward()
    assert p.grad[0].any()
    assert not p.grad[1].any()


def test_wrong_input_is_refused_by_name():
    stepper = small_batch()
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper)
    with pytest.raises(InputError, match="positions: "):
        layer(p[:, 1:], v)
    with pytest.raises(InputError, match=r"velocities: .*torch\.float32"):
        layer(p, v.float())
    with pytest.raises(InputError, match="forces: "):
        layer(p, v, f[:1])
    with pytest.raises(InputError, match="mode = 'rolled'"):
        pc.PDLayer(stepper, mode="rolled")
    with pytest.raises(InputError, match="steps = 0"):
        pc.PDLayer(stepper, steps=0)
    with pytest.raises(InputError, match="on_failure"):
        pc.PDLayer(stepper, on_failure="ignore")
    with pytest.raises(InputError, match="needs a memory"):
        pc.PDLayer(small_batch(integrator="bdf2"))

"""Gradients of batches, and the layer."""

import gc
import pickle
import weakref

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam, box_mesh, problem_on
from pdcorrect.batch.layer import _Step
from pdcorrect.batch.states import BatchState
from pdcorrect.errors import ConvergenceError, InputError
from test_batch import VARIANTS, moving_states, on_every_device, unlike

NAMES = (
    "positions", "velocities", "forces", "clamped_positions", "mu", "lam", "young", "poisson",
    "density",
)  # fmt: skip


@on_every_device
@pytest.mark.parametrize(
    ("element", "integrator"),
    [(element, "generalised-alpha") for element in VARIANTS]
    + [("hex8-bubble-mean", name) for name in ("backward-euler", "bdf2", "midpoint")],
)
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


KINDS = {
    "quasi-static": {"time": {"integrator": "quasi-static"}},
    "neo-hookean": {"material": {"energy": "neo-hookean"}},
    "st-venant-kirchhoff": {"material": {"energy": "st-venant-kirchhoff"}},
    "arap": {"material": {"energy": "arap"}},
    "no volume": {"material": {"poisson": 0.0}},
    "moving clamps": {
        "clamps": [
            {
                "region": {"plane": "x", "at": 0.0},
                "motion": {"times": [0, 1], "displacement": [[0, 0, 0], [0, 0.3, 0.1]]},
            }
        ],
        "solver": {"mass": "consistent"},
    },
}


@pytest.mark.parametrize("kind", [*KINDS, "inverted", "distorted"])
def test_so_they_are_for_other_kinds_of_scenes(kind):
    load = [{"kind": "gravity", "acceleration": [1.0, 2.0, -5.0]}]
    problems = [
        pc.discretise(beam((n, 1, 1), 0.05, 0.35, **{"loads": load, **KINDS.get(kind, {})}))
        for n in (2, 3)
    ]
    if kind == "distorted":
        problems = [problem_on(box_mesh((n, 2, 2), (0.1 * n, 0.2, 0.2), 0.2)) for n in (2, 3)]
    states = moving_states(problems)
    h = 0.01
    if kind == "inverted":
        flip = [1.0, 1.0, -0.3]
        states = [pc.State(s.positions * flip, s.velocities) for s in states]
        h = 1e-4
    newton = [pc.Newton(p, 1e-12, time_step=h) for p in problems]
    options = {"storage": torch.float64, "recover": False, "time_step": h}
    stepper = pc.BatchStepper(problems, 1e-11, **options)
    before = stepper.state(states)
    result = stepper(before)
    g = torch.as_tensor(np.random.default_rng(0).normal(size=before.positions.shape))
    batch = pc.BatchGradients(stepper, before, result, g, g, tolerance=1e-11)
    assert batch.ok.all()
    for i, (one, state) in enumerate(zip(newton, states, strict=True)):
        by_end = g[i, : len(state.positions)].numpy()
        single = pc.adjoint(one, state, one(state), by_end, by_end, tolerance=1e-12)
        for name in NAMES:
            if kind == "no volume" and name in ("lam", "poisson"):
                continue  # checked by differences below
            exact = getattr(single, name)
            error = np.abs(getattr(batch, name)[i].numpy()[: len(exact)] - exact).max()
            assert error <= 1e-6 * max(np.abs(exact).max(), 1e-30), name


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
    assert found["detached"][0] is None  # nothing of the last frame depends on them
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
    with pytest.raises(ConvergenceError, match=r"step 1 of 1: scene 1 .*failed: "):
        pc.PDLayer(stepper)(p, rest.velocities)
    layer = pc.PDLayer(stepper, on_failure="zero")
    after, _ = layer(p, rest.velocities)
    assert [s.ok for s in layer.statuses[0]] == [True, False]
    after[0].square().sum().backward()
    assert p.grad[0].any()
    assert not p.grad[1].any()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mode", "rolled"), ("steps", 0), ("steps", 2.0), ("steps", True),
        ("on_failure", "ignore"), ("tolerance", 0), ("tolerance", "1e-6"), ("tolerance", np.nan),
    ],
)  # fmt: skip
def test_options_that_make_no_sense_are_refused(name, value):
    with pytest.raises(InputError, match=f"{name} = "):
        pc.PDLayer(small_batch(), **{name: value})


WRONG = {
    "fewer nodes": (lambda r, p, v: ((p[:, 1:], v), {}), r"positions: \(2, 11, 3\)"),
    "float32": (lambda r, p, v: ((p, v.float()), {}), r"velocities: torch\.float32"),
    "forces of one scene": (lambda r, p, v: ((p, v, p[:1]), {}), r"forces: \(1, 12, 3\)"),
    "forces of 5 steps": (lambda r, p, v: ((p, v, p.expand(5, -1, -1, -1)), {}), "of 5 steps"),
    "flat forces": (lambda r, p, v: ((p, v, p[0, 0]), {}), r"forces: \(3,\); expected \(2, 12"),
    "one scene": (lambda r, p, v: ((p[0], v[0]), {}), r"positions: \(12, 3\); expected \(2, 12, 3"),
    "one time": (lambda r, p, v: ((p, v), {"times": 0.5}), r"times = 0\.5: expected 2 finite"),
    "few times": (lambda r, p, v: ((p, v), {"times": [0.0]}), r"times = \[0\.0\]"),
    "words": (lambda r, p, v: ((p, v), {"times": "ab"}), "times = 'ab'"),
    "infinite times": (lambda r, p, v: ((p, v), {"times": [0.0, np.inf]}), "times = "),
    "integers": (lambda r, p, v: ((p, v), {"young": torch.tensor(1)}), r"young: torch\.int64"),
    "young of scenes": (
        lambda r, p, v: ((p, v), {"young": torch.full((3,), 1e5, dtype=p.dtype)}),
        r"young: \(3,\).*one value a scene is \(2, 1\)",
    ),
    "bad young": (
        lambda r, p, v: ((p, v), {"young": torch.tensor([[1e5], [-1e5]], dtype=p.dtype)}),
        r"young of cell 0 in scene 1 \(.*is -100000: expected a finite number above 0",
    ),
    "bad density": (lambda r, p, v: ((p, v), {"density": -1.0}), "density of cell 0 in scene 0"),
    "nan positions": (lambda r, p, v: ((spoilt(p), v), {}), "positions of node 8 in scene 1"),
    "nan velocities": (lambda r, p, v: ((p, spoilt(v)), {}), "velocities of node 8 in scene 1"),
    "nan forces": (lambda r, p, v: ((p, v, spoilt(v)), {}), "forces of node 8 in scene 1"),
}  # fmt: skip


def spoilt(x):
    """With one NaN, at node 8 of scene 1, which is free."""
    out = x.clone()
    out[1, 8, 2] = torch.nan
    return out


@pytest.fixture(scope="module")
def refusing():
    """A layer for all calls that are refused, what it is given, and what it makes of that."""
    layer = pc.PDLayer(small_batch())
    p, v = (x.detach() for x in inputs(layer.stepper)[:2])
    return layer, p, v, layer(p, v)[0]


@pytest.mark.parametrize("what", WRONG)
def test_calls_with_unusable_arguments_are_refused_by_name_and_change_nothing(what, refusing):
    make, message = WRONG[what]
    layer, p, v, expected = refusing
    arguments, named = make(layer.stepper.rest_state(), p, v)
    with pytest.raises(InputError, match=message):
        layer(*arguments, **named)
    assert torch.equal(layer(p, v)[0], expected)


def test_a_failure_tells_its_step_and_the_scenes_statuses():
    stepper = small_batch(max_iterations=30)
    p, v, f = (x.detach() for x in inputs(stepper))
    push = torch.zeros_like(f)
    push[1] = 1e12
    with pytest.raises(ConvergenceError) as caught:
        pc.PDLayer(stepper, 3)(p, v, torch.stack([f, push, f]))
    status = pc.PDLayer(stepper, 3, on_failure="zero")
    status(p, v, torch.stack([f, push, f]))
    expected = f"step 2 of 3: scene 1 ('scene') {status.statuses[1][1].value}. Expected"
    assert expected in str(caught.value)
    assert "scene 0" not in str(caught.value)


def test_padded_cells_do_not_spoil_the_gradient_by_a_factor_on_the_material():
    stepper = small_batch()
    p, v, f = (x.detach() for x in inputs(stepper))
    factor = torch.ones((), dtype=torch.float64, requires_grad=True)
    after, _ = pc.PDLayer(stepper)(p, v, f, young=stepper.material[0] * factor)
    after.square().sum().backward()
    assert torch.isfinite(factor.grad)
    assert factor.grad


def test_calls_one_after_the_other_see_the_loads_of_their_time():
    window = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81], "window": [0.02, 0.1]}]
    stepper = pc.BatchStepper([pc.discretise(beam((2, 1, 1), loads=window))], 1e-9)
    start = stepper.rest_state()
    p, v = start.positions, start.velocities
    expected, _ = pc.PDLayer(stepper, 4)(p, v)
    layer, found, still, memory = pc.PDLayer(stepper), (p, v), (p, v), {}
    for k in range(4):
        found = layer(*found, times=[k * stepper.time_step], memory=memory)
        memory = layer.memory
        still = layer(*still)
    torch.testing.assert_close(found[0], expected, rtol=0, atol=1e-12)
    assert not torch.allclose(still[0], expected, rtol=0, atol=1e-6)


def test_one_scenes_output_becomes_a_state():
    problem = pc.discretise(beam((2, 1, 1)))
    stepper = pc.BatchStepper([problem], 1e-9)
    start = torch.as_tensor(problem.positions.copy())
    out = pc.PDLayer(stepper)(start, torch.zeros_like(start))
    with pytest.raises(InputError, match=r"forces: \(3,\); expected \(1, 12, 3"):
        pc.PDLayer(stepper)(start, torch.zeros_like(start), start[0])
    (state,) = stepper.states(out, [problem.time_step])
    np.testing.assert_array_equal(state.positions, out[0])
    assert pc.ProjectiveDynamics(problem)(state).status.ok


# --- what is recorded, kept and left alone -------------------------------------------------------


def test_the_gradient_by_poissons_ratio_at_zero_is_that_of_differences():

    def loss(nu):
        stepper = small_batch()
        p, v, f = (x.detach() for x in inputs(stepper))
        layer = pc.PDLayer(stepper, tolerance=1e-11)
        return layer(p, v, f, poisson=nu)[0].square().sum()

    nu = torch.zeros(2, 1, dtype=torch.float64, requires_grad=True)
    loss(nu).backward()
    h = 1e-4
    ahead = [float(loss(torch.full_like(nu, k * h).detach())) for k in range(3)]
    slope = (4.0 * ahead[1] - 3.0 * ahead[0] - ahead[2]) / (2.0 * h)
    assert float(nu.grad.sum()) == pytest.approx(slope, rel=1e-5)


def test_a_layer_leaves_the_steppers_material_alone_and_takes_numbers():
    stepper = small_batch()
    stepper.set_material(young=1e5)
    p, v, f = inputs(stepper)
    plain, _ = pc.PDLayer(stepper)(p, v, f)
    direct = stepper(stepper.rest_state()).y
    stiff, _ = pc.PDLayer(stepper)(p, v, f, young=4e5, density=500.0)
    stiff.sum().backward()
    assert torch.equal(stepper(stepper.rest_state()).y, direct)
    stepper.set_material(young=torch.tensor(4e5, dtype=torch.float64), density=500.0)
    again, _ = pc.PDLayer(stepper)(p, v, f)
    torch.testing.assert_close(stiff, again, rtol=0, atol=1e-12)
    assert not torch.allclose(stiff, plain, rtol=0, atol=1e-6)


def test_a_derivative_is_of_its_own_step_whatever_came_later():
    stepper = small_batch()
    p, v, _ = (x.detach() for x in inputs(stepper))
    first = stepper.rest_state()
    second = BatchState(p, v, first.times)
    g = torch.ones_like(p)
    results = [stepper(first), stepper(second)]
    expected = pc.BatchGradients(stepper, first, results[0], g)
    exact = {name: getattr(expected, name).clone() for name in ("density", "young", "poisson")}
    late = pc.BatchGradients(stepper, first, results[0], g)
    pc.BatchGradients(stepper, second, results[1], g)
    stepper.set_material(young=1e4, density=10.0)
    stepper(second)
    for name, value in exact.items():
        torch.testing.assert_close(getattr(late, name), value, rtol=1e-12, atol=0)


def watched(monkeypatch, each_step=True):
    """How many steps' frames are kept: a function of nothing, and a list filled by each step.

    To count, all garbage is collected first, which takes longer than a step.
    """
    frames, counts = [], []
    original = _Step.forward

    def kept():
        gc.collect()
        return sum(frame() is not None for frame in frames)

    def watch(*arguments):
        out = original(*arguments)
        frames.append(weakref.ref(out[0]))
        if each_step:
            counts.append(kept())
        return out

    monkeypatch.setattr(_Step, "forward", staticmethod(watch))
    return kept, counts


@pytest.mark.parametrize(
    ("mode", "most"), [pytest.param("unrolled", 9, marks=pytest.mark.slow), ("checkpointed", 4)]
)
def test_checkpointed_steps_keep_the_states_between_segments_only(mode, most, monkeypatch):
    stepper = small_batch()
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper, 9, mode=mode)
    kept, _ = watched(monkeypatch, each_step=False)
    after, _ = layer(p, v, f)
    assert most / 2 < kept() <= most
    assert len(layer.statuses) == 9
    after.sum().backward()
    assert len(layer.statuses) == 9


def test_a_layer_without_derivatives_keeps_no_frames(monkeypatch):
    stepper = small_batch()
    p, v, f = (x.detach() for x in inputs(stepper))
    _, counts = watched(monkeypatch)
    pc.PDLayer(stepper, 4)(p, v, f)
    assert len(counts) == 4
    assert max(counts) <= 2


def test_what_has_no_derivative_is_told():
    stepper = small_batch()
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper, 2, on_failure="zero")
    step = stepper._step

    def in_parts(*arguments):
        result = step(*arguments)
        result.statuses[1] = pc.Status.SUBSTEPPED
        return result

    stepper._step = in_parts
    after, _ = layer(p, v, f)
    assert layer.differentiable.tolist() == [True, False]
    assert layer.failed_derivatives == []
    after.sum().backward()
    assert sorted(layer.failed_derivatives) == [(0, 1), (1, 1)]
    assert p.grad[0].any()
    assert not p.grad[1].any()


def test_a_linear_system_that_is_not_solved_is_told(monkeypatch):
    monkeypatch.setattr("pdcorrect.batch.stepper._ADJOINT_STEPS", 0)
    stepper = small_batch()
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper, on_failure="zero")
    layer(p, v, f)[0].sum().backward()
    assert layer.differentiable.all()
    assert layer.failed_derivatives == [(0, 0), (0, 1)]
    with pytest.raises(ConvergenceError, match="step 1 of 1: scene 0 "):
        pc.PDLayer(stepper)(p, v, f)[0].sum().backward()


def test_a_bad_material_spoils_its_own_scene_only():
    stepper = small_batch(recover=True)
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper, on_failure="zero")
    poisson = torch.tensor([[0.3], [0.6]], dtype=torch.float64, requires_grad=True)
    after, _ = layer(p, v, f, poisson=poisson)
    assert [s.ok for s in layer.statuses[0]] == [True, False]
    after[layer.differentiable].sum().backward()
    assert poisson.grad[0].any()
    assert not poisson.grad[1].any()
    assert torch.isfinite(p.grad).all()


def test_a_failed_call_does_not_spoil_the_next():
    problem = pc.discretise(beam((2, 1, 1)))
    stepper = pc.BatchStepper([problem], 1e-9)
    layer = pc.PDLayer(stepper, on_failure="zero")
    rest = stepper.rest_state()
    expected, _ = layer(rest.positions, rest.velocities)
    layer(rest.positions, rest.velocities, poisson=0.5)
    layer(torch.full_like(rest.positions, torch.nan), rest.velocities)
    after, _ = layer(rest.positions, rest.velocities)
    torch.testing.assert_close(after, expected, rtol=0, atol=1e-12)


def test_second_derivatives_are_refused():
    stepper = small_batch()
    p, v, f = inputs(stepper)
    after, _ = pc.PDLayer(stepper)(p, v, f)
    (grad,) = torch.autograd.grad(after.square().sum(), f, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


def test_nodes_that_a_scene_does_not_have_get_no_gradient():
    stepper = small_batch()
    p, v, f = inputs(stepper)
    _, velocities = pc.PDLayer(stepper)(p, v, f)
    velocities.sum().backward()
    absent = ~stepper.cells.present_nodes
    assert absent.any()
    for x in (p, v, f):
        assert not x.grad[absent].any()
        assert x.grad[~absent].any()


def test_steps_in_inference_mode_come_out_the_same():
    stepper = small_batch()
    p, v, f = inputs(stepper)
    layer = pc.PDLayer(stepper, 2)
    with torch.inference_mode():
        first, _ = layer(p, v, f)
    after, _ = layer(p, v, f)
    after.sum().backward()
    assert torch.equal(first, after)
    assert p.grad.any()


def test_a_layer_with_follower_loads_can_be_copied():
    twist = [{"kind": "torsion", "strength": 100.0, "stretch": 0.2, "follower": True}]
    stepper = pc.BatchStepper([pc.discretise(beam((2, 1, 1), loads=twist))], 1e-9)
    layer = pc.PDLayer(stepper)
    rest = stepper.rest_state()
    expected, _ = layer(rest.positions, rest.velocities)
    after, _ = pickle.loads(pickle.dumps(layer))(rest.positions, rest.velocities)
    assert torch.equal(after, expected)

"""Batches with every integrator, damping, moving clamps and loads that follow, as single steps."""

import numpy as np
import pytest
import torch

import pdcorrect as pc

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]
TIMES = np.linspace(0.0, 0.2, 41)
SWINGS = {
    "times": TIMES.tolist(), "rotation": (15.0 * np.sin(15.0 * TIMES)).tolist(), "axis": "x",
    "centre": [0.0, 0.05, 0.05],
}  # fmt: skip
FOLLOWERS = [
    {
        "kind": "pressure", "pressure": 2e3, "region": {"plane": "z", "at": 0.1},
        "follower": True,
    },
    {"kind": "torsion", "strength": 3e4, "follower": True, "attraction": 0.3},
]  # fmt: skip
DAMPED = {"viscosity": 3e-3, "stiffness": 1e-3, "mass": 2.0}
CASES = {
    "the best coarse element": ("hex8-enhanced", {"viscosity": 3e-3}, FOLLOWERS[:1], True),
    "all of it": ("hex8-bubble", DAMPED, FOLLOWERS, True),
}


def problem(cells, integrator, element, damping, loads, moving):
    clamp = {"region": {"plane": "x", "at": 0.0}, **({"motion": SWINGS} if moving else {})}
    return pc.discretise(
        pc.Scene(
            body={"shape": "beam", "cells": [cells, 1, 2], "cell_size": 0.05},
            material={"young": 1e5, "poisson": 0.4, "density": 1e3}, damping=damping,
            time={"step": 0.01, "frames": 4, "integrator": integrator}, loads=loads,
            clamps=[clamp], solver={"element": element, "mass": "averaged", "tolerance": 1e-10},
        )
    )  # fmt: skip


def states(problems):
    rng = np.random.default_rng(0)
    return [
        pc.State(p.positions.copy(), 0.2 * rng.normal(size=p.positions.shape) * p.free, 0.0)
        for p in problems
    ]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("case", "integrator"),
    [
        pytest.param("all of it", "backward-euler", marks=pytest.mark.slow),  # no memory
        ("all of it", "bdf2"),
        pytest.param("all of it", "midpoint", marks=pytest.mark.slow),
        ("all of it", "generalised-alpha"),
        ("the best coarse element", "midpoint"),
    ],
)
def test_steps_and_derivatives_are_those_of_single_steps(case, integrator, device):
    problems = [problem(n, integrator, *CASES[case]) for n in (2, 3)]
    stepper = pc.BatchStepper(problems, recover=False, device=device)
    batch, alone = stepper.state(states(problems)), states(problems)
    singles = [pc.ProjectiveDynamics(p) for p in problems]
    rng = np.random.default_rng(3)
    extra = [0.02 * rng.normal(size=p.positions.shape) for p in problems]
    forces = stepper.cells.nodal(extra)[:, : stepper.cells.sizes.nodes]
    for _ in range(2):
        before, result = batch, stepper(batch, forces)
        batch = result.state
        assert set(result.statuses) == {pc.Status.CONVERGED}
        befores = alone
        results = [single(*both) for single, *both in zip(singles, alone, extra, strict=True)]
        alone = [r.state for r in results]
    for found, wanted in zip(stepper.states(batch), alone, strict=True):
        assert np.abs(found.positions - wanted.positions).max() < 1e-9
        assert set(found.memory) == set(wanted.memory)
    for found, wanted, p in zip(stepper.states(batch), alone, problems, strict=True):
        for name in set(found.memory) - {"previous_times"}:
            mine, other = (state.memory[name][p.free] for state in (found, wanted))
            np.testing.assert_allclose(mine, other, rtol=0, atol=1e-5 * np.abs(other).max())
    rng = np.random.default_rng(1)
    grads = [rng.normal(size=p.positions.shape) for p in problems]
    nodes = stepper.cells.sizes.nodes
    given = stepper.cells.nodal(grads)[:, :nodes]
    gradients = pc.BatchGradients(
        stepper, before, result, given, 0.01 * given, forces=forces, tolerance=1e-10
    )
    damping = CASES[case][1]
    for i, (single, state, one, g) in enumerate(zip(singles, befores, results, grads, strict=True)):
        wanted = pc.adjoint(single, state, one, g, 0.01 * g, forces=extra[i], tolerance=1e-10)
        for name in ("positions", "velocities", "forces", "young", "poisson", "density", *damping):
            name = {"mass": "rayleigh_mass", "stiffness": "rayleigh_stiffness"}.get(name, name)
            value = np.asarray(getattr(wanted, name))
            found = getattr(gradients, name)[i].cpu().numpy()
            found = found[: len(value)] if value.ndim else found
            scale = np.abs(value).max()
            np.testing.assert_allclose(found, value, rtol=0, atol=2e-5 * scale)


@pytest.mark.parametrize(
    ("integrator", "mode"),
    [
        ("bdf2", "unrolled"),
        pytest.param("midpoint", "checkpointed", marks=pytest.mark.slow),
        pytest.param("generalised-alpha", "checkpointed", marks=pytest.mark.slow),
    ],
)
def test_a_layer_differentiates_through_the_memory_of_its_steps(integrator, mode):
    problems = [problem(n, integrator, "hex8", {"viscosity": 2e-3}, FOLLOWERS[:1], False)
                for n in (1, 2)]  # fmt: skip
    stepper = pc.BatchStepper(problems)
    start = stepper.state(states(problems))
    x, v = start.positions, start.velocities.clone().requires_grad_()
    rng = np.random.default_rng(2)
    weight = torch.as_tensor(rng.normal(size=x.shape))
    layer = pc.PDLayer(stepper, 2, mode=mode, tolerance=1e-10)

    def loss(v):
        positions, velocities = layer(x, v)
        return (weight * positions).sum() + 0.01 * (weight * velocities).sum()

    (gradient,) = torch.autograd.grad(loss(v), v)
    move = torch.as_tensor(rng.normal(size=x.shape)) * stepper.staging.free
    with torch.no_grad():
        slope = (loss(v + 1e-5 * move) - loss(v - 1e-5 * move)) / 2e-5
    assert float((gradient * move).sum()) == pytest.approx(float(slope), rel=1e-5)


@pytest.mark.parametrize("integrator", ["bdf2", "generalised-alpha"])
def test_calls_that_hand_on_the_memory_are_one(integrator):
    problems = [problem(2, integrator, "hex8", {"viscosity": 2e-3}, [], False)]
    stepper = pc.BatchStepper(problems)
    start = stepper.state(states(problems))
    whole = pc.PDLayer(stepper, 4)(start.positions, start.velocities)
    layer = pc.PDLayer(stepper, 2)
    half = layer(start.positions, start.velocities)
    rest = layer(*half, memory=layer.memory, times=[0.02])
    for one, other in zip(whole, rest, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)

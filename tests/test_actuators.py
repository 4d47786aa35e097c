"""Muscle fibres: derivatives, equilibrium, energy, order in time, adjoint, bad input."""

from itertools import pairwise

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import InputError, SceneError

RISE = [[0.0, 1.0], [0.02, 0.8], [0.05, 0.9]]
OBLIQUE = {"direction": [1, 2, 0.5], "stiffness": 2e5, "activation": RISE}
LOWER = {"region": {"box": [[0, 0, 0], [1, 1, 0.021]]}, "direction": [1, 0, 0]}
TIME = 0.015


def muscles(*actuators, **changes):
    settings = {"loads": [], "solver": {"element": "hex8-enhanced", "mass": "averaged"}}
    return beam((3, 1, 2), actuators=list(actuators), **{**settings, **changes})


def shaken(problem, seed=0, by=0.15):
    rng = np.random.default_rng(seed)
    return problem.positions + by * problem.cell_size * rng.normal(size=problem.positions.shape)


@pytest.mark.parametrize("element", ["hex8-enhanced", "hex27"])
def test_forces_and_their_slopes_are_differences_of_the_energy(element):
    scene = muscles(OBLIQUE, {**OBLIQUE, **LOWER}, solver={"element": element, "mass": "averaged"})
    problem, e = pc.discretise(scene), 1e-7
    fibres, rng = problem.fibres, np.random.default_rng(1)
    u, way, z = shaken(problem) - problem.positions, *rng.normal(size=(2, *problem.positions.shape))
    slope = (
        fibres.energy_and_forces(u + e * way, TIME)[0]
        - fibres.energy_and_forces(u - e * way, TIME)[0]
    )
    assert -np.vdot(fibres.energy_and_forces(u, TIME)[1], way) == pytest.approx(
        slope / (2 * e), rel=1e-6
    )
    change = (
        fibres.energy_and_forces(u + e * way, TIME)[1]
        - fibres.energy_and_forces(u - e * way, TIME)[1]
    )
    A, H = fibres.stretching, fibres.matrices(u, TIME)
    product = A.T @ np.einsum("pij,pj->pi", H, A @ way)
    np.testing.assert_allclose(
        product, -change / (2 * e), rtol=1e-5, atol=1e-5 * abs(product).max()
    )
    blocks, nodes = fibres.blocks(H), problem.cells[fibres.cells]
    assert np.einsum("cki,cklij,clj->", z[nodes], blocks, way[nodes]) == pytest.approx(
        np.vdot(z, product), rel=1e-12
    )
    assert (
        np.linalg.eigvalsh(H).min()
        < 0
        <= np.linalg.eigvalsh(fibres.matrices(u, TIME, True)).min() + 1e-9
    )


@pytest.mark.parametrize("r", [0.7, 0.0])
def test_a_free_body_contracts_to_where_its_stress_and_the_fibres_balance(r):
    w, young = 3e4, 1e5
    scene = muscles(
        {"direction": [0, 0, 2.0], "stiffness": w, "activation": [[0, r]]},
        material={"young": young, "poisson": 0.0, "density": 1e3},
        time={"step": 0.01, "integrator": "quasi-static"},
        clamps=[{"region": {"plane": "z", "at": "min"}, "components": ["z"]},
                {"region": {"plane": "y", "at": "min"}, "components": ["y"]},
                {"region": {"plane": "x", "at": "min"}, "components": ["x"]}],
    )  # fmt: skip
    problem = pc.discretise(scene)
    state = pc.Newton(problem, 1e-10)(problem.rest_state()).state
    stretch = (young + w * r) / (young + w)
    expected = problem.positions * [1, 1, stretch]
    np.testing.assert_allclose(state.positions, expected, atol=1e-9)


@pytest.mark.parametrize("turn", [30.0, 110.0])
def test_fibres_turn_with_the_body(turn):
    problem, angle = pc.discretise(muscles(OBLIQUE)), np.radians(turn)
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    x, fibres = shaken(problem), problem.fibres
    turned = x @ R.T - problem.positions
    here = fibres.energy_and_forces(x - problem.positions, TIME)[1]
    np.testing.assert_allclose(fibres.energy_and_forces(turned, TIME)[1], here @ R.T, atol=1e-9)
    np.testing.assert_allclose(here.sum(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(x, here).sum(axis=0), 0, atol=1e-9)


def test_projective_dynamics_and_newton_agree():
    scene = muscles({**OBLIQUE, **LOWER}, solver={"element": "hex8-bubble", "tolerance": 1e-9})
    problem = pc.discretise(scene)
    steppers = [
        pc.Newton(problem),
        pc.ProjectiveDynamics(problem),
        pc.ProjectiveDynamics(problem, first_hessian="G"),
        pc.ProjectiveDynamics(problem, method="local-global"),
    ]
    first, *others = (pc.rollout(stepper, frames=6) for stepper in steppers)
    moved = np.abs(first.positions - problem.positions).max()
    assert moved > 0.1 * problem.cell_size
    for run in others:
        np.testing.assert_allclose(run.positions, first.positions, atol=1e-6 * problem.cell_size)


@pytest.mark.parametrize("integrator", ["midpoint", "generalised-alpha"])
def test_errors_and_lost_energy_fall_with_the_second_order(integrator):
    smooth = [[t, 0.9 + 0.1 * np.cos(np.pi * t / 0.02)] for t in np.linspace(0, 0.02, 81)]
    ends, lost = [], []
    for count in (10, 20, 40, 80):
        scene = muscles(
            {**LOWER, "stiffness": 1e5, "activation": smooth},
            time={"step": 0.02 / count, "integrator": integrator},
        )
        run = pc.rollout(pc.Newton(pc.discretise(scene), 1e-9), frames=count)
        ends.append(run.positions[-1])
        balance = pc.metrics.energy_balance(run)
        lost.append(abs(balance.dissipation[-1]) / balance.actuator_work[-1])
    errors = [np.abs(a - b).max() for a, b in pairwise(ends)]
    assert np.log2(errors[1] / errors[2]) > 1.7
    assert lost[-1] < 0.01
    assert np.log2(lost[-2] / lost[-1]) > 1.6


@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "midpoint", "generalised-alpha"])
def test_derivatives_by_activations_are_differences(integrator):
    weights = np.random.default_rng(2).normal(size=(2, 24, 3))

    def runs(tables):
        scene = muscles(
            *(
                {**a, "activation": t}
                for a, t in zip((OBLIQUE, {**OBLIQUE, **LOWER}), tables, strict=True)
            ),
            time={"step": 0.008, "integrator": integrator},
        )
        stepper = pc.Newton(pc.discretise(scene), 1e-11)
        states, results = [stepper.problem.rest_state()], []
        for _ in range(4):
            results.append(stepper(states[-1]))
            states.append(results[-1].state)
        end = states[-1]
        return stepper, states, results, np.vdot(weights, [end.positions, end.velocities])

    tables = [np.array(RISE), np.array([[0.01, 0.9], [0.03, 1.1]])]
    stepper, states, results, _ = runs([t.tolist() for t in tables])
    by_positions, by_velocities, by_memory = *weights, {}
    found = [np.zeros(3), np.zeros(2)]
    for state, result in zip(states[-2::-1], results[::-1], strict=True):
        g = pc.adjoint(
            stepper, state, result, by_positions, by_velocities, grad_memory=by_memory,
            tolerance=1e-12,
        )  # fmt: skip
        found = [a + b for a, b in zip(found, g.activations, strict=True)]
        by_positions, by_velocities, by_memory = g.positions, g.velocities, g.memory
    e = 1e-5
    for a, row in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1)):
        values = []
        for sign in (1, -1):
            changed = [t.copy() for t in tables]
            changed[a][row, 1] += sign * e
            values.append(runs([t.tolist() for t in changed])[3])
        difference = (values[0] - values[1]) / (2 * e)
        assert found[a][row] == pytest.approx(difference, rel=1e-5, abs=1e-6 * abs(found[0]).max())


def test_a_clamp_feels_the_pull_of_the_fibres():
    held = [{"region": {"plane": "x", "at": "min"}}, {"region": {"plane": "x", "at": "max"}}]
    scene = muscles(
        {"direction": [1, 0, 0], "stiffness": 1e5, "activation": [[0, 0.9]]},
        clamps=held, time={"step": 0.01, "integrator": "quasi-static"},
        material={"young": 1e5, "poisson": 0.0, "density": 1e3},
    )  # fmt: skip
    problem = pc.discretise(scene)
    state = pc.Newton(problem)(problem.rest_state()).state
    forces = pc.reactions(problem, state, np.zeros_like(state.positions))
    low, high = problem.mesh.bounds
    area = (high - low)[1] * (high - low)[2]
    at_low = problem.positions[:, 0] < 1e-9
    assert forces[at_low, 0].sum() == pytest.approx(-1e5 * 0.1 * area, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"direction": [0, 0, 0]}, "direction"),
        ({"stiffness": 0.0}, "stiffness"),
        ({"activation": []}, "activation"),
        ({"activation": [[0, 1], [0, 0.5]]}, "activation"),
        ({"activation": [[0, -0.1]]}, "activation"),
        ({"region": {"sphere": [9, 9, 9], "radius": 0.1}}, "region"),
        ({"region": {"nodes": [0, 1]}}, "region"),
    ],
)
def test_wrong_actuators_are_refused_by_their_key(change, key):
    with pytest.raises(SceneError, match=rf"actuators\[0\].*{key}"):
        pc.discretise(muscles({**OBLIQUE, **change}))


def test_batches_and_derivatives_without_actuators_are_refused():
    torch = pytest.importorskip("torch")
    assert torch
    with pytest.raises(InputError, match="actuators"):
        pc.BatchStepper([pc.discretise(muscles(OBLIQUE))], device="cpu")
    problem = pc.discretise(muscles())
    stepper, state = pc.Newton(problem), problem.rest_state()
    with pytest.raises(InputError, match="actuators"):
        _ = pc.adjoint(stepper, state, stepper(state), problem.positions).activations

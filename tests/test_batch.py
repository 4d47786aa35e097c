"""Many scenes in one batch are many scenes one by one."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam
from pdcorrect.batch import decomposition
from pdcorrect.batch.cells import Sizes
from pdcorrect.batch.memory import expected_bytes
from pdcorrect.batch.points import Points
from pdcorrect.batch.tall import tall_product
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem import energies
from pdcorrect.fem.hyperelasticity import energy_code

VARIANTS = ["hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean"]
DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]
on_every_device = pytest.mark.parametrize("device", DEVICES)


def unlike(seed, element="hex8", **changes):
    """A beam of random size, material, clamps and loads."""
    rng = np.random.default_rng(seed)
    cells = [int(rng.integers(3, 7)), int(rng.integers(1, 3)), int(rng.integers(1, 3))]
    clamps = [{"region": {"plane": "x", "at": 0.0}}]
    if seed % 3 == 1:
        clamps.append({"region": {"plane": "y", "at": 0.0}, "components": ["y"]})
    if seed % 4 == 3:
        clamps = []
    material = {
        "young": float(rng.uniform(1e5, 4e5)),
        "poisson": float(rng.uniform(0.1, 0.45)),
        "density": float(rng.uniform(800, 1400)),
    }
    torsion = {
        "kind": "torsion", "strength": float(rng.uniform(0, 3e4)), "stretch": 0.2,
        "follower": bool(seed % 2),
    }  # fmt: skip
    gravity = {"kind": "gravity", "acceleration": [float(a) for a in rng.uniform(-12, 12, 3)]}
    settings = {
        "clamps": clamps,
        "loads": [gravity, torsion],
        "material": material,
        "solver": {"element": element, "mass": ["lumped", "averaged", "consistent"][seed % 3]},
    }
    return beam(cells, float(rng.uniform(0.02, 0.05)), **{**settings, **changes})


def moving_states(problems, seed=0):
    """States that are strained and move, one for each problem."""
    out = []
    for i, problem in enumerate(problems):
        rng = np.random.default_rng(seed + i)
        x, free = problem.positions, problem.free
        p = x + 0.15 * problem.cell_size * rng.uniform(-0.5, 0.5, x.shape) * free
        out.append(pc.State(p, 0.5 * rng.normal(size=x.shape) * free))
    return out


def stepped(stepper, states, steps):
    batch = stepper.state(states)
    for _ in range(steps):
        result = stepper(batch)
        batch = result.state
    return stepper.states(batch), result


def alone(problem, state, steps, tolerance=1e-9):
    stepper = pc.ProjectiveDynamics(problem, tolerance)
    for _ in range(steps):
        state = stepper(state).state
    return state


def furthest(a, b):
    return np.abs(a.positions - b.positions).max()


# --- points ------------------------------------------------------------------------------------


def matrices():
    rng = np.random.default_rng(0)
    special = [np.zeros((3, 3)), np.diag([1.0, 0, 0]), np.diag([1.0, 1, 0]), -np.eye(3)]
    return np.concatenate(
        [
            rng.normal(size=(3000, 3, 3)),
            np.eye(3) + 0.3 * rng.normal(size=(3000, 3, 3)),
            np.eye(3) + 1e-9 * rng.normal(size=(100, 3, 3)),
            2.5 * np.eye(3) + 0.5 * rng.normal(size=(500, 3, 3)),
            (np.eye(3) + 0.3 * rng.normal(size=(100, 3, 3))) * [1.0, 1.0, 1e-7],
            special,
        ]
    )


def rows(F):
    return torch.as_tensor(np.ascontiguousarray(F.reshape(-1, 9).T))


def test_the_signed_svd_is_the_same_as_numbas():
    F = matrices()
    U, s, V = (torch.stack(a).numpy() for a in decomposition.signed_svd(list(rows(F))))
    _, expected, _ = energies.signed_svd(F)
    np.testing.assert_allclose(s.T, expected, atol=1e-13)
    U, V = U.T.reshape(-1, 3, 3), V.T.reshape(-1, 3, 3)
    np.testing.assert_allclose(U * s.T[:, None] @ V.swapaxes(1, 2), F, atol=3e-14)
    for Q in (U, V):
        np.testing.assert_allclose(Q @ Q.swapaxes(1, 2), np.tile(np.eye(3), (len(F), 1, 1)),
                                   atol=1e-13)  # fmt: skip
        assert (np.linalg.det(Q) > 0).all()


@pytest.mark.parametrize("energy", ["corotated", "neo-hookean", "st-venant-kirchhoff"])
def test_stress_and_tangent_at_points_are_those_of_the_energies(energy):
    F = matrices()
    F = F[np.abs(np.linalg.det(F)) > 1e-3]  # off the kinks
    rng = np.random.default_rng(1)
    mu, omega = rng.uniform(1, 2, (2, len(F)))
    points = Points(energy_code(energy), 0, 1, compiled=False)
    weights = torch.as_tensor(np.stack([mu, omega]))
    density, P = points.stress(rows(F), weights)
    np.testing.assert_allclose(density, energies.energy_density(F, mu, omega, energy), rtol=1e-10,
                               atol=1e-13)  # fmt: skip
    exact = energies.first_piola(F, mu, omega, energy)
    scale = 1 + np.abs(exact).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(P.numpy().T.reshape(-1, 3, 3) / scale, exact / scale, atol=1e-11)
    D = rng.normal(size=F.shape)
    found = points.product(points.tangent(rows(F), weights), rows(D)).numpy().T.reshape(-1, 3, 3)
    C = energies.elasticity(F, mu, omega, energy=energy)
    exact = np.einsum("nijkl,nkl->nij", C, D)
    scale = 1 + np.abs(C).max(axis=(1, 2, 3, 4))[:, None, None]
    np.testing.assert_allclose(found / scale, exact / scale, atol=1e-9)


@on_every_device
def test_products_with_few_columns_are_matrix_products(device):
    torch.manual_seed(0)
    for size, columns in ((300, 3), (517, 1), (261, 4), (64, 7)):
        A = torch.randn(3, size, size, device=device)
        x = torch.randn(3, size, columns, device=device)
        torch.testing.assert_close(tall_product(A, x), A @ x, rtol=1e-4, atol=1e-4)


# --- batch and single ---------------------------------------------------------------------------


@on_every_device
def test_thirty_two_unlike_scenes_step_as_each_alone(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(32)]
    states = moving_states(problems)
    stepper = pc.BatchStepper(problems, 1e-9, device=device, recover=False)
    found, result = stepped(stepper, states, 2)
    assert set(result.statuses) == {pc.Status.CONVERGED}
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 2), after) < 1e-9
        assert after.time == pytest.approx(2 * problem.time_step)


@on_every_device
@pytest.mark.parametrize("first_hessian", ["rest", "G", "G-scaled"])
@pytest.mark.parametrize("element", VARIANTS[1:])
def test_so_they_do_with_every_element_and_first_hessian(element, first_hessian, device):
    problems = [pc.discretise(unlike(seed, element)) for seed in range(4)]
    states = moving_states(problems)
    stepper = pc.BatchStepper(
        problems, 1e-9, first_hessian=first_hessian, device=device, recover=False
    )
    found, result = stepped(stepper, states, 1)
    assert set(result.statuses) == {pc.Status.CONVERGED}
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 1), after) < 1e-9


@pytest.mark.parametrize(
    ("name", "memory"), [("bdf2", True), ("midpoint", False), ("generalised-alpha", True)]
)
def test_so_they_do_with_every_integrator(name, memory):
    time = {"integrator": name}
    problems = [pc.discretise(unlike(seed, time=time, damping={"mass": 0.5})) for seed in range(3)]
    states = [alone(p, s, 1) for p, s in zip(problems, moving_states(problems), strict=True)]
    assert bool(states[0].memory) is memory
    found, _ = stepped(pc.BatchStepper(problems, 1e-9, recover=False), states, 2)
    for problem, state, after in zip(problems, states, found, strict=True):
        exact = alone(problem, state, 2)
        assert furthest(exact, after) < 1e-9
        np.testing.assert_allclose(after.velocities, exact.velocities, atol=1e-6)


@on_every_device
def test_company_and_order_do_not_matter(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(6)]
    states = moving_states(problems)
    whole, _ = stepped(pc.BatchStepper(problems, 1e-9, device=device), states, 2)
    order = [4, 1, 5]
    some, _ = stepped(
        pc.BatchStepper([problems[i] for i in order], 1e-9, device=device),
        [states[i] for i in order],
        2,
    )
    for i, state in zip(order, some, strict=True):
        assert furthest(whole[i], state) < 1e-9


def test_scenes_with_the_same_matrix_share_one_inverse():
    loads = [[{"kind": "gravity", "acceleration": [0.0, a, -9.81]}] for a in (0.0, 3.0, 5.0)]
    problems = [pc.discretise(beam((4, 1, 1), loads=load)) for load in loads]
    problems.append(pc.discretise(beam((4, 1, 1), poisson=0.3)))
    stepper = pc.BatchStepper(problems, 1e-9, first_hessian="G", recover=False)
    found, _ = stepped(stepper, [p.rest_state() for p in problems], 2)
    assert stepper.inverse_bytes == 2 * 4 * len(problems[0].positions) ** 2
    for problem, after in zip(problems, found, strict=True):
        assert furthest(alone(problem, problem.rest_state(), 2), after) < 1e-9


@on_every_device
def test_a_scene_of_nan_and_one_that_cannot_converge_fail_alone(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(32)]
    absurd = [{"kind": "gravity", "acceleration": [0.0, 0.0, -1e12]}]
    problems[20] = pc.discretise(unlike(20, loads=absurd))
    states = moving_states(problems)
    positions = states[7].positions.copy()
    positions[3, 1] = np.nan
    object.__setattr__(states[7], "positions", positions)  # which State itself would refuse
    stepper = pc.BatchStepper(problems, 1e-9, device=device, recover=False, max_iterations=60)
    found, result = stepped(stepper, states, 1)
    assert result.statuses[7] is pc.Status.NOT_FINITE
    assert not result.statuses[20].ok
    for i, (problem, state) in enumerate(zip(problems, states, strict=True)):
        if i not in (7, 20):
            assert result.statuses[i] is pc.Status.CONVERGED
            assert furthest(alone(problem, state, 1), found[i]) < 1e-9


def test_scenes_that_fail_are_tried_again_alone():
    problems = [pc.discretise(unlike(seed, "hex8-bubble")) for seed in range(4)]
    states = moving_states(problems)
    stepper = pc.BatchStepper(problems, 1e-9, first_hessian="G", max_iterations=8)
    found, result = stepped(stepper, states, 1)
    assert pc.Status.RECOVERED in result.statuses
    for problem, state, after in zip(problems, states, found, strict=True):
        assert furthest(alone(problem, state, 1), after) < 1e-9


def test_they_are_tried_with_the_material_that_they_have():
    problem = pc.discretise(beam((3, 1, 1)))
    state = moving_states([problem])[0]
    stepper = pc.BatchStepper([problem], 1e-9, max_iterations=1)
    values = {"young": 2e5, "poisson": 0.2, "density": 1500.0}
    stepper.set_material(*(torch.tensor([[v]], dtype=torch.float64) for v in values.values()))
    found, result = stepped(stepper, [state], 1)
    assert result.statuses == [pc.Status.RECOVERED]
    assert furthest(alone(problem.with_material(**values), state, 1), found[0]) < 1e-9
    stepper.set_material()
    found, _ = stepped(stepper, [state], 1)
    assert furthest(alone(problem, state, 1), found[0]) < 1e-9


@on_every_device
def test_single_precision_reaches_a_loose_tolerance(device):
    problems = [pc.discretise(unlike(seed)) for seed in range(4)]
    stepper = pc.BatchStepper(problems, 1e-3, dtype=torch.float32, device=device, recover=False)
    found, result = stepped(stepper, [p.rest_state() for p in problems], 2)
    assert all(s.ok for s in result.statuses)
    for problem, after in zip(problems, found, strict=True):
        exact = alone(problem, problem.rest_state(), 2)
        assert furthest(exact, after) < 5e-3 * problem.cell_size


def test_the_memory_formula_fits_what_was_measured_on_a_gpu():
    """Where it matters: batches that take more than half a gigabyte."""
    results = Path(__file__).parents[1] / "benchmarks" / "results"
    record = json.loads((results / "nvidia-h200.json").read_text())
    checked = 0
    for row in record["coarse"] + record["fine"]:
        sizes = Sizes(row["scenes"], row["nodes"], 0, row["cells"], 8, 8)
        width = 3 if row["first_hessian"] == "rest" else 1
        if row["memory_bytes"] > 1e9:
            found = expected_bytes(sizes, row["scenes"], width)
            assert found == pytest.approx(row["memory_bytes"], rel=1 / 3)
            checked += 1
    assert checked >= 6


def test_extra_forces_and_moving_clamps_act_as_on_one_scene():
    turn = {"times": [0.0, 1.0], "rotation": [0.0, 90.0], "centre": [0, 0.02, 0.02], "axis": "x"}
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": turn}]
    problems = [pc.discretise(unlike(seed, clamps=clamps)) for seed in (0, 2)]
    states = [p.rest_state() for p in problems]
    forces = [0.01 * np.random.default_rng(i).normal(size=s.positions.shape)
              for i, s in enumerate(states)]  # fmt: skip
    stepper = pc.BatchStepper(problems, 1e-9, recover=False)
    padded = stepper.cells.nodal(forces)[:, : stepper.cells.sizes.nodes]
    found = stepper.states(stepper(stepper.state(states), padded).state)
    for problem, state, force, after in zip(problems, states, forces, found, strict=True):
        exact = pc.ProjectiveDynamics(problem, 1e-9)(state, force).state
        assert furthest(exact, after) < 1e-9


def test_batches_that_cannot_be_are_refused_by_name():
    def batch(*scenes, **options):
        return pc.BatchStepper([pc.discretise(scene) for scene in scenes], **options)

    with pytest.raises(InputError, match="no problems"):
        pc.BatchStepper([])
    with pytest.raises(InputError, match="element = 'hex8-mean'"):
        batch(unlike(0), unlike(1, "hex8-mean"))
    with pytest.raises(InputError, match=r"time\.step"):
        batch(unlike(0), unlike(1, time={"step": 0.02}))
    radii = ({"integrator": "generalised-alpha", "spectral_radius": r} for r in (0.5, 0.8))
    with pytest.raises(InputError, match=r"time\.spectral_radius"):
        batch(*(unlike(i, time=time) for i, time in enumerate(radii)))
    shift = {"times": [0.0, 1.0], "displacement": [[0, 0, 0], [0.1, 0, 0]]}
    moved = [{"region": {"plane": "x", "at": 0.0}, "motion": shift}]
    with pytest.raises(InputError, match="moving clamps with midpoint"):
        batch(unlike(0, clamps=moved), integrator="midpoint")
    with pytest.raises(InputError, match=r"damping\.stiffness"):
        batch(unlike(0, damping={"stiffness": 0.1}))
    adrift = batch(beam((2, 1, 1), clamps=[], loads=[]), integrator="quasi-static")
    with pytest.raises(ConvergenceError, match="not positive definite"):
        adrift(adrift.rest_state())
    stepper = batch(unlike(0), unlike(1))
    with pytest.raises(InputError, match="1 states: expected 2"):
        stepper.state([stepper.problems[0].rest_state()])
    with pytest.raises(InputError, match="state 1 has"):
        stepper.state([stepper.problems[0].rest_state()] * 2)

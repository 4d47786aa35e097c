"""Projective dynamics and Newton: agreement, accuracy estimates, descent, faults."""

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

import pdcorrect as pc
from conftest import CLAMPED, GRAVITY, beam, cross, disturbed, rotation
from oracle import Oracle
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.solvers.integrators import backward_euler
from pdcorrect.solvers.minimise import History, MinimiserOptions, largest_displacement, minimise
from pdcorrect.solvers.step import GlobalSolver, StepObjective

EULER = {"integrator": "backward-euler"}


def backward_euler_objective(problem, state, h):
    """What a step of h seconds minimises."""
    return StepObjective(problem, state, backward_euler(problem, state, h))


# --- agreement ------------------------------------------------------------------------


@pytest.mark.parametrize("poisson", [0.3, 0.45])
@pytest.mark.parametrize("name", ["beam with gravity", "cross with torsion"])
def test_pd_and_newton_agree_on_the_same_energy(name, poisson):
    scene = beam((16, 2, 2), poisson=poisson) if "beam" in name else cross(poisson)
    problem = pc.discretise(scene)
    by_pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-8), frames=20)
    by_newton = pc.rollout(pc.Newton(problem), frames=20)
    assert np.abs(by_newton.positions[-1] - problem.positions).max() > 0.5 * problem.cell_size
    assert np.abs(by_pd.positions - by_newton.positions).max() < 1e-8
    assert set(by_pd.stats["status"]) == set(by_newton.stats["status"]) == {"CONVERGED"}


@pytest.mark.parametrize("weights", ["lame", "published"])
def test_both_agree_with_the_literal_scikit_fem_forms(weights):
    scene = beam(
        (3, 2, 1), material={"volume_weight": weights}, solver={"mass": "consistent"}, time=EULER,
        loads=[{"kind": "gravity", "acceleration": [3.0, -20.0, 40.0]}],
    )  # fmt: skip
    problem = pc.discretise(scene)
    oracle = Oracle(
        (3, 2, 1), 0.02, problem.materials.mu[0], problem.materials.volume_weight[0], 1e3,
        (3.0, -20.0, 40.0), 0.01,
    )  # fmt: skip
    newton = pc.rollout(pc.Newton(problem), frames=6)
    pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-9), frames=6)
    for frame in range(1, 7):
        assert oracle.step() < 10  # quadratic: its tangent is right
        expected = problem.positions + oracle.displacement_at(problem.positions)
        np.testing.assert_allclose(newton.positions[frame], expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(pd.positions[frame], expected, rtol=0, atol=1e-9)


def test_the_peers_trajectory_is_reproduced(request):
    data = np.load(request.path.parent / "data" / "diffpd_beam_24x2x2.npz", allow_pickle=False)
    scene = beam(
        (24, 2, 2), 0.02, 0.45, material={"volume_weight": "published"},
        solver={"mass": "per-node", "tolerance": 1e-7}, time={"frames": 50, **EULER},
    )  # fmt: skip
    problem = pc.discretise(scene)
    np.testing.assert_array_equal(problem.positions, data["rest_positions"])
    run = pc.rollout(pc.ProjectiveDynamics(problem))
    assert len(run) == 50
    assert np.abs(data["positions"] - problem.positions).max() > 0.1
    assert np.abs(run.positions - data["positions"]).max() < 1e-7
    velocities = np.diff(data["positions"], axis=0) / data["time_step"]
    assert np.abs(run.velocities[1:] - velocities).max() < 1e-5


def test_local_global_reaches_the_same_state():
    problem = pc.discretise(beam((4, 2, 1), poisson=0.3))
    state = pc.State(disturbed(problem, 0.1), np.zeros_like(problem.positions))
    plain = pc.ProjectiveDynamics(problem, method="local-global", tolerance=1e-8)(state)
    quasi = pc.ProjectiveDynamics(problem, tolerance=1e-8)(state)
    assert plain.status is quasi.status is pc.Status.CONVERGED
    assert plain.iterations > 3 * quasi.iterations
    np.testing.assert_allclose(plain.state.positions, quasi.state.positions, atol=1e-9)


@pytest.mark.parametrize("rule", ["lumped", "averaged", "consistent", "per-node"])
def test_a_free_body_falls_freely_with_every_mass(rule):
    """Gravity moves all nodes alike; backward Euler falls by g h^2 n (n + 1) / 2."""
    problem = pc.discretise(cross(clamps=[], loads=GRAVITY, time=EULER), mass=rule)
    run = pc.rollout(pc.ProjectiveDynamics(problem), frames=5)
    for n in range(6):
        fall = np.array([0, 0, -9.81e-4 * n * (n + 1) / 2])
        np.testing.assert_allclose(run.positions[n], problem.positions + fall, atol=1e-9)


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean", "hex27"])
@pytest.mark.parametrize("energy", ["corotated", "neo-hookean"])
def test_a_result_carries_the_energy_and_the_volume_ratios_of_its_state(element, energy):
    material = {"poisson": 0.3, "energy": energy}
    scene = beam((4, 1, 1), material=material, solver={"element": element})
    problem = pc.discretise(scene)
    state = pc.State(disturbed(problem, 0.05), np.zeros_like(problem.positions))
    result = pc.ProjectiveDynamics(problem)(state)
    ratios = problem.volume_ratios(result.state.positions)
    assert np.array_equal(result.volume_ratios, ratios)
    assert result.stats["smallest_volume_ratio"] == ratios.min()
    y = problem.relaxed(result.state.positions)
    energy, _ = problem.energy_and_forces(y)
    assert result.stats["elastic_energy"] == pytest.approx(energy, rel=1e-6)


def test_clamped_and_moving_components_are_where_they_are_told():
    motion = {"times": [0, 0.05], "displacement": [[0, 0, 0], [0.01, 0.005, 0]]}
    scene = beam(
        clamps=[
            {"region": {"plane": "x", "at": 0.0}, "components": ["x", "y"]},
            {"region": {"plane": "x", "at": 0.0}, "components": ["z"]},
            {"region": {"plane": "x", "at": "max"}, "motion": motion},
            {"region": {"box": [[0.05, -1, 0.035], [0.07, 1, 1]]}, "components": ["z"]},
        ]
    )
    problem = pc.discretise(scene)
    assert len({tuple(column) for column in problem.free.T}) == 2
    runs = [pc.rollout(s, 8) for s in (pc.ProjectiveDynamics(problem), pc.Newton(problem))]
    for run in runs:
        for frame in range(1, 9):
            held = ~problem.free
            target = problem.clamped_positions(frame * 0.01)
            np.testing.assert_allclose(run.positions[frame][held], target[held], atol=1e-15)
    assert np.abs(runs[0].positions - runs[1].positions).max() < 1e-5 * problem.cell_size


# --- what the numbers mean --------------------------------------------------------------


def flight_state(problem, rng):
    spin = np.cross([5.0, 3.0, 2.0], problem.positions - problem.positions.mean(axis=0))
    return pc.State(problem.positions, spin + 0.3 * rng.normal(size=spin.shape))


ESTIMATED = [
    *itertools.product(("twist", "bending", "flight"), (0.3, 0.45), ("lbfgs",)),
    *itertools.product(("bending", "flight"), (0.3, 0.45), ("local-global",)),
    ("twist", 0.3, "local-global"),
    pytest.param("twist", 0.45, "local-global", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("motion", "poisson", "method"), ESTIMATED)
def test_the_error_estimate_is_within_ten_times_of_the_error(motion, poisson, method, rng):
    loads = {"twist": [{"kind": "torsion", "strength": 2e5}], "bending": GRAVITY, "flight": []}
    scene = beam(
        (8, 2, 2), poisson=poisson, loads=loads[motion],
        clamps=[] if motion == "flight" else CLAMPED,
    )  # fmt: skip
    problem = pc.discretise(scene)
    state = flight_state(problem, rng) if motion == "flight" else problem.rest_state()
    for tolerance in (1e-2, 1e-3) if method == "local-global" else (1e-2, 1e-4, 1e-6):
        stepper = pc.ProjectiveDynamics(problem, tolerance=tolerance, method=method)
        current = state
        for _ in range(3):
            result = stepper(current)
            exact = pc.Newton(problem, tolerance=1e-11)(current)
            error = largest_displacement(result.state.positions - exact.state.positions)
            assert result.status is pc.Status.CONVERGED
            assert result.error_estimate <= tolerance * problem.cell_size
            assert 0.1 < result.error_estimate / error < 10
            current = exact.state


@pytest.mark.parametrize(
    ("cells", "poisson", "young", "tolerance", "least"),
    [
        ((100, 2, 2), 0.45, 1e8, 1e-3, 0.1),
        ((100, 1, 1), 0.49, 1e7, 1e-4, 0.5),
        ((100, 1, 1), 0.49, 1e7, 1e-2, 0.03),
    ],
)
def test_the_estimate_holds_for_slender_beams_and_long_steps(
    cells, poisson, young, tolerance, least
):
    """One Newton step is short of the minimum where a loose tolerance stops the descent early."""
    scene = beam(cells, poisson=poisson, material={"young": young}, time={"step": 0.1})
    problem = pc.discretise(scene)
    state = problem.rest_state()
    for _ in range(3):
        result = pc.ProjectiveDynamics(problem, tolerance)(state)
        exact = pc.Newton(problem, tolerance=1e-11)(state)
        error = largest_displacement(result.state.positions - exact.state.positions)
        assert result.status.ok
        assert least < result.error_estimate / error < 10
        state = exact.state


@pytest.mark.parametrize("contrast", [1e4, 1e7])
def test_the_estimate_sees_a_stiff_part_turn_on_a_soft_neck(contrast):
    """G takes that slow mode for stiff, so only the residual itself shows it."""
    neck = {"region": {"box": [[0.0, 0, 0], [0.04, 1, 1]]}, "young": 1e6}
    tip = {"kind": "traction", "traction": [0, 500.0, -2e3], "region": {"plane": "x", "at": "max"}}
    scene = beam((8, 2, 2), material={"young": 1e6 * contrast}, materials=[neck], loads=[tip])
    problem = pc.discretise(scene)
    result = pc.ProjectiveDynamics(problem)(problem.rest_state())
    exact = pc.Newton(problem)(problem.rest_state()).state.positions
    assert result.status.ok
    assert largest_displacement(exact - problem.positions) > 1e-3 * problem.cell_size
    assert largest_displacement(result.state.positions - exact) < 1e-4 * problem.cell_size


def test_the_preconditioned_gradient_alone_would_be_far_too_small():
    """Why the estimate uses the true Hessian: in twist G^-1 grad gamma misses the soft modes."""
    scene = beam((12, 2, 2), loads=[{"kind": "torsion", "strength": 2e5}])
    problem = pc.discretise(scene)
    solve = GlobalSolver(problem, (1e4, 1.0))
    objective = backward_euler_objective(problem, problem.rest_state(), 0.01)
    options = MinimiserOptions(0.0, history=0, max_iterations=2000)
    found = minimise(objective, objective.start, solve, options)
    exact = pc.Newton(problem)(problem.rest_state()).state.positions
    error = largest_displacement(found.positions - exact)
    assert largest_displacement(solve(found.gradient)) < error / 100


def test_the_history_reproduces_the_inverse_hessian_of_bfgs(rng):
    """Against the dense update H <- (I - s y'/ys) H (I - y s'/ys) + s s'/ys of the kept pairs."""
    n, size = 12, 4
    factor = rng.normal(size=(n, n))
    G = factor @ factor.T + n * np.eye(n)
    curvature = G + np.diag(rng.uniform(0, 5, n))
    solve = np.linalg.inv(G)
    history = History(size, n)
    gradient = rng.normal(size=n)
    pairs = []
    for step in range(9):
        s = rng.normal(size=n)
        sign = -1.0 if step in (2, 6) else 1.0  # these pairs have negative curvature
        y = sign * curvature @ s
        new = gradient + y
        history.append(s, solve @ y, gradient, new)
        gradient = new
        if sign > 0:
            pairs = [*pairs, (s, y)][-size:]
        H = solve.copy()
        for s, y in pairs:
            project = np.eye(n) - np.outer(s, y) / (s @ y)
            H = project @ H @ project.T + np.outer(s, s) / (s @ y)
        assert len(history) == len(pairs)
        np.testing.assert_allclose(
            history.direction(gradient, solve @ gradient), -H @ gradient, rtol=1e-8, atol=1e-10
        )


@pytest.mark.parametrize(("history", "scale"), [(0, 1.0), (8, 1.0), (16, 0.25)])
def test_gamma_never_rises_over_iterations(history, scale):
    problem = pc.discretise(cross())
    state = pc.State(disturbed(problem, 0.4), np.zeros_like(problem.positions))
    objective = backward_euler_objective(problem, state, 0.01)
    solve = GlobalSolver(problem, (1e4, 1.0), volume_scale=scale)
    values = [
        minimise(objective, objective.start, solve, MinimiserOptions(0.0, history, n)).value
        for n in range(25)
    ]
    assert (np.diff(values) <= 1e-12 * np.abs(values[0])).all()
    assert values[-1] < values[0]


def test_the_answer_does_not_depend_on_the_origin():
    near = pc.discretise(beam())
    far = pc.discretise(
        beam(
            body={"origin": [100.0, -50.0, 30.0]},
            clamps=[{"region": {"plane": "x", "at": 100.0}}],
        )
    )
    shift = np.array([100.0, -50.0, 30.0])
    here, there = (pc.rollout(pc.ProjectiveDynamics(p, 1e-8), 10) for p in (near, far))
    np.testing.assert_allclose(there.positions - shift, here.positions, rtol=0, atol=2e-9)
    counts = [run.stats["iterations"] for run in (here, there)]
    assert counts[0][0] == counts[1][0]
    assert counts[0].sum() == pytest.approx(counts[1].sum(), rel=0.1)


def test_turning_the_scene_turns_the_answer():
    """A free body in flight, once as it is and once with everything rotated."""
    problem = pc.discretise(cross(clamps=[], loads=[]))
    state = flight_state(problem, np.random.default_rng(0))
    turn = rotation()
    plain = pc.Newton(problem)(state).state.positions
    turned = pc.Newton(problem)(
        pc.State(state.positions @ turn.T, state.velocities @ turn.T)
    ).state.positions
    np.testing.assert_allclose(turned, plain @ turn.T, atol=1e-11)


def test_extra_forces_add_to_the_loads(rng):
    bare = pc.discretise(beam(loads=[]))
    loaded = pc.discretise(beam())
    forces = loaded.external_forces(0.0)
    a = pc.ProjectiveDynamics(bare, tolerance=1e-9)(bare.rest_state(), forces=forces)
    b = pc.ProjectiveDynamics(loaded, tolerance=1e-9)(loaded.rest_state())
    np.testing.assert_allclose(a.state.positions, b.state.positions, atol=1e-10)


def test_energy_bookkeeping_closes_as_the_step_shrinks():
    """Work of the loads = elastic + kinetic + what backward Euler dissipates, which is O(h)."""
    losses = []
    for h in (0.002, 0.001, 0.0005):
        loads = [{**GRAVITY[0], "ramp": 0.04}]  # smooth, so that only slow modes swing
        problem = pc.discretise(beam((4, 1, 1), time={"step": h}, loads=loads))
        run = pc.rollout(pc.Newton(problem), frames=round(0.04 / h))
        stored = run.stats["elastic_energy"][-1] + run.stats["kinetic_energy"][-1]
        losses.append(run.stats["external_work"].sum() - stored)
    assert losses[0] > losses[1] > losses[2] > 0
    assert losses[1] / losses[2] == pytest.approx(2, abs=0.4)


def test_the_reported_residual_is_the_out_of_balance_force():
    problem = pc.discretise(beam(time=EULER))
    result = pc.ProjectiveDynamics(problem, 1e-3)(problem.rest_state())
    objective = backward_euler_objective(problem, problem.rest_state(), 0.01)
    _, gradient = objective.value_and_gradient(result.state.positions)
    assert result.residual == np.abs(gradient).max() > 0


def test_a_pressure_on_a_turned_body_pushes_along_the_turned_normal():
    """Where the step ends; a small one, after which the body has not turned further."""
    load = {"kind": "pressure", "pressure": 2e3, "region": {"plane": "x", "at": "max"}}
    problem = pc.discretise(beam(clamps=[], loads=[{**load, "follower": True}], time=EULER))
    turn = rotation()
    state = pc.State(problem.positions @ turn.T, np.zeros_like(problem.positions))
    result = pc.Newton(problem, time_step=1e-5)(state)
    momentum = (problem.mass[:, None] * result.state.velocities).sum(axis=0)
    area = 0.04**2
    np.testing.assert_allclose(momentum, -2e3 * area * 1e-5 * turn[:, 0], rtol=1e-5, atol=1e-12)


def test_without_a_volume_term_no_volume_is_projected(monkeypatch):
    """The arrays of the projection are never read, so poisoned ones do no harm."""
    from pdcorrect.fem import energies

    density, t, T = np.empty(1), np.empty((3, 1)), np.empty((12, 1))
    s = np.array([[1.2], [1.0], [0.9]])
    poison = np.full((3, 1), np.nan)
    mu, omega = np.ones(1), np.zeros(1)
    energies.corotated_lanes(s, poison, poison[0], mu, omega, 1, density, t)
    energies.corotated_tangent_lanes(s, poison, poison[0], mu, omega, 1, T)
    for array in (density, t, T):
        assert np.isfinite(array).all()


def test_g_is_factorised_once(monkeypatch):
    from pdcorrect.solvers import implicit

    made = []
    real = implicit.GlobalSolver
    monkeypatch.setattr(implicit, "GlobalSolver", lambda *args: made.append(args[1]) or real(*args))
    problem = pc.discretise(beam(time=EULER))
    stepper = pc.ProjectiveDynamics(problem, first_hessian="G")
    pc.rollout(stepper, 4)
    assert made == [(1e4, 1.0)]
    stepper(problem.rest_state(), time_step=0.02)
    pc.rollout(stepper, 2)
    assert made == [(1e4, 1.0), (2.5e3, 1.0)]


def test_a_run_does_not_depend_on_the_number_of_threads():
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from conftest import cross\n"
        "import numba, pdcorrect as pc\n"
        "from pdcorrect.fem import cell_loops\n"
        "run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(cross(), refine=2)), 2)\n"
        "assert numba.get_num_threads() == 2\n"
        "assert cell_loops._in_threads.signatures\n"
        "sys.stdout.buffer.write(run.positions.tobytes())"
    )
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2"}
    for one_thread in ("PYTEST_XDIST_WORKER", "OMP_THREAD_LIMIT"):  # by conftest, by OpenMP
        environment.pop(one_thread, None)
    two = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent)],
        env=environment, stdout=subprocess.PIPE, check=True,
    ).stdout  # fmt: skip
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = pc.rollout(pc.ProjectiveDynamics(pc.discretise(cross(), refine=2)), 2)
    finally:
        numba.set_num_threads(before)
    assert one.positions.tobytes() == two


# --- factors stay right --------------------------------------------------------------------


def test_a_new_time_step_refactorises():
    problem = pc.discretise(beam(time=EULER))
    stepper = pc.ProjectiveDynamics(problem, tolerance=1e-9)
    state = stepper(problem.rest_state()).state
    for h in (0.003, 0.01, 0.02, 0.003):
        fresh = pc.ProjectiveDynamics(problem, tolerance=1e-9, time_step=h)(state)
        again = stepper(state, time_step=h)
        np.testing.assert_array_equal(again.state.positions, fresh.state.positions)
        assert again.iterations == fresh.iterations


@pytest.mark.parametrize(
    "change",
    [
        {"material": {"young": 3e6}},
        {"material": {"density": 200.0}},
        {"clamps": [{"region": {"plane": "y", "at": 0.0}, "components": ["y", "z"]}]},
    ],
)
def test_another_material_or_clamp_set_has_its_own_factor(change):
    pc.ProjectiveDynamics(pc.discretise(beam()))(pc.discretise(beam()).rest_state())
    problem = pc.discretise(beam(**change))
    pd = pc.ProjectiveDynamics(problem, tolerance=1e-9)(problem.rest_state())
    newton = pc.Newton(problem)(problem.rest_state())
    np.testing.assert_allclose(pd.state.positions, newton.state.positions, atol=1e-10)


# --- hard states and faults ------------------------------------------------------------------


def smallest_determinant(problem, positions):
    F = np.einsum("cki,cqkj->cqij", positions[problem.cells], problem.quadrature.gradients)
    return np.linalg.det(F).min()


def hard_states(problem):
    x, free = problem.positions, problem.free
    flat = np.where(free, x * [1, 1, 0] + [0, 0, 0.02], x)
    last = x[:, 0] > x[:, 0].max() - 1.5 * problem.cell_size
    inside_out = x.copy()
    inside_out[last, 0] = 2 * x[last, 0].min() - x[last, 0]
    return {"flat": flat, "random": disturbed(problem, 1.0), "inside out": inside_out}


@pytest.mark.parametrize("name", ["flat", "random", "inside out"])
@pytest.mark.parametrize("kind", [pc.ProjectiveDynamics, pc.Newton])
def test_hard_states_return_to_positive_volume(kind, name):
    problem = pc.discretise(beam((10, 2, 2), time=EULER))
    state = pc.State(hard_states(problem)[name], np.zeros_like(problem.positions))
    run = pc.rollout(kind(problem), 8, state=state)
    assert all(pc.Status[s].ok for s in run.stats["status"])
    assert smallest_determinant(problem, run.positions[-1]) > 0.5


def test_a_step_that_stalls_falls_back_to_newton_cg():
    problem = pc.discretise(beam())
    state = pc.State(hard_states(problem)["random"], np.zeros_like(problem.positions))
    result = pc.ProjectiveDynamics(problem, max_iterations=10)(state)
    assert result.status is pc.Status.RECOVERED
    assert result.status.ok
    assert result.iterations > 10
    given_up = pc.ProjectiveDynamics(problem, max_iterations=10, recover=False)(state)
    assert given_up.status is pc.Status.ITERATION_LIMIT
    assert not given_up.status.ok
    assert given_up.error_estimate > 1e-5 * problem.cell_size


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "generalised-alpha"])
def test_integrators_with_a_memory_go_on_after_substeps(monkeypatch, integrator):
    """As after a step of their own, also in batches, where all scenes have the same memory."""
    time = {"step": 0.01, "frames": 6, "integrator": integrator}
    problem = pc.discretise(beam(time=time, damping={"viscosity": 1e-3}))
    stepper = pc.ProjectiveDynamics(problem)
    before = stepper(stepper(problem.rest_state()).state).state
    whole = stepper(before).state
    real, calls = stepper._solved, []

    def stuck_in_the_whole_step(*arguments):
        calls.append(real(*arguments))
        return replace(calls[0], status=pc.Status.LINE_SEARCH) if len(calls) == 1 else calls[-1]

    monkeypatch.setattr(stepper, "_solved", stuck_in_the_whole_step)
    result = stepper(before)
    assert result.status is pc.Status.SUBSTEPPED
    assert len(calls) == 3
    parts = result.state
    assert set(parts.memory) == set(whole.memory)
    way = np.abs(whole.positions - before.positions).max()
    assert np.abs(parts.positions - whole.positions).max() < 0.3 * way
    monkeypatch.undo()
    after, expected = stepper(parts), stepper(whole)
    assert after.status is pc.Status.CONVERGED
    assert np.abs(after.state.positions - expected.state.positions).max() < 0.7 * way


def test_substeps_are_the_second_fallback(monkeypatch):
    from pdcorrect.solvers import implicit

    problem = pc.discretise(beam(time=EULER))
    calls = []

    def only_small_steps(objective, start, solve, options):
        calls.append(1 / objective.stage.rate)
        status = pc.Status.CONVERGED if calls[-1] < 0.004 else pc.Status.LINE_SEARCH
        found = minimise(objective, start, solve, replace(options, max_iterations=500))
        return replace(found, status=status)

    monkeypatch.setattr(implicit, "newton_cg", only_small_steps)
    stepper = pc.ProjectiveDynamics(problem, max_iterations=1, first_hessian="G")
    result = stepper(problem.rest_state())
    assert result.status is pc.Status.SUBSTEPPED
    assert calls == [0.01, 0.005, 0.0025, 0.0025, 0.0025, 0.0025]
    fine = pc.rollout(pc.ProjectiveDynamics(problem, time_step=0.0025), 4)
    np.testing.assert_allclose(result.state.positions, fine.positions[-1], atol=1e-6)
    assert result.state.time == pytest.approx(0.01)
    np.testing.assert_allclose(result.state.velocities, fine.velocities[-1], atol=1e-3)
    assert result.stats["external_work"] == pytest.approx(
        fine.stats["external_work"].sum(), rel=1e-3
    )
    assert result.iterations > fine.stats["iterations"].sum() / 2


def test_a_hopeless_step_is_reported_never_accepted():
    problem = pc.discretise(beam((2, 1, 1)))
    stepper = pc.ProjectiveDynamics(problem, tolerance=1e-30, max_iterations=30)
    result = stepper(problem.rest_state())
    assert not result.status.ok
    with pytest.raises(ConvergenceError, match="frame 1 .* failed") as caught:
        pc.rollout(stepper, 3)
    assert len(caught.value.trajectory) == 0
    assert caught.value.result.status == result.status
    assert len(pc.rollout(stepper, 3, on_failure="stop")) == 0
    kept = pc.rollout(stepper, 3, on_failure="continue")
    assert len(kept) == 3
    assert not any(pc.Status[s].ok for s in kept.stats["status"])


def test_a_singular_problem_is_named_not_a_traceback():
    """No clamps and hardly any inertia: neither G nor the tangent has a factor."""
    problem = pc.discretise(beam(clamps=[], time={"step": 1e10}, material={"density": 1e-6}))
    for kind in (pc.ProjectiveDynamics, pc.Newton):
        try:
            result = kind(problem)(pc.State(1.1 * problem.positions, 0 * problem.positions))
        except ConvergenceError as error:
            assert "singular" in str(error)
        else:
            assert result.status in pc.Status


def test_stiff_bodies_move_even_below_the_tolerance():
    problem = pc.discretise(beam(material={"young": 1e12}))
    result = pc.ProjectiveDynamics(problem)(problem.rest_state())
    exact = pc.Newton(problem)(problem.rest_state()).state.positions - problem.positions
    moved = result.state.positions - problem.positions
    assert np.abs(exact).max() < 0.1 * 1e-5 * problem.cell_size
    np.testing.assert_allclose(moved, exact, atol=0.2 * np.abs(exact).max())


def test_a_body_at_rest_without_loads_stays_there():
    for clamps in ([], CLAMPED):
        problem = pc.discretise(beam(loads=[], clamps=clamps))
        run = pc.rollout(pc.ProjectiveDynamics(problem), 3)
        np.testing.assert_array_equal(run.positions[-1], problem.positions)
        assert (run.stats["iterations"] == 0).all()


def test_an_overflowing_state_fails_by_name():
    problem = pc.discretise(beam((2, 1, 1)))
    velocities = np.full_like(problem.positions, 1e200)
    result = pc.ProjectiveDynamics(problem)(pc.State(problem.positions, velocities))
    assert result.status is pc.Status.NOT_FINITE


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [pc.ProjectiveDynamics, pc.Newton])
def test_numbers_that_are_not_finite_are_refused_with_the_node(kind, value):
    problem = pc.discretise(beam())
    stepper, rest = kind(problem), problem.rest_state()
    for name in ("positions", "velocities", "forces"):
        arrays = {n: np.zeros_like(rest.positions) for n in ("velocities", "forces")}
        arrays["positions"] = rest.positions.copy()
        arrays[name][11, 2] = value
        state = pc.State(arrays["positions"], arrays["velocities"])
        with pytest.raises(InputError, match=f"{name} of node 11 "):
            stepper(state, forces=arrays["forces"])


def test_wrong_shapes_and_options_are_refused():
    problem = pc.discretise(beam())
    for bad in (np.zeros(3), np.zeros((2, 3))):
        with pytest.raises(InputError, match=r"expected \(63, 3\)"):
            problem.energy(bad)
        with pytest.raises(InputError, match=r"expected \(63, 3\)"):
            problem.linearise(problem.positions).apply(bad)
    with pytest.raises(InputError, match="time = nan"):
        pc.State(problem.positions, problem.positions, np.nan)
    small = pc.State(np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"\(4, 3\): expected \(63, 3\)"):
        pc.ProjectiveDynamics(problem)(small)
    with pytest.raises(InputError, match=r"expected shape \(N, 3\)"):
        pc.State(np.zeros(9), np.zeros(9))
    for options in (
        {"max_iterations": -1}, {"backend": "magic"}, {"time_step": 1e300},
        {"method": "magic"}, {"first_hessian": "H"}, {"tolerance": 0.0}, {"time_step": np.nan},
        {"method": "local-global", "first_hessian": "G-scaled"},
    ):  # fmt: skip
        with pytest.raises(InputError, match="expected|leave"):
            pc.ProjectiveDynamics(problem, **options)
    with pytest.raises(InputError, match="time_step = -1"):
        pc.ProjectiveDynamics(problem)(problem.rest_state(), time_step=-1)
    with pytest.raises(InputError, match="expected a Scene"):
        pc.discretise("scene.toml")
    for bad in ({"frames": -1}, {"frames": 0}, {"frames": 2.5}, {"on_failure": "pray"}):
        with pytest.raises(InputError, match="expected"):
            pc.rollout(pc.ProjectiveDynamics(problem), **bad)
    with pytest.raises(InputError, match=r"problem is a Scene: expected pc.discretise"):
        pc.ProjectiveDynamics(problem.scene)
    for stepper in (problem, problem.scene):
        with pytest.raises(InputError, match="stepper is a"):
            pc.rollout(stepper)
    with pytest.raises(InputError, match="state is a ndarray"):
        pc.ProjectiveDynamics(problem)(problem.positions)
    for forces in ({}, 1.0):
        with pytest.raises(InputError, match=r"forces is a \w+: expected an array"):
            pc.ProjectiveDynamics(problem)(problem.rest_state(), forces)


def test_an_indefinite_tangent_is_replaced_by_its_projection():
    """Compressed flat with a large step, the exact tangent is indefinite; Newton still descends."""
    problem = pc.discretise(beam((4, 2, 2)))
    squashed = np.where(problem.free, problem.positions * [0.2, 1, 1], problem.positions)
    state = pc.State(squashed, np.zeros_like(squashed))
    free = problem.free.ravel()
    exact = problem.stiffness(squashed).toarray() + np.diag(np.repeat(problem.mass, 3))
    exact = exact[free][:, free]
    assert np.linalg.eigvalsh(exact).min() < 0
    result = pc.Newton(problem, time_step=1.0)(state)
    assert result.status.ok
    assert smallest_determinant(problem, result.state.positions) > 0


# --- restrict --------------------------------------------------------------------------------


def test_restriction_keeps_the_coincident_nodes():
    scene = beam((3, 2, 1))
    coarse = pc.discretise(scene)
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene, refine=4)), 2)
    here = pc.restrict(run, to=coarse)
    np.testing.assert_array_equal(here.positions[0], coarse.positions)
    nodes = run.problem.mesh.coarse_nodes
    np.testing.assert_array_equal(here.positions, run.positions[:, nodes])
    np.testing.assert_array_equal(here.velocities, run.velocities[:, nodes])
    with pytest.raises(pc.errors.MeshError, match="no coincident node"):
        pc.restrict(run, to=pc.discretise(beam((4, 2, 1))))

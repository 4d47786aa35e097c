"""Time integrators: their orders, what they conserve, damping, and agreement of the solvers."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as sla

import pdcorrect as pc
from conftest import CLAMPED, GRAVITY, beam, box_mesh, disturbed, problem_on
from pdcorrect.solvers import schemes
from test_elements import MESHES
from time_orders import errors, reference, swinging

SECOND = [
    ("midpoint", 0.0),
    ("generalised-alpha", 0.8),
    ("generalised-alpha", 1.0),
    ("bdf2", 0.0),
    ("generalised-alpha", 0.0),
]
DYNAMIC = [("backward-euler", 0.0), *SECOND]


def names(cases):
    return [name + (f" {r:g}" if "alpha" in name else "") for name, r in cases]


on_second_order = pytest.mark.parametrize(("name", "radius"), SECOND, ids=names(SECOND))
on_every_integrator = pytest.mark.parametrize(("name", "radius"), DYNAMIC, ids=names(DYNAMIC))

# --- orders ----------------------------------------------------------------------------------

MOTIONS = {
    "pulse": {},
    "moving clamp, consistent mass": {"moving": True, "mass": "consistent"},
    "moving clamp, mass damping": {"moving": True, "damping": {"mass": 3.0}},
    "small, Rayleigh damping": {"strength": 0.01, "damping": {"mass": 1.0, "stiffness": 0.01}},
    "incompatible modes": {"element": "hex8-bubble", "mass": "consistent"},
}
_EXACT = {}


def measured_orders(motion, name, radius, counts):
    """Orders of positions and velocities between each two counts of steps."""
    settings = MOTIONS[motion]
    if motion not in _EXACT:
        _EXACT[motion] = reference(swinging(**settings), settings.get("moving", False))
    problem = swinging(**settings, integrator=name, spectral_radius=radius)
    found = np.array([errors(problem, _EXACT[motion], n) for n in counts])
    return np.log2(found[:-1] / found[1:])


def check_orders(found, name):
    """At steps where fast modes still spoil the velocities."""
    if name == "backward-euler":
        assert ((found > 0.85) & (found < 1.2)).all()
    else:
        assert found[:, 0].min() > 1.85
        assert found[:, 1].min() > 1.5


@on_every_integrator
def test_errors_fall_with_the_order_of_the_integrator(name, radius):
    check_orders(measured_orders("pulse", name, radius, (32, 64)), name)


@pytest.mark.parametrize(
    ("name", "radius"), [("midpoint", 0.0), ("generalised-alpha", 0.8), ("generalised-alpha", 0.0)]
)
def test_inertia_of_moving_clamps_acts_on_their_neighbours(name, radius):
    """Through a consistent mass."""
    found = measured_orders("moving clamp, consistent mass", name, radius, (32, 64))
    check_orders(found, name)


@pytest.mark.slow
@pytest.mark.parametrize("motion", [m for m in MOTIONS if "small" not in m])  # at round-off
@on_every_integrator
def test_errors_fall_so_at_smaller_steps_in_every_motion(name, radius, motion):
    found = measured_orders(motion, name, radius, (128, 256))
    low, high = (0.9, 1.2) if name == "backward-euler" else (1.9, 2.3)
    assert low < found.min()
    assert found.max() < high


@on_second_order
def test_stiffness_damping_of_small_motion_keeps_the_second_order(name, radius):
    found = measured_orders("small, Rayleigh damping", name, radius, (32, 64))
    check_orders(found, name)


# --- steps much longer than every period -----------------------------------------------------

LONG = 1e3
"""Omega h of the lowest mode."""


@pytest.fixture(params=[1.0, 0.8, 0.5, 0.0])
def one_cell(request):
    """(spectral radius, stepper of a thousand times 1 / omega_1, tiny displacements (N, 3), m)."""
    problem = problem_on(
        box_mesh((1, 1, 1), (0.1, 0.09, 0.08)), clamps=CLAMPED,
        material={"young": 2e4, "poisson": 0.3},
        time={"integrator": "generalised-alpha", "spectral_radius": request.param},
    )  # fmt: skip
    step = LONG / (2 * np.pi * pc.modes(problem, 1).frequencies[0])
    stepper = pc.Newton(problem, time_step=step, tolerance=1e-12)
    return request.param, stepper, disturbed(problem, 1e-6) - problem.positions


def share(field, of):
    return np.vdot(field, of) / np.vdot(of, of)


def test_the_amplification_of_long_steps_has_the_spectral_radius_asked_for(one_cell):
    """Three eigenvalues tend to minus it (Chung and Hulbert 1993), that of the forces to zero.

    Compared are the coefficients of (x + r)^3 x: a triple eigenvalue is ill-conditioned.
    """
    radius, stepper, u = one_cell
    rest, h = stepper.problem.positions, stepper.time_step
    forces = LONG**2 / h**2 * stepper.problem.mass_times(u)
    units = {"positions": u, "velocities": u / h, "accelerations": u / h**2,
             "internal_forces": forces}  # fmt: skip
    columns = []
    for k in range(4):
        p, v, a, f = (unit * (i == k) for i, unit in enumerate(units.values()))
        memory = {"accelerations": a, "internal_forces": f}
        end = stepper(pc.State(rest + p, v, 0.0, memory)).state
        after = end.positions - rest, end.velocities, *(end.memory[name] for name in memory)
        columns.append([share(x, unit) for x, unit in zip(after, units.values(), strict=True)])
    expected = [1.0, 3 * radius, 3 * radius**2, radius**3, 0.0]
    np.testing.assert_allclose(np.poly(np.transpose(columns)), expected, rtol=0, atol=1e-4)


def test_in_long_steps_a_displacement_is_gone_and_the_velocity_alternates(one_cell):
    """For steps in balance at their ends; the velocity is a parabola times powers of -radius."""
    radius, stepper, u = one_cell
    rest, h = stepper.problem.positions, stepper.time_step
    run = pc.rollout(stepper, 9, state=pc.State(rest + u, np.zeros_like(u)))
    assert max(abs(share(x, u)) for x in run.positions[1:] - rest) < 1e-4
    speeds = [h * share(v, u) for v in run.velocities[1:]]
    assert speeds[0] == pytest.approx(-2.0, abs=1e-3)
    left = np.convolve(speeds, [1.0, 3 * radius, 3 * radius**2, radius**3], mode="valid")
    assert np.abs(left).max() < 1e-3


@pytest.mark.parametrize("radius", [0.8, 0.0])
def test_a_stiff_body_let_go_twisted_gains_no_energy_in_steps_it_does_not_resolve(radius):
    """Waves cross a hundred cells in a step; forces at points of chords made it 24 times."""
    cell, h = 0.05, 0.01
    problem = problem_on(
        box_mesh((4, 1, 1), (0.2, 0.05, 0.05), 0.0), "hex8-bubble", clamps=CLAMPED,
        material={"young": 1e4 * 1e3 * (cell / h) ** 2, "poisson": 0.4, "density": 1e3},
        time={"step": h, "integrator": "generalised-alpha", "spectral_radius": radius},
    )  # fmt: skip
    centre = np.array([0.0, 0.025, 0.025])
    x = problem.positions - centre
    angle = 0.5 * x[:, 0] / 0.2
    turned = np.stack([x[:, 0], np.cos(angle) * x[:, 1] - np.sin(angle) * x[:, 2],
                       np.sin(angle) * x[:, 1] + np.cos(angle) * x[:, 2]], axis=1)  # fmt: skip
    start = pc.State(turned + centre, np.zeros_like(x))
    run = pc.rollout(pc.Newton(problem), 40, state=start)
    energy = pc.metrics.energy_balance(run).total
    assert energy[0] > 0.0
    assert (np.diff(energy) < 1e-9 * energy[0]).all()


# --- conservation ----------------------------------------------------------------------------


def flight(element, mass, integrator, radius=0.8, loads=()):
    """A free body that spins, drifts and vibrates."""
    problem = problem_on(
        box_mesh((3, 2, 1), (0.06, 0.05, 0.03), 0.0), element,
        material={"young": 2e5, "poisson": 0.35}, solver={"mass": mass}, loads=list(loads),
        time={"step": 0.002, "integrator": integrator, "spectral_radius": radius},
    )  # fmt: skip
    x = problem.positions - problem.positions.mean(axis=0)
    noise = np.random.default_rng(8).normal(size=x.shape)
    velocities = np.cross([15.0, -9.0, 21.0], x) + [1.0, -2.0, 0.5] + 0.05 * noise
    return problem, pc.State(disturbed(problem, 0.03), velocities)


def momenta(problem, run):
    """Linear and angular momentum of every frame, with the mass matrix."""
    impulse = np.array([problem.mass_times(v) for v in run.velocities])
    return impulse.sum(axis=1), np.cross(run.positions, impulse).sum(axis=1)


def drift(values):
    return np.linalg.norm(values - values[0], axis=1).max() / np.linalg.norm(values[0])


STEPPERS = {
    "newton": lambda problem: pc.Newton(problem, tolerance=1e-12),
    "pd": lambda problem: pc.ProjectiveDynamics(problem, tolerance=1e-10),
    "pd, not even converged well": lambda problem: pc.ProjectiveDynamics(problem, tolerance=1e-4),
}


@pytest.mark.parametrize("solver", STEPPERS)
@on_every_integrator
def test_free_flight_keeps_linear_momentum(name, radius, solver):
    problem, state = flight("hex8-bubble", "consistent", name, radius)
    run = pc.rollout(STEPPERS[solver](problem), 20, state=state)
    assert set(run.stats["status"]) == {"CONVERGED"}
    assert drift(momenta(problem, run)[0]) < 1e-12


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
def test_the_midpoint_rule_keeps_angular_momentum_and_backward_euler_does_not(element, mass):
    problem, state = flight(element, mass, "midpoint")
    run = pc.rollout(pc.Newton(problem, tolerance=1e-12), 50, state=state)
    assert drift(momenta(problem, run)[1]) < 1e-9
    problem, state = flight(element, mass, "backward-euler")
    run = pc.rollout(pc.Newton(problem, tolerance=1e-12), 50, state=state)
    assert drift(momenta(problem, run)[1]) > 1e-2


@on_every_integrator
def test_gravity_adds_momentum_at_its_own_rate(name, radius):
    problem, state = flight("hex8", "consistent", name, radius, GRAVITY)
    run = pc.rollout(pc.Newton(problem, tolerance=1e-12), 20, state=state)
    found, _ = momenta(problem, run)
    fall = np.outer(run.times, [0.0, 0.0, -9.81]) * problem.mass.sum()
    np.testing.assert_allclose(found, found[0] + fall, rtol=0, atol=1e-11 * np.abs(found).max())


# --- damping ---------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize(
    ("mass", "stiffness"), [(0.4, 0.0), (0.0, 5e-2), (0.2, 3e-2)], ids=["mass", "stiffness", "both"]
)
def test_the_first_mode_decays_at_the_rate_of_rayleigh(mass, stiffness, element):
    """Amplitudes fall by exp(-(alpha + beta w^2) t / 2)."""
    problem = problem_on(
        box_mesh((4, 1, 1), (0.4, 0.1, 0.08), 0.0), element, clamps=CLAMPED,
        material={"young": 2e4, "poisson": 0.3}, solver={"mass": "consistent"},
        damping={"mass": mass, "stiffness": stiffness},
    )  # fmt: skip
    free = problem.free.ravel()
    K = problem.stiffness(problem.positions).toarray()[np.ix_(free, free)]
    M = np.kron(problem.mass_matrix.toarray(), np.eye(3))[np.ix_(free, free)]
    values, modes = sla.eigh(K, M)
    omega, mode = np.sqrt(values[0]), modes[:, 0]
    start = problem.positions.copy()
    start[problem.free] += 1e-5 * mode / np.abs(mode).max()
    period = 2 * np.pi / omega
    stepper = pc.Newton(problem, integrator="midpoint", time_step=period / 60, tolerance=1e-12)
    run = pc.rollout(stepper, 120, state=pc.State(start, np.zeros_like(start)))
    q = (run.positions - problem.positions)[:, problem.free] @ (M @ mode)
    speed = run.velocities[:, problem.free] @ (M @ mode)
    energy = 0.5 * speed**2 + 0.5 * (omega * q) ** 2
    rate = -np.log(energy[-1] / energy[0]) / (2 * run.times[-1])
    expected = (mass + stiffness * omega**2) / 2
    assert 0.02 < expected / omega < 0.3
    assert rate == pytest.approx(expected, rel=0.02)
    others = run.positions[-1][problem.free] - problem.positions[problem.free] - q[-1] * mode
    assert np.abs(others).max() < 0.02 * 1e-5


def test_stiffness_damping_hardly_slows_a_rigid_rotation():
    """K is that of the start of the step: what it takes falls with the step."""
    losses = []
    for h in (0.004, 0.002, 0.001):
        mesh = box_mesh((2, 1, 1), (0.04, 0.02, 0.03))
        problem = problem_on(
            mesh, damping={"stiffness": 0.005}, time={"integrator": "midpoint"},
            material={"young": 1e5, "poisson": 0.3},
        )  # fmt: skip
        x = problem.positions - problem.positions.mean(axis=0)
        start = pc.State(problem.positions, np.cross([4.0, 2.0, -3.0], x))
        kinetic = 0.5 * np.vdot(start.velocities, problem.mass_times(start.velocities))
        stepper = pc.Newton(problem, time_step=h, tolerance=1e-9)
        run = pc.rollout(stepper, round(0.04 / h), state=start)
        assert set(run.stats["status"]) == {"CONVERGED"}
        losses.append(run.stats["damping_loss"].sum() / kinetic)
    assert losses[-1] < 5e-2
    assert losses[0] > 1.7 * losses[1] > 1.7**2 * losses[2] > 0


# --- the solvers agree -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "radius"),
    [*DYNAMIC, ("quasi-static", 0.0)],
    ids=names([*DYNAMIC, ("quasi-static", 0)]),
)
def test_projective_dynamics_is_newton_for_every_integrator(name, radius):
    motion = {"times": [0.0, 0.1], "displacement": [[0, 0, 0], [0.01, 0.004, 0.0]]}
    problem = problem_on(
        MESHES["random"](), "hex8-bubble", material={"young": 3e5},
        clamps=[{**CLAMPED[0], "motion": motion}], loads=GRAVITY, solver={"mass": "consistent"},
        damping={"mass": 0.5, "stiffness": 2e-3},
        time={"step": 0.01, "integrator": name, "spectral_radius": radius},
    )  # fmt: skip
    by_pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-8), frames=6)
    by_newton = pc.rollout(pc.Newton(problem, tolerance=1e-11), frames=6)
    assert np.abs(by_newton.positions - problem.positions).max() > 0.1 * problem.cell_size
    assert np.abs(by_pd.positions - by_newton.positions).max() < 1e-8
    assert set(by_pd.stats["status"]) == set(by_newton.stats["status"]) == {"CONVERGED"}


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize("energy", ["neo-hookean", "st-venant-kirchhoff"])
def test_lbfgs_is_newton_for_other_energies(energy, element):
    problem = problem_on(
        MESHES["random"](), element, material={"young": 3e5, "energy": energy, "poisson": 0.4},
        clamps=CLAMPED, loads=[*GRAVITY, {"kind": "torsion", "strength": 6e4}],
    )  # fmt: skip
    by_pd = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-8), frames=6)
    by_newton = pc.rollout(pc.Newton(problem, tolerance=1e-11), frames=6)
    assert np.abs(by_newton.positions - problem.positions).max() > 0.1 * problem.cell_size
    assert np.abs(by_pd.positions - by_newton.positions).max() < 1e-8


# --- energy ----------------------------------------------------------------------------------


DAMPED = {
    "none": {},
    "viscosity": {"viscosity": 5e-3},
    "rayleigh": {"mass": 4.0, "stiffness": 4e-3},
}
BALANCED = [  # every integrator and every damping once, the other pairs slowly
    pytest.param(
        name, damping, id=f"{name}-{kind}",
        marks=[] if name == "generalised-alpha" or kind == "none" else [pytest.mark.slow],
    )
    for name in ("bdf2", "midpoint", "generalised-alpha")
    for kind, damping in DAMPED.items()
]  # fmt: skip


@pytest.mark.parametrize(("name", "damping"), BALANCED)
def test_the_energy_balance_under_moving_clamps_closes(name, damping):
    """What is put in, less the loss by damping, is there; what the integrator loses vanishes."""
    times = np.linspace(0.0, 0.2, 401)
    way = [[0.0, 0.0, 0.01 * np.sin(np.pi * t / 0.2) ** 2] for t in times]
    motion = {"times": times.tolist(), "displacement": way}
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": motion}]
    gaps = []
    for count in (20, 80):
        problem = pc.discretise(beam(
            clamps=clamps, damping=damping, solver={"element": "hex8-bubble", "mass": "averaged"},
            material={"young": 2e4, "poisson": 0.3},
            time={"step": 0.2 / count, "frames": count, "integrator": name},
        ))  # fmt: skip
        balance = pc.metrics.energy_balance(pc.rollout(pc.Newton(problem, tolerance=1e-10)))
        put_in = balance.external_work + balance.clamp_work - balance.damping_loss
        gaps.append(abs(balance.total - put_in)[-1] / balance.total.max())
    assert gaps[0] < 0.035
    assert gaps[1] < 0.005


# --- states of other integrators -------------------------------------------------------------

ALL = ["backward-euler", "bdf2", "midpoint", "generalised-alpha", "quasi-static"]
MOVING = {
    "times": [0.0, 0.02, 0.1], "rotation": [0.0, 10.0, 0.0], "centre": [0, 0.01, 0.01], "axis": "x",
}  # fmt: skip


@pytest.mark.parametrize("before", ALL)
@pytest.mark.parametrize("name", ALL)
def test_a_viscous_state_of_another_integrator_is_gone_on_from(name, before):
    """Of which some entries of the memory may serve."""
    damping = {"viscosity": 2e-3}
    problem = pc.discretise(beam(loads=GRAVITY, damping=damping, solver={"mass": "consistent"}))
    old = pc.ProjectiveDynamics(problem, integrator=before)
    state = old(old(problem.rest_state()).state).state
    found = pc.ProjectiveDynamics(problem, integrator=name)(state)
    expected = pc.ProjectiveDynamics(problem, integrator=name)(replace(state, memory={}))
    assert found.status is pc.Status.CONVERGED
    way = np.abs(expected.state.positions - state.positions).max()
    assert np.abs(found.state.positions - expected.state.positions).max() < 0.2 * way + 1e-4
    batch = pc.BatchStepper([problem], integrator=name)
    (again,) = batch.states(batch(batch.state([state])).state)
    assert np.abs(again.positions - found.state.positions).max() < 1e-6


def test_tables_are_sums_of_numbers_and_arrays_alike():
    assert doctest.testmod(schemes).failed == 0
    assert schemes.Linear()({}) == 0.0


@pytest.mark.parametrize("before", ALL)
@pytest.mark.parametrize("name", ALL)
def test_a_state_of_another_integrator_is_one_without_a_memory(name, before):
    """Under clamps that move, whose first step generalised-alpha takes otherwise."""
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": MOVING}]
    problem = pc.discretise(beam(loads=GRAVITY, clamps=clamps, solver={"mass": "consistent"}))
    old = pc.ProjectiveDynamics(problem, integrator=before)
    state = old(old(problem.rest_state()).state).state
    stepper = pc.ProjectiveDynamics(problem, integrator=name)
    found, expected = stepper(state).state, stepper(replace(state, memory={})).state
    if name == before and state.memory:
        assert not np.array_equal(found.positions, expected.positions)
    else:
        assert np.array_equal(found.positions, expected.positions)
        assert np.array_equal(found.velocities, expected.velocities)


@pytest.mark.parametrize("before", ["backward-euler", "generalised-alpha"])
@pytest.mark.parametrize("name", ["bdf2", "midpoint"])
def test_so_it_is_in_batches(name, before):
    pytest.importorskip("torch")
    problem = pc.discretise(beam(loads=GRAVITY))
    state = pc.ProjectiveDynamics(problem, integrator=before)(problem.rest_state()).state
    stepper = pc.BatchStepper([problem], integrator=name)
    found = stepper(stepper.state([state])).state
    expected = stepper(stepper.state([replace(state, memory={})])).state
    assert found.positions.equal(expected.positions)
    assert set(found.memory) == set(expected.memory)


@pytest.mark.parametrize("integrator", ["generalised-alpha", "bdf2", "midpoint", "backward-euler"])
def test_substeps_are_shorter_steps_of_which_frames_are_kept(integrator):
    scene = beam(time={"step": 0.02, "frames": 3, "substeps": 4, "integrator": integrator})
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
    short = scene.with_changes(time={"step": 0.005, "frames": 12, "substeps": 1})
    every = pc.rollout(pc.ProjectiveDynamics(pc.discretise(short)))
    assert (run.positions == every.positions[::4]).all()
    assert (run.velocities == every.velocities[::4]).all()
    assert run.times == pytest.approx(0.02 * np.arange(4))
    for name in ("iterations", "external_work", "evaluations"):
        assert run.stats[name] == pytest.approx(every.stats[name].reshape(3, 4).sum(axis=1))
    for name in ("residual", "error_estimate"):
        assert (run.stats[name] == every.stats[name].reshape(3, 4).max(axis=1)).all()
    assert (run.stats["elastic_energy"] == every.stats["elastic_energy"][3::4]).all()
    left, expected = (pc.metrics.energy_balance(r).dissipation for r in (run, every))
    assert left == pytest.approx(expected[::4], abs=1e-9 * np.abs(expected).max())


def test_a_run_of_substeps_goes_on_from_a_frame():
    scene = beam(time={"step": 0.02, "frames": 4, "substeps": 3})
    stepper = pc.ProjectiveDynamics(pc.discretise(scene))
    whole = pc.rollout(stepper)
    first = pc.rollout(stepper, 2)
    rest = pc.rollout(stepper, 2, state=first.state(-1))
    assert (rest.positions[1:] == whole.positions[3:]).all()


def test_a_frame_whose_substep_fails_is_named():
    scene = beam(time={"step": 0.02, "frames": 4, "substeps": 2})
    stepper = pc.ProjectiveDynamics(pc.discretise(scene), max_iterations=1, recover=False)
    with pytest.raises(pc.errors.ConvergenceError, match="frame 1 "):
        pc.rollout(stepper)
    assert len(pc.rollout(stepper, on_failure="stop")) == 0
    run = pc.rollout(stepper, on_failure="continue")
    assert len(run) == 4
    assert set(run.stats["status"]) == {"ITERATION_LIMIT"}


def test_a_frame_has_the_status_of_the_substep_that_failed():
    problem = pc.discretise(beam(time={"step": 0.02, "frames": 2, "substeps": 3}))
    told = iter(
        ["RECOVERED", "ITERATION_LIMIT", "CONVERGED", "CONVERGED", "RECOVERED", "CONVERGED"]
    )

    def stepper(state, forces=None):
        return pc.StepResult(state, pc.Status[next(told)], 1, 0.0, 0.0)

    stepper.problem = problem
    statuses = [result.status.name for result, _ in pc.march(stepper, on_failure="continue")]
    assert statuses == ["ITERATION_LIMIT", "RECOVERED"]


def test_a_lagged_hessian_and_correctors_refuse_substeps():
    problem = pc.discretise(beam(time={"step": 0.02, "frames": 2, "substeps": 3}))
    with pytest.raises(pc.errors.InputError, match="'lagged' with time.substeps = 3"):
        pc.ProjectiveDynamics(problem, first_hessian="lagged")
    with pytest.raises(pc.errors.InputError, match="time.substeps = 3"):
        pc.HybridStepper(pc.ProjectiveDynamics(problem), None)

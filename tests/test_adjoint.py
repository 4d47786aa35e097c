"""Gradients of a step: against differences, between solvers, and of chains of steps."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import pdcorrect as pc
from conftest import ELEMENTS, beam, box_mesh, problem_on, slow_unless
from pdcorrect.errors import ConvergenceError, InputError

INTEGRATORS = ["backward-euler", "bdf2", "midpoint", "generalised-alpha"]
TORSION = {"kind": "torsion", "strength": 2e3, "stretch": 0.3, "follower": True}
PRESSURE = {
    "kind": "pressure",
    "pressure": 3e3,
    "region": {"plane": "x", "at": "max"},
    "follower": True,
}
GRAVITY = {"kind": "gravity", "acceleration": [1.0, -3.0, -9.81]}


def scene(element="hex8", **changes):
    """A short beam of two materials with follower loads, held at one end."""
    settings = {
        "material": {"young": 2e5, "poisson": 0.4},
        "loads": [TORSION, PRESSURE, GRAVITY],
        "materials": [{"region": {"box": [[0, 0, 0], [0.04, 1, 1]]}, "young": 3e5, "poisson": 0.3,
                       "density": 1400.0}],
        "solver": {"element": element, "mass": "averaged"},
        "time": {"step": 0.01, "frames": 3},
    }  # fmt: skip
    settings.update(changes)
    return beam((3, 1, 2), **settings)


def asymmetric_state(problem, seed=0, amplitude=0.15, invert=False):
    """Compressed, twisted, and random, with velocities; one corner pushed through if asked."""
    rng = np.random.default_rng(seed)
    x = problem.positions
    length = x[:, 0].max()
    angle = 0.9 * x[:, 0] / length
    y, z = x[:, 1] - x[:, 1].mean(), x[:, 2] - x[:, 2].mean()
    p = x.copy()
    p[:, 0] *= 0.85
    p[:, 1] += np.cos(angle) * y - np.sin(angle) * z - y
    p[:, 2] += np.sin(angle) * y + np.cos(angle) * z - z
    p += amplitude * problem.cell_size * rng.uniform(-0.5, 0.5, x.shape)
    if invert:
        corner = int(np.argmax(x.sum(axis=1)))
        p[corner, 0] -= 1.6 * problem.cell_size
    p = np.where(problem.free, p, x)
    v = np.where(problem.free, rng.normal(size=x.shape), 0.0)
    return pc.State(p, v)


class NewtonOfLength(pc.Newton):
    """Takes steps of another length than its own."""

    length = 0.02

    def __call__(self, state, forces=None, time_step=None):
        return super().__call__(state, forces, self.length if time_step is None else time_step)


class Case:
    """A step with a random linear loss of positions, velocities and memory after it."""

    def __init__(self, problem, stepper=None, state=None, steps_before=0, **options):
        self.problem = problem
        self.stepper = stepper or pc.Newton(problem, tolerance=1e-13, recover=False)
        self.state = asymmetric_state(problem) if state is None else state
        for _ in range(steps_before):
            self.state = self.stepper(self.state).state
        rng = np.random.default_rng(7)
        shape = problem.positions.shape
        self.forces = 0.05 * rng.normal(size=shape)
        self.result = self.stepper(self.state, self.forces)
        assert self.result.status.ok, self.result.status
        memory = {n: rng.normal(size=shape) for n in self.result.state.memory}
        memory.pop("previous_times", None)
        if "internal_forces" in memory:  # where clamped they are for the clamps' work only
            memory["internal_forces"] *= problem.free
        self.weights = {"positions": rng.normal(size=shape) / problem.cell_size}
        self.weights["velocities"] = rng.normal(size=shape)
        scale = {"accelerations": 1e-3, "previous_positions": 1.0 / problem.cell_size}
        self.memory = {n: scale.get(n, 1.0) * g for n, g in memory.items()}
        self.found = pc.adjoint(
            self.stepper, self.state, self.result, self.weights["positions"],
            self.weights["velocities"], grad_memory=self.memory, forces=self.forces,
            **{"tolerance": 1e-12, **options},
        )  # fmt: skip

    def loss(self, state=None, forces=None, stepper=None, time_step=None):
        stepper = stepper or self.stepper
        after = stepper(
            self.state if state is None else state,
            self.forces if forces is None else forces,
            time_step,
        )
        assert after.status is self.result.status
        value = np.vdot(self.weights["positions"], after.state.positions)
        value += np.vdot(self.weights["velocities"], after.state.velocities)
        return value + sum(np.vdot(g, after.state.memory[n]) for n, g in self.memory.items())

    def with_material(self, **values):
        materials = self.problem.materials
        full = {"young": materials.young, "poisson": materials.poisson, **values}
        return type(self.stepper)(
            self.problem.with_material(**full), self.stepper.tolerance, recover=False
        )


def difference(function, step):
    """Central difference of fourth order at 0."""
    f = function
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


def agrees(found, exact, scale=None):
    size = max(abs(exact), abs(found)) if scale is None else scale
    assert abs(found - exact) <= 1e-6 * size, (found, exact)


def check_state_gradients(case, names=("positions", "velocities", "forces")):
    rng = np.random.default_rng(3)
    state = case.state
    for name in names:
        direction = rng.normal(size=state.positions.shape)  # clamped components too

        def moved(t, name=name, direction=direction):
            if name == "forces":
                return case.loss(forces=case.forces + t * direction)
            arrays = {"positions": state.positions, "velocities": state.velocities}
            memory = dict(state.memory)
            if name in arrays:
                arrays[name] = arrays[name] + t * direction
            else:
                memory[name] = memory[name] + t * direction
            return case.loss(
                pc.State(arrays["positions"], arrays["velocities"], state.time, memory)
            )

        steps = {"positions": 1e-4 * case.problem.cell_size, "velocities": 1e-3, "forces": 1e-4}
        found = case.found.memory[name] if name in state.memory else getattr(case.found, name)
        step = steps.get(name, steps["positions"] if "positions" in name else 1e-3)
        agrees(np.vdot(found, direction), difference(moved, step))


def check_material_gradients(case):
    rng = np.random.default_rng(4)
    materials = case.problem.materials
    for name, value in (
        ("young", materials.young),
        ("poisson", materials.poisson),
        ("density", materials.density),
    ):
        direction = rng.uniform(0.5, 1.5, len(value)) * value

        def changed(t, name=name, value=value, direction=direction):
            return case.loss(stepper=case.with_material(**{name: value + t * direction}))

        agrees(np.vdot(getattr(case.found, name), direction), difference(changed, 1e-4))


def stretched_state(state, h):
    """The same, as if the step before it had been of h seconds."""
    memory = dict(state.memory)
    if "previous_times" in memory:
        memory["previous_times"] = np.full_like(state.positions, state.time - h)
    return replace(state, memory=memory)


def check_time_step(case):
    """All steps change together: so BDF2 stays what it is."""
    h = case.stepper.time_step

    def stretched(t):
        new = h * (1 + t)
        stepper = pc.Newton(case.problem, 1e-13, time_step=new, recover=False)
        return case.loss(stretched_state(case.state, new), stepper=stepper)

    agrees(case.found.time_step * h, difference(stretched, 1e-3))


def check_clamped_positions(case):
    problem = case.problem
    direction = np.random.default_rng(5).normal(size=problem.free.shape) * ~problem.free

    def shifted(t):
        clamps = replace(problem.clamps, rest=problem.clamps.rest + t * direction)
        stepper = pc.Newton(replace(problem, clamps=clamps), 1e-13, recover=False)
        return case.loss(stepper=stepper)

    found = case.found.clamped_positions
    assert (found[problem.free] == 0).all()
    agrees(np.vdot(found, direction), difference(shifted, 1e-4 * problem.cell_size))


def timed(integrator, radius=0.8, step=0.01):
    return {"step": step, "frames": 3, "integrator": integrator, "spectral_radius": radius}


ONCE = {
    *((element, "generalised-alpha") for element in ELEMENTS),
    *(("hex8-bubble-mean", integrator) for integrator in INTEGRATORS),
}
"""Elements and integrators, each once: they do not know of each other."""
EACH_INTEGRATOR = slow_unless(["bdf2", "generalised-alpha"], INTEGRATORS)
PAIRS = slow_unless(ONCE, itertools.product(ELEMENTS, INTEGRATORS))


@pytest.mark.parametrize(("element", "integrator"), PAIRS)
def test_gradients_are_those_of_central_differences(element, integrator):
    """In a state that is compressed, twisted and random, under follower loads, on the second step.

    So that the memory of integrators with several steps takes part.
    """
    case = Case(pc.discretise(scene(element, time=timed(integrator))), steps_before=1)
    names = ("positions", "velocities", "forces", *case.memory)
    check_state_gradients(case, [n for n in names if n != "previous_times"])
    check_material_gradients(case)
    check_clamped_positions(case)
    check_time_step(case)


@pytest.mark.parametrize("integrator", EACH_INTEGRATOR)
@pytest.mark.parametrize(
    "element", [pytest.param("hex8", marks=pytest.mark.slow), "hex8-bubble-mean"]
)
def test_so_they_are_on_the_first_step_of_a_damped_body(element, integrator):
    damping = {"mass": 2.0, "stiffness": 0.003}
    changes = {"time": timed(integrator), "damping": damping}
    case = Case(pc.discretise(scene(element, **changes)))
    check_state_gradients(case)
    check_material_gradients(case)
    check_clamped_positions(case)
    check_time_step(case)


@pytest.mark.parametrize("element", slow_unless(["hex8", "hex8-enhanced", "hex27"], ELEMENTS))
def test_so_they_are_on_a_distorted_mesh(element):
    mesh = box_mesh((2, 2, 2), (0.04, 0.04, 0.04), distortion=0.3)
    given = scene(element)
    settings = {"clamps": given.clamps, "loads": given.loads, "materials": given.materials}
    problem = problem_on(mesh, element, time={"step": 0.01, "frames": 3}, **settings)
    assert np.ptp(problem.space.volumes()) > 0.1 * problem.cell_size**3
    case = Case(problem)
    check_state_gradients(case)
    check_material_gradients(case)
    check_clamped_positions(case)
    check_time_step(case)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_step_of_another_length_goes_without_memory_as_it_does_forwards(integrator):
    """Its derivatives too; those by the memory are zero."""
    problem = pc.discretise(scene(time=timed(integrator)))
    stepper = pc.Newton(problem, 1e-13, recover=False)
    state = stepper(asymmetric_state(problem)).state
    longer = NewtonOfLength(problem, 1e-13, recover=False)
    case = Case(problem, longer, state, time_step=longer.length)
    check_state_gradients(case)
    assert list(case.found.memory) == list(state.memory)
    assert not any(g.any() for g in case.found.memory.values())


@pytest.mark.parametrize("energy", ["corotated", "neo-hookean", "st-venant-kirchhoff"])
@pytest.mark.parametrize("stiffness", [0.0, 0.003])
def test_so_they_are_by_a_poisson_ratio_of_zero(energy, stiffness):
    """Against one-sided differences, as there are no materials with less."""
    material = {"young": 2e5, "poisson": 0.0, "energy": energy}
    damping = {"mass": 0.0, "stiffness": stiffness}
    problem = pc.discretise(scene(material=material, materials=[], damping=damping))
    case, e = Case(problem), 1e-4
    losses = [
        case.loss(stepper=case.with_material(poisson=np.full(len(problem.cells), k * e)))
        for k in range(5)
    ]
    slope = np.dot([-25.0, 48.0, -36.0, 16.0, -3.0], losses) / (12.0 * e)
    assert case.found.poisson.sum() == pytest.approx(slope, rel=1e-6)
    assert case.found.lam.all()


@pytest.mark.parametrize(
    ("energy", "without"), [("corotated-only", "lam"), ("arap", "lam"), ("volume-only", "mu")]
)
def test_a_term_that_the_energy_lacks_has_no_derivative(energy, without):
    material = {"young": 2e5, "poisson": 0.3, "energy": energy}
    time = {"step": 0.003, "frames": 2}
    found = Case(pc.discretise(scene(material=material, time=time))).found
    for name in ("mu", "lam"):
        assert getattr(found, name).any() == (name != without)


def test_so_they_are_of_an_equilibrium():
    time = {"step": 0.01, "frames": 3, "integrator": "quasi-static"}
    loads = [{"kind": "gravity", "acceleration": [1.0, -3.0, -9.81]}]
    problem = pc.discretise(scene("hex8-bubble", time=time, loads=loads))
    case = Case(problem, state=problem.rest_state())
    check_state_gradients(case, ["forces"])
    check_material_gradients(case)
    check_clamped_positions(case)
    assert not case.found.positions.any()
    assert not case.found.velocities.any()


@pytest.mark.parametrize("element", ["hex8", "hex8-mean", "hex27"])
def test_so_they_are_with_an_inverted_cell(element):
    problem = pc.discretise(scene(element, time={"step": 2e-4, "frames": 3}))
    state = asymmetric_state(problem, invert=True)
    assert problem.volume_ratios(state.positions).min() < 0
    case = Case(problem, state=state)
    assert case.result.stats["smallest_volume_ratio"] < 0
    check_state_gradients(case)
    check_material_gradients(case)


@pytest.mark.parametrize("energy", ["corotated-only", "neo-hookean", "st-venant-kirchhoff"])
def test_so_they_are_for_other_energies(energy):
    material = {"young": 2e5, "poisson": 0.3, "energy": energy}
    case = Case(pc.discretise(scene("hex8-bubble", material=material)))
    check_state_gradients(case)
    check_material_gradients(case)


@pytest.mark.parametrize("mass", ["lumped", "consistent", "averaged", "per-node"])
def test_so_they_are_for_every_mass_and_volume_weight(mass):
    material = {"young": 2e5, "poisson": 0.4, "volume_weight": "published"}
    solver = {"element": "hex8", "mass": mass}
    case = Case(pc.discretise(scene(material=material, solver=solver)))
    check_state_gradients(case, ["positions", "velocities"])
    check_material_gradients(case)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_time_step_counts_for_moving_clamps_and_ramps(integrator):
    turn = {"times": [0.0, 1.0], "rotation": [0.0, 300.0], "centre": [0, 0.02, 0.02], "axis": "x"}
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": turn}]
    ramp = {**GRAVITY, "ramp": 0.5}
    problem = pc.discretise(scene(clamps=clamps, loads=[ramp], time=timed(integrator)))
    case = Case(problem)
    check_time_step(case)


def test_gradients_by_lame_parameters_are_those_by_moduli():
    case = Case(pc.discretise(scene()))
    materials = case.problem.materials
    e = 1e-6
    for name, value in (("young", materials.young), ("poisson", materials.poisson)):
        full = {"young": materials.young, "poisson": materials.poisson}
        plus = case.problem.with_material(**{**full, name: value * (1 + e)}).materials
        minus = case.problem.with_material(**{**full, name: value * (1 - e)}).materials
        mu = (plus.mu - minus.mu) / (2 * e * value)
        lam = (plus.volume_weight - minus.volume_weight) / (6 * e * value)
        expected = case.found.mu * mu + case.found.lam * lam
        np.testing.assert_allclose(getattr(case.found, name), expected, rtol=1e-7)


# --- solvers of the linear system --------------------------------------------------------------


@pytest.mark.parametrize("element", ELEMENTS)
def test_projective_dynamics_and_newton_have_the_same_gradients(element):
    problem = pc.discretise(scene(element))
    newton = Case(problem)
    slow = [{"method": "local-global"}] if element == "hex8" else []
    for options in ({}, {"first_hessian": "G"}, *slow):
        pd = pc.ProjectiveDynamics(problem, 1e-11, **options)
        found = Case(problem, pd).found
        for name in ("positions", "velocities", "forces", "young", "poisson", "density"):
            exact = getattr(newton.found, name)
            error = np.abs(getattr(found, name) - exact).max()
            assert error < 1e-8 * np.abs(exact).max()


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
def test_all_solvers_agree(element):
    time = {"step": 0.003, "frames": 2}
    problem = pc.discretise(scene(element, time=time, loads=[GRAVITY]))
    cases = {
        name: Case(problem, solver=name, tolerance=1e-10)
        for name in ("cg", "direct", "fixed-point", "auto")
    }
    exact = cases["direct"].found.x
    for name, case in cases.items():
        assert case.found.solver == ("cg" if name == "auto" else name)
        assert case.found.residual <= 1e-10
        np.testing.assert_allclose(case.found.x, exact, atol=1e-9 * np.abs(exact).max())
    assert cases["cg"].found.iterations < cases["fixed-point"].found.iterations


@pytest.mark.parametrize("first_hessian", ["rest", "G-scaled", "G"])
def test_the_fixed_point_falls_by_its_spectral_radius_whatever_the_first_hessian(first_hessian):
    problem = pc.discretise(scene(time={"step": 0.003, "frames": 2}))
    pd = pc.ProjectiveDynamics(problem, 1e-11, first_hessian=first_hessian)
    fixed = Case(problem, pd, solver="fixed-point", tolerance=1e-10).found
    radius = fixed.spectral_radius
    assert 0 < radius < 1
    assert fixed.iterations == pytest.approx(np.log(1e-10) / np.log(radius), rel=0.35)


def test_where_the_hessian_is_indefinite_a_direct_solution_takes_over():
    """A state that is no minimum: conjugate gradients say so, auto falls back."""
    problem = pc.discretise(scene(loads=[], time={"step": 10.0, "frames": 2}))
    squeezed = problem.positions * [0.45, 1.0, 1.0]
    state = pc.State(squeezed, np.zeros_like(squeezed))
    stepper, g = pc.Newton(problem), np.random.default_rng(0).normal(size=squeezed.shape)
    _, gradient = stepper.objective(state, None, 10.0).value_and_gradient(squeezed)
    residual = float(np.abs(gradient).max())
    result = pc.StepResult(replace(state, time=10.0), pc.Status.CONVERGED, 0, residual, 0.0)
    with pytest.raises(ConvergenceError, match="negative curvature"):
        pc.adjoint(stepper, state, result, g, solver="cg")
    found = pc.adjoint(stepper, state, result, g, tolerance=1e-10)
    assert found.solver == "direct"
    assert found.residual < 1e-10


@pytest.mark.parametrize("solver", ["auto", "direct"])
def test_where_the_hessian_is_singular_there_is_no_derivative(solver):
    """A free body in equilibrium, with hardly any inertia, which a force moves any distance."""
    time = {"step": 1e10, "frames": 3, "integrator": "backward-euler"}
    problem = pc.discretise(scene(clamps=[], loads=[], time=time, material={"density": 1e-6}))
    state = problem.rest_state()
    result = pc.StepResult(replace(state, time=1e10), pc.Status.CONVERGED, 0, 0.0, 0.0)
    g = np.random.default_rng(0).normal(size=state.positions.shape)
    for stepper in (pc.ProjectiveDynamics(problem), pc.Newton(problem)):
        with pytest.raises(ConvergenceError, match="singular"):
            pc.adjoint(stepper, state, result, g, solver=solver)


def test_a_direct_solution_that_misses_its_tolerance_says_so():
    problem = pc.discretise(scene())
    stepper, state = pc.Newton(problem), problem.rest_state()
    g = np.ones_like(state.positions)
    with pytest.raises(ConvergenceError, match="expected 1e-30 or less"):
        pc.adjoint(stepper, state, stepper(state), g, solver="direct", tolerance=1e-30)


# --- the adjoint is the transpose of the linearised step ----------------------------------------


class LinearisedStep:
    """Changes of what a step leads to by changes of what it starts from, to first order.

    For loads that do not follow, without damping, and with the memory for a step: then the
    step's equation is linear in all that it starts from, and its stages' differences are exact.
    """

    def __init__(self, case):
        problem, stepper = case.problem, case.stepper
        self.case, self.h = case, stepper.time_step
        self.stage = stepper.integrate(problem, case.state, self.h)
        self.loads = problem.external_forces(*self.stage.loads_over, problem.positions)
        scheme = stepper.integrate.scheme(case.state, self.h)
        share = scheme.positions.coefficients["y"]
        nothing = np.zeros_like(problem.positions)
        rest = self.stage.finish(nothing, nothing).positions
        self.y = (case.result.state.positions - rest) / share
        K = problem.stiffness(self.y).toarray()  # with internal modes that follow
        M = np.kron(problem.mass_matrix.toarray(), np.eye(3))
        self.H = K + self.stage.inertia * M

    def __call__(self, positions=0.0, velocities=0.0, forces=0.0, memory=None):
        """Changes of positions, velocities and memory after the step, by name."""
        case, problem = self.case, self.case.problem
        start = case.state
        moved = pc.State(
            start.positions + positions,
            start.velocities + velocities,
            start.time,
            {name: array + (memory or {}).get(name, 0.0) for name, array in start.memory.items()},
        )
        stage = case.stepper.integrate(problem, moved, self.h)
        free = problem.free.ravel()
        before = self.stage.load_factor * self.loads + self.stage.past_forces
        after = stage.load_factor * (self.loads + forces) + stage.past_forces
        right = self.stage.inertia * problem.mass_times(stage.target - self.stage.target)
        right += after - before
        change = np.where(problem.free, 0.0, stage.start - self.stage.start).ravel()
        right = right.ravel() - self.H @ change
        change[free] = np.linalg.solve(self.H[free][:, free], right[free])
        before = self.stage.finish(self.y, before)
        after = stage.finish(self.y + change.reshape(-1, 3), after)
        changes = {name: after.memory[name] - before.memory[name] for name in case.memory}
        changes["positions"] = after.positions - before.positions
        changes["velocities"] = after.velocities - before.velocities
        return changes


def linear_case(element, integrator):
    """A second step under gravity alone."""
    problem = pc.discretise(scene(element, time=timed(integrator), loads=[GRAVITY]))
    return Case(problem, steps_before=1)


def inputs(case, rng):
    """Random changes of all that a step starts from, clamped components too."""
    shape, size = case.problem.positions.shape, case.problem.cell_size
    names = [name for name in case.state.memory if name != "previous_times"]
    return {
        "positions": size * rng.normal(size=shape),
        "velocities": rng.normal(size=shape),
        "forces": rng.normal(size=shape),
        "memory": {
            name: (size if "positions" in name else 1.0) * rng.normal(size=shape) for name in names
        },
    }


@pytest.mark.parametrize(("element", "integrator"), sorted(ONCE))
def test_the_adjoint_is_the_transpose_of_the_linearised_step(element, integrator):
    """U . (J w) is (J^T u) . w for all that goes into a step, each by itself."""
    case = linear_case(element, integrator)
    linearised, changes = LinearisedStep(case), inputs(case, np.random.default_rng(1))
    u = {**case.weights, **case.memory}
    for name in ("positions", "velocities", "forces"):
        forwards = linearised(**{name: changes[name]})
        expected = sum(np.vdot(u[key], value) for key, value in forwards.items())
        found = np.vdot(getattr(case.found, name), changes[name])
        assert found == pytest.approx(expected, rel=1e-10), name
    for name, change in changes["memory"].items():
        forwards = linearised(memory={name: change})
        expected = sum(np.vdot(u[key], value) for key, value in forwards.items())
        assert np.vdot(case.found.memory[name], change) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_that_linearised_step_is_the_steps_own_to_first_order(integrator):
    case = linear_case("hex8-bubble", integrator)
    changes = inputs(case, np.random.default_rng(2))
    forwards = LinearisedStep(case)(**changes)

    def moved(t):
        memory = dict(case.state.memory)
        for name, change in changes["memory"].items():
            memory[name] = memory[name] + t * change
        state = pc.State(
            case.state.positions + t * changes["positions"],
            case.state.velocities + t * changes["velocities"],
            case.state.time,
            memory,
        )
        after = case.stepper(state, case.forces + t * changes["forces"]).state
        return {"positions": after.positions, "velocities": after.velocities, **after.memory}

    for name, change in forwards.items():
        exact = difference(lambda t, name=name: moved(t)[name], 1e-4)
        assert np.abs(change - exact).max() < 1e-6 * np.abs(exact).max(), name


def test_a_loose_step_says_how_far_its_gradients_are_off():
    """To first order: its estimate is the difference from those of the exact step."""
    problem = pc.discretise(scene())
    exact = Case(problem)
    for tolerance in (1e-2, 1e-3, 1e-4):
        pd = pc.ProjectiveDynamics(problem, tolerance, first_hessian="G", recover=False)
        loose = Case(problem, pd)
        for name, estimate in loose.found.estimated_errors().items():
            right = getattr(exact.found, name)
            off = np.linalg.norm(getattr(loose.found, name) - right) / np.linalg.norm(right)
            assert off == pytest.approx(estimate, rel=0.2), (name, tolerance)


# --- chains of steps -----------------------------------------------------------------------------


def chain(stepper, state, steps, loss_weights):
    """Loss of the last state, all states, and the steps' results."""
    states, results = [state], []
    for _ in range(steps):
        results.append(stepper(states[-1]))
        states.append(results[-1].state)
    value = np.vdot(loss_weights[0], states[-1].positions)
    value += np.vdot(loss_weights[1], states[-1].velocities)
    return value, states, results


def chained(stepper, state, steps, loss_weights):
    """Loss of the last state, and its gradients by the first and by all steps' length."""
    value, states, results = chain(stepper, state, steps, loss_weights)
    g, gv, memory, by_time_step = loss_weights[0], loss_weights[1], {}, 0.0
    for before, result in zip(states[-2::-1], results[::-1], strict=True):
        found = pc.adjoint(stepper, before, result, g, gv, grad_memory=memory, tolerance=1e-12)
        g, gv, memory = found.positions, found.velocities, found.memory
        by_time_step += found.time_step
    return value, g, gv, by_time_step


@pytest.mark.parametrize("integrator", EACH_INTEGRATOR)
def test_through_twenty_steps_the_remainder_is_of_second_order(integrator):
    """Of steps so short that backward Euler has not damped the beginning away."""
    problem = pc.discretise(scene(time=timed(integrator, step=0.002), loads=[TORSION]))
    stepper = pc.Newton(problem, 1e-12)
    state = asymmetric_state(problem)
    rng = np.random.default_rng(2)
    weights = rng.normal(size=(2, *problem.positions.shape)) * [[[100.0]], [[1.0]]]
    value, g, gv, _ = chained(stepper, state, 20, weights)
    d = rng.normal(size=problem.positions.shape) * problem.free
    dp, dv = 0.02 * problem.cell_size * d, 0.3 * d
    slope = np.vdot(g, dp) + np.vdot(gv, dv)
    remainders = []
    for t in (1e-2, 5e-3, 2.5e-3, 1.25e-3):
        moved = pc.State(state.positions + t * dp, state.velocities + t * dv)
        remainders.append(abs(chain(stepper, moved, 20, weights)[0] - value - t * slope))
    orders = np.log2(np.divide(remainders[:-1], remainders[1:]))
    assert orders[-1] == pytest.approx(2.0, abs=0.15)
    assert remainders[-1] < 1e-2 * abs(1.25e-3 * slope)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_derivatives_by_the_time_step_add_up_to_that_by_the_length_of_all_steps(integrator):
    """Under loads that do not change in time."""
    problem = pc.discretise(scene(time=timed(integrator), loads=[TORSION]))
    state, h, steps = asymmetric_state(problem), 0.01, 4
    weights = np.random.default_rng(2).normal(size=(2, *problem.positions.shape))

    def stepper(t):
        return pc.Newton(problem, 1e-13, time_step=h * (1 + t), recover=False)

    exact = difference(lambda t: chain(stepper(t), state, steps, weights)[0], 1e-3)
    agrees(h * chained(stepper(0.0), state, steps, weights)[3], exact)


# --- bad input ------------------------------------------------------------------------------------


def test_wrong_input_is_refused_by_name():
    problem = pc.discretise(scene())
    stepper, state = pc.Newton(problem), problem.rest_state()
    result = stepper(state)
    g = np.ones_like(state.positions)
    with pytest.raises(InputError, match="grad_positions has shape"):
        pc.adjoint(stepper, state, result, g[1:])
    with pytest.raises(InputError, match="grad_velocities of node 0"):
        pc.adjoint(stepper, state, result, g, g * np.nan)
    with pytest.raises(InputError, match="solver = 'magic'"):
        pc.adjoint(stepper, state, result, g, solver="magic")
    with pytest.raises(InputError, match=r"tolerance = -1.0: expected a number between"):
        pc.adjoint(stepper, state, result, g, tolerance=-1.0)
    for status, words in (
        (pc.Status.LINE_SEARCH, "no decrease"),
        (pc.Status.SUBSTEPPED, "smaller parts"),
    ):
        with pytest.raises(InputError, match=words):
            pc.adjoint(stepper, state, replace(result, status=status), g)

    # names that the memory does not have
    problem = pc.discretise(scene(time=timed("generalised-alpha")))
    stepper, state = pc.Newton(problem), problem.rest_state()
    result, g = stepper(state), np.ones_like(state.positions)
    with pytest.raises(
        InputError, match=r"grad_memory has acceleration: .*\(accelerations, internal_forces\)"
    ):
        pc.adjoint(stepper, state, result, grad_memory={"acceleration": g})
    with pytest.raises(InputError, match="grad_memory has positions"):
        pc.adjoint(stepper, state, result, g, grad_memory={"positions": g})
    short = stepper(state, time_step=0.005)
    with pytest.raises(InputError, match=r"grad_memory has accelerations: .*it has none"):
        pc.adjoint(stepper, state, short, grad_memory={"accelerations": g}, time_step=0.005)


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble", "hex27"])
def test_a_result_of_another_step_is_refused_with_what_is_off(element):
    problem = pc.discretise(scene(element))
    stepper, state = pc.ProjectiveDynamics(problem), asymmetric_state(problem)
    result, g = stepper(state), np.ones_like(state.positions)
    with pytest.raises(InputError, match=r"0\.01 s.*time_step = 0\.011 s"):
        pc.adjoint(stepper, state, result, g, time_step=0.011)
    with pytest.raises(InputError, match=r"0\.02 s"):
        pc.adjoint(stepper, state, stepper(state, time_step=0.02), g)
    forces = np.full_like(g, 0.05)
    other = pc.State(state.positions, 1.1 * state.velocities)
    for changed in (
        lambda: pc.adjoint(stepper, state, result, g, forces=forces),
        lambda: pc.adjoint(stepper, other, result, g),
        lambda: pc.adjoint(pc.Newton(problem, integrator="midpoint"), state, result, g),
    ):
        with pytest.raises(InputError, match=r"out of balance by .* N .* but reports"):
            changed()
    with pytest.raises(InputError, match="forces has shape"):
        pc.adjoint(stepper, state, result, g, forces=forces[1:])


@pytest.mark.parametrize(("element", "integrator"), [*sorted(ONCE), ("hex8", "quasi-static")])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_no_step_of_any_tolerance_is_refused(element, integrator, offset):
    """Also far from the origin, where positions are rounded more."""
    body = {"shape": "beam", "cells": [3, 1, 2], "cell_size": 0.02, "origin": [offset, 0.0, 0.0]}
    changes = {"clamps": [{"region": {"plane": "x", "at": offset}}], "materials": []}
    changes |= {"loads": [GRAVITY], "body": body, "time": timed(integrator)}
    problem = pc.discretise(scene(element, **changes))
    for tolerance in (1e-1, 1e-3, 1e-5, 1e-9):
        stepper = pc.ProjectiveDynamics(problem, tolerance)
        state = problem.rest_state()
        for _ in range(2):
            result = stepper(state)
            pc.adjoint(stepper, state, result)
            state = result.state


def test_without_a_loss_there_is_nothing_to_solve():
    problem = pc.discretise(scene())
    stepper, state = pc.Newton(problem), problem.rest_state()
    found = pc.adjoint(stepper, state, stepper(state))
    assert found.solver == "none needed"
    assert not found.positions.any()
    assert not found.young.any()
    assert found.time_step == 0.0

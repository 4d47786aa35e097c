"""Gradients of a step: against differences, between solvers, and of chains of steps."""

import numpy as np
import pytest

import pdcorrect as pc
from conftest import ELEMENTS, beam

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
        "materials": [{"region": {"box": [[0, 0, 0], [0.05, 1, 1]]}, "young": 3e5, "poisson": 0.3,
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
        self.weights = {"positions": rng.normal(size=shape) / problem.cell_size}
        self.weights["velocities"] = rng.normal(size=shape)
        scale = {"accelerations": 1e-3, "previous_positions": 1.0 / problem.cell_size}
        self.memory = {n: scale.get(n, 1.0) * g for n, g in memory.items()}
        self.found = pc.adjoint(
            self.stepper, self.state, self.result, self.weights["positions"],
            self.weights["velocities"], grad_memory=self.memory, forces=self.forces, **options,
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
    state, free = case.state, case.problem.free
    for name in names:
        direction = rng.normal(size=free.shape) * free

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


def check_time_step(case):
    h = case.stepper.time_step
    agrees(case.found.time_step * h, difference(lambda t: case.loss(time_step=h * (1 + t)), 1e-4))


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("element", ELEMENTS)
def test_gradients_are_those_of_central_differences(element, integrator):
    time = {"step": 0.01, "frames": 3, "integrator": integrator}
    case = Case(pc.discretise(scene(element, time=time)), steps_before=1)
    check_state_gradients(case, ("positions", "velocities", "forces"))
    check_material_gradients(case)

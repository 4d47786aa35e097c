"""Kelvin-Voigt viscosity: a potential of the change of stretch, zero in any rigid motion."""

from itertools import pairwise

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, rotation
from pdcorrect.errors import SceneError
from pdcorrect.fem.viscosity import Stretches, product, small_strain_stress

ELEMENTS = ["hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex27"]
SECOND = ["bdf2", "midpoint", "generalised-alpha"]
ALL = ["backward-euler", *SECOND]


def body(element="hex8-bubble-mean", cells=(3, 2, 2), **sections):
    given = {"time": {"step": 0.01, "frames": 3}, "solver": {"element": element}, **sections}
    return pc.discretise(
        pc.Scene(
            body={"shape": "beam", "cells": list(cells), "cell_size": 0.05},
            material={"young": 1e5, "poisson": 0.4, "density": 1e3}, **given,
        )
    )  # fmt: skip


def shaken(problem, seed=0, size=0.01):
    rng = np.random.default_rng(seed)
    return problem.relaxed(problem.positions + size * rng.normal(size=problem.positions.shape))


@pytest.mark.parametrize("element", ELEMENTS)
def test_forces_and_tangent_are_the_derivatives_of_the_potential(element):
    problem = body(element)
    y, before = shaken(problem, size=0.005), Stretches(problem, shaken(problem, 1)).tensor
    rng = np.random.default_rng(2)
    x, z = 0.01 * rng.normal(size=(2, *y.shape))

    def potential(y):
        change = Stretches(problem, y).tensor - before
        return 0.5 * product(change, small_strain_stress(problem, change)).sum()

    def gradient(y):
        here = Stretches(problem, y)
        return here.forces(small_strain_stress(problem, here.tensor - before))

    def slope(f, e=1e-4):
        return (8 * (f(e) - f(-e)) - (f(2 * e) - f(-2 * e))) / (12 * e)

    assert slope(lambda t: potential(y + t * x)) == pytest.approx(np.vdot(gradient(y), x), rel=1e-7)
    here = Stretches(problem, y)
    stress = small_strain_stress(problem, here.tensor - before)
    Kx = here.apply(stress, 1.0, x)
    assert Kx == pytest.approx(slope(lambda t: gradient(y + t * x)), abs=1e-6 * np.abs(Kx).max())
    assert np.vdot(z, Kx) == pytest.approx(np.vdot(x, here.apply(stress, 1.0, z)), rel=1e-10)
    K = problem.assembly.matrix(here.blocks(stress, 1.0))
    assert (K @ x.ravel()).reshape(x.shape) == pytest.approx(Kx, abs=1e-10 * np.abs(Kx).max())
    projected = problem.assembly.matrix(here.blocks(stress, 1.0, project=True)).toarray()
    values = np.linalg.eigvalsh(projected)
    assert values.min() > -1e-12 * values.max()


@pytest.mark.parametrize("element", ELEMENTS)
def test_at_rest_the_tangent_is_that_of_the_elastic_energy(element):
    problem = body(element)
    rest = problem.extended(problem.positions)
    x = np.random.default_rng(0).normal(size=rest.shape)
    nothing = np.zeros_like(Stretches(problem, rest).tensor)
    found = Stretches(problem, rest).apply(nothing, 1.0, x)
    wanted = problem.linearise(rest).apply(x)
    assert found == pytest.approx(wanted, abs=1e-10 * np.abs(wanted).max())


def test_a_rotation_of_a_strained_body_changes_no_stretch_and_no_spin_has_a_rate():
    problem = body()
    y = shaken(problem)
    R, nodes = rotation(3), len(problem.positions)
    turned = y @ R.T
    assert Stretches(problem, turned).tensor == pytest.approx(
        Stretches(problem, y).tensor, abs=1e-13
    )
    spin = np.cross([3.0, -2.0, 5.0], y[:nodes])
    rates = Stretches(problem, problem.extended(y[:nodes])).rates(problem.extended(spin))
    assert np.abs(rates).max() < 1e-12


@pytest.mark.parametrize("integrator", ALL)
def test_a_steady_spin_is_not_slowed(integrator):
    """One turn in 31 steps, viscosity of one step; the body is stretched by its own spin."""
    spins = []
    for viscosity in (0.0, 0.01):
        problem = body(
            cells=(2, 2, 2), time={"step": 0.01, "frames": 60, "integrator": integrator},
            damping={"viscosity": viscosity}, solver={"element": "hex8", "tolerance": 1e-10},
        )  # fmt: skip
        middle = problem.positions.mean(axis=0)
        v = np.cross([0.0, 0.0, 20.0], problem.positions - middle)
        run = pc.rollout(pc.ProjectiveDynamics(problem), state=pc.State(problem.positions, v))
        arms = run.positions - run.positions.mean(axis=1, keepdims=True)
        spins.append((problem.mass[:, None] * np.cross(arms, run.velocities)).sum(axis=1)[:, 2])
    elastic, viscous = (spin[-1] / spin[-20] for spin in spins)  # two schemes lose some themselves
    assert viscous == pytest.approx(elastic, rel=2e-3)
    if integrator in ("midpoint", "generalised-alpha"):
        assert viscous == pytest.approx(1.0, abs=2e-3)
    lost = run.stats["damping_loss"]
    if integrator != "backward-euler":
        assert lost[-5:].max() < 2e-3 * run.stats["kinetic_energy"][-1]


def bar(integrator, step, steps, **damping):
    """A bar of one row of cells that swings along its axis as one mode, nu = 0."""
    scene = pc.Scene(
        body={"shape": "beam", "cells": [8, 1, 1], "cell_size": 0.05},
        material={"young": 1e4, "poisson": 0.0, "density": 1e3},
        clamps=[{"region": {"plane": "x", "at": 0.0}},
                {"region": {"everywhere": True}, "components": ["y", "z"]}],
        time={"step": step, "frames": steps, "integrator": integrator},
        damping=damping, solver={"element": "hex8", "mass": "lumped", "tolerance": 1e-9},
    )  # fmt: skip
    problem = pc.discretise(scene)
    modes = pc.modes(problem, 1)
    return problem, 2.0 * np.pi * modes.frequencies[0], modes.shapes[0]


@pytest.mark.parametrize("kind", ["viscosity", "stiffness"])
@pytest.mark.parametrize("integrator", SECOND)
def test_a_mode_loses_its_amplitude_at_the_rate_of_theory(kind, integrator):
    """At 10 ms, the mode's period being 0.51 s."""
    _, omega, _ = bar(integrator, 0.01, 1)
    ratio = 0.05
    problem, omega, shape = bar(integrator, 0.01, 150, **{kind: 2.0 * ratio / omega})
    start = problem.positions + 1e-4 * shape / np.abs(shape).max()
    run = pc.rollout(pc.ProjectiveDynamics(problem), state=pc.State(start, np.zeros_like(start)))
    q = np.einsum("tni,ni->t", run.positions - problem.positions, problem.mass_times(shape))[10:]
    (a, b), *_ = np.linalg.lstsq(np.stack([q[1:-1], q[:-2]], axis=1), q[2:], rcond=None)
    root = max(np.roots([1.0, -a, -b]), key=lambda z: z.imag)
    rate = -np.log(abs(root)) / 0.01
    assert rate == pytest.approx(ratio * omega, rel=1e-2)


@pytest.mark.parametrize("kind", ["viscosity", pytest.param("stiffness", marks=pytest.mark.slow)])
@pytest.mark.parametrize("integrator", ALL)
def test_damping_keeps_the_order_in_time(kind, integrator):
    table = np.linspace(0.0, 0.4, 401)
    load = {
        "kind": "body-force", "density": [900.0, 1400.0, -3000.0],
        "table": np.column_stack([table, np.sin(np.pi * table / 0.4) ** 4]).tolist(),
    }  # fmt: skip
    problem = body(
        "hex8-bubble", (3, 1, 1), time={"step": 0.01, "frames": 1, "integrator": integrator},
        damping={kind: 5e-3}, loads=[load], clamps=[{"region": {"plane": "x", "at": 0.0}}],
    )  # fmt: skip
    ends = []
    for steps in (30, 60, 120):
        run = pc.rollout(pc.Newton(problem, 1e-9, time_step=0.3 / steps), steps)
        assert set(run.stats["status"]) == {"CONVERGED"}
        ends.append(run.positions[-1])
    changes = [np.linalg.norm(b - a) for a, b in pairwise(ends)]
    order = np.log2(changes[-2] / changes[-1])
    least, most = (0.7, 1.4) if integrator == "backward-euler" else (1.8, 2.8)
    assert least < order < most  # bdf2's third-order terms are still seen


def test_viscosity_takes_out_what_the_body_loses():
    """Midpoint conserves the rest: the energies of a swinging body and the loss add up."""
    problem = body(
        "hex8-bubble", time={"step": 0.002, "frames": 100, "integrator": "midpoint"},
        damping={"viscosity": 2e-3}, solver={"element": "hex8-bubble", "tolerance": 1e-9},
    )  # fmt: skip
    stretched = problem.positions * np.array([1.1, 0.97, 1.0])
    state = pc.State(stretched, np.zeros_like(stretched))
    run = pc.rollout(pc.ProjectiveDynamics(problem), state=state)
    total = run.stats["elastic_energy"] + run.stats["kinetic_energy"]
    lost = np.cumsum(run.stats["damping_loss"])
    start = problem.energy(stretched)
    assert lost[-1] > 0.3 * start
    assert (total + lost)[5:] == pytest.approx(start, rel=3e-2)  # of a y between frames
    assert (run.stats["damping_loss"] >= 0.0).all()


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        *(("damping", "viscosity", value) for value in (-1e-3, np.nan, np.inf, "thick")),
        *(("time", "spectral_radius", value) for value in (-0.1, 1.5, np.nan)),
    ],
)
def test_values_out_of_range_are_refused_by_their_key(section, key, value):
    with pytest.raises(SceneError, match=rf"{section}.*{key}"):
        beam(**{section: {key: value}})

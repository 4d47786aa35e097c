"""The learned element with any network: what holds by construction, and how solvers take it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam, cross, problem_on, slow_unless
from pdcorrect.elements.answers import VoxelMesh, unit_cell
from pdcorrect.elements.linear import unit_strains
from pdcorrect.errors import PdcorrectWarning, SceneError
from pdcorrect.fem import element_network, learned
from pdcorrect.fem.assembly import summed_cells
from pdcorrect.fem.cell_correction import CellCorrection, cell_shapes
from pdcorrect.fem.cube_symmetry import PATTERNS, group, on_scalars, on_strains
from pdcorrect.fem.mesh import HexMesh, voxel_mesh
from pdcorrect.fem.neighbourhood import (
    NEIGHBOURS,
    SIZE,
    CellGraph,
    cell_graph,
    neighbours_of,
    permutations,
)
from pdcorrect.solvers.integrators import backward_euler
from pdcorrect.solvers.step import StepObjective

OUTPUTS = 171 + 28
SMALL_CROSS = {
    "shape": "cross", "cells": [4, 2, 1], "cell_size": 0.05, "arms": 2, "arm_start": 2,
    "arm_width": 1, "arm_length": 1,
}  # fmt: skip
DAMPINGS = [{}, {"stiffness": 1e-3, "viscosity": 1e-3}, {"mass": 3.0}]


@pytest.fixture(autouse=True, scope="module")
def any_network():
    """Weights at random, with answers as large as bounds allow."""
    rng = np.random.default_rng(0)
    sizes = {"first": (SIZE, 12), "hidden": (24, 24), "last": (24, OUTPUTS)}
    sizes |= {f"rounds.{n}": (NEIGHBOURS * 12, 12) for n in range(2)}
    arrays = {f"norms.{n}.weight": 1.0 + 0.1 * rng.normal(size=12) for n in range(2)}
    for name, (n, m) in sizes.items():
        arrays[f"{name}.weight"] = rng.normal(size=(m, n)) / np.sqrt(n)
        arrays[f"{name}.bias"] = rng.normal(size=m)
    network = element_network.Network(arrays)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(element_network, "released", lambda: network)
        yield network


def learned_problem(scene):
    return pc.discretise(pc.learned_coarse(scene))


def with_correction(problem, matrices, masses):
    """The same problem with other matrices K and masses in its cells."""
    own = problem.correction
    more = problem.materials.density[:, None, None] * (masses - own.masses)
    return replace(
        problem,
        correction=replace(own, writer=None, matrices=matrices, masses=masses),
        mass_matrix=problem.mass_matrix + summed_cells(problem.cells, more, len(problem.mass)),
    )


def u_shape():
    solid = np.ones((4, 2, 3), dtype=bool)
    solid[1:3, :, 1:] = False
    solid[0, 0, 2] = False
    return solid


def seen(solid, seed=3):
    """The graph of a body with nodes held here and there."""
    index = np.argwhere(solid)
    rng = np.random.default_rng(seed)
    young, poisson = 10.0 ** rng.uniform(-0.5, 0.5, len(index)), rng.uniform(0.0, 0.49, len(index))
    held = rng.integers(0, 2, (len(index), 8)).astype(float)
    return cell_graph(neighbours_of(VoxelMesh.of(solid).cells, index), young, poisson, held)


def test_the_corrections_are_large_enough_to_test(any_network):
    N, H = any_network(seen(u_shape()))
    S = learned.bounded(N)
    assert 0.2 < np.abs(np.linalg.eigvalsh(S)).max() < learned.BOUND + 1e-12
    assert np.abs(np.linalg.eigvalsh(learned.bounded(H))).max() > 0.2


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.495])
def test_the_stiffness_to_changes_of_volume_changes_within_its_bound(poisson):
    """By no more than 30 %, or the bound times three times the shear stiffness."""
    C = learned.own_stiffness(unit_cell(poisson)[0], unit_strains())
    shear, own = 1.0 / (1.0 + poisson), 1.0 / (1.0 - 2.0 * poisson)
    most = max(min(own, 3.0 * shear) * learned.BOUND, 0.3 * own)
    assert learned.BOUND * np.linalg.eigvalsh(C[:6, :6]).max() == pytest.approx(most, rel=1e-6)


@pytest.mark.parametrize("g", [3, 17, 40])
def test_answers_turn_with_the_cube(any_network, g):
    graph = seen(u_shape())
    turned = CellGraph(*(x[:, places[g]] for x, places in zip(graph, permutations(), strict=True)))
    for answer, moved, moves in zip(
        any_network(graph), any_network(turned), (on_strains(), on_scalars()), strict=True
    ):
        R = np.zeros((answer.shape[1],) * 2)
        R[range(len(R)), moves.places[g]] = moves.signs[g]
        assert moved == pytest.approx(R @ answer @ R.T, abs=1e-6)


def test_cells_on_both_sides_of_a_cut_do_not_see_each_other():
    cells = np.arange(16).reshape(2, 8)
    alone = neighbours_of(cells, np.array([[0, 0, 0], [1, 0, 0]]))
    assert (alone < 2).sum() == 2
    assert alone[:, 13].tolist() == [0, 1]


def test_answers_depend_on_what_is_in_reach(any_network):
    """And no further: three cells away with two rounds."""
    row = np.ones((9, 1, 1), dtype=bool)
    neighbours = neighbours_of(VoxelMesh.of(row).cells, np.argwhere(row))
    held, poisson = np.zeros((9, 8)), np.full(9, 0.3)
    young = np.ones(9)
    young[8] = 2.0
    same, other = (
        any_network(cell_graph(neighbours, e, poisson, held))[0] for e in (0 * young + 1, young)
    )
    changed = np.abs(same - other).max(axis=(1, 2)) > 1e-9
    assert changed.tolist() == [False] * 5 + [True] * 4
    assert any_network.reach == 3


@pytest.mark.parametrize("g", [5, 22, 43])
def test_a_turned_body_has_turned_forces(g):
    R = group()[g]
    solid = u_shape()
    mesh = voxel_mesh(solid, (0, 0, 0), 0.1)
    order = np.arange(8) if np.linalg.det(R) > 0.0 else [1, 0, 3, 2, 5, 4, 7, 6]
    other = HexMesh.create(mesh.positions @ R.T, mesh.cells[:, order])
    problems = [problem_on(m, "hex8-learned") for m in (mesh, other)]
    u = 0.02 * np.random.default_rng(4).normal(size=mesh.positions.shape)
    first = problems[0].forces(mesh.positions + u)
    second = problems[1].forces(other.positions + u @ R.T)
    assert second == pytest.approx(first @ R.T, abs=1e-6 * np.abs(first).max())
    a, b = (p.mass_matrix.toarray() for p in problems)
    assert b == pytest.approx(a, abs=1e-6 * a.max())


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.495])
def test_affine_deformations_of_free_bodies_are_exact(poisson):
    """The patch test, up to the boundary."""
    mesh = voxel_mesh(u_shape(), (0, 0, 0), 0.1)
    F = np.eye(3) + 0.2 * np.random.default_rng(5).normal(size=(3, 3))
    forces = [
        problem_on(mesh, element, material={"poisson": poisson}).forces(mesh.positions @ F.T)
        for element in ("hex8-enhanced", "hex8-learned")
    ]
    assert forces[1] == pytest.approx(forces[0], abs=1e-10 * np.abs(forces[0]).max())


def test_rigid_motions_cost_nothing_and_the_body_is_stable_at_rest():
    problem = problem_on(voxel_mesh(u_shape(), (0, 0, 0), 0.1), "hex8-learned")
    values = np.linalg.eigvalsh(problem.stiffness(problem.positions).toarray())
    assert np.abs(values[:6]).max() < 1e-9 * values[-1]
    assert values[6] > 1e-5 * values[-1]
    M = problem.mass_matrix.toarray()
    assert np.linalg.eigvalsh(M).min() > 0.0
    plain = problem_on(voxel_mesh(u_shape(), (0, 0, 0), 0.1), "hex8-enhanced")
    assert problem.mass == pytest.approx(plain.mass, rel=1e-12)


def test_strains_are_corrected_at_held_corners_only():
    problem = learned_problem(beam((5, 2, 2)))
    strains = np.abs(problem.correction.matrices[:, :6]).max(axis=(1, 2))
    held = ~problem.free.any(axis=1)[problem.cells]
    assert (strains[held.any(axis=1)] > 0.0).all()
    assert (strains[~held.any(axis=1)] == 0.0).all()


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.48, 0.495])
def test_no_correction_makes_a_drawn_out_cell_burst(poisson):
    """With all that may be taken away the energy is positive near rest, and grows far out."""
    mesh = voxel_mesh(np.ones((1, 1, 1), dtype=bool), (0, 0, 0), 1.0)
    plain = problem_on(mesh, "hex8-enhanced", material={"young": 1.0, "poisson": poisson})
    C = learned.own_stiffness(unit_cell(poisson)[0], unit_strains())
    shapes, sizes = cell_shapes(mesh.positions[mesh.cells])
    less = CellCorrection(
        mesh.cells, shapes, sizes, -learned.BOUND * C[None], np.zeros((1, 8, 8)), np.array([True])
    )
    rng = np.random.default_rng(8)

    def energy(stretches):
        V = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        x = mesh.positions @ V @ np.diag(stretches) @ V.T
        return plain.energy(x) + less.energy_and_forces(x - mesh.positions)[0]

    assert min(energy(s) for s in np.exp(rng.uniform(-0.8, 0.8, (60, 3)))) > 0.0
    for far in ([2.0, 1.0, 1.0], [2.0, 2.0, 1.0], [2.0, 2.0, 2.0]):
        assert energy(10.0 * np.array(far)) > energy(5.0 * np.array(far)) > 0.0


def test_what_the_matrices_depend_on_has_no_units():
    """Twice the size, 10 times the modulus: K of 20 times, mass of 8 times."""
    first = learned_problem(beam())
    other = learned_problem(beam(cell_size=0.04, material={"young": 1e7}))
    K, L = first.correction.matrices, other.correction.matrices
    assert pytest.approx(20.0 * K, abs=1e-9 * np.abs(L).max()) == L
    assert other.correction.masses == pytest.approx(8.0 * first.correction.masses, rel=1e-9)


def test_energy_forces_and_stiffness_agree():
    problem = learned_problem(cross())
    rng = np.random.default_rng(6)
    x = problem.positions + 0.01 * rng.normal(size=problem.positions.shape)
    d = rng.normal(size=x.shape)
    e = 1e-6
    work = (problem.energy(x + e * d) - problem.energy(x - e * d)) / (2 * e)
    assert work == pytest.approx(-np.vdot(problem.forces(x), d), rel=1e-6)
    change = -(problem.forces(x + e * d) - problem.forces(x - e * d)) / (2 * e)
    Kd = (problem.stiffness(x) @ d.ravel()).reshape(d.shape)
    assert Kd == pytest.approx(change, abs=1e-6 * np.abs(Kd).max())


@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "midpoint", "generalised-alpha"])
def test_newton_and_projective_dynamics_agree(integrator):
    problem = learned_problem(cross(time={"integrator": integrator}))
    steppers = [cls(problem, tolerance=1e-9) for cls in (pc.ProjectiveDynamics, pc.Newton)]
    runs = [pc.rollout(stepper, 6) for stepper in steppers]
    size = np.abs(runs[0].positions - problem.positions).max()
    assert runs[0].positions == pytest.approx(runs[1].positions, abs=1e-7 * size)


@pytest.mark.parametrize("solver", [pc.ProjectiveDynamics, pc.Newton])
def test_statics_end_in_equilibrium(solver):
    problem = learned_problem(beam(time={"integrator": "quasi-static", "frames": 2}))
    result = pc.rollout(solver(problem, tolerance=1e-10), 2)
    unbalanced = problem.forces(result.positions[-1]) + problem.external_forces(1.0)
    assert (
        np.abs(unbalanced[problem.free]).max() < 1e-6 * np.abs(problem.external_forces(1.0)).max()
    )


def test_a_free_body_keeps_its_momentum():
    scene = beam(
        clamps=[], loads=[], initial={"velocity": [1.0, 0.0, 0.5], "angular_velocity": [0, 5, 3]}
    )
    problem = learned_problem(scene)
    run = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-10), 10)
    momenta = [problem.mass_times(v).sum(axis=0) for v in run.velocities]
    assert momenta[-1] == pytest.approx(momenta[0], abs=1e-9 * np.abs(momenta[0]).max())


def two_materials(**changes):
    parts = [{"region": {"box": [[0.0, 0.0, 0.0], [0.06, 1.0, 0.02]]}, "young": 3e6,
              "poisson": 0.42, "density": 1.8e3}]  # fmt: skip
    return beam((4, 2, 2), materials=parts, **changes)


def on_rollers(axes, cells=(4, 4, 2), **changes):
    """A part of a beam held at one end, the rest of it behind planes of symmetry."""
    clamps = [{"region": {"plane": "x", "at": "min"}}]
    clamps += [{"region": {"plane": a, "at": at}, "components": [a]} for a, at in axes.items()]
    cells = [n // (2 if axis in axes else 1) for n, axis in zip(cells, "xyz", strict=True)]
    return beam(tuple(cells), clamps=clamps, **changes)


@pytest.mark.parametrize("axes", [{"y": "min"}, {"y": "max"}, {"y": "max", "z": "min"}], ids=str)
def test_cells_on_planes_of_symmetry_are_those_of_the_whole_body(axes):
    whole, part = learned_problem(on_rollers({})), learned_problem(on_rollers(axes))
    middles = [p.positions[p.cells].mean(axis=1) for p in (whole, part)]
    middles[1] += sum(
        np.eye(3)["xyz".index(a)] * np.ptp(part.positions, axis=0)
        for a, at in axes.items() if at == "min"
    )  # fmt: skip
    distances = np.linalg.norm(middles[1][:, None] - middles[0], axis=2)
    same = distances.argmin(axis=1)
    assert distances.min(axis=1) == pytest.approx(0.0, abs=1e-12)
    assert part.correction.learned.all()
    for name in ("matrices", "masses"):
        own, its = getattr(part.correction, name), getattr(whole.correction, name)[same]
        assert own == pytest.approx(its, abs=1e-9 * np.abs(its).max())


def test_an_eighth_of_a_free_body_is_not_held_where_its_planes_meet():
    clamps = [{"region": {"plane": a, "at": "min"}, "components": [a]} for a in "xyz"]
    part = learned_problem(beam((2, 1, 1), clamps=clamps))
    whole = learned_problem(beam((4, 2, 2), clamps=[]))
    last = part.correction.matrices[-1], whole.correction.matrices[-1]
    assert last[0] == pytest.approx(last[1], abs=1e-9 * np.abs(last[1]).max())
    assert not part.correction.matrices[:, :6].any()


def test_one_plane_of_symmetry_an_axis():
    rollers = [{"region": {"plane": "z", "at": at}, "components": ["z"]} for at in ("min", "max")]
    scenes = (beam((3, 2, n), clamps=rollers, loads=[]) for n in (1, 2))
    thin, thick = (learned_problem(scene).correction.learned for scene in scenes)
    assert not thin.any()
    assert thick.sum() == 6
    rollers[1]["motion"] = {"times": [0.0, 1.0], "displacement": [[0.0] * 3, [0.0, 0.0, 0.01]]}
    assert learned_problem(beam((3, 2, 2), clamps=rollers, loads=[])).correction.learned.sum() == 6
    moved = learned_problem(beam((3, 2, 2), clamps=rollers[1:], loads=[]))
    assert moved.correction.learned.sum() == 6  # a plane that moves is none of symmetry


@pytest.mark.parametrize("damping", DAMPINGS, ids=str)
def test_derivatives_by_the_material(damping):
    """Of a step from a moving state, cell by cell, through what the network sees."""
    rollers = [{"region": {"plane": "z", "at": "max"}, "components": ["z"]}]
    held = [{"region": {"plane": "x", "at": 0.0}}] + (rollers if damping else [])
    problem = learned_problem(two_materials(damping=damping, clamps=held))
    rng = np.random.default_rng(7)
    start = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-10), 3)
    state = pc.State(start.positions[-1], start.velocities[-1], 0.0)
    g = rng.normal(size=problem.positions.shape)

    def after(problem):
        stepper = pc.ProjectiveDynamics(problem, tolerance=1e-12)
        return stepper, stepper(state)

    stepper, result = after(problem)
    gradients = pc.adjoint(stepper, state, result, g, tolerance=1e-10)
    direction = rng.normal(size=len(problem.cells))
    scales = {"young": 1e6, "poisson": 0.1, "density": 1e3}
    values = {name: getattr(problem.materials, name) for name in scales}
    for what, scale in scales.items():

        def value(t, what=what, scale=scale):
            changed = {**values, what: values[what] + t * scale * direction}
            return np.vdot(g, after(problem.with_material(**changed))[1].state.positions)

        e = 1e-3
        found = (8 * (value(e) - value(-e)) - (value(2 * e) - value(-2 * e))) / (12 * e)
        expected = scale * np.vdot(getattr(gradients, what), direction)
        assert expected == pytest.approx(found, rel=5e-5), what


def test_viscosity_is_of_the_stiffness_without_learned_volume():
    """At rest its second derivative is the rate times that of the energy."""
    problem = learned_problem(two_materials(damping={"viscosity": 2e-3}))
    stage = backward_euler(problem, problem.rest_state(), 0.01)
    objective = StepObjective(problem, problem.rest_state(), stage)
    rest = problem.extended(problem.positions)
    blocks = objective.viscous.tangent(rest).blocks()
    own = problem.correction
    shearing = with_correction(problem, own.without_volume().matrices, own.masses)
    K = shearing.linearise(rest).blocks()
    assert blocks == pytest.approx(objective.viscous.rate * K, abs=1e-9 * np.abs(blocks).max())


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45])
def test_no_force_drives_a_cell_into_the_fades(poisson):
    """With the stiffest matrices that a network can write, energy grows all the way."""
    material = {"young": 1.0, "poisson": poisson, "density": 1.0}
    problem = learned_problem(beam((1, 1, 1), 1.0, material=material, clamps=[], loads=[]))
    C = learned.own_stiffness(unit_cell(poisson)[0], unit_strains())
    own = problem.correction
    problem = with_correction(problem, learned.BOUND * C[None], own.masses)
    X, cell = problem.positions, problem.cells[0]
    ways = [-X * np.isin(range(3), axes) for axes in ([0], [0, 1], [0, 1, 2])]
    ways.append(X * [1.5, -0.3, -0.3])
    if poisson < 0.45:  # see below
        ways.append(X * [1.0, 1.0, -0.6])
    for pattern in PATTERNS:
        for i in range(3):
            way = np.zeros_like(X)
            way[cell, i] = 0.6 * pattern
            ways.append(way)
    for way in ways:
        energies = [problem.energy(X + t * way) for t in np.linspace(0.0, 0.98, 60)]
        assert (np.diff(energies) > 0.0).all()


@pytest.mark.parametrize(("poisson", "most"), [(0.45, 0.02), (0.48, 0.13)])
def test_cells_drawn_out_in_two_directions_have_a_shallow_well(poisson, most):
    """Nearly incompressible, with a change of volume, by the stiffest matrices."""
    material = {"young": 1.0, "poisson": poisson, "density": 1.0}
    problem = learned_problem(beam((1, 1, 1), 1.0, material=material, clamps=[], loads=[]))
    C = learned.own_stiffness(unit_cell(poisson)[0], unit_strains())
    stiffest = with_correction(problem, learned.BOUND * C[None], problem.correction.masses)
    X = problem.positions
    for way, bound in ((X * [1.0, 1.0, -0.6], most), (X * [1.0, -0.5, -0.5], 0.0)):
        energies = np.array([stiffest.energy(X + t * way) for t in np.linspace(0.0, 0.98, 60)])
        drops = np.maximum.accumulate(energies) - energies
        assert drops.max() <= bound * energies.max()


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_viscosity_takes_energy_however_soft_the_matrices(poisson, rng):
    """At large strain, with the softest matrices that a network can write, and no others."""
    scene = beam(
        (3, 2, 2), material={"young": 1e5, "poisson": poisson, "density": 1e3},
        damping={"viscosity": 1e-2},
    )  # fmt: skip
    problem = learned_problem(scene)
    own, a, h = problem.correction, problem.cell_size, 1e-6
    C = 1e5 * a * learned.own_stiffness(unit_cell(poisson)[0], unit_strains())
    softest = np.tile(-learned.BOUND * C, (len(own.matrices), 1, 1))
    problem = with_correction(problem, softest, own.masses)
    X, free = problem.positions, problem.free * a
    motions = [
        (X + size * free * rng.normal(size=X.shape), free * rng.normal(size=X.shape))
        for size in np.repeat([0.05, 0.1, 0.2], 5)
    ]
    motions.append((X * [1.4, 0.8, 0.8], X * [1.0, -0.5, -0.5]))  # volume, but no trace of S
    motions += [(X * [1.0, 1.0, squeezed], X * [0.0, 0.0, -1.0]) for squeezed in (0.5, 0.2, 0.1)]
    motions += [
        (X + 0.4 * free * rng.normal(size=X.shape), free * rng.normal(size=X.shape))
        for _ in range(10)
    ]
    for x, v in motions:
        state = pc.State(x, v, 0.0)
        viscous = StepObjective(problem, state, backward_euler(problem, state, h)).viscous
        assert viscous.loss(problem.relaxed(x + h * v), h) > 0.0


@pytest.mark.parametrize("damping", DAMPINGS, ids=str)
def test_derivatives_by_the_matrices(damping):
    problem = learned_problem(beam((3, 2, 2), damping=damping))
    rng = np.random.default_rng(10)
    start = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-10), 3)
    state = pc.State(start.positions[-1], start.velocities[-1], 0.0)
    g = rng.normal(size=problem.positions.shape)
    own = problem.correction
    dK = 0.1 * np.abs(own.matrices).max() * rng.normal(size=own.matrices.shape)
    dM = 0.1 * np.abs(own.masses).max() * rng.normal(size=own.masses.shape)
    dK, dM = dK + np.swapaxes(dK, 1, 2), dM + np.swapaxes(dM, 1, 2)

    def after(t):
        changed = with_correction(problem, own.matrices + t * dK, own.masses + t * dM)
        stepper = pc.ProjectiveDynamics(changed, tolerance=1e-12)
        return stepper, stepper(state)

    stepper, result = after(0.0)
    gradients = pc.adjoint(stepper, state, result, g, tolerance=1e-10)
    expected = np.vdot(gradients.matrices, dK) + np.vdot(gradients.masses, dM)
    values = [np.vdot(g, after(t)[1].state.positions) for t in (1e-2, -1e-2, 2e-2, -2e-2)]
    found = (8 * (values[0] - values[1]) - (values[2] - values[3])) / 0.12
    assert expected == pytest.approx(found, rel=1e-4)


def test_modes_are_of_both_corrections():
    problem = learned_problem(beam())
    plain = pc.discretise(pc.best_coarse(beam()))
    found, without = pc.modes(problem, 3), pc.modes(plain, 3)
    assert np.abs(found.frequencies / without.frequencies - 1.0).max() > 1e-3
    u = found.shapes[0]
    K = problem.stiffness(problem.positions)
    square = (2 * np.pi * found.frequencies[0]) ** 2
    free = problem.free.ravel()
    left = (K @ u.ravel())[free]
    right = square * problem.mass_times(u).ravel()[free]
    assert left == pytest.approx(right, abs=1e-6 * np.abs(right).max())


def test_cells_off_the_grid_keep_the_element_and_are_counted():
    mesh = voxel_mesh(np.ones((3, 2, 2), dtype=bool), (0, 0, 0), 0.1)
    x = mesh.positions.copy()
    x[-1] += 0.03
    with pytest.warns(PdcorrectWarning, match="1 of 12 cells.*grid"):
        problem = problem_on(HexMesh.create(x, mesh.cells), "hex8-learned")
    assert problem.correction.learned.sum() == 11
    assert not problem.correction.matrices[~problem.correction.learned].any()


PART = {"region": {"box": [[0.0, 0.0, 0.0], [0.06, 1.0, 1.0]]}}


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("nu", {"material": {"poisson": 0.4999}}),
        ("components", {"clamps": [{"region": {"plane": "x", "at": 0.0}, "components": ["y"]}]}),
        ("moduli", {"materials": [{**PART, "young": 1e9}]}),
        ("densities", {"materials": [{**PART, "density": 10.0}]}),
        ("nu", {"materials": [{**PART, "poisson": 0.1}]}),
    ],
)  # fmt: skip
def test_what_it_was_not_trained_for_is_told(what, changes):
    with pytest.warns(PdcorrectWarning, match=what):
        problem = learned_problem(beam(**changes))
    own, materials = problem.correction, problem.materials
    ((told, count),) = own.writer.unlike(materials.mu, materials.volume_weight).items()
    assert what in told
    assert count == (~own.learned).sum() > 0


def test_mass_and_weights_are_those_of_the_learned_element_only(tmp_path):
    with pytest.raises(SceneError, match="mass"):
        beam(solver={"element": "hex8-learned", "mass": "lumped"})
    assert beam(solver={"element": "hex8-learned"}).solver.mass == "averaged"
    for path in ("", "a\0b"):
        with pytest.raises(SceneError, match="weights"):
            beam(solver={"element": "hex8-learned", "weights": path})
    with pytest.raises(SceneError, match="weights"):
        beam(solver={"element": "hex8", "weights": tmp_path / "w.safetensors"})
    tuned = beam(solver={"element": "hex8-learned", "weights": tmp_path / "w.safetensors"})
    assert pc.learned_coarse(tuned).solver == tuned.solver
    assert pc.best_coarse(tuned).solver.weights is None
    assert pc.discretise(tuned, element="hex27").scene.solver.weights is None
    with pytest.raises(SceneError, match="weights"):
        pc.best_coarse(tuned).with_changes(solver={"weights": tmp_path / "w.safetensors"})


def test_second_order_under_refinement():
    """Of the lowest elastic frequency of a free block, whose mode is smooth."""

    def frequency(k, element):
        scene = beam((2 * k, k, k), 0.04 / k, 0.3, clamps=[], loads=[])
        scene = scene.with_changes(solver={"element": element, "mass": "averaged"})
        return pc.modes(pc.discretise(scene), 7).frequencies[-1]

    half, whole = (frequency(k, "hex8-enhanced") for k in (4, 8))
    right = whole + (whole - half) / 3.0
    coarse, fine = (right - frequency(k, "hex8-learned") for k in (4, 8))
    assert np.log2(coarse / fine) > 1.85


def batch_of_two(damping):
    problems = [
        learned_problem(s)
        for s in (two_materials(damping=damping), cross(damping=damping, body=SMALL_CROSS))
    ]
    return problems, pc.BatchStepper(problems, 1e-10)


@pytest.mark.parametrize("damping", DAMPINGS[:2], ids=str)
def test_batches_equal_single_steps(damping):
    problems, stepper = batch_of_two(damping)
    state = stepper.rest_state()
    for _ in range(3):
        state = stepper(state).state
    for i, problem in enumerate(problems):
        single = pc.rollout(pc.ProjectiveDynamics(problem, tolerance=1e-10), 3).positions[-1]
        assert state.positions[i, : len(single)].numpy() == pytest.approx(single, abs=1e-10)


@pytest.mark.parametrize("damping", slow_unless(DAMPINGS[:2], DAMPINGS), ids=str)
def test_derivatives_of_batches_equal_those_of_single_steps(damping):
    problems, batch = batch_of_two(damping)
    before = batch(batch.rest_state()).state
    result = batch(before)
    rng = np.random.default_rng(8)
    g = torch.as_tensor(rng.normal(size=tuple(before.positions.shape)))
    memory = {k: torch.as_tensor(rng.normal(size=g.shape)) for k in result.state.memory}
    memory = {k: 1e-3 * v for k, v in memory.items()}
    found = pc.BatchGradients(batch, before, result, g, grad_memory=memory, tolerance=1e-10)
    for i, problem in enumerate(problems):
        n, count = len(problem.positions), len(problem.cells)

        def own(field, i=i, n=n):
            return field[i, :n].numpy()

        state = pc.State(
            own(before.positions), own(before.velocities), before.times[i],
            {k: own(v) for k, v in before.memory.items()},
        )  # fmt: skip
        stepper = pc.ProjectiveDynamics(problem, tolerance=1e-12)
        single = pc.adjoint(
            stepper, state, stepper(state), own(g), tolerance=1e-12,
            grad_memory={k: own(v) for k, v in memory.items()},
        )  # fmt: skip
        for name in ("positions", "young", "poisson", "density"):
            a, b = getattr(found, name)[i], getattr(single, name)
            expected = pytest.approx(b, abs=2e-5 * np.abs(b).max())
            assert a[: n if name == "positions" else count].numpy() == expected


def test_batches_take_other_materials():
    problems, stepper = batch_of_two({})
    stepper.set_material(young=5e5, poisson=0.2)
    after = stepper(stepper.rest_state()).state
    for i, problem in enumerate(problems):
        other = problem.with_material(young=5e5, poisson=0.2)
        single = pc.rollout(pc.ProjectiveDynamics(other, tolerance=1e-10), 1).positions[-1]
        assert after.positions[i, : len(single)].numpy() == pytest.approx(single, abs=1e-9)


def test_batches_have_the_same_forces_and_tangents_where_cells_are_crushed():
    problems, stepper = batch_of_two({"viscosity": 1e-3})
    rng = np.random.default_rng(9)
    y = stepper.cells.rest + 0.003 * torch.as_tensor(
        rng.normal(size=tuple(stepper.cells.rest.shape))
    )
    y[:, : stepper.cells.sizes.nodes] *= torch.as_tensor([0.5, 0.8, 0.9])
    x = torch.as_tensor(rng.normal(size=tuple(y.shape)))
    cells = stepper.cells
    u, local = y - cells.rest, cells.local(y - cells.rest)
    energy, forces = cells.correction.energy_and_forces(local)
    rates = cells.correction.rates(local, cells.local(x))
    products = {
        p: cells.of_corners(
            cells.correction.apply(cells.correction.linearise(local, p), cells.local(x))
        )
        for p in (False, True)
    }
    for i, problem in enumerate(problems):
        n, count = len(problem.positions), len(problem.cells)
        own, way = u[i, :n].numpy(), x[i, :n].numpy()
        value, force = problem.correction.energy_and_forces(own)
        assert float(energy[i]) == pytest.approx(value, rel=1e-9)
        found = cells.of_corners(forces)[i, :n].numpy()
        assert found == pytest.approx(force, abs=1e-9 * np.abs(force).max())
        expected = problem.correction.rates(own, way)
        assert rates[i, :count].numpy() == pytest.approx(
            expected, abs=1e-6 * np.abs(expected).max()
        )
        for project, product in products.items():
            expected = problem.correction.tangent(own, project).apply(way)
            size = np.abs(expected).max()
            assert product[i, :n].numpy() == pytest.approx(expected, abs=1e-9 * size)

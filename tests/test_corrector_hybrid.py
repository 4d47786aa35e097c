"""Corrected steps: what they are made of, and what must not change."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam, box_mesh, held, problem_on, rotation
from hybrid_samples import (
    CELL,
    TINY,
    TORSION,
    bumped,
    fitted,
    flying,
    folded,
    prescribed,
    same,
    shaken,
    silent,
    soft_beam,
)
from pdcorrect.corrector import features
from pdcorrect.corrector.batch_hybrid import BatchHybrid, HybridLayer, _TimesMass
from pdcorrect.corrector.corrector import Corrector, preset
from pdcorrect.corrector.gate import Gate, moved
from pdcorrect.corrector.hybrid import MEMORY, HybridStepper
from pdcorrect.errors import InputError
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.solvers.rollout import check_same_run

# --- no correction, no change ----------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize("kind", [pc.ProjectiveDynamics, pc.Newton])
def test_a_network_that_gives_nothing_leaves_the_coarse_rollout_bit_for_bit(element, kind):
    problem = pc.discretise(soft_beam(solver={"element": element}, loads=[TORSION]))
    corrector = silent(fitted([problem]))
    run = pc.rollout(HybridStepper(kind(problem), corrector, gate=Gate()), 4)
    plain = pc.rollout(kind(problem), 4)
    assert same(run, plain)
    assert not run.stats["refused"].any()
    for name in plain.stats:
        if name != "seconds":
            assert np.array_equal(run.stats[name], plain.stats[name]), name


def test_the_network_takes_one_thread_and_gives_the_others_back(monkeypatch):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    seen, plain = [], Corrector.of_view

    def asked(self, *given):
        seen.append(torch.get_num_threads())
        return plain(self, *given)

    monkeypatch.setattr(Corrector, "of_view", asked)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem])).prepare()
        hybrid(problem.rest_state())
        assert set(seen) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_network_and_gate_look_at_the_same_features(monkeypatch):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    names = (*preset("compact").node_features, "velocity")
    corrector = fitted([problem], node_features=names)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=Gate())
    computed = []
    for table in (features.NODE_FEATURES, features.EDGE_FEATURES):
        for name, (count, function) in list(table.items()):
            monkeypatch.setitem(table, name, (count, counted(computed, name, function)))
    hybrid(problem.rest_state())
    config = hybrid.corrector.config
    assert sorted(computed) == sorted([*config.node_features, *config.edge_features])


def counted(computed, name, function):
    def call(view):
        computed.append(name)
        return function(view)

    return call


@pytest.mark.parametrize("size", [0.0, 1e-4, 1e-2])
def test_energies_from_near_modes_are_those_from_none(size):
    problem = pc.discretise(soft_beam(solver={"element": "hex8-bubble"}))
    state = pc.ProjectiveDynamics(problem)(shaken(problem))
    near = state.state.positions + bumped(problem, size, 3)
    assert state.modes.shape == (problem.space.internal, 3)
    expected = problem.energy(near)
    assert problem.energy(near, state.modes) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("element", ["hex8-bubble", "hex8-bubble-mean"])
@pytest.mark.parametrize("size", [1e-4, 1e-3, 1e-2])
def test_modes_in_equilibrium_are_those_from_anywhere_near(element, size, rng):
    problem = pc.discretise(soft_beam(solver={"element": element}))
    positions = shaken(problem).positions + bumped(problem, 0.05, 4)
    rested, nodes = problem.relaxed(positions), len(positions)
    forces = problem.energy_and_forces(rested)[1]
    scale = problem.scene.material.young * problem.cell_size**2
    assert np.abs(forces[nodes:]).max() < 1e-12 * scale
    start = rested[nodes:] + size * problem.cell_size * rng.normal(size=rested[nodes:].shape)
    again = problem.relaxed(positions, modes=start)
    assert np.abs(again - rested).max() < 1e-12 * problem.cell_size


def test_corrected_answers_are_measured_once(monkeypatch):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem]), gate=Gate())
    hybrid(problem.rest_state())
    energies, ratios = [], []
    body, kernel = type(problem).energy, type(problem).volume_ratios
    monkeypatch.setattr(
        type(problem), "energy", lambda self, *a: energies.append(a) or body(self, *a)
    )
    monkeypatch.setattr(
        type(problem), "volume_ratios", lambda self, *a: ratios.append(a) or kernel(self, *a)
    )
    assert hybrid(problem.rest_state()).stats["correction"] > 0.0
    assert len(energies) == 1
    assert len(ratios) == 2  # coarse step, corrected one


# --- velocities and momentum -----------------------------------------------------------------


def test_recomputed_velocities_are_the_way_over_the_step_and_kept_ones_the_coarse_solver_s():
    problem = pc.discretise(soft_beam())
    coarse, corrector = pc.ProjectiveDynamics(problem), prescribed(problem, bumped(problem))
    before = shaken(problem)
    plain = coarse(before).state
    after = HybridStepper(coarse, corrector)(before).state
    expected = (after.positions - before.positions) / problem.time_step
    assert np.allclose(after.velocities, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert np.abs(after.positions - plain.positions).max() > 1e-2 * CELL
    found = HybridStepper(coarse, corrector, velocity="kept")(before).state
    assert np.array_equal(found.velocities, plain.velocities)
    assert np.allclose(found.positions - plain.positions, corrector.answer, rtol=0, atol=1e-15)


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "generalised-alpha", "quasi-static"])
def test_every_integrator_goes_on_as_if_it_had_found_the_corrected_positions(integrator):
    problem = pc.discretise(soft_beam())
    corrector = prescribed(problem, bumped(problem))
    stepper = HybridStepper(pc.ProjectiveDynamics(problem, integrator=integrator), corrector)
    first = stepper.coarse(shaken(problem)).state
    before = stepper.coarse(first).state
    after, h = stepper(before).state, problem.time_step
    p, v, q, w = before.positions, before.velocities, after.positions, after.velocities
    if integrator == "bdf2":
        expected = (3 * q - 4 * p + first.positions) / (2 * h)
        assert np.array_equal(after.memory["previous_positions"], p)
    elif integrator == "midpoint":
        expected = 2 * (q - p) / h - v
    elif integrator == "quasi-static":
        expected = np.zeros_like(p)
    else:
        r = problem.scene.time.spectral_radius
        alpha_m, alpha_f = (2 * r - 1) / (r + 1), r / (r + 1)
        gamma, beta = 0.5 - alpha_m + alpha_f, 0.25 * (1 - alpha_m + alpha_f) ** 2
        a, b = (state.memory["accelerations"] for state in (before, after))
        expected = v + h * ((1 - gamma) * a + gamma * b)
        way = p + h * v + h**2 * ((0.5 - beta) * a + beta * b)
        assert np.allclose(q, way, rtol=0, atol=1e-9 * CELL)
    free = problem.free
    assert np.allclose(w[free], expected[free], rtol=0, atol=1e-8)


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint", "generalised-alpha"])
def test_a_corrected_state_is_gone_on_from_as_from_the_solution_itself(integrator):
    """A body that is stiffer than the true one, with the difference as the correction."""
    time = {"step": 0.01, "frames": 4, "integrator": integrator}
    loads = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]
    true, stiff = (
        pc.ProjectiveDynamics(pc.discretise(beam(
            (3, 2, 2), time=time, loads=loads, material={"young": young, "poisson": 0.4},
            solver={"mass": "averaged"},
        )), 1e-10)
        for young in (1e5, 1.3e5)
    )  # fmt: skip
    state = true(true(true.problem.rest_state()).state).state
    wanted, coarse = true(state).state, stiff(state).state
    free, mass_times = true.problem.free, true.problem.mass_times
    scheme = stiff.integrate.scheme(state, 0.01)
    difference = wanted.positions - coarse.positions
    found = moved(scheme, coarse, difference, "recomputed", lambda x: mass_times(x) * free)
    for mine, other in zip(
        found, (wanted.positions, wanted.velocities, wanted.memory), strict=True
    ):
        mine, other = ([x] if isinstance(x, np.ndarray) else x.values() for x in (mine, other))
        for a, b in zip(mine, other, strict=True):
            np.testing.assert_allclose(a[free], b[free], rtol=0, atol=1e-6 * np.abs(b).max())


def test_neutral_corrections_leave_a_free_body_the_momentum_of_its_coarse_step():
    problem, before = flying()
    momenta = {}
    for neutral in (True, False):
        corrector = fitted([pc.discretise(soft_beam())], size=0.5, momentum_neutral=neutral)
        stepper = HybridStepper(pc.ProjectiveDynamics(problem, 1e-12), corrector)
        bent = pc.State(problem.positions + bumped(problem), before.velocities)
        found, coarse = stepper(bent), stepper.coarse(bent)
        assert found.stats["correction"] > 1e-5 * CELL
        change = problem.mass[:, None] * (found.state.velocities - coarse.state.velocities)
        momenta[neutral] = np.abs(change.sum(axis=0)).max() / np.abs(change).sum()
    assert momenta[True] < 1e-6
    assert momenta[False] > 1e-3


# --- memory ----------------------------------------------------------------------------------


def test_a_run_goes_on_from_its_file_with_the_correction_before(tmp_path):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = fitted([problem], seed=1, **TINY)
    stepper = HybridStepper(pc.ProjectiveDynamics(problem), corrector)
    whole = pc.rollout(stepper, 5)
    pc.save_trajectory(tmp_path / "run.h5", pc.rollout(stepper, 3))
    read = pc.load_trajectory(tmp_path / "run.h5")
    check_same_run(stepper, read)
    rest = pc.rollout(stepper, 2, state=read.state(-1))
    assert np.array_equal(rest.positions[-1], whole.positions[-1])
    forgetful = pc.State(read.positions[-1], read.velocities[-1], read.times[-1])
    other = pc.rollout(stepper, 2, state=forgetful)
    assert not np.array_equal(other.positions[-1], whole.positions[-1])


def test_only_networks_that_ask_for_the_correction_before_remember_it():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    for names, expected in ((preset("compact").node_features, set()), (None, {MEMORY})):
        changes = TINY if names is None else {"node_features": names}
        stepper = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem], **changes))
        assert set(stepper(problem.rest_state()).state.memory) == expected


def test_the_correction_before_is_no_memory_of_the_integrator():
    problem = pc.discretise(soft_beam(time={"integrator": "generalised-alpha"}))
    corrector = fitted([pc.discretise(soft_beam())], **TINY)
    stepper = HybridStepper(pc.ProjectiveDynamics(problem), silent(corrector))
    state = pc.State(
        shaken(problem).positions, shaken(problem).velocities, memory={MEMORY: bumped(problem)}
    )
    assert same(stepper(state).state, stepper.coarse(shaken(problem)).state)


def test_a_run_is_not_continued_with_other_weights():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    run = pc.rollout(HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem])), 1)
    other = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem], seed=1))
    with pytest.raises(InputError, match="corrector was"):
        check_same_run(other, run)


# --- statistics ------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
def test_energies_are_those_of_the_corrected_state(element):
    problem = pc.discretise(soft_beam(solver={"element": element}))
    corrector = prescribed(problem, bumped(problem))
    result = HybridStepper(pc.ProjectiveDynamics(problem), corrector)(shaken(problem))
    state, stats = result.state, result.stats
    assert stats["elastic_energy"] == pytest.approx(problem.energy(state.positions), rel=1e-12)
    kinetic = 0.5 * np.vdot(state.velocities, problem.mass_times(state.velocities))
    assert stats["kinetic_energy"] == pytest.approx(kinetic, rel=1e-12)
    way = state.positions - problem.positions
    work = np.vdot(problem.external_forces(0.0, 0.01), way)
    assert stats["external_work"] == pytest.approx(work, rel=1e-9)
    assert stats["smallest_volume_ratio"] == problem.volume_ratios(state.positions).min()
    assert stats["correction"] == np.linalg.norm(corrector.answer, axis=1).max()
    assert np.array_equal(result.volume_ratios, problem.volume_ratios(state.positions))
    assert result.modes is None  # those of the coarse answer are not passed on
    if element == "hex8-bubble":
        assert pc.ProjectiveDynamics(problem)(shaken(problem)).modes.any()


@pytest.mark.parametrize("found", [s for s in pc.Status if s.ok])
@pytest.mark.parametrize("folds", [True, False])
def test_how_a_step_was_found_stays_and_inverted_cells_are_the_corrected_state_s(found, folds):
    problem = pc.discretise(soft_beam())

    class Told(pc.ProjectiveDynamics):
        def __call__(self, *args, **options):
            return replace(super().__call__(*args, **options), status=found)

    corrector = prescribed(problem, folded(problem) if folds else bumped(problem))
    status = HybridStepper(Told(problem), corrector)(problem.rest_state()).status
    if found in (pc.Status.CONVERGED, pc.Status.INVERTED):
        assert status is (pc.Status.INVERTED if folds else pc.Status.CONVERGED)
    else:
        assert status is found


# --- turning the scene -----------------------------------------------------------------------


def block(turn):
    """A distorted block, held at one side, in some orientation."""
    mesh = box_mesh((3, 2, 1), (0.06, 0.04, 0.02), 0.2)
    gravity = {"kind": "gravity", "acceleration": [float(x) for x in turn @ [3.0, -5.0, 8.0]]}
    turned = HexMesh.create(mesh.positions @ turn.T, mesh.cells)
    problem = problem_on(turned, loads=[gravity], material={"young": 5e4})
    return held(problem, np.flatnonzero(mesh.positions[:, 0] < 1e-9), problem.positions)


def test_a_turned_scene_has_the_turned_rollout():
    turn = rotation()
    straight, turned = block(np.eye(3)), block(turn)
    torch.manual_seed(5)
    config = preset("equivariant")
    fit = fitted([straight], size=0.2, layers=3, width=32)
    corrector = Corrector(config.model_copy(update={"layers": 3, "width": 32, "mlp_layers": 2}))
    corrector.normaliser.load_state_dict(fit.normaliser.state_dict())
    runs = [
        pc.rollout(HybridStepper(pc.ProjectiveDynamics(p, 1e-9), corrector), 5)
        for p in (straight, turned)
    ]
    plain = pc.rollout(pc.ProjectiveDynamics(straight, 1e-9), 5)
    assert np.abs(runs[0].positions - plain.positions).max() > 1e-3 * CELL
    assert runs[0].stats["correction"].min() > 1e-4 * CELL
    assert np.abs(runs[0].positions @ turn.T - runs[1].positions).max() < 1e-5 * CELL


# --- bad input -------------------------------------------------------------------------------


def test_correctors_without_statistics_and_cells_of_27_nodes_are_refused():
    problem, known = pc.discretise(soft_beam()), fitted([pc.discretise(soft_beam())])
    quadratic = pc.discretise(soft_beam(), element="hex27")
    for kind, parts in (
        (HybridStepper, pc.ProjectiveDynamics),
        (BatchHybrid, lambda one: pc.BatchStepper([one])),
    ):
        with pytest.raises(InputError, match="corrector"):
            kind(parts(problem), Corrector(preset("compact")))
        with pytest.raises(InputError, match="27 nodes"):
            kind(parts(quadratic), known)
    with pytest.raises(InputError, match="corrector"):
        HybridLayer(pc.BatchStepper([problem]), Corrector(preset("compact")), through_solver=True)


def test_parts_that_do_not_fit_are_refused():
    problem = pc.discretise(soft_beam())
    coarse, stepper = pc.ProjectiveDynamics(problem), pc.BatchStepper([problem])
    corrector = fitted([problem])
    with pytest.raises(InputError, match="coarse_stepper is a BatchStepper"):
        HybridStepper(stepper, corrector)
    with pytest.raises(InputError, match="stepper is a ProjectiveDynamics"):
        BatchHybrid(coarse, corrector)
    with pytest.raises(InputError, match="corrector is a str"):
        HybridStepper(coarse, "weights.pt")
    with pytest.raises(InputError, match="gate is a dict"):
        HybridStepper(coarse, corrector, gate={"energy": 1.0})
    with pytest.raises(InputError, match="velocity = 'mixed'"):
        BatchHybrid(stepper, corrector, velocity="mixed")
    for hybrid in (HybridStepper, BatchHybrid):
        part = (pc.ProjectiveDynamics if hybrid is HybridStepper else pc.BatchStepper)(
            problem if hybrid is HybridStepper else [problem], integrator="bdf2"
        )
        with pytest.raises(InputError, match="'kept' with bdf2"):
            hybrid(part, corrector, velocity="kept")


def test_a_correction_before_of_other_bodies_is_refused():
    stepper = pc.BatchStepper([pc.discretise(soft_beam())])
    corrector = fitted(stepper.problems)
    state, other = stepper.rest_state(), torch.zeros(3, 3, dtype=torch.float64)
    with pytest.raises(InputError, match="previous"):
        BatchHybrid(stepper, corrector)(state, other)
    layer = HybridLayer(stepper, corrector, through_solver=True)
    with pytest.raises(InputError, match="previous"):
        layer(state.positions, state.velocities, previous=other)


def test_the_mass_times_a_correction_is_differentiated_as_it_is_computed():
    cells = (2, 1, 1), (3, 2, 1)
    scenes = [pc.discretise(soft_beam(c, solver={"mass": "averaged"})) for c in cells]
    stepper = pc.BatchStepper(scenes)
    stepper(stepper.rest_state())
    generator = torch.Generator().manual_seed(3)
    x, weight = (
        torch.randn(stepper.rest_state().positions.shape, generator=generator, dtype=torch.float64)
        for _ in range(2)
    )
    x.requires_grad_()
    found = _TimesMass.apply(stepper, x)
    (gradient,) = torch.autograd.grad((found * weight).sum(), x)
    free = stepper.staging.free
    wanted = _TimesMass.apply(stepper, weight)
    torch.testing.assert_close(gradient, wanted, rtol=1e-12, atol=1e-15)
    assert not found[~free].any()
    for i, problem in enumerate(scenes):
        count = len(problem.positions)
        nodal = (x.detach() * free)[i, :count].numpy()
        np.testing.assert_allclose(
            found[i, :count].detach().numpy(), problem.mass_times(nodal) * problem.free, atol=1e-14
        )

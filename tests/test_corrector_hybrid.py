"""Corrected steps: what they are made of, and what must not change."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import box_mesh, disturbed, held, problem_on, rotation
from hybrid_samples import (
    PLACEMENTS,
    PRESSURE,
    TORSION,
    Prescribed,
    fitted,
    prescribed,
    problems,
    silent,
    soft_beam,
)
from pdcorrect.corrector import features
from pdcorrect.corrector.batch_bodies import BatchBodies, external_forces
from pdcorrect.corrector.batch_hybrid import BatchHybrid, HybridLayer
from pdcorrect.corrector.batch_hybrid import BatchCoarseStep, BatchParts
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.config import preset
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.gate import Gate, Measured, Reason, refusals
from pdcorrect.corrector.hybrid import MEMORY, HybridStepper
from pdcorrect.corrector.normaliser import Moments
from pdcorrect.corrector.single_step import SingleCoarseStep
from pdcorrect.errors import InputError
from pdcorrect.fem.mesh import HexMesh
from pdcorrect.solvers.rollout import check_same_run

CELL = 0.02
OPEN = Gate(body=None, margin=None, average=None, volume=None, crushing=None, energy=None)


def same(a, b):
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.velocities, b.velocities)


def bumped(problem, size=0.1, seed=0):
    """A displacement of some cells, (N, 3), zero where clamped."""
    return disturbed(problem, size, seed) - problem.positions


def shaken(problem, speed=0.3, seed=1):
    """At rest positions, but in motion."""
    velocities = speed * np.random.default_rng(seed).normal(size=problem.positions.shape)
    return pc.State(problem.positions, velocities * problem.free)


# --- no correction, no change ----------------------------------------------------------------


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize("kind", [pc.ProjectiveDynamics, pc.Newton])
def test_a_network_that_gives_nothing_leaves_the_coarse_rollout_bit_for_bit(
    placement, element, kind
):
    problem = pc.discretise(soft_beam(solver={"element": element}, loads=[TORSION]))
    corrector = silent(fitted([problem], placement=placement))
    run = pc.rollout(HybridStepper(kind(problem), corrector, gate=Gate()), 4)
    plain = pc.rollout(kind(problem), 4)
    assert same(run, plain)
    assert not run.stats["refused"].any()
    for name in plain.stats:
        if name != "seconds":
            assert np.array_equal(run.stats[name], plain.stats[name]), name


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_network_that_gives_nothing_leaves_a_batch_bit_for_bit(placement):
    scenes = problems((3, 1, 1), (2, 2, 1))
    stepper = pc.BatchStepper(scenes)
    hybrid = BatchHybrid(stepper, silent(fitted(scenes, placement=placement)), gate=Gate())
    state = plain = stepper.rest_state()
    for _ in range(3):
        state, plain = hybrid(state).state, stepper(plain).state
        assert torch.equal(state.positions, plain.positions)
        assert torch.equal(state.velocities, plain.velocities)


def test_network_and_gate_look_at_the_same_features(monkeypatch):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    names = (*preset("compact").node_features, "velocity")  # not compiled
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


def test_corrected_steps_do_not_pass_on_the_coarse_modes():
    problem = pc.discretise(soft_beam(solver={"element": "hex8-bubble"}, loads=[TORSION]))
    coarse = pc.ProjectiveDynamics(problem)
    result = HybridStepper(coarse, fitted([problem]))(problem.rest_state())
    assert result.stats["correction"] > 0.0
    assert result.modes is None
    assert coarse(problem.rest_state()).modes.any()


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


# --- one scene and many ----------------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_scenes_of_a_batch_are_corrected_as_each_alone(placement, element):
    scenes = [pc.discretise(p.scene, element=element) for p in problems((3, 1, 1), (2, 2, 1))]
    names = (*preset("compact").node_features, "previous-correction")
    corrector = fitted(scenes, placement=placement, node_features=names)
    gate = Gate(margin=None, average=None)
    stepper = pc.BatchStepper(scenes, 1e-12)
    many = BatchHybrid(stepper, corrector, gate=gate)
    alone = [HybridStepper(pc.ProjectiveDynamics(p, 1e-12), corrector, gate=gate) for p in scenes]
    state, states, previous = stepper.rest_state(), [p.rest_state() for p in scenes], None
    for _ in range(4):
        result = many(state, previous)
        state, previous = result.state, result.correction
        states = [one(s).state for one, s in zip(alone, states, strict=True)]
        assert result.correction.abs().max() > 1e-5 * CELL
        for found, expected in zip(stepper.states(state), states, strict=True):
            size = np.abs(expected.positions - scenes[0].positions.min()).max()
            assert np.abs(found.positions - expected.positions).max() < 1e-9 * size
            speed = np.abs(expected.velocities).max()
            assert np.abs(found.velocities - expected.velocities).max() < 1e-9 * speed


def test_padding_and_flat_order_are_inverse():
    scenes = problems((3, 1, 1), (2, 2, 1))
    stepper = pc.BatchStepper(scenes)
    nodes = BatchBodies(stepper)
    x = torch.arange(3.0 * len(nodes.graph.rest), dtype=torch.float64).reshape(-1, 3)
    assert torch.equal(nodes.flat(nodes.padded(x)), x)
    assert not nodes.padded(x)[~stepper.node_mask].any()
    assert torch.equal(nodes.flat(stepper.rest_state().positions), nodes.graph.rest)


@pytest.mark.parametrize("load", [TORSION, PRESSURE, {**TORSION, "window": [0.0, 0.015]}])
def test_the_network_is_told_all_loads_of_the_step(load):
    problem = pc.discretise(soft_beam(loads=[load]))
    stepper = pc.BatchStepper([problem])
    state = pc.State(disturbed(problem, 0.05), shaken(problem).velocities, 0.01)
    ahead = state.positions + 0.01 * state.velocities
    expected = problem.external_forces(0.01, 0.02, ahead)
    found = external_forces(stepper, stepper.state([state]))[0].numpy()
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def proposed(problem, state):
    """What the network is shown before the coarse solver was asked, one by one and in a batch."""
    bodies = BodyGraph.of([problem], dtype=torch.float64)
    one = SingleCoarseStep(pc.ProjectiveDynamics(problem), bodies, "recomputed", state)
    stepper = pc.BatchStepper([problem])
    many = BatchBodies(stepper).snapshot(stepper.state([state]), None, None)
    return one.view(None).snapshot.proposed.numpy(), many.proposed.numpy()


def test_moving_clamps_are_proposed_where_they_will_be():
    turn = {"times": [0.0, 0.1], "rotation": [0.0, 40.0], "centre": [0, 0.01, 0.01], "axis": "x"}
    clamps = [{"region": {"plane": "x", "at": 0.0}, "motion": turn}]
    problem = pc.discretise(soft_beam(clamps=clamps, loads=[TORSION]))
    coarse, state = pc.ProjectiveDynamics(problem), problem.rest_state()
    for _ in range(2):
        after = coarse(state).state
        for found in proposed(problem, state):
            held_at = ~problem.free
            assert np.array_equal(found[held_at], after.positions[held_at])
            assert np.abs(found - state.positions)[held_at].max() > 1e-2 * CELL
        state = after


def test_clamps_that_do_not_move_and_free_nodes_are_proposed_by_inertia_and_loads():
    problem = pc.discretise(soft_beam(loads=[TORSION], clamps=[{
        "region": {"plane": "x", "at": 0.0}, "components": ["x", "z"],
    }]))  # fmt: skip
    h, state = problem.time_step, pc.rollout(pc.ProjectiveDynamics(problem), 3).state()
    loads = problem.external_forces(state.time, state.time + h)
    expected = state.positions + h * state.velocities
    expected += h**2 * loads * problem.free / problem.mass[:, None]
    one, many = proposed(problem, state)
    assert np.array_equal(one, expected)
    assert np.allclose(many, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("mass", ["lumped", "averaged", "per-node"])
def test_the_network_knows_the_material_that_the_stepper_has_now(mass):
    scenes = [pc.discretise(p.scene, mass=mass) for p in problems((3, 1, 1), (2, 2, 1))]
    stepper = pc.BatchStepper(scenes)
    layer = HybridLayer(stepper, fitted(scenes), through_solver=False)
    nodes, own = BatchBodies(stepper), BodyGraph.of(scenes, dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    young, poisson, density = (
        low + (high - low) * torch.rand(2, 4, generator=random, dtype=torch.float64)
        for low, high in ((1e4, 1e5), (0.1, 0.4), (500.0, 2000.0))
    )
    known = nodes.graph.rest_frames
    stepper.set_material(young, poisson, density)
    changed = [
        p.with_material(*(m[i, : len(p.cells)].numpy() for m in (young, poisson, density)))
        for i, p in enumerate(scenes)
    ]
    expected = BodyGraph.of(changed, dtype=torch.float64)
    late = BatchBodies(stepper)
    for found in (nodes.graph, layer.bodies, late.graph):
        for name in ("mass", "young", "poisson", "density"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name))
            assert not torch.allclose(getattr(found, name), getattr(own, name))
        assert torch.equal(found.rest_frames, own.rest_frames)
    assert nodes.graph is nodes.graph
    assert nodes.graph.rest_frames is known
    stepper.set_material()
    for found in (nodes.graph, layer.bodies, late.graph):
        for name in ("mass", "young", "poisson", "density"):
            assert torch.equal(getattr(found, name), getattr(own, name))


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_batch_of_another_material_is_corrected_as_scenes_of_that_material(placement):
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes, placement=placement)
    stepper = pc.BatchStepper(scenes, 1e-11)
    hybrid = BatchHybrid(stepper, corrector)
    before = hybrid(stepper.rest_state())
    stepper.set_material(young=2e5, density=700.0)
    other = pc.BatchStepper([stepper.problem_now(i) for i in range(2)], 1e-11)
    found, expected = (
        hybrid(stepper.rest_state()),
        BatchHybrid(other, corrector)(other.rest_state()),
    )
    torch.testing.assert_close(found.correction, expected.correction, rtol=1e-6, atol=1e-12)
    size = float(before.correction.abs().max())
    assert float((found.correction - before.correction).abs().max()) > 1e-2 * size


# --- placements ------------------------------------------------------------------------------


def test_recomputed_velocities_are_the_way_over_the_step():
    problem = pc.discretise(soft_beam())
    stepper = HybridStepper(pc.ProjectiveDynamics(problem), prescribed(problem, bumped(problem)))
    before = shaken(problem)
    after = stepper(before).state
    expected = (after.positions - before.positions) / problem.time_step
    assert np.allclose(after.velocities, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert np.abs(after.positions - stepper.coarse(before).state.positions).max() > 1e-2 * CELL


def test_kept_velocities_are_the_coarse_solver_s():
    problem = pc.discretise(soft_beam())
    corrector = prescribed(problem, bumped(problem))
    stepper = HybridStepper(pc.ProjectiveDynamics(problem), corrector, velocity="kept")
    before = shaken(problem)
    found, coarse = stepper(before).state, stepper.coarse(before).state
    assert np.array_equal(found.velocities, coarse.velocities)
    assert np.allclose(found.positions - coarse.positions, corrector.answer, rtol=0, atol=1e-15)


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
        a, b = before.memory["accelerations"], after.memory["accelerations"]
        expected = v + h * ((1 - gamma) * a + gamma * b)
        way = p + h * v + h**2 * ((0.5 - beta) * a + beta * b)
        assert np.allclose(q, way, rtol=0, atol=1e-9 * CELL)
    free = problem.free
    assert np.allclose(w[free], expected[free], rtol=0, atol=1e-8)


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_a_force_moves_a_free_body_by_the_correction(mass):
    problem = problem_on(box_mesh((2, 1, 1), (0.04, 0.02, 0.02), 0.2), solver={"mass": mass})
    shift = np.broadcast_to([1e-3, 2e-3, -3e-3], problem.positions.shape)
    corrector = prescribed(problem, shift, placement="force")
    before = shaken(problem)
    stepper = HybridStepper(pc.ProjectiveDynamics(problem, 1e-12), corrector)
    way = stepper(before).state.positions - stepper.coarse(before).state.positions
    assert np.allclose(way, shift, rtol=0, atol=1e-10)


def test_forces_of_the_caller_act_beside_those_of_the_correction():
    problem = pc.discretise(soft_beam())
    push = np.full(problem.positions.shape, 1e-3)
    corrector = prescribed(problem, bumped(problem), placement="force")
    stepper = HybridStepper(pc.ProjectiveDynamics(problem, 1e-11), corrector)
    added = problem.mass[:, None] * corrector.answer / problem.time_step**2
    expected = stepper.coarse(problem.rest_state(), push + added).state
    assert np.allclose(stepper(problem.rest_state(), push).state.positions, expected.positions)


def test_a_corrected_guess_leads_to_the_coarse_answer():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = prescribed(problem, bumped(problem), placement="guess")
    stepper = HybridStepper(pc.ProjectiveDynamics(problem, 1e-9), corrector)
    state = plain = problem.rest_state()
    for _ in range(3):
        result, expected = stepper(state), stepper.coarse(plain)
        state, plain = result.state, expected.state
        assert np.abs(state.positions - plain.positions).max() < 1e-7 * CELL
        assert result.iterations != expected.iterations


def test_a_guess_may_lead_to_another_minimum():
    """A beam that is pressed together at its ends bows to the side of the guess."""
    push = {"times": [0.0, 0.01], "displacement": [[0, 0, 0], [-CELL, 0, 0]]}
    clamps = [
        {"region": {"plane": "x", "at": "min"}},
        {"region": {"plane": "x", "at": "max"}, "motion": push},
    ]
    time = {"integrator": "quasi-static"}
    problem = pc.discretise(soft_beam((8, 1, 1), clamps=clamps, loads=[], time=time))
    bow = np.zeros_like(problem.positions)
    bow[:, 2] = CELL * np.sin(np.pi * problem.positions[:, 0] / (8 * CELL)) ** 2
    coarse, ways = pc.ProjectiveDynamics(problem, 1e-7), []
    plain = coarse(problem.rest_state())
    for side in (1.0, -1.0):
        corrector = prescribed(problem, side * bow, placement="guess")
        result = HybridStepper(coarse, corrector)(problem.rest_state())
        assert result.status is pc.Status.CONVERGED
        assert result.stats["elastic_energy"] < 0.99 * plain.stats["elastic_energy"]
        ways.append((result.state.positions - problem.positions)[:, 2])
    assert ways[0].max() > 0.5 * CELL
    assert ways[0].min() > -1e-3 * CELL
    assert ways[1].min() < -0.5 * CELL
    assert ways[1].max() < 1e-3 * CELL


@pytest.mark.parametrize("placement", ["state", "force"])
def test_neutral_corrections_leave_a_free_body_the_momentum_of_its_coarse_step(placement):
    problem, before = flying()
    momenta = {}
    for neutral in (True, False):
        corrector = fitted([pc.discretise(soft_beam())], size=0.5, placement=placement,
                           momentum_neutral=neutral)  # fmt: skip
        stepper = HybridStepper(pc.ProjectiveDynamics(problem, 1e-12), corrector)
        bent = pc.State(problem.positions + bumped(problem), before.velocities)
        found, coarse = stepper(bent), stepper.coarse(bent)
        assert found.stats["correction"] > 1e-5 * CELL
        change = problem.mass[:, None] * (found.state.velocities - coarse.state.velocities)
        momenta[neutral] = np.abs(change.sum(axis=0)).max() / np.abs(change).sum()
    assert momenta[True] < 1e-6
    assert momenta[False] > 1e-3


@pytest.mark.parametrize("integrator", ["backward-euler", "midpoint", "bdf2"])
@pytest.mark.parametrize("kind", [pc.ProjectiveDynamics, pc.Newton])
def test_a_step_that_begins_at_its_answer_ends_at_once(kind, integrator):
    problem = pc.discretise(soft_beam(loads=[TORSION], time={"integrator": integrator}))
    stepper = kind(problem, 1e-7)
    answer = stepper(shaken(problem))
    again = stepper(shaken(problem), guess=answer.state.positions)
    assert again.iterations <= 1 < answer.iterations
    assert np.abs(again.state.positions - answer.state.positions).max() < 1e-6 * CELL


def test_a_batch_that_begins_at_its_answer_ends_at_once():
    scenes = problems((3, 1, 1), (2, 2, 1))
    stepper = pc.BatchStepper(scenes, 1e-7)
    answer = stepper(stepper.rest_state())
    again = stepper(stepper.rest_state(), guess=answer.state.positions)
    assert (again.iterations <= 1).all()
    assert (answer.iterations > 1).all()
    guess = answer.state.positions.clone()
    guess[1, 3] = torch.nan
    other = stepper(stepper.rest_state(), guess=guess)
    assert other.iterations.tolist() == [again.iterations[0], answer.iterations[1]]
    assert torch.equal(other.state.positions[1], answer.state.positions[1])


def test_a_step_recovers_from_an_absurd_guess():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    stepper = pc.ProjectiveDynamics(problem, 1e-8, max_iterations=15)
    answer = stepper(problem.rest_state())
    again = stepper(problem.rest_state(), guess=1e12 * (problem.positions[::-1] - 0.01))
    assert again.status.ok
    assert np.abs(again.state.positions - answer.state.positions).max() < 1e-6 * CELL


@pytest.mark.parametrize(
    ("guess", "message"),
    [
        (np.zeros((3, 3)), "guess has shape"),
        ("there", "guess is a str"),
        (np.full((16, 3), np.nan), "guess of node 0"),
    ],
)
def test_a_guess_that_is_none_is_refused(guess, message):
    problem = pc.discretise(soft_beam())
    with pytest.raises(InputError, match=message):
        pc.ProjectiveDynamics(problem)(problem.rest_state(), guess=guess)


def test_a_batch_refuses_a_guess_of_another_shape():
    stepper = pc.BatchStepper(problems((3, 1, 1)))
    with pytest.raises(InputError, match="guess"):
        stepper(stepper.rest_state(), guess=torch.zeros(1, 2, 3, dtype=torch.float64))


# --- derivatives -----------------------------------------------------------------------------

_TINY = {
    "node_features": ("load", "previous-correction"),
    "edge_features": ("stretch",),
    "layers": 1,
    "width": 3,
}


class Unrolled:
    """A loss over four corrected steps from a bent shape, by the network's weights."""

    def __init__(self, placement, through_solver, cells=((2, 1, 1),)):
        scenes = [
            pc.discretise(
                soft_beam(c, loads=[TORSION, PRESSURE, {**PRESSURE, "window": [0, 0.02]}])
            )
            for c in cells
        ]
        self.corrector = fitted(scenes, size=0.5, placement=placement, seed=4, **_TINY)
        self.stepper = pc.BatchStepper(scenes, 1e-13)
        self.layer = HybridLayer(self.stepper, self.corrector, through_solver=through_solver)
        self.layer.steps.tolerance = 1e-10
        self.start = self.stepper.rest_state()
        self.through, self.frames = through_solver, []

    def __call__(self, frames=None):
        """The loss; each step from its given frame where there are such."""
        p, v, d = self.start.positions, self.start.velocities, None
        total, rest = 0.0, self.start.positions
        self.frames = []
        for k in range(4):
            if frames is not None:
                p, v, d = frames[k]
            self.frames.append((p, v, d))
            times = [k * self.stepper.time_step] * len(self.stepper.problems)
            p, v, d = self.layer(p, v, times, d)
            total = total + ((p - rest) / CELL).square().sum() + (d / CELL).square().sum()
        return total


CHAINS = [("state", True), ("state", False), ("force", True), ("force", False)]


def frozen(unrolled):
    """The inputs of each step, if they count as given."""
    if unrolled.layer.through_solver:
        return None
    return [tuple(None if x is None else x.detach() for x in frame) for frame in unrolled.frames]


@pytest.mark.parametrize(("placement", "through_solver"), CHAINS)
def test_derivatives_along_ways_through_all_weights_are_difference_quotients(
    placement, through_solver
):
    unrolled = Unrolled(placement, through_solver)
    unrolled().backward()
    given, step = frozen(unrolled), 1e-6
    weights = list(unrolled.corrector.parameters())
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for _ in range(3):
            way = [torch.randn(w.shape, generator=random, dtype=w.dtype) for w in weights]
            expected = sum((w.grad * d).sum() for w, d in zip(weights, way, strict=True))
            losses = []
            for shift in (step, -2 * step):
                for w, d in zip(weights, way, strict=True):
                    w += shift * d
                losses.append(unrolled(given))
            for w, d in zip(weights, way, strict=True):
                w += step * d
            quotient = (losses[0] - losses[1]) / (2 * step)
            assert abs(quotient - expected) < 1e-5 * abs(expected)


@pytest.mark.slow
@pytest.mark.parametrize(("placement", "through_solver"), CHAINS)
def test_derivatives_by_every_weight_are_difference_quotients(placement, through_solver):
    unrolled = Unrolled(placement, through_solver)
    unrolled().backward()
    given, step, found = frozen(unrolled), 1e-5, {}
    with torch.no_grad():
        for name, weights in unrolled.corrector.named_parameters():
            flat, quotients = weights.view(-1), torch.zeros(weights.numel(), dtype=torch.float64)
            for i, value in enumerate(flat.tolist()):
                flat[i] = value + step
                ahead = unrolled(given)
                flat[i] = value - step
                quotients[i] = (ahead - unrolled(given)) / (2 * step)
                flat[i] = value
            found[name] = quotients, weights.grad.view(-1)
    largest = max(q.abs().max() for q, _ in found.values())
    for name, (quotients, grad) in found.items():
        error = (grad - quotients).abs().max()
        assert error <= 1e-5 * quotients.abs().max() + 1e-8 * largest, name
    assert sum(int((q != 0.0).sum()) for q, _ in found.values()) > 100


def test_derivatives_through_the_solver_are_other_ones_than_without():
    both = [Unrolled("state", through) for through in (True, False)]
    for unrolled in both:
        unrolled().backward()
    a, b = (u.corrector.network.decoder[-1].weight.grad for u in both)
    assert (a - b).abs().max() > 1e-3 * a.abs().max()


def test_the_layer_takes_the_steps_of_the_hybrid():
    unrolled = Unrolled("state", True, ((2, 1, 1), (2, 2, 1)))
    hybrid = BatchHybrid(unrolled.stepper, unrolled.corrector)
    result, previous, state = None, None, unrolled.start
    p, v, d = state.positions, state.velocities, None
    for k in range(3):
        result = hybrid(state, previous)
        p, v, d = unrolled.layer(p, v, state.times, d)
        state, previous = result.state, result.correction
        assert torch.allclose(p, state.positions, rtol=0, atol=1e-12 * CELL), k
        assert torch.allclose(v, state.velocities, rtol=0, atol=1e-12)
    assert d.requires_grad
    assert not result.correction.requires_grad


# --- memory ----------------------------------------------------------------------------------


def test_a_run_goes_on_from_its_file_with_the_correction_before(tmp_path):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = fitted([problem], seed=1, **_TINY)
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
        changes = _TINY if names is None else {"node_features": names}
        stepper = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem], **changes))
        assert set(stepper(problem.rest_state()).state.memory) == expected


def test_the_correction_before_is_no_memory_of_the_integrator():
    problem = pc.discretise(soft_beam(time={"integrator": "generalised-alpha"}))
    corrector = fitted([pc.discretise(soft_beam())], **_TINY)
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


# --- refusals --------------------------------------------------------------------------------


def folded(problem):
    """A correction that pushes the end of the beam through its last cells."""
    x = problem.positions[:, 0]
    return np.outer(np.isclose(x, x.max()), [-1.5 * CELL, 0.0, 0.0])


def wild(problem):
    """One without inverted cells, but with far more energy than the step has."""
    stretch = np.zeros_like(problem.positions)
    stretch[:, 0] = 0.5 * problem.positions[:, 0]
    return stretch * problem.free


def strange(problem):
    """Forces far outside what the network has seen, and so its inputs."""
    return np.random.default_rng(0).normal(size=problem.positions.shape) * 0.5


CASES = {
    Reason.NOT_FINITE: (OPEN, lambda p: np.full(p.positions.shape, np.nan), False),
    Reason.FEATURES: (
        Gate(volume=None, crushing=None, energy=None),
        lambda p: 0.01 * bumped(p),
        True,
    ),
    Reason.INVERSION: (Gate(margin=None, average=None, energy=None), folded, False),
    Reason.ENERGY: (Gate(margin=None, average=None, volume=None, crushing=None), wild, False),
}


@pytest.mark.parametrize("placement", ["state", "force"])
@pytest.mark.parametrize("reason", CASES)
def test_each_reason_refuses_a_correction_and_keeps_the_coarse_step(reason, placement):
    gate, answer, pushed = CASES[reason]
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    correction = answer(problem)
    if placement == "force" and reason in (Reason.INVERSION, Reason.ENERGY):
        correction = 100.0 * correction  # the body resists
    corrector = prescribed(problem, correction, placement=placement)
    coarse = pc.ProjectiveDynamics(problem)
    stepper = HybridStepper(coarse, corrector, gate=gate)
    push = strange(problem) if pushed else None
    found, plain = stepper(problem.rest_state(), push), coarse(problem.rest_state(), push)
    assert found.stats["gate"] == reason
    assert found.stats["refused"] == 1.0
    assert found.stats["correction"] == 0.0
    assert same(found.state, plain.state)
    if reason is not Reason.NOT_FINITE:
        open_ = HybridStepper(coarse, corrector, gate=OPEN)(problem.rest_state(), push)
        assert open_.stats["refused"] == 0.0
        assert not same(open_.state, plain.state)


@pytest.mark.parametrize("placement", ["state", "force"])
@pytest.mark.parametrize("reason", [Reason.NOT_FINITE, Reason.INVERSION, Reason.ENERGY])
def test_a_batch_refuses_one_scene_s_correction_and_not_the_other_s(reason, placement):
    gate, answer, _ = CASES[reason]
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes, kind=Prescribed, placement=placement)
    factor = 100.0 if placement == "force" else 1.0
    small = 1e-4 * bumped(scenes[1])
    corrector.answer = np.concatenate([factor * answer(scenes[0]), small])
    stepper = pc.BatchStepper(scenes)
    result = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state())
    plain = stepper(stepper.rest_state())
    assert result.reasons.tolist() == [reason, 0]
    assert result.refused.tolist() == [True, False]
    assert torch.equal(result.state.positions[0], plain.state.positions[0])
    assert torch.equal(result.state.velocities[0], plain.state.velocities[0])
    assert not torch.equal(result.state.positions[1], plain.state.positions[1])
    assert torch.isfinite(result.state.positions).all()
    assert torch.isfinite(result.correction).all()
    first = len(scenes[0].positions)
    assert not result.correction[:first].any()
    assert result.correction[first:].any()


def test_inputs_unlike_the_training_data_are_refused_in_a_batch():
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes)
    stepper = pc.BatchStepper(scenes)
    states = [pc.State(disturbed(scenes[0], 0.3), shaken(scenes[0], 5.0).velocities)]
    state = stepper.state([*states, scenes[1].rest_state()])
    result = BatchHybrid(stepper, corrector, gate=Gate(volume=None, energy=None))(state)
    assert result.reasons.tolist() == [Reason.FEATURES, 0]
    wide = BatchHybrid(
        stepper, corrector, gate=Gate(margin=1e9, average=1e9, volume=None, energy=None)
    )
    assert wide(state).reasons.tolist() == [0, 0]


def test_a_body_whose_mean_inputs_are_strange_is_refused_though_every_node_is_familiar():
    """Fitted to two beams, of which one moves as it did, and one all of whose means are new."""
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector, averages = fitted(scenes), Moments()
    stepper = pc.BatchStepper(scenes)
    state = stepper.rest_state()
    open_ = Gate(volume=None, energy=None)
    assert BatchHybrid(stepper, corrector, gate=open_)(state).reasons.tolist() == [0, 0]
    seen = []
    answer, corrector.of_view = corrector.of_view, lambda view: seen.append(view) or answer(view)
    BatchHybrid(stepper, corrector)(state)
    corrector.of_view = answer
    familiar = seen[0].bodies.body_means(corrector.inputs(seen[0])[0])[:1]
    averages.add(familiar.detach())
    corrector.normaliser.fit_averages(averages)
    away = corrector.unlike(seen[0]).tolist()
    assert away[0] < 1e-6 < 1.0 < away[1]
    for average, reason in ((0.9 * away[1], Reason.FEATURES), (1.1 * away[1], 0), (None, 0)):
        gate = open_.model_copy(update={"average": average})
        assert BatchHybrid(stepper, corrector, gate=gate)(state).reasons.tolist() == [0, reason]
    for scene, (problem, reason) in enumerate(zip(scenes, (0, Reason.FEATURES), strict=True)):
        gate = open_.model_copy(update={"average": 0.5})
        one = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
        assert one(problem.rest_state()).stats["gate"] == reason, scene


def test_a_gate_lets_pass_what_it_has_no_objection_to():
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes)
    stepper = pc.BatchStepper(scenes)
    result = BatchHybrid(stepper, corrector, gate=Gate())(stepper.rest_state())
    assert result.reasons.tolist() == [0, 0]
    assert result.correction.any()


def test_a_limited_correction_is_scaled_back_until_it_passes():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = prescribed(problem, folded(problem))
    gate = Gate(margin=None, average=None, energy=None, limit=True)
    coarse = pc.ProjectiveDynamics(problem)
    result = HybridStepper(coarse, corrector, gate=gate)(problem.rest_state())
    factor = result.stats["correction_factor"]
    assert result.stats["refused"] == 0.0
    assert factor in (0.5, 0.25, 0.125)
    assert result.stats["smallest_volume_ratio"] > 0.0
    way = result.state.positions - coarse(problem.rest_state()).state.positions
    assert np.allclose(way, factor * corrector.answer, rtol=0, atol=1e-15)
    stepper = pc.BatchStepper([problem])
    many = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state())
    assert many.factors.tolist() == [factor]
    assert many.reasons.tolist() == [0]


def test_a_limit_that_does_not_suffice_refuses():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = prescribed(problem, 1e4 * folded(problem))
    gate = Gate(margin=None, average=None, energy=None, limit=True)
    coarse = pc.ProjectiveDynamics(problem)
    result = HybridStepper(coarse, corrector, gate=gate)(problem.rest_state())
    assert result.stats["gate"] == Reason.INVERSION
    assert same(result.state, coarse(problem.rest_state()).state)


def test_a_correction_may_improve_what_the_coarse_step_inverted():
    problem = pc.discretise(soft_beam(loads=[]))
    bad = pc.State(problem.positions + folded(problem), np.zeros_like(problem.positions))
    coarse = pc.ProjectiveDynamics(problem)
    answer = coarse(bad).state.positions
    corrector = prescribed(problem, 0.5 * (problem.positions - answer))
    ratio = problem.volume_ratios(answer).min()
    gate = Gate(margin=None, average=None, energy=None, volume=float(ratio) + 10.0)
    assert HybridStepper(coarse, corrector, gate=gate)(bad).stats["refused"] == 0.0
    corrector.answer = -corrector.answer
    assert HybridStepper(coarse, corrector, gate=gate)(bad).stats["gate"] == Reason.INVERSION


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_failed_coarse_step_is_not_corrected(placement):
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    corrector = prescribed(problem, bumped(problem), placement=placement)
    coarse = pc.ProjectiveDynamics(problem, 1e-13, max_iterations=1, recover=False)
    result, plain = (s(shaken(problem)) for s in (HybridStepper(coarse, corrector), coarse))
    assert not plain.status.ok
    assert result.status is plain.status
    assert same(result.state, plain.state)
    assert result.stats["gate"] == Reason.SOLVER
    assert result.stats["correction"] == 0.0


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_failed_step_of_a_batch_is_the_plain_one(placement):
    scenes = problems((3, 1, 1), (2, 2, 1))
    corrector = fitted(scenes, placement=placement)
    stepper = pc.BatchStepper(scenes, 1e-13, max_iterations=1, recover=False)
    state = stepper.state([shaken(p) for p in scenes])
    result, plain = BatchHybrid(stepper, corrector)(state), stepper(state)
    assert result.reasons.tolist() == [Reason.SOLVER] * 2
    assert torch.equal(result.state.positions, plain.state.positions)
    assert not result.correction.any()


def measured(ratios, stored=1.0, work=0.0):
    """Of scenes with some smallest det F in their cells."""
    ratios = torch.tensor(ratios, dtype=torch.float64)
    one = torch.ones(len(ratios), dtype=torch.float64)
    return Measured(ratios, stored * one, work * one)


@pytest.mark.parametrize(
    ("ratios", "passes"),
    [
        ([-1.0, 0.9], True),  # as it was
        ([-0.5, 0.9], True),  # better, though not good
        ([-1.0, -0.5], False),  # inverts a cell that was not the worst one
        ([0.5, -1e-9], False),
        ([-1.1, 0.9], False),  # worse than inverted
        ([-1.0, 0.091], True),
        ([-1.0, 0.089], False),  # below a tenth of the coarse answer's
        ([np.nan, 0.9], False),
        ([-1.0, np.nan], False),
    ],
)
def test_a_gate_looks_at_each_cell(ratios, passes):
    coarse = measured([[-1.0, 0.9, np.inf], [1.0, 1.0, 1.0]])
    answer = measured([[*ratios, np.inf], [1.0, 1.0, 1.0]])
    found = Gate().reasons(answer, coarse, None)
    assert found.tolist() == [0 if passes else Reason.INVERSION, 0]
    found = Gate().reasons(
        measured([[1.0, 1.0, 1.0], [*ratios, 1.0]]), measured([[1.0] * 3, [-1.0, 0.9, 1.0]]), None
    )
    assert found.tolist() == [0, 0 if passes else Reason.INVERSION]


def test_tests_of_volume_are_switched_off_one_by_one():
    coarse = measured([[1.0, 1.0]])
    crushed, inverted = measured([[1.0, 0.05]]), measured([[1.0, -0.5]])
    for gate, expected in (
        (Gate(crushing=None), (0, Reason.INVERSION)),
        (Gate(volume=None), (Reason.INVERSION, Reason.INVERSION)),
        (Gate(volume=None, crushing=None), (0, 0)),
        (Gate(crushing=0.05), (0, Reason.INVERSION)),
    ):
        found = [int(gate.reasons(x, coarse, None)) for x in (crushed, inverted)]
        assert found == list(expected)


def test_a_crushed_cell_refuses_a_correction():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    flat = -(problem.positions - problem.positions[0]) * [0.0, 0.0, 1.0]
    held_at = problem.positions[:, :1] / (3 * CELL)  # the held end stays
    corrector = prescribed(problem, flat * held_at)
    stepper = pc.BatchStepper([problem])
    for gate, reason in (
        (Gate(margin=None, average=None, energy=None), Reason.INVERSION),
        (Gate(margin=None, average=None, energy=None, crushing=None), Reason.NONE),
    ):
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
        assert hybrid(problem.rest_state()).stats["gate"] == reason
        many = BatchHybrid(stepper, corrector, gate=gate)(stepper.rest_state())
        assert many.reasons.tolist() == [reason]


def flying(speed=0.5):
    """A free body in uniform motion along x, and its state."""
    problem = problem_on(box_mesh((2, 1, 1), (0.04, 0.02, 0.02), 0.2))
    velocities = np.zeros_like(problem.positions)
    velocities[:, 0] = speed
    return problem, pc.State(problem.positions, velocities)


@pytest.mark.parametrize("placement", ["state", "force"])
@pytest.mark.parametrize(
    ("push", "refused"), [(0.999, False), (1.001, True), (100.0, True), (-1.5, False), (-3.1, True)]
)
def test_the_bound_on_energy_does_not_grow_with_the_correction(placement, push, refused):
    """A push of x times the way makes the energy (1 + x)^2 times as large; 4 is allowed."""
    problem, before = flying()
    way = np.zeros_like(problem.positions)
    way[:, 0] = push * problem.time_step * before.velocities[:, 0]
    corrector = prescribed(problem, way, placement=placement)
    gate = Gate(margin=None, average=None, energy=3.0)
    result = HybridStepper(pc.ProjectiveDynamics(problem, 1e-10), corrector, gate=gate)(before)
    assert result.stats["gate"] == (Reason.ENERGY if refused else 0)
    stepper = pc.BatchStepper([problem], 1e-10)
    many = BatchHybrid(stepper, corrector, gate=gate)(stepper.state([before]))
    assert many.reasons.tolist() == [Reason.ENERGY if refused else 0]


@pytest.mark.parametrize(
    ("gate", "heavier", "refused"),
    [
        (Gate(margin=None, average=None), 4.0, False),
        (Gate(margin=None, average=None), 5.89, False),
        (Gate(margin=None, average=None), 5.90, True),
        (Gate(margin=None, average=None, energy=1.0), 2.73, False),
        (Gate(margin=None, average=None, energy=1.0), 2.74, True),
    ],
)
def test_a_kick_s_right_answer_passes_where_the_coarse_mass_is_four_times_too_heavy(
    gate, heavier, refused
):
    """From rest energy less work rises by (r - 1)^2/3 of the coarse step's energy and work."""
    problem = problem_on(box_mesh((2, 1, 1), (0.04, 0.02, 0.02), 0.2))
    kick = np.zeros_like(problem.positions)
    kick[:, 0] = 10.0 * problem.mass
    result = pc.ProjectiveDynamics(problem, 1e-10)(problem.rest_state(), kick)
    way = result.state.positions - problem.positions
    corrector = prescribed(problem, (heavier - 1.0) * way)
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem, 1e-10), corrector, gate=gate)
    assert hybrid(problem.rest_state(), kick).stats["refused"] == refused


@pytest.mark.parametrize(
    ("push", "steps"), [(-0.5, ["forced"]), (0.5, ["forced", "plain"]), (9.0, ["forced", "plain"])]
)
def test_the_plain_step_is_solved_only_where_energy_rises_beyond_the_loads_work(push, steps):
    problem, before = flying()
    way = np.zeros_like(problem.positions)
    way[:, 0] = push * problem.time_step * before.velocities[:, 0]
    corrector = prescribed(problem, way, placement="force")
    taken = []

    class Counting(pc.ProjectiveDynamics):
        def __call__(self, state, forces=None, *args, **options):
            taken.append("plain" if forces is None else "forced")
            return super().__call__(state, forces, *args, **options)

    gate = Gate(margin=None, average=None, energy=3.0)
    result = HybridStepper(Counting(problem), corrector, gate=gate)(before)
    assert taken == steps
    assert result.stats["refused"] == (push == 9.0)


@pytest.mark.parametrize("push", [False, True])
def test_the_work_of_a_correction_s_forces_is_no_work_of_loads(push):
    problem = pc.discretise(soft_beam(loads=[PRESSURE]))
    corrector = prescribed(problem, bumped(problem), placement="force")
    stepper = HybridStepper(pc.ProjectiveDynamics(problem), corrector)
    before = shaken(problem)
    extra = np.full(problem.positions.shape, 1e-3) if push else None
    result = stepper(before, extra)
    loads = problem.external_forces(0.0, problem.time_step) + (0.0 if extra is None else extra)
    work = np.vdot(loads, result.state.positions - before.positions)
    assert result.stats["correction"] > 0.0
    assert result.stats["external_work"] == pytest.approx(work, rel=1e-9)
    other = stepper.coarse(before, extra).stats["external_work"]
    assert abs(other - work) > 0.1 * abs(work)


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
@pytest.mark.parametrize("integrator", ["backward-euler", "midpoint"])
def test_a_batch_s_gate_measures_what_a_single_scene_s_does(integrator, element):
    scenes = [pc.discretise(p.scene, element=element) for p in problems((3, 1, 1), (2, 2, 1))]
    corrector, shifts = fitted(scenes), [bumped(p) for p in scenes]
    stepper = pc.BatchStepper(scenes, 1e-12, integrator=integrator)
    states = [pc.State(disturbed(p, 0.1), shaken(p).velocities) for p in scenes]
    many = BatchCoarseStep(
        BatchParts(stepper, corrector, "recomputed"), stepper.state(states), None
    )
    answer = many.solved()
    many.view(answer)
    moved = many.moved(answer, torch.tensor(np.concatenate(shifts)))
    for i, (problem, state, shift) in enumerate(zip(scenes, states, shifts, strict=True)):
        coarse = pc.ProjectiveDynamics(problem, 1e-12, integrator=integrator)
        bodies = BodyGraph.of([problem], dtype=torch.float64)
        one = SingleCoarseStep(coarse, bodies, "recomputed", state)
        alone = one.solved()
        pairs = (
            (many.measured(answer), one.measured(alone), True),
            (many.measured(moved), one.measured(one.moved(alone, shift)), False),
            (many.before(), one.before(), True),
        )
        for found, expected, same_modes in pairs:
            if found is None:
                assert element == "hex8-bubble"
                continue
            count = len(problem.cells)
            ratios = found.ratios[i, :count].numpy()
            assert ratios == pytest.approx(expected.ratios[0], rel=1e-8)
            assert torch.isinf(found.ratios[i, count:]).all()
            assert float(found.work[i]) == pytest.approx(expected.work[0], rel=1e-8)
            stored, least = float(found.stored[i]), float(expected.stored[0])
            if same_modes or element == "hex8" or integrator == "midpoint":
                assert stored == pytest.approx(least, rel=1e-8)
            else:
                assert stored > least


def test_a_gate_judges_arrays_as_it_judges_tensors():
    rng, gates = np.random.default_rng(0), (Gate(), Gate(volume=None), Gate(crushing=None))
    numbers = [rng.normal(size=(40, 6)) + 1.0, *rng.normal(size=(2, 40))]
    others = [rng.normal(size=(40, 6)) + 1.0, *rng.normal(size=(2, 40))]
    numbers[0][0, 0] = others[0][1, 1] = numbers[1][2] = others[2][3] = np.nan
    arrays = Measured(*numbers), Measured(*others)
    tensors = [Measured(*map(torch.tensor, each)) for each in (numbers, others)]
    for gate in gates:
        for rise in (None, 0.0, 0.5):
            found, expected = gate.reasons(*arrays, rise), gate.reasons(*tensors, rise)
            assert found.dtype == np.int64
            assert np.array_equal(found, expected.numpy())
            assert len(set(found.tolist())) == (2 if rise is None else 3)


def test_a_corrected_step_carries_the_volume_ratios_of_its_own_state():
    problem = pc.discretise(soft_beam(loads=[TORSION]))
    hybrid = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem]))
    result = hybrid(problem.rest_state())
    assert result.stats["correction"] > 0.0
    assert np.array_equal(result.volume_ratios, problem.volume_ratios(result.state.positions))


def test_refusals_are_counted_by_reason():
    assert refusals(np.array([0.0, 1.0, 3.0, 3.0, 9.0])) == {
        "not finite": 1, "features": 0, "inversion": 2, "energy": 0, "solver": 0, "body": 0,
        "pause": 0, "folded": 0, "time step": 1,
    }  # fmt: skip


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


def test_a_state_that_the_correction_inverts_is_called_so():
    problem = pc.discretise(soft_beam())
    corrector = prescribed(problem, folded(problem))
    result = HybridStepper(pc.ProjectiveDynamics(problem), corrector)(problem.rest_state())
    assert result.status is pc.Status.INVERTED


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


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_turned_scene_has_the_turned_rollout(placement):
    turn = rotation()
    straight, turned = block(np.eye(3)), block(turn)
    torch.manual_seed(5)
    config = preset("equivariant", placement=placement)
    fit = fitted([straight], size=0.2, placement=placement, layers=3, width=32)
    corrector = Corrector(config.model_copy(update={"layers": 3, "width": 32, "mlp_layers": 2}))
    corrector.normaliser.load_state_dict(fit.normaliser.state_dict())
    runs = [
        pc.rollout(HybridStepper(pc.ProjectiveDynamics(p, 1e-9), corrector), 5)
        for p in (straight, turned)
    ]
    plain = pc.rollout(pc.ProjectiveDynamics(straight, 1e-9), 5)
    if placement != "guess":
        assert np.abs(runs[0].positions - plain.positions).max() > 1e-3 * CELL
    assert runs[0].stats["correction"].min() > 1e-4 * CELL
    assert np.abs(runs[0].positions @ turn.T - runs[1].positions).max() < 1e-5 * CELL


# --- bad input -------------------------------------------------------------------------------


def test_a_corrector_without_statistics_is_refused():
    problem = pc.discretise(soft_beam())
    corrector = Corrector(preset("compact"))
    with pytest.raises(InputError, match="seen no data"):
        HybridStepper(pc.ProjectiveDynamics(problem), corrector)
    with pytest.raises(InputError, match="seen no data"):
        BatchHybrid(pc.BatchStepper([problem]), corrector)
    with pytest.raises(InputError, match="seen no data"):
        HybridLayer(pc.BatchStepper([problem]), corrector, through_solver=True)


def test_cells_with_more_than_eight_nodes_are_refused():
    problem = pc.discretise(soft_beam(), element="hex27")
    corrector = fitted([pc.discretise(soft_beam())])
    with pytest.raises(InputError, match="27 nodes"):
        HybridStepper(pc.ProjectiveDynamics(problem), corrector)
    with pytest.raises(InputError, match="27 nodes"):
        BatchHybrid(pc.BatchStepper([problem]), corrector)


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
        HybridStepper(coarse, corrector, gate={"margin": 1.0})
    with pytest.raises(InputError, match="velocity = 'mixed'"):
        BatchHybrid(stepper, corrector, velocity="mixed")
    with pytest.raises(InputError, match="limit with placement 'force'"):
        HybridStepper(coarse, fitted([problem], placement="force"), gate=Gate(limit=True))
    for hybrid in (HybridStepper, BatchHybrid):
        part = (pc.ProjectiveDynamics if hybrid is HybridStepper else pc.BatchStepper)(
            problem if hybrid is HybridStepper else [problem], integrator="bdf2"
        )
        with pytest.raises(InputError, match="'kept' with bdf2"):
            hybrid(part, corrector, velocity="kept")


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_correction_before_of_other_bodies_is_refused(placement):
    stepper = pc.BatchStepper([pc.discretise(soft_beam())])
    corrector = fitted(stepper.problems, placement=placement)
    state, other = stepper.rest_state(), torch.zeros(3, 3, dtype=torch.float64)
    with pytest.raises(InputError, match="previous"):
        BatchHybrid(stepper, corrector)(state, other)
    layer = HybridLayer(stepper, corrector, through_solver=True)
    with pytest.raises(InputError, match="previous"):
        layer(state.positions, state.velocities, previous=other)


def test_a_state_that_is_none_is_refused():
    problem = pc.discretise(soft_beam())
    stepper = HybridStepper(pc.ProjectiveDynamics(problem), fitted([problem]))
    with pytest.raises(InputError, match="state is a"):
        stepper(problem.positions)
    with pytest.raises(InputError, match="forces has shape"):
        stepper(problem.rest_state(), np.zeros((2, 3)))


@pytest.mark.parametrize("changes", [{"margin": -1.0}, {"share": 1.0}, {"energy": float("nan")}])
def test_a_gate_without_meaning_is_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        Gate(**changes)


def gradients_beside(scenes, corrector, through_solver, spoil=None):
    """Gradients of a loss on scene 0 after two steps; ``spoil`` changes the start of scene 1."""
    stepper = pc.BatchStepper(scenes, 1e-12)
    layer = HybridLayer(stepper, corrector, through_solver=through_solver, on_failure="zero")
    start = stepper.rest_state()
    p, v, given = start.positions.clone(), start.velocities.clone(), None
    if spoil is not None:
        spoil(p, v)
        given = torch.zeros_like(layer.bodies.rest)
    loss, nodes = 0.0, len(scenes[0].positions)
    for k in range(2):
        p, v, given = layer(p, v, [k * stepper.time_step] * len(scenes), given)
        if spoil is not None and k == 0:
            assert not layer.steps.statuses[-1][1].ok
            assert not given[nodes:].any()
        assert layer.steps.statuses[-1][0].ok
        loss = loss + (p - start.positions)[0, :nodes].square().sum()
        loss = loss + given[:nodes].square().sum()
    return torch.autograd.grad(loss, list(corrector.parameters()))


def lost(p, v):
    v[1] = torch.nan


def far_away(p, v):
    v[1] = 1e200  # whose square is infinite


class Overflowing(Corrector):
    """Gives what is not finite, with such derivatives, where a body is fast."""

    def of_view(self, view):
        speed = view.snapshot.velocities.norm(dim=1, keepdim=True)
        return super().of_view(view) * torch.exp(1e6 * (speed - 100.0).clamp_min(0.0))


def fast(p, v):
    v[1] = 1e3


@pytest.mark.parametrize("through_solver", [True, False])
def test_loads_that_are_not_finite_fail_their_scene_alone(through_solver):
    scenes = problems((3, 1, 1), (2, 1, 1))
    corrector = fitted(scenes, kind=Overflowing, placement="force")
    found = gradients_beside(scenes, corrector, through_solver, fast)
    expected = gradients_beside(scenes[:1], corrector, through_solver)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, abs=1e-3 * float(other.abs().max()))
    stepper = pc.BatchStepper(scenes)
    layer = HybridLayer(stepper, corrector, through_solver=through_solver)
    start = stepper.rest_state()
    fast(start.positions, start.velocities)
    with pytest.raises(InputError, match="forces"):
        layer(start.positions, start.velocities)


@pytest.mark.parametrize("spoil", [lost, far_away])
@pytest.mark.parametrize("through_solver", [True, False])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_scene_whose_step_fails_has_no_part_in_the_derivatives(placement, through_solver, spoil):
    scenes = problems((3, 1, 1), (2, 1, 1))
    names = (*preset("compact").node_features, "previous-correction")
    corrector = fitted(scenes, placement=placement, node_features=names)
    found = gradients_beside(scenes, corrector, through_solver, spoil)
    expected = gradients_beside(scenes[:1], corrector, through_solver)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, abs=1e-3 * float(other.abs().max()))
    assert any(g.any() for g in found)

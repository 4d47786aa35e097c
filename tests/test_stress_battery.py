"""How the stress battery judges a run: distances from what has to be reached, and verdicts."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import rotation
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.plan import make_plan
from pdcorrect.scene import trained_coarse

VALIDATION = Path(__file__).parents[1] / "validation"
sys.path.insert(0, str(VALIDATION))
import harness  # noqa: E402

CASE = harness.Case(VALIDATION / "stress")
BATTERY = CASE.module
SCENES = {scenario.name: scenario for scenario in BATTERY.BATTERY}
SOLVERS, MODELS, NO_GATE = BATTERY.SOLVERS, BATTERY.MODELS, "no gate"


def run_of(scenario, *frames, statuses=("CONVERGED",), iterations=(3,)):
    """A made-up run through positions (N, 3)."""
    problem = pc.discretise(scenario.scene)
    shown = [f(problem) for f in frames]
    found = [pc.Status[name] for name in statuses]
    return BATTERY.Run(problem, np.stack(shown), found, list(iterations), [0] * len(found))


def at_rest(problem):
    return problem.positions


def pushed(by, nodes=slice(None)):
    def place(problem):
        out = problem.positions.copy()
        out[nodes] += by
        return out

    return place


def judged(scenario, solver):
    """Names of the figures that are expected of a run; nothing is of one without a gate."""
    if solver == NO_GATE:
        return set()
    finer = scenario.finer and solver in MODELS
    found = {"error above PD best's" if finer else "distance", "status"}
    if scenario.name == "cross ordinary" and solver in MODELS:
        found.add("accepted")
    if solver == BATTERY.LEARNED:
        found.add("beside PD enhanced")
    return {f"{scenario.name}, {solver}, {what}" for what in found}


def test_every_scene_and_solver_has_an_expectation_and_there_are_no_others():
    names = {
        name
        for scenario in SCENES.values()
        for solver in (scenario.solvers or SOLVERS)
        for name in judged(scenario, solver)
    }
    assert set(CASE.expected) == names
    quick = {name for name, aim in CASE.expected.items() if aim.quick}
    assert quick == {name for name in names if SCENES[name.split(",")[0]].quick}


def test_the_distance_from_rest_is_in_cells_and_of_no_number_is_far():
    found = run_of(SCENES["plane"], at_rest, pushed([0.0, 0.03, 0.04], nodes=7))
    assert BATTERY.distance(SCENES["plane"], found, None) == pytest.approx(1.0)
    found = run_of(SCENES["plane"], at_rest, pushed([np.nan, 0.0, 0.0], nodes=3))
    assert BATTERY.distance(SCENES["plane"], found, None) == BATTERY.UNDEFINED


def test_a_free_body_may_move_rigidly_but_not_change_its_shape():
    scenario, turn = SCENES["no clamp"], rotation()
    rigid = run_of(scenario, at_rest, lambda p: p.positions @ turn.T + [3.0, -2.0, 1.0])
    assert BATTERY.distance(scenario, rigid, None) < 1e-12
    mirrored = run_of(scenario, at_rest, lambda p: p.positions * [1.0, 1.0, -1.0])
    assert BATTERY.distance(scenario, mirrored, None) > 1.0
    longer = run_of(scenario, at_rest, lambda p: p.positions * [1.1, 1.0, 1.0])
    assert BATTERY.distance(scenario, longer, None) == pytest.approx(0.05 * 0.3 / 0.05)


def test_of_two_bodies_the_held_one_may_not_move():
    scenario = SCENES["two bodies"]
    problem = pc.discretise(scenario.scene)
    free = problem.positions[:, 0] > 0.25
    assert 0 < free.sum() < len(free)
    moved = run_of(scenario, at_rest, pushed([0.0, 0.0, 0.5], nodes=free))
    assert BATTERY.distance(scenario, moved, None) < 1e-12
    moved = run_of(scenario, at_rest, pushed([0.0, 0.0, 0.05], nodes=~free))
    assert BATTERY.distance(scenario, moved, None) == pytest.approx(1.0)


def test_a_motion_is_compared_in_all_frames_with_the_largest_displacement_as_unit():
    scenario = SCENES["1 cell"]
    truth = run_of(scenario, at_rest, pushed([0.0, 0.0, 0.5]), pushed([0.0, 0.0, 0.1]))
    found = run_of(scenario, at_rest, pushed([0.0, 0.0, 0.55]), pushed([0.0, 0.0, 0.1]))
    assert BATTERY.distance(scenario, found, truth) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("statuses", "iterations", "far", "word"),
    [
        (["CONVERGED", "CONVERGED"], [3, 200], 1e-4, "pass"),
        (["CONVERGED", "CONVERGED"], [201, 3], 1e-4, "slow"),
        (["SUBSTEPPED", "CONVERGED"], [3, 3], 1e-4, "slow"),
        (["INVERTED", "CONVERGED"], [3, 3], 1e-4, "pass"),
        (["CONVERGED", "INVERTED"], [3, 3], 1e-4, "fail"),
        (["LINE_SEARCH", "CONVERGED"], [3, 3], 1e-4, "fail"),
        (["CONVERGED", "CONVERGED"], [3, 3], 1e-2, "fail"),
    ],
)
def test_verdicts(statuses, iterations, far, word):
    """A failed step counts wherever it is, inverted cells at the end."""
    scenario, cell = SCENES["plane"], 0.05
    end = pushed([far * cell, 0.0, 0.0], nodes=9)
    found = run_of(scenario, at_rest, end, statuses=statuses, iterations=iterations)
    figures = BATTERY.figures_of(scenario, "PD", found, None)
    assert BATTERY.verdict("PD", found, figures) == word
    # Newton is slow sooner
    found = run_of(SCENES["plane"], at_rest, at_rest, iterations=[31])
    figures = BATTERY.figures_of(SCENES["plane"], "Newton", found, None)
    assert BATTERY.verdict("Newton", found, figures) == "slow"


def test_rest_is_a_minimum_and_a_strained_body_is_not_in_balance():
    problem_at_rest = run_of(SCENES["plane"], at_rest, at_rest)
    force, softest, ratio, corner = BATTERY.minimum(problem_at_rest)
    assert force < 1e-12
    assert (softest, ratio, corner) == pytest.approx((1.0, 1.0, 1.0))
    strained = run_of(SCENES["plane"], at_rest, lambda p: p.positions * [1.5, 1.0, 1.0])
    assert BATTERY.minimum(strained)[0] > 0.01


def test_starts_keep_what_is_clamped():
    for name in ("point", "random 50", "inside-out"):
        scenario = SCENES[name]
        problem = pc.discretise(scenario.scene)
        state = scenario.state(problem)
        np.testing.assert_array_equal(
            state.positions[~problem.free], problem.positions[~problem.free]
        )
        assert np.abs(state.positions - problem.positions).max() > problem.cell_size


def test_the_reversing_load_turns_round_at_every_step():
    problem = pc.discretise(SCENES["reversal"].scene)
    first, second = (SCENES["reversal"].forces(problem, k) for k in (0, 1))
    np.testing.assert_array_equal(first, -second)
    assert first.sum(axis=0)[2] == pytest.approx(-100.0 * problem.mass.sum())
    scenario = SCENES["cross reversal 10"]
    problem = pc.discretise(scenario.scene)
    load = problem.external_forces(0.0, problem.time_step)
    for step, sign in ((0, 1.0), (1, -1.0), (2, 1.0)):
        np.testing.assert_allclose(load + scenario.forces(problem, step), sign * load)


def test_a_solver_that_fails_is_seen_as_failing(monkeypatch):
    """The battery as a whole, with a stepper that stops after one iteration."""
    solvers = ("PD", BATTERY.ENHANCED, BATTERY.LEARNED, "Newton")
    scenario = replace(SCENES["1 cell"], solvers=solvers)
    make = {**BATTERY.run.__globals__["MAKE"]}
    make["PD"] = lambda problem: pc.ProjectiveDynamics(problem, max_iterations=0, recover=False)
    monkeypatch.setitem(BATTERY.run.__globals__, "MAKE", make)
    outcome = BATTERY.part(scenario)
    row = dict(zip(outcome.tables[0].headings, outcome.tables[0].rows[0], strict=True))
    assert row["PD"].startswith("fail")
    assert row["Newton"].startswith("pass")
    assert outcome.figures["1 cell, PD, status"] == "ITERATION_LIMIT"


# --- the learned element beside the best coarse model -------------------------------------------


def test_the_learned_element_and_the_best_coarse_model_are_those_of_scenes():
    make, solvers = sys.modules["solvers"].problem_of, ("PD", BATTERY.ENHANCED, BATTERY.LEARNED)
    found = [make(SCENES["1 cell"], solver).element for solver in solvers]
    assert found == ["hex8", "hex8-enhanced", "hex8-learned"]


@pytest.mark.parametrize(
    ("mine", "its", "word"),
    [(0.0, 0.0, "both"), (0.0, 1.0, "won"), (1.0, 0.0, "lost"), (1.0, 1.0, "neither")],
)
def test_a_scene_is_lost_if_only_the_best_coarse_model_reaches_what_it_has_to(mine, its, word):
    scenario = SCENES["plane"]
    learned, best = (
        BATTERY.figures_of(scenario, s, run_of(scenario, at_rest, pushed([far, 0.0, 0.0])), None)
        for s, far in ((BATTERY.LEARNED, mine), (BATTERY.ENHANCED, its))
    )
    assert BATTERY.beside(learned, best) == word
    wanted = CASE.expected["plane, PD learned, beside PD enhanced"]
    assert wanted.met_by(word) == (word != "lost")


def test_the_share_of_cells_that_are_learned_is_told():
    rows = {}
    for name in ("1 cell", "slivers"):
        truth = BATTERY.Truth(SCENES[name])
        figures = {s: truth.figures(s) for s in (BATTERY.ENHANCED, BATTERY.LEARNED)}
        rows[name] = BATTERY.learned(truth, figures, "both")[1][0]
    assert [row[-2:] for row in rows.values()] == [("both", 100.0), ("both", 0.0)]


# --- crosses that the torsion model knows ------------------------------------------------------


def test_the_cross_is_drawn_as_those_of_training_and_none_of_them():
    module = sys.modules["crosses"]
    config = DatasetConfig.load(module.DATASET / "config.toml")
    assert config.seed != module.SEED
    mesh = make_plan(config.model_copy(update={"seed": module.SEED}))[module.MESH]
    assert mesh.design.key() not in {plan.design.key() for plan in make_plan(config)}
    material, ranges = module.CROSS.material, config.material
    for name in ("young", "poisson", "density"):
        low, high = getattr(ranges, name)
        assert low <= getattr(material, name) <= high
    low, high = config.motion.strength
    assert low <= abs(module.CROSS.loads[0].strength) / material.density <= high


def test_the_model_knows_the_cross_at_rest_and_not_with_its_far_end_held():
    found = pc.load_model("torsion-exact")
    for name, known in (("cross ordinary", True), ("cross plane", True), ("cross turned", False)):
        problem = pc.discretise(trained_coarse(SCENES[name].scene))
        bodies = BodyGraph.of([problem], dtype=torch.float64)
        assert (found.corrector.envelope.rest_score(bodies) <= pc.Gate().outside) == known


def test_the_twisted_cross_has_its_ends_where_they_were_and_its_middle_upside_down():
    problem = pc.discretise(SCENES["cross twisted"].scene)
    rest, start = problem.positions, SCENES["cross twisted"].state(problem).positions
    along = rest[:, 0] / rest[:, 0].max()
    ends = (along == 0.0) | (along == 1.0)
    np.testing.assert_allclose(start[ends], rest[ends], atol=1e-12)
    edges = np.linalg.norm(rest[:, 1:] - 0.05, axis=1)
    np.testing.assert_allclose(np.linalg.norm(start[:, 1:] - 0.05, axis=1), edges, atol=1e-12)
    assert np.abs(start - rest).max() > 0.1


def test_hybrids_in_motion_are_held_against_the_finer_mesh_and_pd_best():
    scenario = SCENES["cross ordinary"]
    truth = run_of(scenario, at_rest, pushed([0.0, 0.0, 0.5]))
    best = run_of(scenario, at_rest, pushed([0.0, 0.0, 0.45]))
    name = "cross ordinary, hybrid torsion"
    for end, above in ((0.48, 0.0), (0.55, 0.0), (0.4, 0.1)):
        hybrid = run_of(scenario, at_rest, pushed([0.0, 0.0, end]))
        figures = BATTERY.figures_of(scenario, "hybrid torsion", hybrid, truth, best)
        assert figures[f"{name}, error above PD best's"] == pytest.approx(above)
        assert figures[f"{name}, accepted"] == 1.0
    lost = run_of(scenario, at_rest, pushed([0.0, 0.0, np.nan]))
    figures = BATTERY.figures_of(scenario, "hybrid torsion", lost, truth, best)
    assert BATTERY.verdict("hybrid torsion", lost, figures) == "fail"


def test_the_matrix_tells_folded_corners_and_the_share_corrected():
    scenario = SCENES["cross plane"]

    def folded(problem):
        out, corner = problem.positions.copy(), int(problem.positions.sum(axis=1).argmax())
        out[corner] -= 0.4 * problem.cell_size  # past the plane of its three neighbours
        return out

    found = run_of(scenario, at_rest, folded)
    found = replace(found, refused=[1, 0, 0, 0])
    figures = BATTERY.figures_of(scenario, "hybrid torsion", found, None)
    cell = BATTERY.cell(scenario, "hybrid torsion", found, figures)
    assert cell.endswith("folded corner, 75% corrected")
    figures = BATTERY.figures_of(scenario, NO_GATE, found, None)
    assert BATTERY.cell(scenario, NO_GATE, found, figures).startswith("converged ")


def test_where_runs_part_the_better_answer_has_less_of_the_objective():
    scenario = SCENES["1 cell"]
    found = BATTERY.run(scenario, "Newton")
    other = found.positions.copy()
    other[3:, -1] += 0.1 * found.problem.cell_size
    frame, apart, mine, its, curvature, _ = BATTERY.parting(
        scenario, found, replace(found, positions=other)
    )
    assert frame == 3
    assert apart == pytest.approx(0.1 * np.sqrt(3.0))
    assert mine < its
    assert curvature > 0.0
    assert BATTERY.parting(scenario, found, found) is None

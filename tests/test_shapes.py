"""Measures of bodies at rest, and a gate that knows bodies by them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pdcorrect as pc
from conftest import beam, box_mesh, held, problem_on, rotation
from hybrid_samples import TORSION, Watched, fitted, problems, soft_beam
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.bodies import SHAPE_MEASURES, BodyGraph
from pdcorrect.corrector.corrector import Corrector, preset
from pdcorrect.corrector.gate import Gate, Reason
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.normaliser import RunningMoments
from pdcorrect.fem.mesh import voxel_mesh

ONLY_BODIES = Gate(crushing=None, energy=None)


def measured(*several):
    """Measures by name, (B,) each."""
    shapes = BodyGraph.of(several, 0.01, dtype=torch.float64).shapes
    return dict(zip(SHAPE_MEASURES, shapes.numpy().T, strict=True))


def cantilever(cells=(4, 1, 1), **changes):
    return pc.discretise(beam(cells, **changes))


# --- measures ----------------------------------------------------------------------------------


def test_a_cantilever_of_four_cells_has_the_measures_that_one_can_count():
    found = {name: float(value[0]) for name, value in measured(cantilever()).items()}
    gyration = 2.0 + 0.25 + 0.25  # variances of 0 ... 4, and of 0 and 1 twice
    assert found == pytest.approx({
        "nodes": np.log(20), "largest radius": np.log(np.sqrt(2.0)),
        "middle radius": np.log(0.5), "smallest radius": np.log(0.5),
        "volume to surface": np.log(4 / 18), "supported": np.log(4 / 20), "fixity": 0.0,
        "distance": np.log1p(2.0), "overhang": 2.0 / np.sqrt(gyration),
        "spread": np.log1p(np.sqrt(0.5)),
    }, abs=1e-12)  # fmt: skip


def test_a_beam_held_at_both_ends_hangs_over_nothing_and_its_supports_are_far_apart():
    ends = [{"plane": "x", "at": at} for at in ("min", "max")]
    clamps = [{"region": region} for region in ends]
    found = measured(cantilever((6, 1, 1)), cantilever((6, 1, 1), clamps=clamps))
    one, both = ({name: value[k] for name, value in found.items()} for k in range(2))
    assert both["overhang"] == pytest.approx(0.0, abs=1e-12)
    assert both["spread"] == pytest.approx(np.log1p(np.sqrt(9.5)))
    assert both["distance"] == pytest.approx(np.log1p(9 / 7))
    assert one["overhang"] > 1.0
    assert both["supported"] == pytest.approx(one["supported"] + np.log(2.0))
    for name in SHAPE_MEASURES[:5]:  # of the shape alone
        assert both[name] == one[name]


def test_measures_do_not_depend_on_place_orientation_units_or_numbering(rng):
    mesh = box_mesh((4, 2, 1), (0.08, 0.04, 0.02), distortion=0.2)
    nodes = np.flatnonzero(mesh.positions[:, 0] < 1e-9)

    def of(positions, cells, fixed):
        problem = problem_on(replace(mesh, positions=positions, cells=cells))
        return measured(held(problem, fixed, problem.positions))

    new = rng.permutation(len(mesh.positions))
    positions = np.empty_like(mesh.positions)
    positions[new] = 70.0 * mesh.positions @ rotation().T + [3.0, -2.0, 9.0]
    cells = new[mesh.cells][rng.permutation(len(mesh.cells))]
    before, after = of(mesh.positions, mesh.cells, nodes), of(positions, cells, new[nodes])
    for name in SHAPE_MEASURES:
        assert after[name] == pytest.approx(before[name], abs=1e-9), name


def test_bodies_of_a_batch_have_the_measures_of_single_ones():
    several = [cantilever(), cantilever((3, 3, 2)), cantilever((2, 2, 2), clamps=[])]
    together = measured(*several)
    for k, one in enumerate(several):
        for name, value in measured(one).items():
            assert together[name][k] == pytest.approx(float(value[0]), abs=1e-12), name


def test_a_body_that_nothing_holds_has_finite_measures_and_others_than_a_held_one():
    found = measured(cantilever(), cantilever(clamps=[]))
    assert all(np.isfinite(value).all() for value in found.values())
    for name in ("fixity", "distance", "overhang", "spread"):
        assert found[name][1] == 0.0
    assert found["supported"][0] - found["supported"][1] > 5.0


def loose_end(cells):
    """A bar held at one end, with one cell missing."""
    there = np.ones((cells, 1, 1), dtype=bool)
    there[cells // 2] = False
    problem = problem_on(voxel_mesh(there, (0, 0, 0), 1.0))
    return held(problem, np.flatnonzero(problem.positions[:, 0] < 1e-9), problem.positions)


def test_a_node_without_a_path_to_a_support_is_farther_than_any_other():
    found = measured(loose_end(7))
    assert found["distance"] == pytest.approx(np.log1p(((0 + 1 + 2 + 3) * 4 + 16 * 64) / 32))
    whole = problem_on(voxel_mesh(np.ones((7, 1, 1), dtype=bool), (0, 0, 0), 1.0))
    whole = held(whole, np.flatnonzero(whole.positions[:, 0] < 1e-9), whole.positions)
    assert found["distance"][0] - measured(whole)["distance"][0] > 1.5


def test_supports_that_slide_are_less_fixed_than_clamps():
    problem = cantilever(clamps=[])
    for components, share in (([0], 1 / 3), ([0, 1], 2 / 3), ([0, 1, 2], 1.0)):
        free = problem.free.copy()
        free[np.ix_(problem.positions[:, 0] < 1e-9, components)] = False
        found = measured(replace(problem, clamps=replace(problem.clamps, free=free)))
        assert found["supported"] == pytest.approx(np.log(4 / 20))
        assert found["fixity"] == pytest.approx(np.log(share))
        assert found["spread"] == pytest.approx(np.log1p(np.sqrt(0.5)))


def test_measures_do_not_need_derivatives_or_double_precision():
    body = BodyGraph.of([cantilever((3, 2, 2))])
    exact = BodyGraph.of([cantilever((3, 2, 2))], dtype=torch.float64).shapes
    assert body.shapes.dtype == torch.float32
    torch.testing.assert_close(body.shapes.double(), exact, rtol=0, atol=1e-5)
    moving = replace(body, rest=body.rest.clone().requires_grad_())
    assert torch.equal(moving.shapes, body.shapes)


def test_bodies_of_one_cell_and_flat_ones_have_finite_measures():
    for body in (cantilever((1, 1, 1)), problem_on(box_mesh((2, 2, 1), (2.0, 2.0, 1e-6)))):
        assert all(np.isfinite(value).all() for value in measured(body).values())


# --- ranges ------------------------------------------------------------------------------------


def ranged(*several):
    """A corrector that knows some bodies, otherwise without values."""
    corrector, shapes = Corrector(preset("compact", layers=1, width=8)), RunningMoments()
    shapes.add(BodyGraph.of(several, 0.01, dtype=torch.float64).shapes)
    corrector.envelope.fit({"shape": shapes})
    return corrector


def excess(corrector, *several):
    shapes = BodyGraph.of(several, 0.01, dtype=torch.float64).shapes
    return corrector.envelope.shape_excess(shapes).amax(dim=1).tolist()


def test_what_lies_between_two_known_bodies_is_known_and_what_is_larger_by_how_much_it_is():
    short, middle, long, longer = (cantilever((n, 2, 2)) for n in (4, 6, 8, 16))
    corrector = ranged(short, long)
    assert max(excess(corrector, short, middle, long)) < 1e-12
    (found,) = excess(corrector, longer)
    radii = measured(long, longer)["largest radius"]
    assert found == pytest.approx(radii[1] - radii[0], abs=1e-12)
    assert 0.6 < found < np.log(2.0)


def test_nobody_is_known_before_bodies_were_fitted_and_further_data_widen_the_range():
    corrector = Corrector(preset("compact", layers=1, width=8))
    assert excess(corrector, cantilever()) == [np.inf]
    unknown = torch.full((1, len(SHAPE_MEASURES)), torch.nan, dtype=torch.float64)
    one, other = cantilever((4, 1, 1)), cantilever((3, 3, 3), clamps=[])
    corrector, shapes = ranged(one), RunningMoments()
    assert corrector.envelope.shape_excess(unknown).isposinf().all()
    assert excess(corrector, other)[0] > 1.0
    shapes.add(BodyGraph.of([other], dtype=torch.float64).shapes)
    corrector.envelope.widen({"shape": shapes})
    assert excess(corrector, one, other) == [0.0, 0.0]


# --- the gate ----------------------------------------------------------------------------------


def test_an_out_of_distribution_body_keeps_its_coarse_steps_and_the_network_is_not_asked():
    known = problems((3, 1, 1))
    corrector = fitted(known, kind=Watched)
    scene = soft_beam((6, 1, 1), loads=[TORSION])
    coarse = pc.ProjectiveDynamics(pc.discretise(scene))
    hybrid = HybridStepper(coarse, corrector, gate=Gate()).prepare()
    run, plain = pc.rollout(hybrid, 5), pc.rollout(coarse, 5)
    assert np.array_equal(run.positions, plain.positions)
    assert run.stats["gate"].tolist() == [Reason.OUTSIDE] * 5
    assert run.stats["refused"].tolist() == [1.0] * 5
    assert not run.stats["correction"].any()
    assert corrector.calls == 0
    others = [pc.discretise(soft_beam(cells, loads=[TORSION])) for cells in ((6, 1, 1), (3, 3, 3))]
    stepper = pc.BatchStepper(others)
    result = BatchHybrid(stepper, corrector, gate=Gate())(stepper.rest_state())
    assert result.reasons.tolist() == [Reason.OUTSIDE] * 2
    assert not result.correction.any()
    assert corrector.calls == 0
    known_body = HybridStepper(pc.ProjectiveDynamics(known[0]), corrector, gate=Gate())
    assert known_body(known[0].rest_state()).stats["gate"] == 0.0
    assert corrector.calls == 1


def test_a_longer_body_is_beyond_the_range_by_its_size_and_its_hybrid_refuses_it():
    known = problems((3, 1, 1), (5, 1, 1))
    corrector = fitted(known)

    def beyond(problem):
        """Measures outside of their ranges, by name."""
        shapes = BodyGraph.of([problem], dtype=torch.float64).shapes
        far = corrector.envelope.shape_excess(shapes)[0].tolist()
        return {name: x for name, x in zip(SHAPE_MEASURES, far, strict=True) if x > 0.0}

    assert beyond(known[0]) == beyond(known[1]) == {}
    longer = pc.discretise(soft_beam((12, 1, 1), loads=[TORSION]))
    found = beyond(longer)
    assert found["nodes"] == pytest.approx(np.log(52 / 24))
    assert {"largest radius", "supported", "distance"} < set(found)
    assert "smallest radius" not in found
    assert max(found.values()) == pytest.approx(excess(corrector, longer)[0])
    hybrid = HybridStepper(pc.ProjectiveDynamics(longer), corrector, gate=Gate()).prepare()
    assert hybrid(longer.rest_state()).stats["gate"] == Reason.OUTSIDE


@pytest.mark.parametrize("recorded", [False, True])
def test_a_batch_refuses_the_out_of_distribution_body_and_not_the_others(recorded):
    known, strange = problems((3, 1, 1)), pc.discretise(soft_beam((6, 1, 1), loads=[TORSION]))
    corrector = fitted(known)
    stepper = pc.BatchStepper([known[0], strange])
    hybrid = BatchHybrid(stepper, corrector, gate=ONLY_BODIES, recorded=recorded)
    result, plain = hybrid(stepper.rest_state()), stepper(stepper.rest_state()).state
    assert result.reasons.tolist() == [0, Reason.OUTSIDE]
    for found, expected in (
        (result.state.positions, plain.positions), (result.state.velocities, plain.velocities)
    ):  # fmt: skip
        assert torch.equal(found[1], expected[1])
        assert not torch.equal(found[0], expected[0])
    assert not result.correction[len(known[0].positions) :].any()
    assert result.correction.any()


def unlike_supports():
    """A bar as it was trained on, but free, on sliding supports, or with a loose end."""
    whole = pc.discretise(soft_beam((8, 1, 1), loads=[]))
    sliding = whole.free.copy()
    sliding[:, 1:] = True
    return {
        "free": pc.discretise(soft_beam((8, 1, 1), loads=[], clamps=[])),
        "sliding": replace(whole, clamps=replace(whole.clamps, free=sliding)),
        "loose": loose_end(9),
    }


@pytest.mark.parametrize("kind", ["free", "sliding", "loose"])
def test_a_known_shape_on_unknown_supports_is_refused(kind):
    corrector = ranged(*(pc.discretise(soft_beam((n, 1, 1))) for n in (6, 12)))
    assert max(excess(corrector, pc.discretise(soft_beam((8, 1, 1))))) < 1e-12
    body = BodyGraph.of([unlike_supports()[kind]], 0.01, dtype=torch.float64)
    assert corrector.envelope.shape_excess(body.shapes).max() > 0.3


def test_the_bound_on_bodies_is_an_argument():
    corrector = fitted(problems((3, 1, 1)))
    problem = pc.discretise(soft_beam((4, 1, 1), loads=[TORSION]))
    (away,) = excess(corrector, problem)
    assert float(corrector.rest_score(BodyGraph.of([problem], dtype=torch.float64))) == (
        pytest.approx(away / 0.3)
    )
    for bound, reason in ((3.0 * away, Reason.OUTSIDE), (1e6, 0), (None, 0)):
        gate = ONLY_BODIES.model_copy(update={"outside": bound})
        hybrid = HybridStepper(pc.ProjectiveDynamics(problem), corrector, gate=gate)
        assert hybrid(problem.rest_state()).stats["gate"] == reason, bound


def test_a_correction_that_is_not_a_number_does_not_hide_an_out_of_distribution_body():
    known, strange = problems((3, 1, 1)), pc.discretise(soft_beam((6, 1, 1), loads=[TORSION]))
    corrector = fitted(known)
    corrector.of_view = lambda view: torch.full_like(view.bodies.rest, torch.nan)
    stepper = pc.BatchStepper([known[0], strange])
    result = BatchHybrid(stepper, corrector, gate=Gate())(stepper.rest_state())
    assert result.reasons.tolist() == [Reason.NOT_FINITE, Reason.OUTSIDE]


def test_measures_are_kept_where_only_the_material_changes():
    body = BodyGraph.of([cantilever()], dtype=torch.float64)
    shapes = body.shapes
    cells = torch.ones(len(body.cells))
    other = body.with_material(2.0 * body.mass, cells, 0.3 * cells, cells)
    assert other.shapes is shapes

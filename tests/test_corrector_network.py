"""Frames, features, network, normaliser and built-in physics of the corrector."""

import math
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")

from torch.utils.flop_counter import FlopCounterMode  # noqa: E402

import network_samples as samples  # noqa: E402
from block_meshes import o_grid, spokes, warped  # noqa: E402
from conftest import beam, problem_on, rotation  # noqa: E402
from network_samples import SIZE, STEP, tensor  # noqa: E402
from pdcorrect import discretise  # noqa: E402
from pdcorrect.corrector import features, frames, rotations  # noqa: E402
from pdcorrect.corrector import model_io as cost
from pdcorrect.corrector.bodies import BodyGraph  # noqa: E402
from pdcorrect.corrector.config import PRESETS, CorrectorConfig, preset  # noqa: E402
from pdcorrect.corrector.corrector import Corrector, without_momentum  # noqa: E402
from pdcorrect.corrector.features import (  # noqa: E402
    EDGE_FEATURES,
    NODE_FEATURES,
    Snapshot,
    View,
)
from pdcorrect.corrector.network import MLP, MeshGraphNetwork, MessageLayer  # noqa: E402
from pdcorrect.corrector.normaliser import Moments, Normaliser  # noqa: E402
from pdcorrect.data.reader import TrajectoryDataset  # noqa: E402
from pdcorrect.errors import InputError  # noqa: E402
from reader_samples import shard, write  # noqa: E402

WORLD_NODES = ("young", "poisson", "density", "time-step", "velocity", "force", "node-type")
FRAME_NODES = tuple(name for name in NODE_FEATURES if name not in WORLD_NODES)
FRAME_EDGES = ("rest-edge", "stretch", "motion", "turn")
ALL = {**NODE_FEATURES, **EDGE_FEATURES}


def value(name, view):
    return ALL[name][1](view)


def largest(x):
    return float(x.detach().abs().max())


def sample(**options):
    bodies = samples.body(**options)
    return bodies, samples.moving(bodies)


# --- frames ----------------------------------------------------------------------------


def matrices(kind, count=200):
    rng = np.random.default_rng(len(kind))
    if kind == "random":
        found = rng.normal(size=(count, 3, 3))
        return found * np.sign(np.linalg.det(found))[:, None, None]
    stretches = {
        "near a rotation": rng.uniform(0.99, 1.01, (count, 3)),
        "stretched": rng.uniform(0.05, 20.0, (count, 3)),
        "nearly flat": np.stack([np.ones(count), rng.uniform(0.5, 1, count),
                                 rng.uniform(2e-3, 1e-2, count)], axis=1),
        "tiny": rng.uniform(0.5e-9, 1e-9, (count, 3)),
    }[kind]  # fmt: skip
    U, V = (np.stack([rotation(int(s)) for s in rng.integers(10**9, size=count)]) for _ in "ab")
    return U * stretches[:, None, :] @ V


@pytest.mark.parametrize("kind", ["random", "near a rotation", "stretched", "nearly flat", "tiny"])
def test_rotations_are_those_of_the_singular_value_decomposition(kind):
    M = matrices(kind)
    s = np.linalg.svd(M, compute_uv=False)
    kept = np.linalg.det(M) > 2e-3 * (s**2).sum(axis=1) ** 1.5 / 3**1.5
    assert kept.mean() > 0.5
    M = M[kept]
    R = rotations.polar_rotations(tensor(M)).numpy()
    U, _, V = np.linalg.svd(M)
    np.testing.assert_allclose(
        R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_allclose(R, U @ V, atol=1e-12 * (s[kept, 0] / s[kept, 2]).max())


@pytest.mark.parametrize("kind", ["random", "near a rotation", "stretched", "nearly flat", "tiny"])
def test_rotations_one_by_one_are_those_of_all_together(kind):
    M = tensor(np.concatenate([matrices(kind), list(UNUSABLE.values()), [np.full((3, 3), np.nan)]]))
    assert largest(rotations.polar_rotations(M) - rotations.together(M)) < 1e-13


def test_rotations_in_single_precision_are_rotations():
    M = torch.as_tensor(matrices("stretched"), dtype=torch.float32)
    R = rotations.polar_rotations(M)
    assert R.dtype == torch.float32
    assert largest(R @ R.transpose(1, 2) - torch.eye(3)) < 1e-5


UNUSABLE = {
    "mirrored": np.diag([1.0, 1.0, -1.0]),
    "flat": np.diag([1.0, 1.0, 0.0]),
    "nearly flat": np.diag([1.0, 1.0, 1e-5]),
    "collapsed": np.zeros((3, 3)),
    "a line": np.diag([1.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("kind", UNUSABLE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_there_is_no_rotation_of_what_is_flat_or_mirrored(kind, dtype):
    good = rotation()
    M = torch.as_tensor(np.stack([UNUSABLE[kind], 2.0 * good]), dtype=dtype).requires_grad_()
    R = rotations.polar_rotations(M)
    assert torch.equal(R[0], torch.eye(3, dtype=dtype))
    assert largest(R[1] - torch.as_tensor(good, dtype=dtype)) < 1e-6
    (gradient,) = torch.autograd.grad((R * torch.arange(9.0).reshape(3, 3)).sum(), M)
    assert torch.equal(gradient[0], torch.zeros(3, 3, dtype=dtype))
    assert torch.isfinite(gradient).all()
    assert gradient[1].any()


def test_derivatives_of_rotations_are_right():
    M = tensor(matrices("stretched")[:4] / 10 + np.eye(3)).requires_grad_()
    assert torch.autograd.gradcheck(rotations.polar_rotations, (M,), eps=1e-6, atol=1e-7)
    tiny = (1e-6 * M).detach().requires_grad_()
    weights = tensor(np.random.default_rng(3).normal(size=M.shape))
    (one,) = torch.autograd.grad((rotations.polar_rotations(M) * weights).sum(), M)
    (other,) = torch.autograd.grad((rotations.polar_rotations(tiny) * weights).sum(), tiny)
    torch.testing.assert_close(1e-6 * other, one)


def test_axes_of_a_cell_are_the_means_of_its_edges():
    F = np.array([[2.0, 0.3, 0.0], [0.1, 1.0, 0.2], [0.0, -0.4, 0.5]])
    bodies = samples.body((2, 1, 1), distortion=0.0)
    axes = frames.cell_axes(bodies.rest @ tensor(F).T + 3.0, bodies.cells)
    np.testing.assert_allclose(axes, np.broadcast_to(SIZE * F, (2, 3, 3)), atol=1e-14)
    warped_cell = bodies.rest.clone()
    warped_cell[bodies.cells[0, 6], 0] += 0.04  # its end of one edge along x of four
    np.testing.assert_allclose(
        frames.cell_axes(warped_cell, bodies.cells)[0, 0], [SIZE + 0.01, 0.01, 0.01], atol=1e-14
    )


def test_a_node_takes_the_mean_of_its_cells():
    bodies = samples.body((2, 1, 1), distortion=0.0)
    x = bodies.rest.clone()
    x[x[:, 0] > 1.5 * SIZE, 0] += 0.5 * SIZE  # the second cell is half as long again
    F = frames.node_gradients(x, bodies.rest_inverses, bodies.cells, bodies.cell_counts)
    expected = 1.0 + 0.25 * (bodies.rest[:, 0] / SIZE).round()
    assert torch.allclose(F[:, 0, 0], expected)
    assert torch.allclose(frames.node_axes(x, bodies.cells, bodies.cell_counts), SIZE * F)


def blocks():
    return {"o-grid": o_grid(), "spokes": spokes(5), "warped": warped(o_grid())}


@pytest.mark.parametrize("name", ["box", *blocks()])
def test_frames_turn_with_the_scene_and_with_the_body(name):
    bodies, step = sample(mesh=blocks().get(name))
    R, view = tensor(rotation()), View(bodies, step)
    if name == "box":  # cells that agree on their corners
        everything = View(*samples.turned_and_moved(bodies, step, R, [1.0, 2.0, 3.0]))
        assert largest(everything.rest_frames - R @ view.rest_frames) < 1e-12
        assert largest(everything.frames - R @ view.frames) < 1e-12
        assert largest(everything.strain - view.strain) < 1e-12
    _, turned = samples.turned_and_moved(bodies, step, R, [1.0, 2.0, 3.0])
    body = View(bodies, turned)
    assert largest(body.frames - R @ view.frames) < 1e-12
    assert largest(body.strain - view.strain) < 1e-12
    assert 0.01 < float(view.deformation) < 1.0


def test_strain_is_the_stretch_of_a_uniform_deformation():
    S = np.array([[1.2, 0.05, 0.02], [0.05, 0.9, -0.03], [0.02, -0.03, 1.1]])
    F = rotation() @ S
    for mesh in (None, o_grid()):
        bodies, step = sample(mesh=mesh)
        view = View(bodies, replace(step, proposed=bodies.rest @ tensor(F).T))
        world = view.rest_frames @ view.strain @ view.rest_frames.transpose(1, 2)
        assert largest(world - tensor(S - np.eye(3))) < 1e-12
        assert float(view.deformation) == pytest.approx(np.linalg.norm(S - np.eye(3)), rel=1e-12)


# --- features on two cells ---------------------------------------------------------------


@pytest.fixture(scope="module")
def pair():
    """Two cubes along x; turned by 90 degrees about z, then 10 per cent longer along y."""
    bodies = samples.body((2, 1, 1), distortion=0.0, clamped=False)
    bodies.free[0, 1] = False
    turn = tensor(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    stretch = tensor(np.diag([1.0, 1.1, 1.0]))
    n = len(bodies.rest)
    start = bodies.rest @ turn.T
    step = Snapshot(
        positions=start,
        velocities=tensor(np.tile([1.0, 2.0, 3.0], (n, 1))),
        proposed=start @ stretch.T,
        forces=tensor(np.random.default_rng(0).normal(size=(n, 3))),
        correction=tensor(np.tile([0.01, 0.02, 0.03], (n, 1))),
    )
    return bodies, step, turn


S_PAIR = 0.1
"""Its deformation: strain 0.1 along the first axis of every cell."""


def test_features_of_the_thesis_are_in_si_units_and_world_axes(pair):
    bodies, step, _ = pair
    view = View(bodies, step)
    for name in ("young", "poisson", "density"):
        assert torch.equal(value(name, view), getattr(bodies, name)[:, None])
    assert torch.equal(value("time-step", view), torch.full((12, 1), STEP, dtype=torch.float64))
    assert torch.equal(value("force", view), step.forces)
    moved = step.proposed - step.positions
    assert torch.allclose(value("velocity", view), moved / STEP)
    held = torch.zeros(12, 2, dtype=torch.float64)
    held[:, 0], held[0] = 1.0, torch.tensor([0.0, 1.0])
    assert torch.equal(value("node-type", view), held)
    to, start = bodies.edge_index
    for name, x in (("rest-position", bodies.rest), ("position", step.proposed)):
        found = value(name, view)
        assert torch.allclose(found[:, :3], x[start] - x[to])
        assert torch.allclose(found[:, 3], (x[start] - x[to]).square().sum(1).sqrt())


def test_features_in_frames_have_the_values_of_their_formulas(pair):
    bodies, step, turn = pair
    view = View(bodies, step)
    unit = SIZE * S_PAIR
    assert float(view.deformation) == pytest.approx(S_PAIR)
    assert largest(view.frames - turn) < 1e-12
    assert largest(value("deformation", view) - math.log(S_PAIR)) < 1e-12
    strain = value("strain", view)
    assert largest(strain - tensor([1.0, 0, 0, 0, 0, 0])) < 1e-12
    moved = step.proposed - step.positions
    inertia = (moved - STEP * tensor([1.0, 2.0, 3.0])) @ turn / unit
    assert largest(value("acceleration", view) - inertia) < 1e-11
    load = STEP**2 * step.forces / bodies.mass[:, None] @ turn / unit
    assert largest(value("load", view) - load) < 1e-11
    assert largest(value("previous-correction", view) - tensor([2.0, -1.0, 3.0])) < 1e-11
    without = View(bodies, replace(step, correction=None))
    assert not value("previous-correction", without).any()
    waves = bodies.young * STEP**2 / (bodies.density * SIZE**2)
    assert largest(value("stiffness", view)[:, 0] - waves.log()) < 1e-12
    to, start = bodies.edge_index
    rest = (bodies.rest[start] - bodies.rest[to]) / SIZE
    assert (
        largest(value("rest-edge", view) - torch.cat([rest, rest.norm(dim=1)[:, None]], 1)) < 1e-12
    )
    along = rest * tensor([1.0, 0, 0])
    assert largest(value("stretch", view) - along) < 1e-11  # 0.1 of the edge over 0.1
    motion = (moved[start] - moved[to]) @ turn / unit
    assert largest(motion - along) < 1e-11
    assert largest(value("motion", view) - motion) < 1e-11
    assert largest(value("turn", view)) < 1e-11


def test_strain_has_its_shears_in_the_order_of_the_axes():
    bodies, step = sample(distortion=0.0)
    S = np.array([[1.01, 0.04, 0.05], [0.04, 1.02, 0.06], [0.05, 0.06, 1.03]])
    view = View(bodies, replace(step, proposed=bodies.rest @ tensor(S).T))
    expected = tensor([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]) / view.scale
    assert largest(value("strain", view) - expected) < 1e-11


def test_turn_is_the_rotation_from_the_receiver_to_the_sender():
    bodies, step = sample(cells=(4, 1, 1), distortion=0.0)
    x, y, z = bodies.rest.T
    rate = 0.2  # rad a cell about x
    angle = rate * x / SIZE
    c, s = angle.cos(), angle.sin()
    y, z = y - SIZE / 2, z - SIZE / 2
    view = View(bodies, replace(step, proposed=torch.stack([x, c * y - s * z, s * y + c * z], 1)))
    to, start = bodies.edge_index
    inner = [(x[i] > 0) & (x[i] < 4 * SIZE - 1e-9) for i in (to, start)]
    inner = inner[0] & inner[1]
    found = (value("turn", view) * view.scale[to])[inner]
    along = ((x[start] - x[to]) / SIZE)[inner]
    assert along.abs().max() > 0.5
    assert largest(found[:, 0] - torch.sin(rate * along)) < 1e-10
    assert largest(found[:, 1:]) < 1e-10


def test_each_feature_has_the_width_it_is_listed_with():
    view = View(*sample())
    for table, rows in (
        (NODE_FEATURES, len(view.bodies.rest)), (EDGE_FEATURES, view.bodies.edge_index.shape[1]),
    ):  # fmt: skip
        for name, (k, _) in table.items():
            assert value(name, view).shape == (rows, k), name
            assert value(name, view).dtype == torch.float64, name


def test_features_in_frames_do_not_depend_on_units():
    """Lengths, times and densities in other units, all derived quantities with them."""
    bodies, step = sample()
    a, b, c = 1e3, 1e3, 1e-12  # mm, ms, tonnes
    mass = c * a**3
    other = replace(
        bodies, rest=a * bodies.rest, mass=mass * bodies.mass, young=c * a**2 / b**2 * bodies.young,
        density=c * bodies.density, cell_size=a * bodies.cell_size, time_step=b * bodies.time_step,
    )  # fmt: skip
    same = Snapshot(
        a * step.positions, a / b * step.velocities, a * step.proposed,
        mass * a / b**2 * step.forces, a * step.correction,
    )  # fmt: skip
    one, two = View(bodies, step), View(other, same)
    for name in (*FRAME_NODES, "poisson", "node-type", *FRAME_EDGES):
        assert largest(value(name, one) - value(name, two)) < 1e-9, name
        assert largest(value(name, one)) > 0.01, name
    model = samples.corrector()
    assert largest(model(other, same) / a - model(bodies, step)) < 1e-9 * SIZE


@pytest.mark.parametrize("name", [*FRAME_NODES, *FRAME_EDGES])
def test_features_in_frames_do_not_depend_on_where_the_scene_is(name):
    bodies, step = sample()
    view = View(bodies, step)
    turned = View(*samples.turned_and_moved(bodies, step, rotation(), [3.0, -2.0, 1.0]))
    assert largest(value(name, turned) - value(name, view)) < 1e-9


# --- symmetry of the correction --------------------------------------------------------------


SHIFT, EYE = (0.7, -0.4, 0.9), np.eye(3)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("name", ["equivariant", "compact"])
def test_a_turned_scene_gets_the_turned_correction(name, neutral, dtype, bound):
    model = samples.corrector(name, dtype=dtype, momentum_neutral=neutral)
    bodies, step = sample()
    with torch.no_grad():
        expected = model(bodies, step)
        size = largest(expected)
        assert size > 1e-3 * SIZE
        for R, shift in ((rotation(), (0, 0, 0)), (EYE, SHIFT), (rotation(8), SHIFT)):
            found = model(*samples.turned_and_moved(bodies, step, R, shift))
            assert largest(found - expected @ tensor(R).T) < bound * size
        *other, old = samples.renumbered(bodies, step)
        assert largest(model(*other) - expected[old]) < bound * size
    assert expected.dtype == torch.float64


def test_the_thesis_keeps_its_correction_when_moved_or_renumbered_but_not_when_turned():
    model = samples.corrector("thesis")
    bodies, step = sample()
    expected = model(bodies, step)
    size = largest(expected)
    moved = model(*samples.turned_and_moved(bodies, step, EYE, SHIFT))
    assert largest(moved - expected) < 1e-10 * size
    *other, old = samples.renumbered(bodies, step)
    assert largest(model(*other) - expected[old]) < 1e-10 * size
    R = rotation()
    turned = model(*samples.turned_and_moved(bodies, step, R, (0, 0, 0)))
    assert largest(turned - expected @ tensor(R).T) > 0.1 * size


# --- what holds for any weights ------------------------------------------------------------


def resting(bodies):
    still = torch.zeros_like(bodies.rest)
    return Snapshot(bodies.rest, still, bodies.rest, still)


def flying(bodies, spin=(3.0, -2.0, 5.0)):
    """A rigid body that turns and flies fast, far from where it was."""
    R, shift, velocity = tensor(rotation()), tensor([2.0, 3.0, -1.0]), tensor([5.0, -4.0, 3.0])
    x = bodies.rest @ R.T + shift
    turn = torch.linalg.matrix_exp(STEP * torch.linalg.cross(
        tensor(spin).expand(3, 3), torch.eye(3, dtype=torch.float64)).T)  # fmt: skip
    speed = velocity + torch.linalg.cross(tensor(spin).expand(len(x), 3), x)
    pull = 9.81 * bodies.mass[:, None] * tensor([0.0, 0.0, -1.0])
    return Snapshot(x, speed, x @ turn.T + STEP * velocity, pull)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("motion", [resting, flying])
@pytest.mark.parametrize("name", ["equivariant", "compact"])
def test_bodies_that_are_not_deformed_are_not_corrected(name, motion, dtype):
    model = samples.corrector(name, dtype=dtype)
    for mesh in (None, o_grid()):
        bodies = samples.body(clamped=False, mesh=mesh)
        assert largest(bodies.rest - motion(bodies).proposed) > 1.0 or motion is resting
        assert torch.equal(model(bodies, motion(bodies)), torch.zeros_like(bodies.rest))


@pytest.mark.parametrize("name", list(PRESETS))
def test_held_components_are_not_corrected(name):
    bodies, step = sample()
    bodies.free[-1, 1] = False
    correction = samples.corrector(name)(bodies, step)
    assert not correction[~bodies.free].any()
    assert (correction[bodies.free] != 0).all()


def momenta(bodies, step, correction):
    """Of the wholly free nodes."""
    impulse = bodies.mass[:, None] * correction * bodies.free.all(dim=1, keepdim=True)
    return impulse.sum(0), torch.linalg.cross(step.proposed, impulse).sum(0)


@pytest.mark.parametrize("output", ["frame", "world"])
@pytest.mark.parametrize("held", ["nothing", "an end", "a component", "components"])
def test_neutral_corrections_have_no_momenta(held, output):
    bodies = samples.body((4, 2, 1), clamped=held == "an end")
    if held == "a component":
        bodies.free[3, 1] = False
    if held == "components":
        bodies.free[:10, 2] = False
    step = samples.moving(bodies)
    found = {}
    for neutral in (True, False):
        model = samples.corrector(momentum_neutral=neutral, output=output)
        found[neutral] = model(bodies, step)
    size = largest(found[False])
    for before, after in zip(
        *(momenta(bodies, step, found[k]) for k in (False, True)), strict=True
    ):
        assert largest(before) > 1e-2 * size * SIZE
        assert largest(after) < 1e-11 * largest(before)
    assert not found[True][~bodies.free].any()
    assert torch.equal(*(found[k][~bodies.free.all(dim=1)] for k in (False, True)))
    again = without_momentum(View(bodies, step), found[True])
    assert largest(again - found[True]) < 1e-10 * size


def test_a_neutral_correction_differs_by_a_rigid_motion_of_the_free_nodes():
    bodies, step = sample()
    x = samples.moving(bodies, seed=4).correction
    motion = (x - without_momentum(View(bodies, step), x))[bodies.free.all(1)]
    r = step.proposed[bodies.free.all(1)]
    along = (motion[:, None] - motion) * (r[:, None] - r)
    assert largest(along.sum(dim=2)) < 1e-12 * SIZE * largest(motion) * 100
    assert largest(motion) > 1e-4 * SIZE


@pytest.mark.parametrize("free", [0, 1, 2])
def test_bodies_with_hardly_a_free_node_keep_finite_corrections(free):
    bodies, step = sample(clamped=False)
    bodies.free[free:] = False
    bodies.free[free:, 0] = True
    found, plain = (
        samples.corrector(momentum_neutral=neutral)(bodies, step) for neutral in (True, False)
    )
    assert torch.equal(found[free:], plain[free:])
    assert all(largest(x) > 1e-4 * SIZE for x in plain)
    before, after = momenta(bodies, step, plain), momenta(bodies, step, found)
    for one, other in zip(before, after, strict=True):
        assert largest(other) <= 1e-11 * largest(one)
    if free == 1:
        assert not found[0].any()


@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("name", list(PRESETS))
def test_bodies_in_one_graph_do_not_see_each_other(name, neutral):
    pairs = [sample(), sample(cells=(2, 2, 2), seed=3, size=0.25), sample(cells=(1, 1, 1), seed=7)]
    model = samples.corrector(name, momentum_neutral=neutral)
    bodies = samples.joined(*(b for b, _ in pairs))
    together = model(bodies, samples.together(*(s for _, s in pairs)))
    alone = torch.cat([model(b, s) for b, s in pairs])
    assert largest(together - alone) < 1e-12 * largest(alone)


# --- derivatives -----------------------------------------------------------------------------


def gradients(model, bodies, step):
    positions = step.proposed.clone().requires_grad_()
    found = model(bodies, replace(step, proposed=positions))
    weights = torch.arange(found.numel(), dtype=found.dtype).reshape(found.shape).sin()
    inputs = [positions, *model.network.parameters()]
    return torch.autograd.grad((found * weights).sum(), inputs, allow_unused=True)


@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("motion", [resting, flying])
@pytest.mark.parametrize("name", list(PRESETS))
def test_derivatives_are_finite_where_nothing_is_deformed(name, motion, neutral):
    model = samples.corrector(name, momentum_neutral=neutral)
    bodies = samples.body(clamped=False)
    for gradient in gradients(model, bodies, motion(bodies)):
        assert gradient is None or torch.isfinite(gradient).all()


@pytest.mark.parametrize("name", list(PRESETS))
def test_derivatives_are_finite_where_cells_are_collapsed(name):
    model = samples.corrector(name)
    bodies, step = sample()
    for squashed in (torch.zeros_like(step.proposed), step.proposed * tensor([1.0, 1.0, 0.0])):
        for gradient in gradients(model, bodies, replace(step, proposed=squashed)):
            assert gradient is None or torch.isfinite(gradient).all()


@pytest.mark.parametrize("name", list(PRESETS))
def test_derivatives_by_positions_are_those_of_differences(name):
    model = samples.corrector(name, momentum_neutral=True)
    bodies, step = sample(cells=(2, 1, 1))
    direction = samples.moving(bodies, seed=9).velocities

    def along(t):
        return model(bodies, replace(step, proposed=step.proposed + t * direction))

    eps = 1e-6 * SIZE
    _, exact = torch.autograd.functional.jvp(along, torch.zeros((), dtype=torch.float64),
                                             torch.ones((), dtype=torch.float64))  # fmt: skip
    with torch.no_grad():
        slope = (along(eps) - along(-eps)) / (2 * eps)
    assert largest(slope - exact) < 1e-4 * largest(exact)  # ReLU has kinks
    assert largest(exact) > 0.0


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
def test_bodies_first_used_without_derivatives_serve_with_them_later(mode):
    model = samples.corrector()
    bodies, step = sample()
    expected = gradients(model, *sample())
    with mode():
        model(bodies, step)
    for _ in range(2):
        for one, other in zip(gradients(model, bodies, step), expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-14)


# --- network ---------------------------------------------------------------------------------


def apply(linears, norm, x):
    """ReLU networks by hand."""
    for i, (weight, bias) in enumerate(linears):
        x = x @ weight.T + bias
        if i < len(linears) - 1:
            x = x.clamp_min(0.0)
    if norm is None:
        return x
    mean = x.mean(dim=1, keepdim=True)
    variance = (x - mean).square().mean(dim=1, keepdim=True)
    return (x - mean) / (variance + 1e-5).sqrt() * norm[0] + norm[1]


def parts(module):
    linears = [(m.weight, m.bias) for m in module if isinstance(m, torch.nn.Linear)]
    norms = [(m.weight, m.bias) for m in module if isinstance(m, torch.nn.LayerNorm)]
    return linears, norms[0] if norms else None


@pytest.mark.parametrize("norm", [True, False])
@pytest.mark.parametrize("layers", [2, 4])
def test_a_round_is_the_textbook_formula(layers, norm):
    torch.manual_seed(0)
    layer, width = MessageLayer(6, layers, norm).double(), 6
    for p in layer.parameters():
        torch.nn.init.normal_(p, std=0.5)
    bodies = samples.body()
    to, start = bodies.edge_index
    x = torch.randn(len(bodies.rest), width, dtype=torch.float64)
    e = torch.randn(len(to), width, dtype=torch.float64)
    first = torch.cat([layer.of_edge.weight, layer.of_receiver.weight, layer.of_sender.weight], 1)
    rest, edge_norm = parts(layer.edge_rest)
    edges = e + apply(
        [(first, layer.of_edge.bias), *rest], edge_norm, torch.cat([e, x[to], x[start]], dim=1)
    )
    sums = torch.zeros_like(x)
    for i, receiver in enumerate(to.tolist()):
        sums[receiver] += edges[i]
    nodes = x + apply(*parts(layer.node), torch.cat([x, sums], dim=1))
    found = layer(x, e, bodies.edge_index)
    assert largest(found[0] - nodes) < 1e-12
    assert largest(found[1] - edges) < 1e-12


def test_the_parts_of_the_first_map_begin_as_one_map_from_all_three():
    torch.manual_seed(0)
    layer, width = MessageLayer(64, 2, True), 64
    bound = (3 * width) ** -0.5
    for part in (layer.of_edge.weight, layer.of_receiver.weight, layer.of_sender.weight,
                 layer.of_edge.bias):  # fmt: skip
        assert 0.9 * bound < largest(part) <= bound


@pytest.mark.parametrize("layers", [2, 3, 4])
def test_an_mlp_has_relu_between_its_layers_and_a_norm_at_the_end(layers):
    kinds = [type(m) for m in MLP(3, 8, 5, layers, True)]
    middle = [torch.nn.Linear, torch.nn.ReLU] * (layers - 1)
    assert kinds == [*middle, torch.nn.Linear, torch.nn.LayerNorm]
    assert [type(m) for m in MLP(3, 8, 5, layers, False)] == kinds[:-1]


@pytest.mark.parametrize(
    ("norm", "hidden", "decoder"), [("hidden", 1, 0), ("all", 1, 1), ("none", 0, 0)]
)
def test_norms_are_where_they_are_asked_for(norm, hidden, decoder):
    network = MeshGraphNetwork(4, 5, layers=2, width=8, mlp_layers=3, norm=norm)
    for module in (network.node_encoder, network.edge_encoder, network.rounds[0].node,
                   network.rounds[1].node, *(r.edge_rest for r in network.rounds)):  # fmt: skip
        assert sum(isinstance(m, torch.nn.LayerNorm) for m in module) == hidden
        assert isinstance(module[-1], torch.nn.LayerNorm) == bool(hidden)
    assert isinstance(network.decoder[-1], torch.nn.LayerNorm) == bool(decoder)


def test_shared_rounds_are_one_round_repeated():
    bodies = samples.body()
    x = torch.randn(len(bodies.rest), 4)
    e = torch.randn(bodies.edge_index.shape[1], 5)
    network = MeshGraphNetwork(4, 5, layers=3, width=8, mlp_layers=2, shared=True)
    assert len(network.rounds) == 1
    y, f = network.node_encoder(x), network.edge_encoder(e)
    for _ in range(3):
        y, f = network.rounds[0](y, f, bodies.edge_index)
    assert torch.equal(network(x, e, bodies.edge_index), network.decoder(y))
    alone = MeshGraphNetwork(4, 5, layers=3, width=8, mlp_layers=2)
    assert len({id(r) for r in alone.rounds}) == 3


@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_a_node_is_reached_from_as_many_edges_as_there_are_rounds(rounds):
    bodies = samples.body((5, 1, 1))
    torch.manual_seed(0)
    network = MeshGraphNetwork(1, 5, layers=rounds, width=8, mlp_layers=2).double()
    x = torch.zeros(len(bodies.rest), 1, dtype=torch.float64)
    e = torch.zeros(bodies.edge_index.shape[1], 5, dtype=torch.float64)
    before = network(x, e, bodies.edge_index)
    x[0] = 1.0
    reached = (network(x, e, bodies.edge_index) != before).any(dim=1)
    distance = torch.full((len(x),), 99)
    distance[0] = 0
    for step in range(1, 9):
        near = torch.zeros_like(reached)
        near[bodies.edge_index[0][distance[bodies.edge_index[1]] == step - 1]] = True
        distance[near & (distance == 99)] = step
    assert torch.equal(reached, distance <= rounds)


# --- cost ------------------------------------------------------------------------------------


def test_the_thesis_has_the_parameters_of_its_description():
    w, L = 128, 4

    def mlp(inputs, outputs, norm):
        maps = inputs * w + w + (L - 2) * (w * w + w) + w * outputs + outputs
        return maps + (2 * outputs if norm else 0)

    nodes, edges = 1 + 1 + 3 + 3 + 2, 4 + 4
    by_hand = mlp(nodes, w, True) + mlp(edges, w, True) + mlp(w, 3, False)
    by_hand += 15 * (mlp(3 * w, w, True) + mlp(2 * w, w, True))
    model = Corrector(PRESETS["thesis"])
    assert sum(p.numel() for p in model.parameters()) == by_hand == 2_878_467
    assert cost.parameters(PRESETS["thesis"]) == by_hand


CONFIGS = {
    **PRESETS,
    "shared": preset("compact", shared=True, mlp_layers=2),
    "norms": preset("equivariant", norm="all"),
    "bare": preset("thesis", norm="none", layers=3, width=20),
}


@pytest.mark.parametrize("name", list(CONFIGS))
def test_parameters_and_operations_are_those_counted(name):
    config = CONFIGS[name]
    model = Corrector(config)
    assert cost.parameters(config) == sum(p.numel() for p in model.parameters())
    bodies, step = sample()
    samples.fit(model, View(bodies, step))
    nodes, edges = model.inputs(View(bodies, step))
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model.network(nodes.float(), edges.float(), bodies.edge_index)
    n, E = len(bodies.rest), bodies.edge_index.shape[1]
    assert cost.flops(config, n, E) == counter.get_total_flops()


# --- normaliser ------------------------------------------------------------------------------


def test_moments_that_come_in_parts_are_those_of_the_whole():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(500, 3)) * [1.0, 1e-3, 1e6] + [5.0, 1e3, -2.0]
    moments = Moments()
    for part in np.split(values, [0, 1, 4, 100, 480]):
        moments.add(tensor(part))
    assert moments.count == 500
    for found, expected in (
        (moments.mean, values.mean(0)), (moments.square, (values**2).mean(0)),
        (moments.deviation, values.std(0)),
    ):  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert torch.equal(moments.low, tensor(values.min(0)))
    assert torch.equal(moments.high, tensor(values.max(0)))


def fitted(**columns):
    """A normaliser of features given by their values, and targets of mean square 4."""
    normaliser = Normaliser({name: x.shape[1] for name, x in columns.items()}, {})
    moments = {}
    for name, x in columns.items():
        moments[name] = Moments()
        for part in x.split(7):
            moments[name].add(part)
    target = Moments()
    target.add(torch.tensor([[2.0], [-2.0]]))
    normaliser.fit(moments, target)
    return normaliser


def test_normalised_features_have_zero_mean_and_unit_deviation():
    rng = np.random.default_rng(1)
    a, b = tensor(rng.normal(3.0, 2.0, (100, 2))), tensor(rng.normal(-1e5, 10.0, (100, 1)))
    normaliser = fitted(a=a, b=b)
    assert normaliser.fitted
    assert float(normaliser.output_scale) == 2.0
    found = normaliser.joined({"a": a, "b": b}, None)
    assert largest(found.mean(0)) < 1e-9
    assert largest(found.std(0, correction=0) - 1.0) < 1e-9
    assert not Normaliser({"a": 1}, {}).fitted


@pytest.mark.parametrize("constant", [0.1, -3e5, 0.01, 1e-12, 0.0])
def test_components_that_never_change_become_zero(constant):
    x = torch.full((1000, 1), constant, dtype=torch.float64)
    normaliser = fitted(a=x)
    assert largest(normaliser.joined({"a": x}, None)) < 1e-12
    other = normaliser.joined({"a": 2 * x}, None)
    assert largest(other) == pytest.approx(1.0 if constant else 0.0)


def test_what_never_changed_in_training_is_known_to_a_hundredth():
    one, zero = torch.full((9, 1), 2.5), torch.zeros(9, 1)
    normaliser = fitted(a=one.double(), b=zero.double())
    assert normaliser.excess({"a": tensor([[2.5], [2.55], [1.0]])}).flatten().tolist() == (
        pytest.approx([0.0, 2.0, 60.0], abs=1e-12)
    )
    assert normaliser.excess({"b": tensor([[0.0], [1.0]])}).flatten().tolist() == (
        pytest.approx([0.0, 100.0], abs=1e-12)
    )


def averaged(*rows):
    """A normaliser of two components that has seen bodies with these mean inputs."""
    normaliser, averages = Normaliser({"a": 2}, {"b": 3}), Moments()
    averages.add(tensor(rows))
    normaliser.fit_averages(averages)
    return normaliser


def test_bodies_are_as_strange_as_deviations_of_their_mean_inputs():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(4000, 2)) * [1.0, 3.0] + [5.0, -2.0]
    normaliser = averaged(*rows)
    found = normaliser.strangeness(tensor([[5.0, -2.0], [7.0, -2.0], [5.0, 10.0], [9.0, -11.0]]))
    expected = [[0.0, 0.0], [2.0, 0.0], [0.0, 4.0], [4.0, 3.0]]
    np.testing.assert_allclose(found.numpy(), expected, rtol=0.12, atol=0.1)


def test_rare_extremes_of_mean_inputs_are_not_strange():
    rows = np.zeros((1000, 2))
    rows[0] = 30.0, -7.0
    normaliser = averaged(*rows)
    assert largest(normaliser.strangeness(tensor(rows[:1])) - 3.5) < 1e-9
    beyond = normaliser.strangeness(tensor([[36.0, 0.0], [-6.0, 0.0]]))
    assert 4.1 < float(beyond[0, 0]) < 4.3  # by a fifth
    assert float(beyond[1, 0]) > 6.0  # on the other side, where none was


def test_mean_inputs_that_cancelled_in_all_bodies_count_by_a_tenth():
    normaliser = averaged([0.0, 0.0], [1e-9, -1e-9])
    assert largest(normaliser.strangeness(tensor([[0.1, -0.3]])) - tensor([[1.0, 3.0]])) < 1e-6


def test_mean_inputs_of_further_data_are_as_familiar_as_those_of_the_first():
    normaliser = averaged([0.0, 0.0], [1.0, 1.0], [0.5, 0.2])
    further, averages = tensor([[9.0, 0.5]]), Moments()
    averages.add(further)
    assert float(normaliser.strangeness(further)[0, 0]) > 10.0
    normaliser.widen_averages(averages)
    assert float(normaliser.strangeness(further)[0, 0]) <= 3.5 + 1e-12
    assert float(normaliser.strangeness(-further)[0, 0]) > 10.0


def test_nobody_is_familiar_before_averages_were_fitted():
    assert Normaliser({"a": 1}, {}).strangeness(tensor([[0.0]])).isposinf().all()


def test_rounding_of_stored_positions_is_not_enlarged():
    rng = np.random.default_rng(0)
    x = tensor((1.0 + 1e-7 * rng.normal(size=1000))[:, None])
    assert largest(fitted(a=x).joined({"a": x}, None)) < 1e-6


def test_inputs_bend_towards_the_clip():
    x = tensor(np.linspace(-1.0, 1.0, 50)[:, None])
    normaliser = fitted(a=x)
    far = normaliser.joined({"a": tensor([[1e6], [-1e6], [0.0]])}, 5.0)
    assert largest(far - tensor([[5.0], [-5.0], [0.0]])) < 1e-14
    plain, bent = (normaliser.joined({"a": x}, clip) for clip in (None, 5.0))
    assert largest(bent - 5.0 * torch.tanh(plain / 5.0)) < 1e-14
    assert (bent.diff(dim=0) > 0).all()


def test_node_types_are_not_normalised():
    x = tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert torch.equal(fitted(**{"node-type": x}).joined({"node-type": x}, None), x)


def test_excess_counts_deviations_outside_the_range_seen():
    x = tensor([[0.0, -1.0], [4.0, 1.0]])  # deviations 2 and 1
    found = fitted(a=x).excess({"a": tensor([[2.0, 0.0], [-3.0, 1.0], [5.0, -1.5], [4.0, 3.0]])})
    assert torch.equal(found, tensor([[0.0, 0.0], [1.5, 0.0], [0.5, 0.5], [0.0, 2.0]]))


def test_the_farthest_value_seen_counts_as_three_and_a_half_deviations_at_most():
    kicks = torch.zeros(100, 1).double()
    kicks[0] = 7.0  # ten deviations from the mean
    normaliser = fitted(a=kicks)
    unit = (7.0 - 0.07) / 3.5
    usual = float(kicks.std(correction=0))
    assert usual < 0.4 * unit
    assert normaliser.excess({"a": tensor([[7.0 + unit], [-usual]])}).flatten().tolist() == (
        pytest.approx([1.0, 1.0])
    )
    scale = normaliser.scale("a")
    assert [float(scale.below), float(scale.above)] == pytest.approx([usual, unit])


def test_a_normaliser_needs_values_to_be_fitted_to():
    full, empty, zero = Moments(), Moments(), Moments()
    full.add(torch.ones(3, 1))
    empty.add(torch.ones(0, 1))
    zero.add(torch.zeros(3, 1))
    for found, target, words in (
        ({}, full, "features a: expected values"),
        ({"a": empty}, full, "features a: expected values"),
        ({"a": full}, empty, "targets"),
        ({"a": full}, zero, "targets"),
    ):
        normaliser = Normaliser({"a": 1}, {})
        with pytest.raises(InputError, match=words):
            normaliser.fit(found, target)
        assert not normaliser.fitted


@pytest.mark.parametrize("name", list(PRESETS))
def test_targets_are_what_gives_the_correction_back(name):
    bodies, step = sample()
    view, model = View(bodies, step), samples.corrector(name)
    correction = samples.moving(bodies, seed=4).correction
    x = model.target(view, correction) / model.normaliser.output_scale
    assert largest(model.in_metres(view, x) - correction) < 1e-14
    assert largest(correction) > 0.001 * SIZE


# --- graphs of problems ------------------------------------------------------------------


def test_a_graph_of_problems_has_what_each_one_has():
    scenes = [beam((3, 2, 1)), beam((2, 2, 2), cell_size=0.03, material={"young": 2e6})]
    problems = [discretise(scene) for scene in scenes]
    graph = BodyGraph.of(problems, dtype=torch.float64)
    assert graph.bodies == 2
    first = 0
    for i, problem in enumerate(problems):
        here = graph.graph == i
        n = len(problem.positions)
        assert torch.equal(here.nonzero()[:, 0], torch.arange(first, first + n))
        assert torch.equal(graph.rest[here], tensor(problem.positions))
        assert torch.equal(graph.free[here], tensor(problem.free))
        assert torch.equal(graph.mass[here], tensor(problem.mass))
        assert torch.allclose(graph.young[here], tensor(problem.materials.young[:1]))
        cells = graph.cells[(graph.graph[graph.cells] == i).all(dim=1)]
        assert torch.equal(cells - first, tensor(problem.cells.astype(np.int64)))
        edges = graph.edge_index[:, graph.graph[graph.edge_index[0]] == i]
        assert torch.equal(edges - first, BodyGraph.of([problem]).edge_index)
        first += n
    assert torch.equal(graph.graph[graph.edge_index[0]], graph.graph[graph.edge_index[1]])
    assert graph.cell_size.tolist() == pytest.approx([0.02, 0.03])
    assert graph.time_step.tolist() == [0.01, 0.01]
    assert BodyGraph.of(problems, 0.5).time_step.tolist() == [0.5, 0.5]
    single = graph.to(dtype=torch.float32)
    assert single.rest.dtype == single.cell_size.dtype == torch.float32
    assert single.edge_index.dtype == torch.int64
    assert single.free.dtype == torch.bool


def test_sums_and_means_are_of_each_body():
    graph = samples.joined(samples.body(), samples.body((1, 1, 1)))
    x = torch.arange(2.0 * len(graph.rest)).reshape(-1, 2)
    n = int((graph.graph == 0).sum())
    expected = torch.stack([x[:n].sum(0), x[n:].sum(0)])
    assert torch.equal(graph.node_sums(x), expected)
    assert torch.allclose(graph.body_means(x), expected / tensor([[n], [8.0]]).float())
    assert torch.equal(graph.by_node(expected)[n - 1 : n + 1], expected)


def test_a_batch_of_samples_is_the_same_graph(tmp_path):
    write(tmp_path, [shard(), shard(1, cells=(2, 2, 2))])
    dataset = TrajectoryDataset(tmp_path, "training", dtype=torch.float64)
    batch = dataset.batch([0, 15])
    graph = BodyGraph.of_batch(batch)
    assert graph.bodies == 2
    assert torch.equal(graph.rest, batch.rest)
    assert torch.equal(graph.cells, batch.cells)
    assert largest(graph.cell_size - 0.1) < 1e-12
    assert largest(graph.time_step - 0.02) < 1e-12
    apart = [BodyGraph.of_batch(dataset.batch([i])) for i in (0, 15)]
    assert torch.equal(samples.joined(*apart).edge_index, graph.edge_index)


def test_cell_sizes_of_distorted_bodies_are_roots_of_mean_volumes(tmp_path):
    problem = problem_on(o_grid())
    bodies = samples.body(mesh=problem.mesh)

    class Batch:
        num_graphs, batch, time_step = 1, bodies.graph, bodies.time_step
        edge_index, cells = bodies.edge_index, bodies.cells
        rest, free, mass, young = bodies.rest, bodies.free, bodies.mass, bodies.young
        poisson, density = bodies.poisson, bodies.density

    assert float(BodyGraph.of_batch(Batch).cell_size) == pytest.approx(problem.cell_size, rel=0.02)


# --- bad input -------------------------------------------------------------------------------


def test_bodies_that_have_no_graph_are_refused():
    with pytest.raises(InputError, match="problems: expected one or more"):
        BodyGraph.of([])
    with pytest.raises(InputError, match="cells with 27 nodes"):
        BodyGraph.of([discretise(beam((2, 1, 1)), element="hex27")])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"node_features": ["colour"]}, "feature 'colour': expected one of young"),
        ({"edge_features": ["strain"]}, "feature 'strain': expected one of rest-position"),
        ({"node_features": ["load", "load"]}, "load, load: expected each one once"),
        ({"layers": 0}, "layers = 0: expected at least 1.$"),
        ({"width": 0}, "width"),
        ({"mlp_layers": 1}, "mlp_layers"),
        ({"clip": 0.0}, "clip"),
        ({"norm": "some"}, "norm"),
        ({"placement": "after"}, "placement"),
        ({"depth": 3}, "preset 'compact': depth: unknown key; remove"),
        ({"widths": 3}, r"preset 'compact': widths: unknown key; did you mean width\?$"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, words):
    with pytest.raises(InputError, match=words):
        preset("compact", **changes)


def test_presets_are_known_by_name():
    with pytest.raises(InputError, match="preset 'large': expected one of thesis, equivariant"):
        preset("large")
    for name, config in PRESETS.items():
        assert preset(name) == config
        assert CorrectorConfig.model_validate_json(config.model_dump_json()) == config
    assert features.width(NODE_FEATURES, PRESETS["thesis"].node_features) == 10

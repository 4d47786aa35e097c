"""Frames of cells and nodes, and the features that networks see."""

import math
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torch_geometric")


import network_samples as samples  # noqa: E402
from block_meshes import o_grid, spokes, warped  # noqa: E402
from conftest import rotation  # noqa: E402
from network_samples import SIZE, STEP, tensor  # noqa: E402
from pdcorrect.corrector import frames  # noqa: E402
from pdcorrect.corrector.features import (  # noqa: E402
    EDGE_FEATURES,
    NODE_FEATURES,
    FeatureView,
    Snapshot,
)

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


# --- frames ------------------------------------------------------------------------------------


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
    R = frames.polar_rotations(tensor(M)).numpy()
    U, _, V = np.linalg.svd(M)
    np.testing.assert_allclose(
        R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_allclose(R, U @ V, atol=1e-12 * (s[kept, 0] / s[kept, 2]).max())
    every = tensor(np.concatenate([matrices(kind), [*UNUSABLE.values(), np.full((3, 3), np.nan)]]))
    assert largest(frames.polar_rotations(every) - frames.together(every)) < 1e-13
    single = frames.polar_rotations(torch.as_tensor(M, dtype=torch.float32))
    assert single.dtype == torch.float32
    assert largest(single @ single.transpose(1, 2) - torch.eye(3)) < 1e-5


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
    R = frames.polar_rotations(M)
    assert torch.equal(R[0], torch.eye(3, dtype=dtype))
    assert largest(R[1] - torch.as_tensor(good, dtype=dtype)) < 1e-6
    (gradient,) = torch.autograd.grad((R * torch.arange(9.0).reshape(3, 3)).sum(), M)
    assert torch.equal(gradient[0], torch.zeros(3, 3, dtype=dtype))
    assert torch.isfinite(gradient).all()
    assert gradient[1].any()


def test_derivatives_of_rotations_are_right():
    M = tensor(matrices("stretched")[:4] / 10 + np.eye(3)).requires_grad_()
    assert torch.autograd.gradcheck(frames.polar_rotations, (M,), eps=1e-6, atol=1e-7)
    tiny = (1e-6 * M).detach().requires_grad_()
    weights = tensor(np.random.default_rng(3).normal(size=M.shape))
    (one,) = torch.autograd.grad((frames.polar_rotations(M) * weights).sum(), M)
    (other,) = torch.autograd.grad((frames.polar_rotations(tiny) * weights).sum(), tiny)
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
    R, view = tensor(rotation()), FeatureView(bodies, step)
    if name == "box":  # cells that agree on their corners
        everything = FeatureView(*samples.turned_and_moved(bodies, step, R, [1.0, 2.0, 3.0]))
        assert largest(everything.bodies.rest_frames - R @ view.bodies.rest_frames) < 1e-12
        assert largest(everything.frames - R @ view.frames) < 1e-12
        assert largest(everything.strain - view.strain) < 1e-12
    _, turned = samples.turned_and_moved(bodies, step, R, [1.0, 2.0, 3.0])
    body = FeatureView(bodies, turned)
    assert largest(body.frames - R @ view.frames) < 1e-12
    assert largest(body.strain - view.strain) < 1e-12
    assert 0.01 < float(view.deformation) < 1.0


def test_strain_is_the_stretch_of_a_uniform_deformation():
    S = np.array([[1.2, 0.05, 0.02], [0.05, 0.9, -0.03], [0.02, -0.03, 1.1]])
    F = rotation() @ S
    for mesh in (None, o_grid()):
        bodies, step = sample(mesh=mesh)
        view = FeatureView(bodies, replace(step, proposed=bodies.rest @ tensor(F).T))
        world = view.bodies.rest_frames @ view.strain @ view.bodies.rest_frames.transpose(1, 2)
        assert largest(world - tensor(S - np.eye(3))) < 1e-12
        assert float(view.deformation) == pytest.approx(np.linalg.norm(S - np.eye(3)), rel=1e-12)


# --- features on two cells ---------------------------------------------------------------------


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
    view = FeatureView(bodies, step)
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
    view = FeatureView(bodies, step)
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
    without = FeatureView(bodies, replace(step, correction=None))
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
    view = FeatureView(bodies, replace(step, proposed=bodies.rest @ tensor(S).T))
    expected = tensor([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]) / view.scale
    assert largest(value("strain", view) - expected) < 1e-11


def test_turn_is_the_rotation_from_the_receiver_to_the_sender():
    bodies, step = sample(cells=(4, 1, 1), distortion=0.0)
    x, y, z = bodies.rest.T
    rate = 0.2  # rad a cell about x
    angle = rate * x / SIZE
    c, s = angle.cos(), angle.sin()
    y, z = y - SIZE / 2, z - SIZE / 2
    view = FeatureView(
        bodies, replace(step, proposed=torch.stack([x, c * y - s * z, s * y + c * z], 1))
    )
    to, start = bodies.edge_index
    inner = [(x[i] > 0) & (x[i] < 4 * SIZE - 1e-9) for i in (to, start)]
    inner = inner[0] & inner[1]
    found = (value("turn", view) * view.scale[to])[inner]
    along = ((x[start] - x[to]) / SIZE)[inner]
    assert along.abs().max() > 0.5
    assert largest(found[:, 0] - torch.sin(rate * along)) < 1e-10
    assert largest(found[:, 1:]) < 1e-10


def test_each_feature_has_the_width_it_is_listed_with():
    view = FeatureView(*sample())
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
    one, two = FeatureView(bodies, step), FeatureView(other, same)
    for name in (*FRAME_NODES, "poisson", "node-type", *FRAME_EDGES):
        assert largest(value(name, one) - value(name, two)) < 1e-9, name
        assert largest(value(name, one)) > 0.01, name
    model = samples.corrector()
    assert largest(model(other, same) / a - model(bodies, step)) < 1e-9 * SIZE


@pytest.mark.parametrize("name", [*FRAME_NODES, *FRAME_EDGES])
def test_features_in_frames_do_not_depend_on_where_the_scene_is(name):
    bodies, step = sample()
    view = FeatureView(bodies, step)
    turned = FeatureView(*samples.turned_and_moved(bodies, step, rotation(), [3.0, -2.0, 1.0]))
    assert largest(value(name, turned) - value(name, view)) < 1e-9

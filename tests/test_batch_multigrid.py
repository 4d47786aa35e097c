"""The multigrid first Hessian of batches is a symmetric, good and mesh-independent H^-1."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch

import pdcorrect as pc
from conftest import beam, box_mesh
from pdcorrect.batch.elimination import Elimination, alike_cells, rest_blocks, summed_blocks
from pdcorrect.batch.first_hessian import LARGEST_REST, FirstHessian, chosen
from pdcorrect.batch.multigrid import hierarchy, largest_eigenvalue, with_mass
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.mesh import _lattice, refine

CPU = torch.device("cpu")
MASS = 1e4
"""1/s2: of steps of 0.01 s."""
PARTIAL = [
    {"region": {"plane": "x", "at": 0.0}},
    {"region": {"plane": "y", "at": 0.0}, "components": ["y"]},
]
STIFF_END = [{"region": {"box": [[0.02, -1, -1], [1, 1, 1]]}, "young": 3e6}]


def scenes(element="hex8"):
    """Four of unlike size, clamps and masses."""
    mass = ["per-node", "averaged", "lumped", "consistent"]
    changes = [{"clamps": PARTIAL}, {"clamps": []}, {"poisson": 0.3}, {"clamps": PARTIAL}]
    shapes = [(2, 1, 1), (1, 1, 1), (3, 1, 1), (2, 2, 1)]
    return [
        beam(shape, 0.03, solver={"element": element, "mass": rule}, **change)
        for shape, rule, change in zip(shapes, mass, changes, strict=True)
    ]


def moving(problems, size=0.03):
    """Strained states that move, one for each problem."""
    out = []
    for i, p in enumerate(problems):
        rng = np.random.default_rng(i)
        noise = rng.uniform(-0.5, 0.5, p.positions.shape) * p.free
        out.append(pc.State(p.positions + size * p.cell_size * noise, 0.3 * noise))
    return out


def inverse(problems, kind, storage=torch.float64, strained=False):
    """A first Hessian and its cells; turned to strained states if asked to."""
    stepper = pc.BatchStepper(problems)
    found = FirstHessian(stepper.cells, problems, (MASS, 1.0), kind, storage)
    y = stepper.cells.rest
    if strained:
        y = stepper.staging.extended(stepper.state(moving(problems)).positions)
    found.turn(y)
    return found, stepper.cells


def dense(function, like):
    """Matrices (B, 3 U, 3 U) of a linear function of (B, U, 3)."""
    scenes, size = len(like), like[0].numel()
    columns = []
    for i in range(size):
        e = torch.zeros(scenes, size, dtype=like.dtype)
        e[:, i] = 1.0
        columns.append(function(e.reshape(like.shape)).reshape(scenes, size))
    return torch.stack(columns, dim=2).numpy()


def levels_of(problem, alike):
    blocks = rest_blocks(problem, 1.0, alike)
    return hierarchy(problem.cells, problem.free, *with_mass(problem, blocks, MASS), problem.refine)


def matrix(level):
    found = summed_blocks(level.cells, level.blocks, len(level.free), CPU).numpy()
    return found + np.diag(np.repeat(level.nodal, 3))


# --- the levels ----------------------------------------------------------------------------------


def interpolation(mesh, k):
    """Trilinear, from a mesh's nodes to those of its refinement."""
    corner, weight, _ = _lattice(mesh, k)
    rows, columns = np.nonzero(weight)
    values = weight[rows, columns] / k**3
    shape = (len(weight), len(mesh.positions))
    return sp.csr_matrix((values, (rows, corner[rows, columns])), shape=shape)


@pytest.mark.parametrize(("k", "shape"), [(2, (3, 2, 1)), (4, (2, 1, 1)), (3, (2, 1, 1))])
def test_coarse_matrices_are_galerkins(k, shape):
    """For cells alike and unlike, with the interpolation of the meshes themselves."""
    coarse = pc.discretise(beam(shape))
    for materials in ([], [{"region": {"box": [[0.01, -1, -1], [1, 1, 1]]}, "young": 3e6}]):
        problem = pc.discretise(beam(shape, materials=materials, solver={"mass": "averaged"}), k)
        alike = alike_cells(problem)
        assert alike is (not materials)
        levels = levels_of(problem, alike)
        assert [len(v.cells) for v in levels][-1] == len(coarse.cells)
        P = sp.identity(len(problem.positions))
        for level in levels[:-1]:
            P = P @ level.interpolation
        order = P.tocsr()[problem.mesh.coarse_nodes].toarray()
        np.testing.assert_array_equal(np.sort(order, axis=1)[:, -1], 1.0)
        exact = interpolation(coarse.mesh, k)
        np.testing.assert_allclose((P @ order.T), exact.toarray(), atol=1e-14)
        wide = np.kron(exact.toarray(), np.eye(3))
        expected = wide.T @ matrix(levels[0]) @ wide
        turned = np.kron(order, np.eye(3))
        found = turned @ matrix(levels[-1]) @ turned.T
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
        assert (order @ levels[-1].free == coarse.free).all()


def test_meshes_of_any_cells_have_levels():
    """Of a distorted mesh: its refinement's blocks are all unlike."""
    coarse = box_mesh((2, 2, 1), (0.1, 0.1, 0.05), 0.2, seed=1)
    fine = refine(coarse, 2)
    free = np.ones((len(fine.positions), 3), dtype=bool)
    blocks = np.random.default_rng(0).normal(size=(len(fine.cells), 24, 24))
    finest, coarsest = hierarchy(fine.cells, free, blocks, np.zeros(len(free)), 2)
    P = finest.interpolation
    order = P[fine.coarse_nodes].toarray()
    np.testing.assert_allclose(P @ order.T, interpolation(coarse, 2).toarray(), atol=1e-14)
    wide = np.kron(P.toarray(), np.eye(3))
    expected = wide.T @ matrix(finest) @ wide
    np.testing.assert_allclose(matrix(coarsest), expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("rule", ["lumped", "averaged", "consistent", "per-node"])
def test_masses_are_those_of_the_problem(rule):
    problem = pc.discretise(beam((2, 1, 1), solver={"mass": rule}), 2)
    blocks = rest_blocks(problem, 1.0, True)
    with_it, nodal = with_mass(problem, blocks, MASS)
    assert len(with_it) == 1
    found = summed_blocks(problem.cells, with_it - blocks, len(nodal), CPU).numpy()
    found += np.diag(np.repeat(nodal, 3))
    exact = MASS * np.kron(problem.mass_matrix.toarray(), np.eye(3))
    np.testing.assert_allclose(found, exact, atol=1e-10 * np.abs(exact).max())


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_the_bound_of_eigenvalues_is_one_and_close(element, poisson):
    problem = pc.discretise(beam((3, 1, 1), poisson=poisson, solver={"element": element}), 2)
    cells, owners = pc.BatchStepper([problem]).cells, torch.tensor([0])
    whole = rest_blocks(problem, 1.0, True)
    (kept,) = Elimination(cells, [whole], owners, 8, 3, torch.float64).blocks
    blocks, nodal = with_mass(problem, kept, MASS)
    A = summed_blocks(problem.cells, blocks, len(nodal), CPU).numpy()
    free = problem.free.ravel()
    D = A * np.kron(np.eye(len(nodal)), np.ones((3, 3)))
    A, D = A[np.ix_(free, free)], D[np.ix_(free, free)]
    true = np.linalg.eigvals(np.linalg.solve(D, A)).real.max()
    assert true <= largest_eigenvalue(blocks, CPU) < 1.3 * true


# --- the cycle -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "element", [pytest.param("hex8", marks=pytest.mark.slow), "hex8-bubble-mean"]
)
def test_the_cycle_is_symmetric_positive_and_close_to_the_inverse(element):
    """On unlike scenes, turned with the body, with its modes and partly clamped."""
    problems = [pc.discretise(scene, 2) for scene in scenes(element)]
    approximate, cells = inverse(problems, "multigrid", strained=True)
    exact, _ = inverse(problems, "rest", strained=True)
    assert approximate.regular.all()
    found, true = dense(approximate, cells.rest), dense(exact, cells.rest)
    for B, H, problem in zip(found, true, problems, strict=True):
        np.testing.assert_allclose(B, B.T, atol=1e-12 * np.abs(B).max())
        kept = np.flatnonzero(np.diag(H))
        assert len(kept) == problem.free_unknowns.sum()
        assert not np.delete(B, kept, axis=0).any()
        B, H = (A[np.ix_(kept, kept)] for A in (B, H))
        eigenvalues = np.linalg.eigvals(np.linalg.solve(H, B)).real
        assert eigenvalues.min() > 1 / 3
        assert eigenvalues.max() < 1 + 1e-9


def contraction(poisson, k):
    """Largest eigenvalue of I - B H, by power iteration on nodal fields."""
    problem = pc.discretise(beam((3, 2, 1), 0.05, poisson, solver={"mass": "lumped"}), k)
    B, _ = inverse([problem], "multigrid")
    K = problem.stiffness(problem.positions, project=True)
    H = K + MASS * sp.kron(problem.mass_matrix, sp.eye_array(3))
    free = problem.free.ravel()
    e, size = np.random.default_rng(0).normal(size=free.size) * free, 0.0
    for _ in range(30):
        e = e / np.linalg.norm(e)
        image = torch.as_tensor((H @ e * free).reshape(1, -1, 3))
        e = e - B(image).numpy().ravel()
        size = np.linalg.norm(e)
    return size


@pytest.mark.parametrize(("poisson", "bound"), [(0.3, 0.4), (0.45, 0.6)])
def test_errors_shrink_alike_on_every_refinement(poisson, bound):
    once, twice = contraction(poisson, 2), contraction(poisson, 4)
    assert 0.05 < once < bound
    assert twice < bound
    assert twice < once + 0.1


def test_unlike_cells_and_single_precision_change_little():
    """One matrix for each cell gives what one for all gives; float32 is close to float64."""
    problems = [pc.discretise(scene, 2) for scene in scenes()]
    graded = pc.discretise(beam((4, 1, 1), materials=STIFF_END), 2)
    alike, cells = inverse(problems, "multigrid")
    r = torch.randn(cells.rest.shape, generator=torch.manual_seed(0), dtype=cells.dtype)
    expected = alike(r)
    mixed, wider = inverse([*problems, graded], "multigrid")
    nodes = cells.sizes.nodes
    padded = torch.zeros_like(wider.rest)
    padded[:-1, :nodes] = r
    padded[-1] = torch.randn(wider.rest[0].shape, dtype=cells.dtype)
    found = mixed(padded)
    torch.testing.assert_close(found[:-1, :nodes], expected, rtol=0, atol=1e-14)
    exact, _ = inverse([graded], "rest")
    work = (padded[-1] * found[-1]).sum() / (padded[-1] * exact(padded[-1:])[0]).sum()
    assert 0.8 < float(work) < 1.0
    single, _ = inverse(problems, "multigrid", torch.float32)
    rough = single(r)
    assert not torch.equal(rough, expected)
    torch.testing.assert_close(rough, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


# --- steps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble-mean"])
def test_steps_are_those_of_single_scenes(element):
    problems = [pc.discretise(scene, 2) for scene in scenes(element)]
    problems[2] = pc.discretise(scenes(element)[2].with_changes(materials=STIFF_END), 2)
    states = moving(problems)
    stepper = pc.BatchStepper(problems, 1e-9, first_hessian="multigrid", recover=False)
    result = stepper(stepper.state(states))
    assert set(result.statuses) == {pc.Status.CONVERGED}
    for problem, state, after in zip(problems, states, stepper.states(result.state), strict=True):
        exact = pc.ProjectiveDynamics(problem, 1e-9)(state).state
        assert np.abs(exact.positions - after.positions).max() < 1e-9


def test_it_takes_fewer_iterations_than_g():
    """And at most twice as many as with the exact inverse of the same Hessian."""
    problem = pc.discretise(beam((4, 1, 1), 0.05), 2)
    found = {}
    for kind in ("multigrid", "rest", "G-scaled"):
        stepper = pc.BatchStepper(
            [problem], 1e-6, integrator="backward-euler", first_hessian=kind, recover=False
        )
        state, count = stepper.rest_state(), 0
        for _ in range(3):
            result = stepper(state)
            assert result.statuses[0].ok
            state, count = result.state, count + int(result.iterations[0])
        found[kind] = count
    assert found["multigrid"] < 0.5 * found["G-scaled"]
    assert found["multigrid"] <= 2 * found["rest"]


def test_derivatives_are_those_with_the_exact_inverse():
    problems = [pc.discretise(scene, 2) for scene in scenes("hex8-bubble-mean")]
    found = []
    for kind in ("multigrid", "rest"):
        stepper = pc.BatchStepper(problems, 1e-10, first_hessian=kind)
        before = stepper.state(moving(problems))
        result = stepper(before)
        g = torch.where(stepper.node_mask[..., None], 1.0, 0.0) * torch.ones_like(before.positions)
        gradients = pc.BatchGradients(stepper, before, result, g, tolerance=1e-9)
        assert gradients.ok.all()
        found.append(gradients.positions)
    scale = float(found[1].abs().max())
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-6 * scale)


# --- what it is for ------------------------------------------------------------------------------


def test_refined_meshes_take_it_from_some_size_on():
    small, large = pc.discretise(beam((2, 1, 1)), 2), pc.discretise(beam((4, 3, 2)), 4)
    assert len(small.positions) <= LARGEST_REST < len(large.positions)
    assert chosen("auto", [small]) == "rest"
    assert chosen("auto", [small, pc.discretise(beam((20, 4, 4)), 2)]) == "multigrid"
    assert chosen("auto", [large]) == "multigrid"
    assert chosen("auto", [large, small]) == "G-scaled"
    assert chosen("multigrid", [small]) == "multigrid"
    coarse = pc.discretise(beam((2, 1, 1)))
    quadratic = pc.discretise(beam((2, 1, 1), solver={"element": "hex27"}), 2)
    for problems in ([coarse], [small, coarse], [small, large], [quadratic]):
        with pytest.raises(InputError, match="'multigrid'"):
            chosen("multigrid", problems)


def test_a_body_adrift_fails_by_name_and_alone():
    adrift, held = (pc.discretise(beam((2, 1, 1), **c), 2) for c in ({"clamps": []}, {}))
    options = {"integrator": "quasi-static", "first_hessian": "multigrid", "recover": False}
    lonely = pc.BatchStepper([adrift], **options)
    with pytest.raises(ConvergenceError):
        lonely(lonely.rest_state())
    stepper = pc.BatchStepper([held, adrift], **options)
    assert [s.ok for s in stepper(stepper.rest_state()).statuses] == [True, False]

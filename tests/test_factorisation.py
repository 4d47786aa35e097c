"""All back ends solve the same; the choice follows size and what is installed."""

import importlib.util

import numpy as np
import pytest
import scipy.sparse as sp

import pdcorrect as pc
from conftest import CLAMPED, beam, disturbed
from pdcorrect.errors import InputError
from pdcorrect.fem import factorisation
from pdcorrect.fem.factorisation import NotPositiveDefinite, choose_backend, factorise
from pdcorrect.fem.multigrid import Multigrid, rigid_motions
from pdcorrect.solvers.integrators import backward_euler
from pdcorrect.solvers.newton import _IterativeSteps
from pdcorrect.solvers.step import StepObjective, global_backend
from pdcorrect.solvers.tangent_solver import TangentFactory

BACKENDS = ["cholespy", "splu", "amg"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("columns", [None, 1, 3])
def test_every_back_end_solves(backend, columns, rng):
    problem = pc.discretise(beam((5, 3, 2)))
    matrix = problem.global_matrix(0.01)
    exact = rng.normal(size=(matrix.shape[0],) if columns is None else (matrix.shape[0], columns))
    factor = factorise(matrix, backend)
    assert factor.backend == backend
    np.testing.assert_allclose(factor.solve(matrix @ exact), exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_indefinite_matrices_are_refused_quietly(backend, capfd):
    matrix = pc.discretise(beam((12, 8, 8))).global_matrix(0.01)
    shift = np.linalg.eigvalsh(matrix.toarray())[5] * 1.01
    matrix = (matrix - shift * sp.eye_array(matrix.shape[0])).tocsc()
    assert (matrix.diagonal() > 0).all()
    right = np.random.default_rng(0).normal(size=matrix.shape[0])
    with pytest.raises(NotPositiveDefinite):
        factorise(matrix, backend).solve(right)
    assert capfd.readouterr() == ("", "")


def test_the_choice_falls_back(monkeypatch):
    assert choose_backend(1000, memory=1e9) == "cholespy"
    assert choose_backend(10_000_000, memory=1e9) == "amg"
    assert choose_backend(30_000, memory=4e8) == "cholespy"
    assert choose_backend(30_000, unknowns=3, memory=4e8) == "amg"
    # a thin factor is expected to fit where a compact one is not
    assert choose_backend(90_000, memory=1e9) == "amg"
    assert choose_backend(90_000, memory=1e9, bandwidth=300) == "cholespy"
    assert choose_backend(900_000, memory=1e9, bandwidth=300) == "amg"
    found = importlib.util.find_spec
    monkeypatch.setattr(
        factorisation.importlib.util,
        "find_spec",
        lambda name: None if name == "cholespy" else found(name),
    )
    assert choose_backend(1000, memory=1e9) == "splu"
    with pytest.raises(InputError, match="expected auto"):
        factorise(sp.eye_array(3).tocsc(), "magic")


@pytest.mark.parametrize("first_hessian", ["G", "lagged"])
@pytest.mark.parametrize("backend", [*BACKENDS, "band"])
def test_steppers_give_the_same_answer_with_every_back_end(backend, first_hessian):
    problem = pc.discretise(beam((5, 2, 2)))
    stepper = pc.ProjectiveDynamics(
        problem, tolerance=1e-8, backend=backend, first_hessian=first_hessian
    )
    exact = pc.Newton(problem)(problem.rest_state())
    result = stepper(problem.rest_state())
    if first_hessian == "lagged" or backend != "band":  # which G does not come in
        assert stepper.describe()["factorisation"] == backend
    np.testing.assert_allclose(result.state.positions, exact.state.positions, atol=1e-9)


def test_the_size_estimate_is_of_the_right_order():
    """Against the true fill of SuperLU's symmetric factor; a bound is all that is needed."""
    for cells in ((8, 8, 8), (14, 14, 14)):
        problem = pc.discretise(beam(cells))
        matrix = problem.global_matrix(0.01)
        lu = factorise(matrix, "splu")._lu
        expected = factorisation.factor_bytes(matrix.shape[0])
        assert 0.2 < expected / (12.0 * lu.L.nnz) < 5


PARTLY_HELD = [*CLAMPED, {"region": {"plane": "z", "at": 0.0}, "components": ["z"]}]


def tangent(cells, poisson=0.45, **changes):
    """The tangent with some inertia of the free components, and their rigid motions."""
    problem = pc.discretise(beam(cells, poisson=poisson, **changes))
    free = np.flatnonzero(problem.free.ravel())
    mass = sp.kron(problem.mass_matrix, sp.eye_array(3))
    matrix = sp.csr_matrix(problem.stiffness(disturbed(problem, 0.02), project=True) + mass)
    return matrix[free][:, free], rigid_motions(problem.positions)[free]


def steps_of(matrix, modes, rng):
    solver = factorise(matrix, "amg", 3, modes)
    solver.solve(rng.normal(size=matrix.shape[0]))
    return solver.steps


@pytest.mark.parametrize("clamps", [CLAMPED, PARTLY_HELD], ids=["whole nodes", "components"])
def test_multigrid_solves_tangents_as_cholesky_does(clamps, rng):
    matrix, modes = tangent((16, 5, 4), clamps=clamps)
    b = rng.normal(size=(matrix.shape[0], 2))
    exact = factorise(matrix, "cholespy", 3).solve(b)
    found = factorise(matrix, "amg", 3, modes).solve(b)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())


def test_multigrid_steps_hardly_grow_with_the_mesh(rng):
    few, many = (steps_of(*tangent((n, n, n)), rng) for n in (6, 12))
    assert many <= 1.5 * few
    few, many = (
        steps_of(pc.discretise(beam((n, n, n))).global_matrix(0.01), None, rng) for n in (8, 16)
    )
    assert many <= 1.5 * few


def test_rigid_motions_help_multigrid(rng):
    matrix, modes = tangent((32, 4, 4))
    assert 3 * steps_of(matrix, modes, rng) < steps_of(matrix, None, rng)


def test_rigid_motions_are_not_resisted():
    problem = pc.discretise(beam((3, 2, 2)))
    stiffness = problem.stiffness(problem.positions)
    modes = rigid_motions(problem.positions)
    assert np.linalg.matrix_rank(modes) == 6
    assert np.abs(stiffness @ modes).max() < 1e-10 * abs(stiffness).max()


def test_a_cycle_is_linear_symmetric_positive_and_the_same_each_time(rng):
    matrix, modes = tangent((12, 5, 4))
    cycle = factorise(matrix, "amg", 3, modes, approximate=True)
    x, y = rng.normal(size=(2, matrix.shape[0]))
    mx, my = cycle.solve(x), cycle.solve(y)
    size = abs(x @ mx) + abs(y @ my)
    assert abs(x @ my - y @ mx) < 1e-12 * size
    assert np.linalg.norm(cycle.solve(2 * x - y) - (2 * mx - my)) < 1e-12 * np.linalg.norm(mx)
    assert x @ mx > 0
    again = factorise(matrix, "amg", 3, modes, approximate=True)
    assert (again.solve(x) == mx).all()


def test_multigrid_refuses_and_passes_on_what_is_not_a_number(rng):
    matrix, modes = tangent((6, 3, 3))
    b = rng.normal(size=matrix.shape[0])
    b[3] = np.nan
    assert np.isnan(factorise(matrix, "amg", 3, modes).solve(b)).all()
    broken = matrix.copy()
    broken.data[:] = np.nan
    with pytest.raises(NotPositiveDefinite):
        Multigrid(broken, modes)


@pytest.mark.parametrize("element", ["hex8", "hex8-bubble"])
def test_newton_by_conjugate_gradients_takes_the_same_steps(element):
    problem = pc.discretise(beam((10, 3, 3), solver={"element": element}, clamps=PARTLY_HELD))
    state = problem.rest_state()
    state.positions[:] = disturbed(problem, 0.1)
    direct, by_cg = (pc.Newton(problem, linear_solver=kind)(state) for kind in ("direct", "cg"))
    assert by_cg.status is direct.status
    assert by_cg.iterations <= direct.iterations + 2
    np.testing.assert_allclose(by_cg.state.positions, direct.state.positions, rtol=0, atol=1e-11)


def test_newton_by_conjugate_gradients_takes_no_saddle_for_a_minimum():
    """Pressed together along its axis, far beyond buckling, and pushed along the axis only."""
    problem = pc.discretise(beam((16, 1, 1), loads=[], time={"step": 1.0}))
    state = problem.rest_state()
    stage = backward_euler(problem, state, 1.0)
    objective = StepObjective(problem, state, stage, np.zeros_like(problem.positions))
    free = np.flatnonzero(problem.free.ravel())
    for factor, minimum in ((1.0, True), (0.8, False)):
        p = problem.positions * [factor, 1.0, 1.0]
        hessian = problem.stiffness(p).toarray() + np.diag(np.repeat(problem.mass, 3))
        lowest = np.linalg.eigvalsh(hessian[free][:, free])[0]
        assert (lowest > 0) == minimum
        steps = _IterativeSteps(objective, TangentFactory(problem), tolerance=1e-9)
        step, exact = steps(p, 1e-12 * problem.free * [1.0, 0.0, 0.0])
        assert np.abs(step).max() < 1e-9
        assert exact == minimum


def test_the_linear_solver_follows_size_and_back_end():
    problem = pc.discretise(beam((3, 2, 2)))
    assert pc.Newton(problem).linear_solver == "direct"
    assert pc.Newton(problem, backend="amg").linear_solver == "cg"
    with pytest.raises(InputError, match="expected 'auto', 'direct' or 'cg'"):
        pc.Newton(problem, linear_solver="magic")
    usual, nearly = (pc.discretise(beam((14, 14, 14), poisson=nu)) for nu in (0.45, 0.4999))
    assert pc.Newton(usual).linear_solver == "cg"
    assert pc.Newton(nearly).linear_solver == "direct"  # incompressible


@pytest.mark.parametrize(
    ("cells", "nodes", "expected"),
    [
        ((40, 16, 16), 11_849, "cholespy"),
        ((18, 18, 18), 6_859, "amg"),
        ((12, 12, 12), 2_197, "cholespy"),
    ],
    ids=["slender beam", "block", "small block"],
)
def test_the_global_matrix_of_a_slender_body_is_factorised_and_of_a_block_not(
    cells, nodes, expected
):
    problem = pc.discretise(beam(cells))
    assert len(problem.positions) == nodes
    assert global_backend(problem) == expected


def test_elements_for_which_multigrid_is_slow_are_factorised_up_to_a_size():
    for element in ("hex27", "hex8-bubble"):
        problem = pc.discretise(
            beam((10, 10, 10)), refine=1 if element == "hex27" else 2, element=element
        )
        assert problem.band_order.bandwidth > factorisation.LARGEST_BANDWIDTH
        assert global_backend(problem) == "cholespy"


def test_a_block_steps_by_multigrid_without_being_told():
    problem = pc.discretise(beam((18, 18, 18)))
    chosen = pc.ProjectiveDynamics(problem, 1e-6, first_hessian="G")
    factorised = pc.ProjectiveDynamics(problem, 1e-6, first_hessian="G", backend="cholespy")
    assert chosen.describe()["factorisation"] == "amg"
    results = [stepper(problem.rest_state()) for stepper in (chosen, factorised)]
    moved = [result.state.positions for result in results]
    assert all(result.status is pc.Status.CONVERGED for result in results)
    np.testing.assert_allclose(*moved, rtol=0, atol=2e-6 * problem.cell_size)

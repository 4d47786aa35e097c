"""All back ends solve the same; the choice follows size and what is installed."""

import importlib.util

import numpy as np
import pytest
import scipy.sparse as sp

import pdcorrect as pc
from conftest import beam
from pdcorrect.errors import InputError
from pdcorrect.fem import factorisation
from pdcorrect.fem.factorisation import NotPositiveDefinite, choose_backend, factorise

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

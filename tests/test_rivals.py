"""The case that contestants simulate is the scene of this package."""

from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc


@pytest.fixture
def modules(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks" / "rivals")
    import case
    import ours

    return case, ours


@pytest.mark.parametrize("refine", [1, 2])
@pytest.mark.parametrize("name", ["weight", "twist, nu 0.45"])
def test_both_sides_have_the_same_nodes_mass_and_loads(modules, name, refine):
    case, ours = modules
    body = case.Case(name, refine)
    problem = pc.discretise(ours.scene(body, "neo-hookean"), refine)
    own = body.match(problem.positions)
    np.testing.assert_allclose(problem.positions[own], body.points, atol=1e-12)
    assert (~problem.free[own].any(axis=1)).nonzero()[0].tolist() == body.clamped.tolist()
    np.testing.assert_allclose(body.lumped, problem.mass[own], rtol=1e-12)
    coarse = case.Case(name)
    np.testing.assert_allclose(body.points[body.coarse], coarse.points, atol=1e-12)

    edges = body.points[body.tets[:, 1:]] - body.points[body.tets[:, :1]]
    volume = np.linalg.det(edges) / 6
    assert volume.min() > 0
    assert volume.sum() * body.density == pytest.approx(body.lumped.sum())

    force = problem.loads[0].pattern[own] - body.lumped[:, None] * body.gravity
    np.testing.assert_allclose(body.forces, force, atol=1e-3 * np.abs(force).max() + 1e-9)


def test_neighbouring_tetrahedra_share_whole_faces(modules):
    body = modules[0].Case("weight")
    faces = np.sort(body.tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]], axis=2)
    _, counts = np.unique(faces.reshape(-1, 3), axis=0, return_counts=True)
    boundary = 2 * 2 * sum(a * b for a, b in ((12, 2), (12, 2), (2, 2)))
    assert counts.max() == 2
    assert (counts == 1).sum() == boundary

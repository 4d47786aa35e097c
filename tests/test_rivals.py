"""The case that contestants simulate is the scene of this package."""

from pathlib import Path

import numpy as np
import pytest

import pdcorrect as pc


@pytest.fixture
def modules(monkeypatch):
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(root / "validation" / "error_time")
    monkeypatch.syspath_prepend(root / "benchmarks" / "rivals")
    import case
    import cases

    return case, cases


@pytest.fixture
def made(modules, tmp_path):
    case, cases = modules

    def make(name, refine=1):
        scene = cases.scenes()[name]
        cases.write(scene, refine, tmp_path / "case.npz")
        return case.Case(tmp_path / "case.npz"), pc.discretise(scene, refine)

    return make


@pytest.mark.parametrize(
    ("name", "refine"),
    [
        ("weight", 2),
        ("cross under torsion", 1),
        ("hard and soft", 1),
        ("impulse", 1),
        ("torsion", 1),
    ],
)
def test_both_sides_have_the_same_nodes_mass_and_loads(made, name, refine):
    body, problem = made(name, refine)
    own = body.match(problem.positions)
    np.testing.assert_allclose(problem.positions[own], body.points, atol=1e-12)
    assert (~problem.free[own].any(axis=1)).nonzero()[0].tolist() == body.clamped.tolist()
    held = ~problem.free.any(axis=1)
    np.testing.assert_array_equal(body.held(problem.positions), held)

    edges = body.points[body.tets[:, 1:]] - body.points[body.tets[:, :1]]
    volume = np.linalg.det(edges) / 6
    assert volume.min() > 0
    assert volume @ body.density[body.owners] == pytest.approx(problem.mass.sum())

    corners = body.points[body.cells]
    points = corners.mean(axis=1, keepdims=True) * (1 - 3**-0.5) + corners * 3**-0.5  # Gauss's
    owners = np.arange(len(points))[:, None]
    for k, load in enumerate(problem.loads):
        forces = body.nodal[k] + problem.mass[own, None] * body.accelerations[k]
        np.testing.assert_allclose(forces, load.pattern[own], atol=1e-12 * np.abs(forces).max())
        total = body.force_density(k, points, owners).sum(axis=(0, 1)) * body.size**3 / 8
        np.testing.assert_allclose(total, forces.sum(axis=0), atol=1e-9 * np.abs(forces).sum())


@pytest.mark.parametrize("at", [0.5, 0.8, 1.0])
@pytest.mark.parametrize("substeps", [1, 5, 24])
def test_amplitudes_are_means_over_a_step(modules, made, substeps, at):
    body, problem = made("portal")
    h = body.step / substeps
    times = h * (np.arange(body.frames * substeps) + at)
    mean = problem.loads[0].amplitude.mean
    wanted = [mean(time - 0.5 * h, time + 0.5 * h) for time in times]
    shift = (at - 0.5) * modules[0].PARTS / substeps
    exact = abs(shift - round(shift)) < 1e-9  # else a step ends within a part
    atol = 1e-12 if exact else 1e-4
    np.testing.assert_allclose(body.factors(substeps, at).ravel(), wanted, atol=atol)


@pytest.mark.parametrize("name", ["angle", "impulse"])
@pytest.mark.parametrize("at", [0.5, 1 / 1.8, 1.0])
@pytest.mark.parametrize("substeps", [1, 4])
def test_impulses_are_kept(made, name, substeps, at):
    body, problem = made(name)
    h, end = body.step / substeps, body.step * body.frames
    first = (at - 0.5) * body.amplitudes[:, 0]  # by the acceleration at time 0
    found = h * (body.factors(substeps, at).sum(axis=(0, 1)) + first)
    wanted = [end * load.amplitude.mean(0.0, end) for load in problem.loads]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


@pytest.mark.parametrize("name", ["weight", "torsion"])
def test_loads_on_27_nodes_do_the_work_of_those_on_8(made, name):
    import mujoco_flex

    body, _ = made(name, refine=2)
    found = mujoco_flex.quadratic_forces(body)
    eight = body.nodal + mujoco_flex.masses(body, 1)[:, None] * body.accelerations[:, None]
    fields = np.column_stack([np.ones(len(body.points)), body.points])
    for own, other in zip(found, eight, strict=True):
        atol = 1e-9 * np.abs(fields).max() * np.abs(own).sum()
        np.testing.assert_allclose(fields.T @ own, fields.T @ other, atol=atol)
    if name == "weight":
        wanted = mujoco_flex.masses(body, 2)[:, None] * body.accelerations[0]
        np.testing.assert_allclose(found[0], wanted, atol=1e-12 * np.abs(wanted).max())


def test_neighbouring_tetrahedra_share_whole_faces(made):
    body, _ = made("struck hook")
    faces = np.sort(body.tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]], axis=2)
    _, counts = np.unique(faces.reshape(-1, 3), axis=0, return_counts=True)
    squares = np.sort(body.cells[:, SQUARES], axis=2).reshape(-1, 4)
    boundary = 2 * (np.unique(squares, axis=0, return_counts=True)[1] == 1).sum()
    assert counts.max() == 2
    assert (counts == 1).sum() == boundary


SQUARES = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [2, 3, 7, 6], [0, 3, 7, 4], [1, 2, 6, 5]]


def test_what_contestants_are_not_given_is_told(modules):
    _, cases = modules
    refused = {name for name, scene in cases.scenes().items() if cases.refusal(scene)}
    assert refused == {"sheared block", "twisted bar", "stairs under pressure"}


def test_where_ours_has_no_such_run_its_ratio_is_none(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "docs")
    import rivals_tables as tables

    def row(contestant, case, error, time):
        found = {"contestant": contestant, "case": case, "law": "same"}
        return found | {tables.ERROR: error, tables.TIME: time}

    rows = [row(tables.OURS, "a", 1.0, 2.0), row(tables.OURS, "b", 9.0, 1.0)]
    run = [row("other", "a", 2.0, 8.0), row("other", "b", 3.0, 5.0)]
    assert tables.ratios(rows, run, tables.TIME, tables.ERROR) == "– (1)"
    run.append(row("other", "a", 2.0, 10.0))
    assert tables.ratios(rows, run, tables.TIME, tables.ERROR) == "4.0 (1)"

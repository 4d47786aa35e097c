"""Operators and the discrete problem: conservation, patch tests, loads, clamps, changes."""

import copy
import pickle

import numpy as np
import pytest
from skfem import (
    Basis,
    BilinearForm,
    ElementHex1,
    ElementHex2,
    LinearForm,
    MeshHex1,
)

import pdcorrect as pc
from conftest import beam, cross, disturbed, rotation
from pdcorrect.errors import InputError, SceneError
from pdcorrect.fem import internal_modes
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.hexahedron import VTK_CORNERS
from pdcorrect.fem.loads import cofactor, torsion_field
from pdcorrect.fem.materials import Materials
from pdcorrect.fem.operators import Space, lumped
from pdcorrect.fem.problem import problem_from_body
from test_mesh import distorted_mesh


def distorted_problem(poisson=0.4):
    """A problem on a distorted mesh, which no scene shape makes."""
    scene = cross(poisson, clamps=[], loads=[])
    mesh = distorted_mesh()
    space = Space(mesh)
    count = len(mesh.cells)
    materials = Materials.from_moduli(
        scene.material, np.linspace(2e5, 4e5, count), np.full(count, poisson), np.full(count, 1e3)
    )
    body = ElasticBody(mesh, space, space.quadrature(), materials, 0.05)
    return problem_from_body(scene, 1, body)


@pytest.mark.parametrize("refine", [1, 2])
@pytest.mark.parametrize("rule", ["lumped", "averaged", "consistent"])
def test_mass_sums_to_density_times_volume(rule, refine):
    problem = pc.discretise(cross(), refine=refine, mass=rule)
    volume = (8 * 4 + 4 * 2 * 4) * 0.05**3
    assert problem.mass.sum() == pytest.approx(1e3 * volume, rel=1e-12)
    assert problem.mass_matrix.sum() == pytest.approx(1e3 * volume, rel=1e-12)
    assert (problem.mass > 0).all()


def test_consistent_mass_gives_the_inertia_of_a_linear_motion():
    """x^T M x is the exact second moment for a field that the elements contain."""
    problem = pc.discretise(beam((3, 2, 1), 0.1), mass="consistent")
    x = problem.positions[:, :1]
    exact = 1e3 * 0.2 * 0.1 * 0.3**3 / 3
    assert float(np.vdot(x, problem.mass_times(x))) == pytest.approx(exact, rel=1e-12)
    half = pc.discretise(beam((3, 2, 1), 0.1), mass="averaged")
    lump = pc.discretise(beam((3, 2, 1), 0.1), mass="lumped")
    np.testing.assert_allclose(
        2 * half.mass_matrix.toarray(),
        (problem.mass_matrix + lump.mass_matrix).toarray(),
        atol=1e-15,
    )


def test_per_node_mass_puts_a_cell_on_every_node():
    problem = pc.discretise(beam((24, 2, 2)), mass="per-node")
    np.testing.assert_allclose(problem.mass, 1e3 * 0.02**3)
    true_mass = 24 * 4 * 1e3 * 0.02**3
    assert problem.mass.sum() / true_mass == pytest.approx(225 / 96)  # 2.3 times too heavy


def test_assembled_and_applied_tangents_agree(rng):
    problem = distorted_problem()
    p, x = disturbed(problem, 0.3), rng.normal(size=problem.positions.shape)
    for project in (False, True):
        tangent = problem.linearise(p, project)
        matrix = problem.assembly.matrix(tangent.blocks())
        np.testing.assert_allclose(
            tangent.apply(x).ravel(), matrix @ x.ravel(), rtol=0, atol=1e-11 * abs(matrix).max()
        )
        assert abs(matrix - matrix.T).max() < 1e-11 * abs(matrix).max()
    assert np.linalg.eigvalsh(matrix.toarray()).min() > -1e-8 * abs(matrix).max()


def test_global_matrix_bounds_the_tangent(rng):
    """Gamma's local/global descent rests on G - d2W >= 0."""
    problem = pc.discretise(cross())
    G = np.kron(problem.global_matrix(1e9).toarray(), np.eye(3))
    for amplitude in (0.0, 0.2, 0.5):
        K = problem.stiffness(disturbed(problem, amplitude)).toarray()
        assert np.linalg.eigvalsh(G - K).min() > -1e-9 * np.abs(G).max()


# --- loads ----------------------------------------------------------------------------


def total(problem, *times):
    return problem.external_forces(*times).sum(axis=0)


def test_gravity_weighs_the_body_with_every_mass():
    for rule in ("lumped", "averaged", "consistent", "per-node"):
        problem = pc.discretise(beam(), mass=rule)
        np.testing.assert_allclose(
            total(problem, 0.0), [0, 0, -9.81 * problem.mass.sum()], atol=1e-12
        )


@pytest.mark.parametrize("refine", [1, 2])
def test_consistent_loads_have_the_same_resultant_on_every_mesh(refine):
    tip = {"plane": "x", "at": "max"}
    half = {"box": [[0.04, -1, -1], [0.08, 1, 1]]}
    loads = {
        "traction": [0, 500.0, 0],
        "force": [1.0, 2.0, -3.0],
        "force in cells": [1.0, 2.0, -3.0],
        "body-force": [0, 0, 2e3],
        "pressure": 400.0,
    }
    area, volume = 0.04**2, 2 * 4 * 0.02**3
    expected = {
        "traction": [0, 500 * area, 0],
        "force": [1, 2, -3],
        "force in cells": [1, 2, -3],
        "body-force": [0, 0, 2e3 * volume],
        "pressure": [-400 * area, 0, 0],
    }
    for name, value in loads.items():
        kind = "force" if name == "force in cells" else name
        key = {"body-force": "density"}.get(kind, kind)
        region = half if name in ("force in cells", "body-force") else tip
        scene = beam(loads=[{"kind": kind, key: value, "region": region}])
        problem = pc.discretise(scene, refine=refine)
        np.testing.assert_allclose(total(problem, 0.0), expected[name], atol=1e-12, err_msg=name)


def test_nodal_loads_act_on_coarse_nodes_only_on_every_mesh():
    scene = beam(
        loads=[
            {"kind": "force", "force": [0, 0, -2.0], "region": {"plane": "x", "at": "max"},
             "distribution": "nodal"},
            {"kind": "torsion", "strength": 0.1, "distribution": "nodal"},
        ]
    )  # fmt: skip
    coarse, fine = pc.discretise(scene), pc.discretise(scene, refine=4)
    here, there = coarse.external_forces(0.0), fine.external_forces(0.0)
    np.testing.assert_allclose(there[fine.mesh.coarse_nodes], here, atol=1e-13)
    others = np.setdiff1d(np.arange(len(there)), fine.mesh.coarse_nodes)
    assert (there[others] == 0).all()


def test_torsion_field_is_the_published_one(rng):
    points = rng.normal(size=(50, 3))
    _, y, z = points.T
    k, alpha = 0.3, 0.7
    raw = np.stack([np.full(50, alpha), -z - k * y, y - k * z], axis=1)
    np.testing.assert_allclose(
        torsion_field(points, k, alpha), raw / np.linalg.norm(raw, axis=1)[:, None], atol=1e-14
    )
    np.testing.assert_array_equal(torsion_field(np.zeros((1, 3)), k, 0.0), np.zeros((1, 3)))


def test_follower_pressure_turns_with_the_body():
    """On a rotated, stretched block the resultant is the rotated, stretched one (Nanson)."""
    tip = {"plane": "x", "at": "max"}
    load = {"kind": "pressure", "pressure": 300.0, "region": tip}
    follower = pc.discretise(beam(loads=[{**load, "follower": True}]))
    dead = pc.discretise(beam(loads=[load]))
    A = rotation() @ np.diag([1.1, 0.8, 1.3])
    p = follower.positions @ A.T
    np.testing.assert_allclose(
        follower.external_forces(0, 1, p).sum(axis=0),
        cofactor(A) @ follower.external_forces(0, 1).sum(axis=0),
        atol=1e-13,
    )
    np.testing.assert_array_equal(dead.external_forces(0, 1, p), dead.external_forces(0, 1))
    singular = np.diag([1.0, 2.0, 0.0])
    np.testing.assert_allclose(cofactor(singular), np.diag([0, 0, 2.0]))


def test_follower_torsion_is_sampled_where_the_body_is():
    load = {"kind": "torsion", "strength": 100.0, "centre": [0, 0, 0], "follower": True}
    for distribution in ("nodal", "consistent"):
        problem = pc.discretise(beam(loads=[{**load, "distribution": distribution}]))
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        np.testing.assert_allclose(
            problem.external_forces(0, 1, problem.positions @ turn.T),
            problem.external_forces(0, 1) @ turn.T,
            atol=1e-13,
        )


def amplitude(problem, start, end):
    return total(problem, start, end)[2] / -9.81 / problem.mass.sum()


def test_amplitudes_are_averaged_over_the_step():
    def gravity(**more):
        return pc.discretise(
            beam(loads=[{"kind": "gravity", "acceleration": [0, 0, -9.81], **more}])
        )

    window = gravity(window=[0.0, 0.03])
    assert [round(amplitude(window, t, t + 0.01), 12) for t in (0, 0.01, 0.02, 0.03)] == [
        1,
        1,
        1,
        0,
    ]
    assert amplitude(window, 0.02, 0.04) == pytest.approx(0.5)
    ramp = gravity(window=[0.1, 0.5], ramp=0.2)
    assert amplitude(ramp, 0.0, 0.1) == 0
    assert amplitude(ramp, 0.1, 0.2) == pytest.approx(0.25)
    assert amplitude(ramp, 0.1, 0.5) == pytest.approx(0.75)
    assert amplitude(ramp, 0.3, 0.3) == pytest.approx(1.0)
    table = gravity(table=[[0.0, 0.0], [0.1, 2.0], [0.2, -1.0]])
    assert amplitude(table, 0.0, 0.1) == pytest.approx(1.0)
    assert amplitude(table, 0.05, 0.15) == pytest.approx(0.5 * 1.5 + 0.5 * 1.25)
    assert amplitude(table, 0.5, 0.6) == pytest.approx(-1.0)
    endless = gravity(ramp=0.2)
    assert amplitude(endless, 0.0, 0.2) == pytest.approx(0.5)
    assert amplitude(endless, 7.0, 8.0) == pytest.approx(1.0)


def test_the_impulse_does_not_depend_on_the_step():
    load = {
        "kind": "gravity",
        "acceleration": [0, 0, -9.81],
        "window": [0.003, 0.027],
        "ramp": 0.01,
    }
    problem = pc.discretise(beam(loads=[load]))
    impulses = [
        sum(total(problem, t, t + h)[2] * h for t in np.arange(0, 0.04, h))
        for h in (0.01, 0.005, 0.0025)
    ]
    np.testing.assert_allclose(impulses, impulses[0], rtol=1e-12)


# --- clamps and regions ------------------------------------------------------------------


def test_clamps_hold_the_named_components_of_the_named_nodes():
    scene = beam(
        clamps=[
            {"region": {"plane": "x", "at": 0.0}, "components": ["x", "z"]},
            {"region": {"sphere": [0.12, 0.0, 0.0], "radius": 1e-3}},
            {"region": {"nodes": [10]}, "components": ["y"]},
        ]
    )
    for refine in (1, 2):
        problem = pc.discretise(scene, refine=refine)
        x = problem.positions
        expected = np.ones_like(problem.free)
        expected[np.isclose(x[:, 0], 0), 0] = expected[np.isclose(x[:, 0], 0), 2] = False
        expected[np.isclose(x, [0.12, 0, 0]).all(axis=1)] = False
        expected[problem.mesh.coarse_nodes[10], 1] = False
        np.testing.assert_array_equal(problem.free, expected)


def test_moving_clamps_follow_their_tables():
    motion = {
        "times": [0.0, 0.1], "displacement": [[0, 0, 0], [0.01, 0, 0]],
        "rotation": [0.0, 90.0], "axis": "x", "centre": [0, 0.02, 0.02],
    }  # fmt: skip
    problem = pc.discretise(
        beam(clamps=[{"region": {"plane": "x", "at": "max"}, "motion": motion}])
    )
    held = ~problem.free[:, 0]
    x = problem.positions[held] - [0, 0.02, 0.02]
    for time, angle, shift in (
        (0.0, 0, 0),
        (0.05, np.pi / 4, 0.005),
        (0.1, np.pi / 2, 0.01),
        (9, np.pi / 2, 0.01),
    ):
        c, s = np.cos(angle), np.sin(angle)
        turned = x @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
        np.testing.assert_allclose(
            problem.clamped_positions(time)[held],
            turned + np.array([shift, 0.02, 0.02]),
            atol=1e-15,
        )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"clamps": [{"region": {"plane": "x", "at": 0.5}}]}, r"clamps\[0\].region .* no node"),
        ({"clamps": [{"region": {"nodes": [999]}}]}, "node 999"),
        (
            {"loads": [{"kind": "pressure", "pressure": 1, "region": {"plane": "y", "at": 0.01}}]},
            r"loads\[0\].region .* no boundary face",
        ),
        (
            {"loads": [{"kind": "force", "force": [1, 0, 0], "region": {"nodes": [3]}}]},
            "distribution = 'nodal'",
        ),
        (
            {"loads": [{"kind": "force", "force": [1, 0, 0], "distribution": "nodal",
                        "region": {"plane": "x", "at": 0.0}}]},
            r"loads\[0\] .* clamps hold",
        ),
        ({"materials": [{"region": {"nodes": [1]}, "young": 1.0}]}, r"materials\[0\].*volume"),
        (
            {"materials": [{"region": {"sphere": [9, 9, 9], "radius": 1}, "young": 1.0}]},
            r"materials\[0\].region .* no cell centre",
        ),
        ({"clamps": [{"region": {"everywhere": True}}]}, "expected a free one"),
        (
            {"clamps": [
                {"region": {"plane": "x", "at": 0.0}},
                {"region": {"nodes": [0]}, "motion": {"times": [0], "displacement": [[1, 0, 0]]}},
            ]},
            "differently",
        ),
    ],
)  # fmt: skip
def test_scenes_that_contradict_their_mesh_are_refused(changes, words):
    with pytest.raises(SceneError, match=words):
        pc.discretise(beam(**changes))


def test_materials_by_region_reach_their_cells():
    scene = beam(
        materials=[{"region": {"box": [[0, 0, 0], [0.06, 1, 1]]}, "young": 5e6, "density": 2e3}]
    )
    problem = pc.discretise(scene, refine=2)
    first = problem.mesh.centres[:, 0] < 0.06
    ratio = problem.materials.mu[first].min() / problem.materials.mu[~first].max()
    assert ratio == pytest.approx(5)
    assert problem.mass.sum() == pytest.approx(1.5 * 1e3 * 6 * 4 * 0.02**3)


# --- changes ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "copied", [lambda x: x, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_a_problem_cannot_be_changed_behind_its_factors_back(copied):
    problem = copied(pc.discretise(beam()))
    for array in (problem.positions, problem.free, problem.materials.mu, problem.mass_matrix.data):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_kernels_are_not_compiled_anew_for_copies():
    problem = pc.discretise(pc.best_coarse(beam((2, 1, 1))))
    problem.relaxed(problem.positions)
    known = len(internal_modes.relax.kernel.signatures)
    same = copy.deepcopy(problem)
    same.relaxed(same.positions)
    assert len(internal_modes.relax.kernel.signatures) == known


def test_nan_positions_give_nan_energy_and_forces():
    problem = pc.discretise(beam())
    p = problem.positions.copy()
    p[4, 1] = np.nan
    energy, forces = problem.energy_and_forces(p)
    assert np.isnan(energy)
    assert np.isnan(forces[4]).any()


def test_the_applied_tangent_is_linear_to_the_last_digits(rng):
    problem = pc.discretise(beam())
    tangent = problem.linearise(disturbed(problem, 0.2))
    x = rng.normal(size=problem.positions.shape)
    full = tangent.apply(x)
    for scale in (1e-10, 1e-16, 1e8):
        np.testing.assert_allclose(
            tangent.apply(scale * x) / scale, full, atol=1e-12 * abs(full).max()
        )


def test_runs_say_when_their_material_is_not_the_scenes():
    problem = pc.discretise(beam())
    changed = problem.with_material(young=5e6, poisson=0.1)
    for one, words in ((problem, "the scene's"), (changed, "changed after the scene")):
        run = pc.rollout(pc.ProjectiveDynamics(one), 1)
        assert run.attributes["material"] == words


def test_the_default_torsion_axis_is_the_middle_of_the_body():
    problem = pc.discretise(beam(clamps=[], loads=[{"kind": "torsion", "strength": 1e4}]))
    forces = problem.external_forces(0.0)
    np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-12)
    middle = problem.positions.mean(axis=0)
    torque = np.cross(problem.positions - middle, forces).sum(axis=0)
    assert torque[0] > 0
    np.testing.assert_allclose(torque[1:], 0, atol=1e-12)


@pytest.mark.parametrize("refine", [1, 4])
@pytest.mark.parametrize("distribution", ["nodal", "consistent"])
@pytest.mark.parametrize("element", ["hex8", "hex27"])
def test_rounded_coordinates_on_the_torsion_axis_have_no_direction(element, distribution, refine):
    """Of 1 and 6 cells: the axis goes through points of the quadrature, or through nodes."""
    for width in (1, 6):
        load = {"kind": "torsion", "strength": 1.0, "distribution": distribution}
        body = {"shape": "beam", "cells": [2, width, width], "cell_size": 0.07}
        scene = beam(clamps=[], loads=[load]).with_changes(body=body)
        forces = pc.discretise(scene, refine, element=element).external_forces(0.0)
        np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-10 * np.abs(forces).max())


def test_other_materials_make_another_problem():
    problem = pc.discretise(beam(poisson=0.3))
    other = problem.with_material(young=2e6, poisson=0.3, density=500.0)
    p = disturbed(problem, 0.2)
    assert other.energy(p) == pytest.approx(2 * problem.energy(p))
    np.testing.assert_allclose(2 * other.mass, problem.mass)
    np.testing.assert_allclose(2 * other.external_forces(0), problem.external_forces(0))
    for bad in ({"young": 1e6}, {"density": np.nan}, {"young": 1e6, "poisson": 0.5}):
        with pytest.raises(InputError, match="expected"):
            problem.with_material(**bad)
    cells = np.full(len(problem.cells), 1e3)
    cells[5] = -1
    with pytest.raises(InputError, match="density of cell 5"):
        problem.with_material(density=cells)


def test_energies_that_leave_a_term_out():
    p = disturbed(pc.discretise(beam()), 0.3)
    parts = [
        pc.discretise(beam(material={"energy": kind})).energy(p)
        for kind in ("corotated-only", "volume-only", "corotated")
    ]
    assert parts[0] > 0
    assert parts[1] > 0
    assert parts[0] + parts[1] == pytest.approx(parts[2], rel=1e-13)


def test_discretise_overrides_and_checks():
    problem = pc.discretise(beam(), mass="averaged")
    assert problem.mass_rule == problem.scene.solver.mass == "averaged"
    np.testing.assert_allclose(lumped(problem.mass_matrix), problem.mass)
    with pytest.raises(InputError, match="refine = 0"):
        pc.discretise(beam(), refine=0)
    with pytest.raises(SceneError, match="hex99"):
        pc.discretise(beam(), element="hex99")


@BilinearForm
def weighted_product(u, v, w):
    return w.density * u * v


@LinearForm
def work(v, w):
    return w.load * v


@pytest.mark.parametrize(("element", "shape", "order"), [
    ("hex8", ElementHex1, (3, 5)), ("hex27", ElementHex2, (5, 7)),
])  # fmt: skip
def test_masses_and_body_loads_are_those_of_scikit_fem_to_the_bit(element, shape, order):
    mesh = distorted_mesh()
    space = Space(mesh, element)
    rng = np.random.default_rng(3)
    density = rng.uniform(1.0, 2.0, len(mesh.cells))
    order_of_corners = np.abs(
        VTK_CORNERS[:, None] - ElementHex1().doflocs[None]
    ).max(axis=-1).argmin(axis=1)  # fmt: skip
    cells = np.empty_like(mesh.cells)
    cells[:, order_of_corners] = mesh.cells
    plain = MeshHex1(np.ascontiguousarray(mesh.positions.T), np.ascontiguousarray(cells.T))
    load_basis, mass_basis = (Basis(plain, shape(), intorder=n) for n in order)
    per_point = np.broadcast_to(density[:, None], mass_basis.dx.shape)
    expected = weighted_product.assemble(mass_basis, density=per_point)
    assert abs(space.mass(density) - expected).max() == 0.0
    load = rng.normal(size=(*load_basis.dx.shape, 3))
    columns = [work.assemble(load_basis, load=np.ascontiguousarray(load[..., i])) for i in range(3)]
    assert (space.body_load(load) == np.stack(columns, axis=1)).all()
    gradients = np.stack([f[0].grad for f in load_basis.basis])  # K x (3, C, Q), its order
    found = np.moveaxis(space.quadrature().lanes, (1, 2), (0, 1))
    assert (np.sort(found, axis=0) == np.sort(gradients, axis=0)).all()

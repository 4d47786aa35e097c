"""Several bodies in one scene move as each alone; names are groups; what touches is refused."""

import dataclasses

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam, box_mesh
from pdcorrect.data.importing import portable
from pdcorrect.errors import InputError, PdcorrectWarning, SceneError
from pdcorrect.evaluation.converged import cache_key
from pdcorrect.fem.mesh import coincident_nodes
from pdcorrect.state import Status

ONE = {"shape": "beam", "cells": [4, 2, 1], "cell_size": 0.02}
TWO = {"shape": "beam", "cells": [3, 1, 2], "cell_size": 0.03, "origin": [0.0, 0.0, 0.1]}
ROLLER = {"region": {"plane": "y", "at": "min"}, "components": ["y"]}


def alone(body, **changes):
    return beam(body=body, **changes)


def both(**changes):
    return beam(body=ONE | {"name": "one"}, bodies=[TWO | {"name": "two"}], **changes)


@pytest.mark.parametrize("element", ["hex8", "hex8-enhanced", "hex8-learned", "hex27"])
@pytest.mark.parametrize(("refine", "stepper"), [(1, pc.ProjectiveDynamics), (2, pc.Newton)])
def test_bodies_move_as_each_alone(element, refine, stepper):
    changes = {"solver": {"element": element}, "time": {"frames": 2}}
    changes["clamps"] = [*both().model_dump(exclude_unset=True)["clamps"], ROLLER]
    if refine == 2 and element == "hex27":
        changes["time"]["frames"] = 1
    runs = [
        pc.rollout(stepper(pc.discretise(scene, refine), tolerance=1e-12))
        for scene in (alone(ONE, **changes), alone(TWO, **changes), both(**changes))
    ]
    one, two, joined = (run.problem for run in runs)
    for run in runs[:2]:
        nodes = coincident_nodes(joined.positions, run.points, 1e-12)
        away = np.abs(runs[2].positions[:, nodes] - run.positions).max()
        assert away < 1e-9 * joined.cell_size
    if element == "hex8-learned":
        learned = np.concatenate([one.correction.learned, two.correction.learned])
        np.testing.assert_array_equal(joined.correction.learned, learned)
        assert learned.any()


def test_bodies_are_groups_for_materials_clamps_loads_velocities_and_probes():
    scene = both(
        materials=[{"region": {"group": "two"}, "young": 7e6, "density": 2e3}],
        clamps=[{"region": {"group": "one"}}],
        loads=[{"kind": "force", "region": {"group": "two"}, "force": [1.0, 0.0, 2.0]}],
        actuators=[{"region": {"group": "two"}, "direction": [1, 0, 0], "stiffness": 1.0,
                    "activation": [[0.0, 0.9]]}],
        initial={"region": {"group": "two"}, "angular_velocity": [0.0, 0.0, 3.0]},
        probes=[{"name": "two", "region": {"group": "two"}}],
    )  # fmt: skip
    problem = pc.discretise(scene)
    cells = len(problem.mesh.groups["one"].cells)
    np.testing.assert_array_equal(problem.materials.young, [1e6] * cells + [7e6] * 6)
    held = ~problem.free.any(axis=1)
    np.testing.assert_array_equal(held, problem.positions[:, 2] < 0.05)
    forces = problem.external_forces(0.0)
    np.testing.assert_allclose(forces[~held].sum(axis=0), [1.0, 0.0, 2.0])
    assert not forces[held].any()
    velocities = problem.initial_state().velocities
    assert not velocities[held].any()
    middle = problem.positions[~held].mean(axis=0)
    expected = np.cross([0.0, 0.0, 3.0], problem.positions[~held] - middle)
    np.testing.assert_allclose(velocities[~held], expected, atol=1e-12)
    found = pc.metrics.probes(pc.rollout(pc.ProjectiveDynamics(problem), 1))
    assert list(found) == ["two"]
    assert len(np.unique(problem.fibres.cells, axis=0)) == 6


def test_mesh_files_and_labels_have_groups_by_the_bodys_name(tmp_path):
    mesh = box_mesh((4, 1, 1), (0.4, 0.1, 0.1))
    data = {"part": [np.repeat([4, 9], 2)]}
    meshio.write(tmp_path / "a.vtu", meshio.Mesh(mesh.positions, [("hexahedron", mesh.cells)],
                                                 cell_data=data))  # fmt: skip
    np.save(tmp_path / "b.npy", np.array([[[1, 2, 0, 2]]]))
    text = both(clamps=[], loads=[]).to_toml()
    start, end = text.index("[body]"), text.index("[material]")
    files = (
        '[body]\nshape = "file"\npath = "a.vtu"\nname = "a"\n[[bodies]]\nshape = "voxels"\n'
        'occupancy = "b.npy"\ncell_size = 0.1\norigin = [1, 0, 0]\n'
    )
    (tmp_path / "scene.toml").write_text(text[:start] + files + text[end:])
    scene = pc.Scene.load(tmp_path / "scene.toml")
    assert pc.Scene.from_toml(scene.to_toml()) == scene
    groups = pc.discretise(scene).mesh.groups
    found = {name: group.cells.tolist() for name, group in groups.items() if len(group.cells)}
    assert found == {
        "a": [0, 1, 2, 3],
        "a.part=4": [0, 1],
        "a.part=9": [2, 3],
        "1": [4],
        "2": [5, 6],
    }
    key = cache_key(scene)
    np.save(tmp_path / "b.npy", np.array([[[1, 2, 2, 2]]]))
    assert cache_key(scene) != key  # what a file holds counts


def test_each_body_is_held_in_statics():
    settled = {"step": 1.0, "frames": 1, "integrator": "quasi-static"}
    loose = both(time=settled, clamps=[{"region": {"group": "one"}}])
    with pytest.raises(SceneError, match="the part of the body at node"):
        pc.Newton(pc.discretise(loose))
    run = pc.rollout(pc.Newton(pc.discretise(both(time=settled))))
    assert set(run.stats["status"]) == {"CONVERGED"}


@pytest.mark.parametrize(
    ("bodies", "told"),
    [
        ([TWO | {"name": "one"}], "'one'"),
        ([TWO | {"name": ""}], r"bodies\[0\].*name"),
        ([TWO | {"origin": [0.08, 0.0, 0.0]}], r"bodies\[0\] touches body|body touches bodies"),
        ([TWO | {"origin": [0.01, 0.01, -0.03]}], "touches"),
        ([TWO | {"cell_size": 1e-300}], r"bodies\[0\]\.cell_size"),
        ([TWO, {**TWO, "shape": "cross"}], r"bodies\[1\]"),
    ],
)
def test_wrong_bodies_are_refused_by_name(bodies, told):
    with pytest.raises(SceneError, match=told):
        pc.discretise(beam(body=ONE | {"name": "one"}, bodies=bodies))


def test_unknown_names_and_data_sets_are_refused():
    with pytest.raises(SceneError, match=r"clamps\[0\].*'three'.*'one', 'two'"):
        pc.discretise(both(clamps=[{"region": {"group": "three"}}]))
    with pytest.raises(InputError, match="bodies"):
        portable(both())


def test_restriction_needs_all_bodies_at_one_place():
    run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(both())), 1)
    with pytest.raises(pc.errors.MeshError, match=r"0\.14 m"):
        pc.restrict(run, to=pc.discretise(alone(ONE)))
    hollow = np.ones((3, 3, 3), int)
    hollow[1, 1, 1] = 0
    bodies = [{"shape": "voxels", "cell_size": 0.02, "occupancy": x.tolist()}
              for x in (np.ones((3, 3, 3), int), hollow)]  # fmt: skip
    sections = beam().model_dump(exclude_unset=True)
    full, less = (pc.discretise(pc.Scene(**sections | {"body": body})) for body in bodies)
    with pytest.raises(pc.errors.MeshError, match="m3"):
        pc.restrict(pc.rollout(pc.ProjectiveDynamics(full), 1), to=less)


def test_inverted_frames_are_told_by_the_interface_too():
    class Folding(pc.ProjectiveDynamics):
        def __call__(self, state, forces=None):
            return dataclasses.replace(super().__call__(state, forces), status=Status.INVERTED)

    problem = pc.discretise(beam((2, 1, 1)))
    with pytest.warns(PdcorrectWarning, match="1 of 1 frames ended with inverted"):
        pc.rollout(Folding(problem), 1, on_failure="continue")

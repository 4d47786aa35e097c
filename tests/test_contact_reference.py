"""Barrier, friction and first hits of obstacles are those of the IPC Toolkit (extra dev)."""

import numpy as np
import pytest

from pdcorrect.fem.contact import Touching, barrier
from pdcorrect.fem.obstacles import RigidObstacle
from pdcorrect.scene import Plane
from pdcorrect.solvers.contact import Sliding

ipctk = pytest.importorskip("ipctk", reason="the reference is the IPC Toolkit: pip install ipctk")

POINT, NORMAL = np.array([0.1, 0.0, 0.2]), np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
PLANE = RigidObstacle(Plane(shape="plane", point=POINT.tolist(), normal=NORMAL.tolist()))
DISTANCE, SLIP, FRICTION = 1e-2, 2e-3, 0.6
COUNT = 40


def near(seed=0):
    """Points at gaps of up to one distance."""
    x = np.random.default_rng(seed).normal(size=(COUNT, 3))
    gaps = DISTANCE * np.random.default_rng(seed + 1).uniform(0.05, 0.98, COUNT)
    return x + (gaps - PLANE.gaps(x, 0.0))[:, None] * NORMAL


def test_the_barrier_and_its_derivatives():
    s = np.linspace(0.01, 1.2, 200)
    theirs = ipctk.NormalizedClampedLogBarrier()
    orders = theirs, theirs.first_derivative, theirs.second_derivative
    for ours, function in zip(barrier(s), orders, strict=True):
        np.testing.assert_allclose(ours, [function(x, 1.0) for x in s], rtol=1e-12, atol=1e-14)


def test_friction_on_an_oblique_plane():
    """The IPC Toolkit's barrier is of squared gaps: its normal forces are given to both."""
    x = near()
    vertices = np.asfortranarray(x)
    mesh = ipctk.CollisionMesh(vertices)
    mesh.planes = [ipctk.Hyperplane(NORMAL, POINT)]
    candidates = ipctk.Candidates()  # by default 1.6.1 seeks planes up to half the distance only
    candidates.build(mesh, vertices, DISTANCE)
    normal, tangential = ipctk.NormalCollisions(), ipctk.TangentialCollisions()
    normal.build(candidates, mesh, vertices, DISTANCE)
    potential = ipctk.BarrierPotential(DISTANCE, 1e9)
    tangential.build(mesh, vertices, normal, potential, FRICTION)
    assert len(tangential) == COUNT
    force = np.zeros(COUNT)
    for i in range(COUNT):
        one = tangential[i]
        force[one.vertex_ids(mesh.edges, mesh.faces)[0]] = one.normal_force_magnitude
    normals, curvatures = PLANE.derivatives(x, 0.0)
    touching = Touching(np.arange(COUNT), 0.0, force, np.zeros(COUNT), normals, curvatures)
    sliding = Sliding(FRICTION, touching, x, SLIP)
    u = np.random.default_rng(2).normal(size=(COUNT, 3)) * SLIP  # within and beyond the slip
    theirs, given = ipctk.FrictionPotential(SLIP), (tangential, mesh, np.asfortranarray(u))
    value, forces = sliding.value_and_forces(u)
    at_rest = theirs(tangential, mesh, np.zeros_like(u, order="F"))
    assert value == pytest.approx(theirs(*given) - at_rest, rel=1e-12)
    np.testing.assert_allclose(-forces.ravel(), theirs.gradient(*given), rtol=1e-10, atol=1e-12)
    tangents = theirs.hessian(*given).toarray().reshape(COUNT, 3, COUNT, 3)
    own = tangents[np.arange(COUNT), :, np.arange(COUNT)]
    np.testing.assert_allclose(sliding.matrices(u), own, rtol=1e-9, atol=1e-9 * np.abs(own).max())


def test_first_hits_of_a_plane():
    x = near(3) + 0.3 * NORMAL
    ways = np.random.default_rng(4).normal(size=x.shape)
    for start, way in zip(x, ways, strict=True):
        hits, share = ipctk.point_static_plane_ccd(start, start + way, POINT, NORMAL, 1.0)
        found = PLANE.first_hit(start[None], way[None], 0.0)
        assert (found <= 1.0) == hits
        if hits:
            assert found == pytest.approx(share, rel=1e-9)

"""Scenes and meshes that several tests share; all asymmetric on purpose."""

import gc
import multiprocessing
import os
import sys
from dataclasses import replace

import numba
import numpy as np
import pytest

import pdcorrect as pc
from pdcorrect.cli import main
from pdcorrect.fem.clamps import Selector
from pdcorrect.fem.elastic_body import ElasticBody
from pdcorrect.fem.materials import Materials
from pdcorrect.fem.mesh import HexMesh, boundary_faces, voxel_mesh
from pdcorrect.fem.operators import Space
from pdcorrect.fem.problem import problem_from_body

ELEMENTS = (
    "hex8", "hex8-mean", "hex8-bubble", "hex8-bubble-mean", "hex8-enhanced", "hex27",
)  # fmt: skip

if "PYTEST_XDIST_WORKER" in os.environ:  # kernels of one thread each, as the others want cores
    numba.set_num_threads(1)

LONG = (
    "test_faults", "test_pages", "test_resume", "test_steppers", "test_tiny_again",
    "test_torch_layer", "test_training_unrolled", "test_validation",
)  # fmt: skip
"""Files of long tests, late in the alphabet: first, so that no process ends far behind."""

CLAMPED = [{"region": {"plane": "x", "at": 0.0}}]
GRAVITY = [{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}]


def slow_unless(fast, values):
    """Parameters (tuples are several), marked slow unless they are among the fast ones."""
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=[] if value in fast else [pytest.mark.slow],
        )
        for value in values
    ]


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.stem not in LONG)


def pytest_collection_finish():
    """What modules hold stays, and collections of garbage, a tenth of the time, leave it out."""
    gc.freeze()


def beam(cells=(6, 2, 2), cell_size=0.02, poisson=0.45, **changes):
    """A cantilever under its own weight."""
    settings = {
        "body": {"shape": "beam", "cells": list(cells), "cell_size": cell_size},
        "material": {"young": 1e6, "poisson": poisson, "density": 1e3},
        "time": {"step": 0.01, "frames": 20},
        "clamps": CLAMPED,
        "loads": GRAVITY,
    }
    for key, value in changes.items():
        old = settings.get(key)
        settings[key] = {**old, **value} if isinstance(old, dict) else value
    return pc.Scene(**settings)


def cross(poisson=0.45, **changes):
    """A four-armed cross, twisted."""
    body = {
        "shape": "cross", "cells": [8, 2, 2], "cell_size": 0.05, "arms": 4, "arm_start": 5,
        "arm_width": 2, "arm_length": 2,
    }  # fmt: skip
    return beam(
        poisson=poisson,
        **{
            "body": body,
            "material": {"young": 3e5},
            "loads": [{"kind": "torsion", "strength": 3e4, "stretch": 0.01}],
            **changes,
        },
    )


def box_mesh(counts, size, distortion=0.0, seed=0):
    """A box of hexahedra; inner nodes moved at random by up to ``distortion`` cells."""
    mesh = voxel_mesh(np.ones(counts, dtype=bool), (0, 0, 0), 1.0)
    x = mesh.positions
    inside = ((x > 0) & (x < counts)).all(axis=1)
    moves = np.random.default_rng(seed).uniform(-distortion, distortion, x.shape)
    return HexMesh.create((x + moves * inside[:, None]) * np.divide(size, counts), mesh.cells)


def problem_on(mesh, element="hex8", **changes):
    """A free body without loads on any mesh, which no scene shape makes."""
    scene = beam(**{"clamps": [], "loads": [], **changes}).with_changes(solver={"element": element})
    space = Space(mesh, element)
    cell_size = float(np.cbrt(space.volumes().mean()))
    selector = Selector(mesh, space, cell_size)
    materials = Materials.from_scene(scene, selector, len(mesh.cells))
    body = ElasticBody(mesh, space, space.quadrature(), materials, cell_size)
    return problem_from_body(scene, 1, body)


def boundary_nodes(problem):
    """Numbers of all nodes on the surface, those of edges and faces included."""
    faces = problem.space.face_quadrature(boundary_faces(problem.mesh.cells)[0])
    touched = np.abs(faces.values).max(axis=1) > 1e-9
    return np.unique(problem.cells[faces.cells][touched])


def held(problem, nodes, positions):
    """The same problem with ``nodes`` held at their rows of ``positions`` (N, 3)."""
    free = np.ones_like(problem.free)
    free[nodes] = False
    return replace(problem, clamps=replace(problem.clamps, free=free, rest=positions))


def disturbed(problem, amplitude, seed=0):
    """Rest positions plus noise (of the cell size) on the free components."""
    noise = np.random.default_rng(seed).normal(size=problem.positions.shape)
    return problem.positions + amplitude * problem.cell_size * noise * problem.free


def rotation(seed=3):
    """A rotation matrix without symmetry."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """No test reads or fills the user's cache of converged motions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PDCORRECT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def rng():
    return np.random.default_rng(12345)


@pytest.fixture
def program(capsys, monkeypatch):
    """Call the program in this process; returns (status, standard output, standard error)."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["pdcorrect", *map(str, arguments)])
        status = 0
        try:
            main()
        except SystemExit as end:
            status = end.code or 0
        out, err = capsys.readouterr()
        return status, out, err

    return call


LIMIT = 60.0
"""Seconds that a test waits for a copy of its process."""


class Copy:
    """A copy of this process that calls a function, and a pipe to it; waits `LIMIT` at most."""

    def __init__(self, function, *arguments):
        context = multiprocessing.get_context("fork")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=function, args=(there, *arguments), daemon=True)
        self._process.start()
        there.close()
        self.name = function.__name__
        self.send, self.kill = self._pipe.send, self._process.kill
        self.terminate = self._process.terminate

    def recv(self):
        if not self._pipe.poll(LIMIT):
            pytest.fail(f"{self.name} has sent nothing in {LIMIT} s")
        return self._pipe.recv()

    def join(self):
        """Its exit code."""
        self._process.join(LIMIT)
        assert self._process.exitcode is not None, f"{self.name} has not ended in {LIMIT} s"
        return self._process.exitcode


@pytest.fixture
def fork():
    """Call a function in a copy of this process, which imports nothing again.

    Its first argument is a pipe; the other end of it is in the `Copy` that comes back.
    """
    if sys.platform != "linux":
        pytest.skip("no safe copies of a process with libraries there")
    started = []

    def start(function, *arguments):
        started.append(Copy(function, *arguments))
        return started[-1]

    yield start
    for copy in started:
        copy.kill()
        copy.join()


@pytest.fixture
def few_threads():
    """One thread of torch: small networks are quicker so, and trainings go on bit by bit."""
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)

"""Correctors of small scenes, fitted to their plain runs, with random or chosen weights."""

import itertools

import numpy as np
import torch

import pdcorrect as pc
from conftest import beam, box_mesh, disturbed, problem_on
from pdcorrect.corrector.batch_hybrid import BatchBodies
from pdcorrect.corrector.corrector import Corrector, preset
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES
from pdcorrect.corrector.model_io import ModelRecord, save_model
from pdcorrect.corrector.normaliser import RunningMoments

TORSION = {"kind": "torsion", "strength": 3e3, "stretch": 0.01}
EULER = {"integrator": "backward-euler"}
"""By which correctors learn, and forces and energies of a correction are known in advance."""
CELL = 0.02
"""Of all bodies here, m."""
TINY = {
    "node_features": ("load", "previous-correction"), "edge_features": ("stretch",), "layers": 1,
    "width": 3,
}  # fmt: skip
"""A network with few weights that remembers."""
PRESSURE = {"kind": "pressure", "region": {"plane": "z", "at": "max"}, "pressure": 300.0}


def seen(*parts):
    """Moments of values (m, k) that come in parts."""
    moments = RunningMoments()
    for part in parts:
        moments.add(part)
    return moments


class Prescribed(Corrector):
    """Gives ``answer`` (n, 3), m, whatever it is asked; a NumPy array."""

    answer = None

    def of_view(self, view):
        found = torch.tensor(self.answer).to(view.bodies.rest)
        return torch.where(view.bodies.free, found, 0.0)


class Watched(Corrector):
    """Counts how often it is asked."""

    calls = 0

    def of_view(self, view, network=None):
        self.calls += 1
        return super().of_view(view, network)


def soft_beam(cells=(3, 1, 1), **changes):
    """Small, moves a good part of its cells, and steps as correctors learn."""
    return beam(
        cells, material={"young": 5e4}, time={**EULER, **changes.pop("time", {})}, **changes
    )


def problems(*cells):
    """Unlike beams that step together."""
    scenes = [soft_beam(c, loads=[PRESSURE] if k % 2 else [TORSION]) for k, c in enumerate(cells)]
    return [pc.discretise(scene) for scene in scenes]


def fitted(scenes, size=0.05, kind=Corrector, steps=6, seed=0, **changes):
    """A corrector in float64 whose ranges are those of plain runs; corrections of some ``size``."""
    config = preset("compact", **{"layers": 2, "width": 16, **changes})
    torch.manual_seed(seed)
    corrector = kind(config).double()
    nodes, states = _plain_run(scenes, steps)
    moments = {name: RunningMoments() for name in corrector.normaliser.names}
    views = []
    for state, after in itertools.pairwise(states):
        views.append(nodes.view(state, after.positions, None))
        for table, names in (
            (NODE_FEATURES, config.node_features),
            (EDGE_FEATURES, config.edge_features),
        ):
            for name in names:
                moments[name].add(table[name][1](views[-1]))
    corrector.normaliser.fit(moments, seen(torch.full((4, 1), size)))
    averages = [nodes.graph.body_means(corrector.inputs(view)[0]) for view in views]
    corrector.envelope.fit({
        **moments, "average": seen(*averages), "shape": seen(nodes.graph.shapes),
        "time_step": seen(nodes.graph.time_steps[:, None]),
    })  # fmt: skip
    return corrector


_plain_runs: dict = {}
"""By what a run depends on: tests fit correctors to the same few scenes."""


def _plain_run(scenes, steps):
    """Bodies of a batch and its states from rest on, ``steps`` steps; never changed by anyone."""
    key = (steps, *(_contents(problem) for problem in scenes))
    if key not in _plain_runs:
        stepper = pc.BatchStepper(scenes)
        states = [stepper.rest_state()]
        for _ in range(steps):
            states.append(stepper(states[-1]).state)
        _plain_runs[key] = BatchBodies(stepper), states
    return _plain_runs[key]


def _contents(problem):
    """What tells two problems apart, as bytes."""
    materials, clamps = problem.materials, problem.clamps
    arrays = (
        problem.mesh.positions, problem.mesh.cells, problem.mass, problem.mass_matrix.data,
        problem.free, clamps.rest, materials.young, materials.poisson, materials.density,
    )  # fmt: skip
    return (problem.scene.to_toml(), *(a.tobytes() for a in arrays))


def saved(folder, scenes, base="plain", **changes):
    """A fitted corrector on disk, as trained on some coarse model; its folder."""
    corrector = fitted(scenes, **changes)
    corrector.network.float()
    return save_model(
        corrector,
        folder,
        record=ModelRecord(dataset="none", dataset_hash="", training={"base": base}),
    )


def silent(corrector):
    """The same with zero output."""
    with torch.no_grad():
        corrector.network.decoder[-1].weight.zero_()
        corrector.network.decoder[-1].bias.zero_()
    return corrector


def prescribed(problem, answer, **changes):
    """A corrector of one scene that always gives an answer (N, 3), m."""
    corrector = fitted([problem], kind=Prescribed, **changes)
    corrector.answer = np.asarray(answer, dtype=float)
    return corrector


# --- states and corrections ------------------------------------------------------------------


def same(a, b):
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.velocities, b.velocities)


def bumped(problem, size=0.1, seed=0):
    """A displacement of some cells, (N, 3), zero where clamped."""
    return disturbed(problem, size, seed) - problem.positions


def shaken(problem, speed=0.3, seed=1):
    """At rest positions, but in motion."""
    velocities = speed * np.random.default_rng(seed).normal(size=problem.positions.shape)
    return pc.State(problem.positions, velocities * problem.free)


def folded(problem):
    """A correction that pushes the end of the beam through its last cells."""
    x = problem.positions[:, 0]
    return np.outer(np.isclose(x, x.max()), [-1.5 * CELL, 0.0, 0.0])


def wild(problem):
    """One without inverted cells, but with far more energy than the step has."""
    stretch = np.zeros_like(problem.positions)
    stretch[:, 0] = 0.5 * problem.positions[:, 0]
    return stretch * problem.free


def flying(speed=0.5):
    """A free body in uniform motion along x, and its state."""
    problem = problem_on(box_mesh((2, 1, 1), (0.04, 0.02, 0.02), 0.2), time=EULER)
    velocities = np.zeros_like(problem.positions)
    velocities[:, 0] = speed
    return problem, pc.State(problem.positions, velocities)

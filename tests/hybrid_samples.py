"""Correctors of small scenes, fitted to their plain runs, with random or chosen weights."""

import numpy as np
import torch

import pdcorrect as pc
from conftest import beam
from pdcorrect.corrector.batch_bodies import BatchBodies
from pdcorrect.corrector.config import preset
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import EDGE_FEATURES, NODE_FEATURES, View
from pdcorrect.corrector.normaliser import Moments

PLACEMENTS = ("state", "force", "guess")
TORSION = {"kind": "torsion", "strength": 3e3, "stretch": 0.01}
PRESSURE = {"kind": "pressure", "region": {"plane": "z", "at": "max"}, "pressure": 300.0}


class Prescribed(Corrector):
    """Gives ``answer`` (n, 3), m, whatever it is asked; a NumPy array."""

    answer = None

    def of_view(self, view):
        found = torch.tensor(self.answer).to(view.bodies.rest)
        return torch.where(view.bodies.free, found, 0.0)


def soft_beam(cells=(3, 1, 1), **changes):
    """Small, and it moves a good part of its cells."""
    return beam(cells, material={"young": 5e4}, **changes)


def problems(*cells):
    """Unlike beams that step together."""
    scenes = [soft_beam(c, loads=[PRESSURE] if k % 2 else [TORSION]) for k, c in enumerate(cells)]
    return [pc.discretise(scene) for scene in scenes]


def fitted(scenes, size=0.05, kind=Corrector, steps=6, seed=0, **changes):
    """A corrector in float64 whose ranges are those of plain runs; corrections of some ``size``."""
    config = preset("compact", **{"layers": 2, "width": 16, **changes})
    torch.manual_seed(seed)
    corrector = kind(config).double()
    stepper = pc.BatchStepper(scenes)
    nodes, state = BatchBodies(stepper), stepper.rest_state()
    moments = {name: Moments() for name in corrector.normaliser.names}
    for _ in range(steps):
        after = stepper(state).state
        coarse = after.positions if config.placement == "state" else None
        view = View(nodes.graph, nodes.snapshot(state, coarse, None))
        for table, names in (
            (NODE_FEATURES, config.node_features),
            (EDGE_FEATURES, config.edge_features),
        ):
            for name in names:
                moments[name].add(table[name][1](view))
        state = after
    target = Moments()
    target.add(torch.full((4, 1), size))
    corrector.normaliser.fit(moments, target)
    return corrector


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

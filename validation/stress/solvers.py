"""The solvers of the battery, run alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Any

import numpy as np
from scenarios import Scenario

import pdcorrect as pc
from pdcorrect.scene import trained_coarse

Array = np.ndarray
NO_GATE = "no gate"
"""A corrector without a gate, which shows what the gate is for: nothing is expected of it."""
MODELS = {"hybrid": "tiny", "hybrid torsion": "torsion-exact", NO_GATE: "torsion-exact"}
"""Correctors by solver."""
ENHANCED, LEARNED = "PD enhanced", "PD learned"
"""The best coarse model, and the learned element beside it."""
SOLVERS = ("PD", "PD best", ENHANCED, LEARNED, "Newton", "batch", "hybrid", "hybrid torsion")
"""Projective dynamics on the plain mesh, on that of the correctors, on the best coarse and on the
learned one; Newton and the batch stepper on the plain one; and correctors with their gate."""
KNOWN_SOLVERS = ("PD", "PD best", ENHANCED, LEARNED, "Newton", "hybrid torsion", NO_GATE)
"""Those of bodies that the torsion model knows."""
CHOOSE: dict[str, Callable[[pc.Scene], pc.Scene]] = {
    **dict.fromkeys(("PD best", *MODELS), trained_coarse),
    ENHANCED: pc.best_coarse,
    LEARNED: pc.learned_coarse,
}
"""What chooses the element and mass of a solver, if not the scene."""

TIGHT = 1e-8
"""Of the coarse cell size: PD as Newton's reference.  Newton as that of PD has its own default."""


@dataclass(frozen=True)
class Run:
    """Positions (T+1, N, 3) and what the steps said.

    Attributes
    ----------
    problem : Problem
    positions : (T+1, N, 3)
    statuses : list of Status
    iterations : list of int
    refused : list of int
        1 where a correction was refused.
    """

    problem: pc.Problem
    positions: Array
    statuses: list[pc.Status]
    iterations: list[int]
    refused: list[int]

    @property
    def accepted(self) -> float:
        """Share of the steps whose correction was not refused."""
        return 1.0 - float(np.mean(self.refused))

    @property
    def status(self) -> pc.Status:
        """The last failure, or the status of the last frame."""
        failed = [status for status in self.statuses if not status.ok]
        return failed[-1] if failed else self.statuses[-1]

    @property
    def least_corner(self) -> float:
        """Least det F at the cells' corners at the end; below zero where a cell is folded."""
        return float(self.problem.corner_volume_ratios(self.positions[-1]).min())


def problem_of(scenario: Scenario, solver: str, refine: int = 1) -> pc.Problem:
    """The mesh that a solver works on; solvers of one element share it, since some are large."""
    return _discretised(scenario, CHOOSE.get(solver), refine)


@lru_cache(maxsize=5)
def _discretised(
    scenario: Scenario, choose: Callable[[pc.Scene], pc.Scene] | None, refine: int
) -> pc.Problem:
    return pc.discretise(choose(scenario.scene) if choose else scenario.scene, refine=refine)


def run(scenario: Scenario, solver: str) -> Run:
    """All steps; one that fails does not end the run."""
    problem = problem_of(scenario, solver)
    if solver == "batch":
        return _batch(scenario, problem)
    return steps_of(scenario, MAKE[solver](problem))


def tight(scenario: Scenario, solver: str) -> Run:
    """The same steps by the other method, solved tightly."""
    problem = problem_of(scenario, solver)
    other = pc.ProjectiveDynamics(problem, TIGHT) if solver == "Newton" else pc.Newton(problem)
    return steps_of(scenario, other)


def finer(scenario: Scenario) -> Run:
    """The same steps by PD on a finer mesh of PD best's element, at its nodes."""
    fine = steps_of(
        scenario, pc.ProjectiveDynamics(problem_of(scenario, "PD best", scenario.finer))
    )
    coarse, shared = problem_of(scenario, "PD best"), fine.problem.mesh.coarse_nodes
    return replace(fine, problem=coarse, positions=fine.positions[:, shared])


@cache
def _model(model: str) -> Any:
    return pc.load_model(model)


def _hybrid(solver: str, problem: pc.Problem) -> pc.HybridStepper:
    found, gate = _model(MODELS[solver]), None if solver == NO_GATE else pc.Gate()
    coarse = pc.ProjectiveDynamics(problem)
    return pc.HybridStepper(coarse, found.corrector, velocity=found.velocity, gate=gate)


MAKE: dict[str, Callable[[pc.Problem], pc.Stepper]] = {
    **dict.fromkeys(("PD", "PD best", ENHANCED, LEARNED), pc.ProjectiveDynamics),
    "Newton": pc.Newton,
    **{solver: partial(_hybrid, solver) for solver in MODELS},
}


def steps_of(scenario: Scenario, stepper: pc.Stepper) -> Run:
    """All of a scene's steps by a stepper."""
    problem, state = stepper.problem, scenario.state(stepper.problem)
    results = []
    for number in range(scenario.scene.time.frames):
        forces = scenario.forces(problem, number) if scenario.forces else None
        results.append(stepper(state, forces))
        state = results[-1].state
    return Run(
        problem,
        np.stack([scenario.state(problem).positions, *(r.state.positions for r in results)]),
        [r.status for r in results],
        [r.iterations for r in results],
        [int(r.stats.get("refused", 0)) for r in results],
    )


def _batch(scenario: Scenario, problem: pc.Problem) -> Run:
    import torch

    stepper = pc.BatchStepper([problem])
    states, results = [scenario.state(problem)], []
    batch = stepper.state(states)
    for number in range(scenario.scene.time.frames):
        forces = None
        if scenario.forces:
            forces = torch.as_tensor(scenario.forces(problem, number))[None]
        results.append(stepper(batch, forces))
        batch = results[-1].state
        states += stepper.states(batch)
    return Run(
        problem,
        np.stack([state.positions for state in states]),
        [r.statuses[0] for r in results],
        [int(r.iterations[0]) for r in results],
        [0] * len(results),
    )

"""Coarse-mesh projective dynamics of soft solids, validated against Newton FEM.

    import pdcorrect as pc

    scene = pc.Scene.load("torsion.toml")
    problem = pc.discretise(scene, refine=4)
    run = pc.rollout(pc.ProjectiveDynamics(problem), frames=60)

Everything below is loaded when first used, so importing the package is quick and
brings in neither torch, pyvista, h5py nor meshio.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pdcorrect._version import __version__ as __version__

_NAMES = {
    "scene": ("Scene", "best_coarse", "learned_coarse"),
    "state": ("State", "Status", "StepResult"),
    "trajectory": ("Stepper", "Trajectory"),
    "fem.problem": ("Problem", "discretise", "coarse_model"),
    "fem.stress": ("stress",),
    "fem.modes": ("modes",),
    "solvers.projective": ("ProjectiveDynamics",),
    "solvers.newton": ("Newton",),
    "solvers.adjoint": ("adjoint",),
    "batch.stepper": ("BatchStepper",),
    "batch.adjoint": ("BatchGradients",),
    "batch.layer": ("PDLayer",),
    "corrector.corrector": ("Corrector",),
    "corrector.model_io": ("load_model", "save_model"),
    "corrector.hybrid": ("HybridStepper", "hybrid_of"),
    "corrector.batch_hybrid": ("BatchHybrid", "HybridLayer"),
    "corrector.gate": ("Gate",),
    "solvers.rollout": ("rollout", "march", "restrict"),
    "solvers.reactions": ("reactions", "contact_forces"),
    "io.trajectory": ("load_trajectory", "save_trajectory", "TrajectoryWriter"),
    "io.vtk": ("write_vtu_series",),
    "figures": ("render", "render_overlay"),
    "evaluation.compare": ("compare",),
    "evaluation.converged": ("converged", "error_estimate"),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
_MODULES = ("metrics", "errors", "figures")

__all__ = [  # noqa: RUF022
    "Scene",
    "best_coarse",
    "learned_coarse",
    "State",
    "Status",
    "StepResult",
    "Stepper",
    "Trajectory",
    "Problem",
    "discretise",
    "coarse_model",
    "stress",
    "modes",
    "ProjectiveDynamics",
    "Newton",
    "adjoint",
    "BatchStepper",
    "BatchGradients",
    "PDLayer",
    "Corrector",
    "load_model",
    "save_model",
    "HybridStepper",
    "hybrid_of",
    "BatchHybrid",
    "HybridLayer",
    "Gate",
    "rollout",
    "march",
    "restrict",
    "reactions",
    "contact_forces",
    "load_trajectory",
    "save_trajectory",
    "TrajectoryWriter",
    "write_vtu_series",
    "render",
    "render_overlay",
    "compare",
    "converged",
    "error_estimate",
    "metrics",
    "errors",
    "figures",
    "__version__",
]

if TYPE_CHECKING:
    from pdcorrect import errors, figures, metrics
    from pdcorrect.batch.adjoint import BatchGradients
    from pdcorrect.batch.layer import PDLayer
    from pdcorrect.batch.stepper import BatchStepper
    from pdcorrect.corrector.batch_hybrid import BatchHybrid, HybridLayer
    from pdcorrect.corrector.corrector import Corrector
    from pdcorrect.corrector.gate import Gate
    from pdcorrect.corrector.hybrid import HybridStepper, hybrid_of
    from pdcorrect.corrector.model_io import load_model, save_model
    from pdcorrect.evaluation.compare import compare
    from pdcorrect.evaluation.converged import converged, error_estimate
    from pdcorrect.fem.modes import modes
    from pdcorrect.fem.problem import Problem, coarse_model, discretise
    from pdcorrect.fem.stress import stress
    from pdcorrect.figures import render, render_overlay
    from pdcorrect.io.trajectory import TrajectoryWriter, load_trajectory, save_trajectory
    from pdcorrect.io.vtk import write_vtu_series
    from pdcorrect.scene import Scene, best_coarse, learned_coarse
    from pdcorrect.solvers.adjoint import adjoint
    from pdcorrect.solvers.newton import Newton
    from pdcorrect.solvers.projective import ProjectiveDynamics
    from pdcorrect.solvers.reactions import reactions
    from pdcorrect.solvers.rollout import march, restrict, rollout
    from pdcorrect.state import State, Status, StepResult
    from pdcorrect.trajectory import Stepper, Trajectory


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"pdcorrect.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'pdcorrect' has no attribute {name!r}")
    if _HOME[name].startswith(("batch.", "corrector.")):
        importlib.import_module("pdcorrect.errors").require_extra("torch", "learn")
    return getattr(importlib.import_module(f"pdcorrect.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)

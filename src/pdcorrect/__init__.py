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

_HOME = {
    "Scene": "pdcorrect.scene",
    "best_coarse": "pdcorrect.scene",
    "learned_coarse": "pdcorrect.scene",
    "State": "pdcorrect.state",
    "Status": "pdcorrect.state",
    "StepResult": "pdcorrect.state",
    "Stepper": "pdcorrect.trajectory",
    "Trajectory": "pdcorrect.trajectory",
    "Problem": "pdcorrect.fem.problem",
    "discretise": "pdcorrect.fem.problem",
    "coarse_model": "pdcorrect.fem.problem",
    "stress": "pdcorrect.fem.stress",
    "modes": "pdcorrect.fem.modes",
    "ProjectiveDynamics": "pdcorrect.solvers.projective",
    "Newton": "pdcorrect.solvers.newton",
    "adjoint": "pdcorrect.solvers.adjoint",
    "BatchStepper": "pdcorrect.batch.stepper",
    "BatchGradients": "pdcorrect.batch.adjoint",
    "PDLayer": "pdcorrect.batch.layer",
    "Corrector": "pdcorrect.corrector.corrector",
    "load_model": "pdcorrect.corrector.model_io",
    "save_model": "pdcorrect.corrector.model_io",
    "HybridStepper": "pdcorrect.corrector.hybrid",
    "hybrid_of": "pdcorrect.corrector.hybrid",
    "BatchHybrid": "pdcorrect.corrector.batch_hybrid",
    "HybridLayer": "pdcorrect.corrector.batch_hybrid",
    "Gate": "pdcorrect.corrector.gate",
    "rollout": "pdcorrect.solvers.rollout",
    "march": "pdcorrect.solvers.rollout",
    "restrict": "pdcorrect.solvers.rollout",
    "reactions": "pdcorrect.solvers.reactions",
    "load_trajectory": "pdcorrect.io.trajectory",
    "save_trajectory": "pdcorrect.io.trajectory",
    "TrajectoryWriter": "pdcorrect.io.trajectory",
    "write_vtu_series": "pdcorrect.io.vtk",
    "render": "pdcorrect.figures",
    "render_overlay": "pdcorrect.figures",
    "compare": "pdcorrect.evaluation.compare",
    "converged": "pdcorrect.evaluation.converged",
    "error_estimate": "pdcorrect.evaluation.converged",
}
_NEEDS_TORCH = (
    "BatchStepper", "BatchGradients", "PDLayer", "Corrector", "HybridStepper", "hybrid_of",
    "BatchHybrid", "HybridLayer", "Gate", "load_model", "save_model",
)  # fmt: skip
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
    if name in _NEEDS_TORCH:
        errors_module = importlib.import_module("pdcorrect.errors")
        errors_module.require_extra("torch", "learn")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"pdcorrect.{name}")
    raise AttributeError(f"module 'pdcorrect' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

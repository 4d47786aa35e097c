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

__all__ = [*_HOME, *_MODULES, "__version__"]

if TYPE_CHECKING:
    from pdcorrect import errors as errors
    from pdcorrect import figures as figures
    from pdcorrect import metrics as metrics
    from pdcorrect.batch.adjoint import BatchGradients as BatchGradients
    from pdcorrect.batch.layer import PDLayer as PDLayer
    from pdcorrect.batch.stepper import BatchStepper as BatchStepper
    from pdcorrect.corrector.batch_hybrid import BatchHybrid as BatchHybrid
    from pdcorrect.corrector.batch_hybrid import HybridLayer as HybridLayer
    from pdcorrect.corrector.corrector import Corrector as Corrector
    from pdcorrect.corrector.gate import Gate as Gate
    from pdcorrect.corrector.hybrid import HybridStepper as HybridStepper
    from pdcorrect.corrector.hybrid import hybrid_of as hybrid_of
    from pdcorrect.corrector.model_io import load_model as load_model
    from pdcorrect.corrector.model_io import save_model as save_model
    from pdcorrect.evaluation.compare import compare as compare
    from pdcorrect.evaluation.converged import converged as converged
    from pdcorrect.evaluation.converged import error_estimate as error_estimate
    from pdcorrect.fem.modes import modes as modes
    from pdcorrect.fem.problem import Problem as Problem
    from pdcorrect.fem.problem import coarse_model as coarse_model
    from pdcorrect.fem.problem import discretise as discretise
    from pdcorrect.fem.stress import stress as stress
    from pdcorrect.figures import render as render
    from pdcorrect.figures import render_overlay as render_overlay
    from pdcorrect.io.trajectory import TrajectoryWriter as TrajectoryWriter
    from pdcorrect.io.trajectory import load_trajectory as load_trajectory
    from pdcorrect.io.trajectory import save_trajectory as save_trajectory
    from pdcorrect.io.vtk import write_vtu_series as write_vtu_series
    from pdcorrect.scene import Scene as Scene
    from pdcorrect.scene import best_coarse as best_coarse
    from pdcorrect.scene import learned_coarse as learned_coarse
    from pdcorrect.solvers.adjoint import adjoint as adjoint
    from pdcorrect.solvers.newton import Newton as Newton
    from pdcorrect.solvers.projective import ProjectiveDynamics as ProjectiveDynamics
    from pdcorrect.solvers.reactions import reactions as reactions
    from pdcorrect.solvers.rollout import march as march
    from pdcorrect.solvers.rollout import restrict as restrict
    from pdcorrect.solvers.rollout import rollout as rollout
    from pdcorrect.state import State as State
    from pdcorrect.state import Status as Status
    from pdcorrect.state import StepResult as StepResult
    from pdcorrect.trajectory import Stepper as Stepper
    from pdcorrect.trajectory import Trajectory as Trajectory


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

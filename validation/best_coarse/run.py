"""How much of the plain coarse mesh's error better elements, masses and loads remove."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import common
import numpy as np

import pdcorrect as pc
from pdcorrect.fem.loads import Amplitude, NodalLoad, torsion_field
from pdcorrect.scene import Torsion

Array = np.ndarray

CELL = 0.05
FRAMES = 25
TOLERANCE = 1e-6
"""Of the coarse cell size, of every run."""

BODIES: dict[str, dict[str, Any]] = {
    "beam": {"shape": "beam", "cells": [12, 2, 2], "cell_size": CELL},
    "short beam": {"shape": "beam", "cells": [4, 2, 2], "cell_size": CELL},
    "thin beam": {"shape": "beam", "cells": [12, 1, 1], "cell_size": CELL},
    "cross": {
        "shape": "cross", "cells": [8, 2, 2], "cell_size": CELL,
        "arm_start": 5, "arm_width": 2, "arm_length": 2,
    },
    "weight": {
        "shape": "weight", "cell_size": CELL, "support_cells": [6, 2, 2], "pendulum_start": 2,
        "pendulum_cells": [2, 2, 6], "weight_start": 2, "weight_cells": [4, 4, 2],
    },
}  # fmt: skip
MATERIAL = {"young": 3e5, "poisson": 0.4, "density": 1e3}
LEFT = {"region": {"plane": "x", "at": "min"}}
RIGHT = {"region": {"plane": "x", "at": "max"}}
BOTTOM = {"plane": "z", "at": "min"}
CLAMPS = {"weight": [LEFT, RIGHT]}
"""Of the bodies that are not held at the left only."""

Loads = dict[str, Any]


def gravity(*acceleration: float) -> Loads:
    """Uniform acceleration, m/s2."""
    return {"kind": "gravity", "acceleration": acceleration}


def force(region: dict[str, Any], *total: float, **more: Any) -> Loads:
    """Total force on a plane, N."""
    return {"kind": "force", "force": total, "region": region, **more}


def twist(strength: float, linear: bool = False) -> Loads:
    """The thesis's field of unit vectors (N/m3), or one linear in the distance (N/m3 a cell)."""
    return {"kind": "torsion", "strength": strength, "linear": linear}


IMPULSE = (0.0, 0.03)
MOTIONS: dict[str, Loads] = {
    "beam, bend": gravity(0, 0, -9.81),
    "beam, impulse": force(RIGHT["region"], 0, 30, 60, window=IMPULSE),
    "beam, stretch": force(RIGHT["region"], 400, 0, 0),
    "beam, twist unit": twist(4e4),
    "beam, twist linear": twist(4e4, True),
    "cross, bend": gravity(0, 0, -15.0),
    "cross, impulse": force(RIGHT["region"], 0, 80, 120, window=IMPULSE),
    "cross, stretch": force(RIGHT["region"], 300, 0, 0),
    "cross, twist unit": twist(4e4),
    "cross, twist linear": twist(2e4, True),
    "weight, bend": gravity(0, 15.0, 0),
    "weight, impulse": force(BOTTOM, 60, 90, 0, window=IMPULSE),
    "weight, stretch": force(BOTTOM, 0, 0, -300),
    "weight, twist unit": twist(4e4),
    "weight, twist linear": twist(1e4, True),
}


CHECKS: dict[str, Loads] = {
    "short beam, bend": gravity(0, 0, -9.81),
    "short beam, twist unit": twist(4e4),
}
"""For the reference's own error, which takes an 8x8x8 mesh."""
THIN: dict[str, Loads] = {
    "thin beam, bend": gravity(0, 0, -4.0),
    "thin beam, stretch": force(RIGHT["region"], 100, 0, 0),
    "thin beam, twist unit": twist(6e4),
}
"""One cell through the thickness."""
VARIED: dict[str, Loads] = {
    "beam, twist unit, half": twist(2e4),
    "beam, twist linear, half": twist(2e4, True),
    "beam, stretch, published": force(RIGHT["region"], 400, 0, 0),
}
"""The same with half the load, or another volume weight."""
MATERIALS = {"beam, stretch, published": {"volume_weight": "published"}}
ALL = MOTIONS | CHECKS | THIN | VARIED


@dataclass(frozen=True)
class Model:
    """A discretisation.

    ``lumped`` is the share of the lumped mass, the rest is consistent; force densities are
    ``integrated`` with the shape functions, or their values at nodes times the nodes' volumes.
    """

    element: str
    lumped: float = 1.0
    integrated: bool = False
    refine: int = 1

    @property
    def label(self) -> str:
        """Its row in the tables."""
        names = {0.0: "consistent", 0.5: "averaged", 1.0: "lumped"}
        mass = names.get(self.lumped, f"{self.lumped:g} lumped")
        cells = "" if self.refine == 1 else f" {self.refine}x"
        loads = "integrated" if self.integrated else "nodal"
        return f"{self.element}{cells}, {mass}, {loads}"


PLAIN = Model("hex8")
DEFAULT = Model("hex8", 1.0, True)
"""What a scene gives that says nothing."""
REFERENCE = Model("hex8-enhanced", 0.5, True, refine=4)
BEST = Model("hex8-enhanced", 0.5, True)
"""What `pdcorrect.best_coarse` chooses."""
MODELS = (
    Model("hex8", refine=2), DEFAULT, Model("hex8", 0.5, True), Model("hex8-mean", 0.5, True),
    Model("hex8-bubble", 0.5, True), Model("hex8-bubble-mean", 0.5, True),
    *(Model("hex8-enhanced", a, True) for a in (1.0, 0.5, 0.0)), Model("hex27", 0.5, True),
)  # fmt: skip
THIN_MODELS = tuple(
    Model(e, 0.5, True) for e in ("hex8-bubble", "hex8-bubble-mean", "hex8-enhanced", "hex27")
)
VARIED_MODELS = tuple(Model("hex8-enhanced", a, True) for a in (0.5, 0.0))


# --- problems ------------------------------------------------------------------------------


def scene(motion: str) -> pc.Scene:
    """The scene of a motion."""
    body = motion.split(",")[0]
    keys = dict(ALL[motion])
    keys.pop("linear", None)
    return pc.Scene(
        name=motion, body=BODIES[body], loads=[keys],
        material={**MATERIAL, **MATERIALS.get(motion, {})},
        clamps=CLAMPS.get(body, [LEFT]), solver={"tolerance": TOLERANCE},
        time={"step": 0.01, "frames": FRAMES, "integrator": "generalised-alpha"},
    )  # fmt: skip


def discretised(motion: str, model: Model) -> pc.Problem:
    """A motion's problem."""
    keys, told = ALL[motion], scene(motion)
    problem = pc.discretise(told, model.refine, "consistent", model.element)
    share = model.lumped
    lumped = pc.discretise(told, model.refine, "lumped", model.element).mass_matrix
    matrix = lumped if share == 1.0 else share * lumped + (1.0 - share) * problem.mass_matrix
    loads = problem.loads
    if isinstance(told.loads[0], Torsion):
        loads = (torsion(problem, told.loads[0], keys["linear"], model.integrated),)
    return replace(problem, mass_matrix=matrix.tocsr(), loads=loads)


def torsion(problem: pc.Problem, load: Torsion, linear: bool, integrated: bool) -> NodalLoad:
    """A rotational force density, integrated, or its value at each node times the node's volume."""
    x = problem.positions
    centre = 0.5 * (x.min(axis=0) + x.max(axis=0))

    def density(points: Array) -> Array:
        if not linear:
            return load.strength * torsion_field(points - centre, 0.0, 0.0)
        y, z = np.moveaxis(points - centre, -1, 0)[1:]
        return load.strength / problem.cell_size * np.stack([np.zeros_like(y), -z, y], axis=-1)

    if integrated:
        pattern = problem.space.body_load(density(problem.space.interpolate(x)))
    else:
        pattern = density(x) * (problem.mass / MATERIAL["density"])[:, None]
    return NodalLoad(Amplitude(load), pattern)


# --- figures -------------------------------------------------------------------------------


def run(problem: pc.Problem) -> pc.Trajectory:
    """All frames by projective dynamics."""
    return pc.rollout(pc.ProjectiveDynamics(problem))


def on_coarse(trajectory: pc.Trajectory, coarse: pc.Trajectory) -> Array:
    """Positions (T+1, N, 3) on the plain coarse nodes."""
    return pc.restrict(trajectory, to=coarse).positions


def shares(motion: str, models: Sequence[Model]) -> common.Figures:
    """Omega of each model, and in cells what it is a share of."""
    plain = run(discretised(motion, PLAIN))
    truth = on_coarse(run(discretised(motion, REFERENCE)), plain)
    figures = {
        f"{motion}, displacement": pc.metrics.largest_displacement(truth) / CELL,
        f"{motion}, plain error": pc.metrics.rms_error(plain, truth) / CELL,
    }
    for model in models:
        found = on_coarse(run(discretised(motion, model)), plain)
        figures[f"{motion}, {model.label}"] = pc.metrics.error_corrected(found, plain, truth)
    return figures


def reference_error(motion: str) -> common.Figures:
    """Omega of the reference and of the best coarse model against a mesh twice as fine."""
    plain = run(discretised(motion, PLAIN))
    truth = on_coarse(run(discretised(motion, replace(REFERENCE, refine=8))), plain)
    figures: common.Figures = {}
    for model in (REFERENCE, BEST):
        found = on_coarse(run(discretised(motion, model)), plain)
        label = f"{motion}, {model.label}, against 8x"
        figures[label] = pc.metrics.error_corrected(found, plain, truth)
        figures[f"{label}, error"] = pc.metrics.rms_error(found, truth) / CELL
    return figures


def summary(figures: common.Figures) -> common.Figures:
    """Over all motions: Omega of the summed squared errors, mean and least Omega.

    Against the plain mesh, and against what a scene's defaults give.
    """
    plain = np.array([figures[f"{motion}, plain error"] for motion in MOTIONS]) ** 2
    out: common.Figures = {}
    left = {
        model: np.array([1.0 - figures[f"{motion}, {model.label}"] / 100.0 for motion in MOTIONS])
        for model in (DEFAULT, *MODELS)
    }
    for against, base in (("", np.ones(len(plain))), (" against defaults", left[DEFAULT])):
        for model in MODELS:
            row = 100.0 * (1.0 - left[model] / base)
            pooled = 1.0 - (plain @ left[model]) / (plain @ base)
            out[f"pooled{against}, {model.label}"] = float(100.0 * pooled)
            out[f"mean{against}, {model.label}"] = float(row.mean())
            out[f"least{against}, {model.label}"] = float(row.min())
    return out


def compute() -> common.Figures:
    """All figures."""
    figures: common.Figures = {}
    for motion in MOTIONS:
        figures |= shares(motion, MODELS)
    for motion in THIN:
        figures |= shares(motion, THIN_MODELS)
    for motion in VARIED:
        figures |= shares(motion, VARIED_MODELS)
    for motion in CHECKS:
        figures |= shares(motion, (BEST,))
        figures |= reference_error(motion)
    return figures | summary(figures)


SHOWN = {
    "the scene's defaults (hex8)": DEFAULT,
    "hex8-mean": Model("hex8-mean", 0.5, True),
    "hex8-bubble": Model("hex8-bubble", 0.5, True),
    "hex8-bubble-mean": Model("hex8-bubble-mean", 0.5, True),
    "hex8-enhanced, chosen": BEST,
    "hex27": Model("hex27", 0.5, True),
    "hex8, 2×2×2 cells a cell": Model("hex8", refine=2),
}
"""Models of the picture, by name; with the averaged mass but the first and last."""


def finding(record: common.Record) -> str:
    """Of the best coarse model, over all motions."""
    pooled, least = (
        record.figures[f"{w}, {BEST.label}"] for w in ("pooled", "least against defaults")
    )
    return (
        f"The best coarse model removes {pooled:.0f} % of the plain mesh's squared error, and is "
        f"better than a scene's defaults in every motion (least {least:.0f} %)."
    )


def case(quick: bool) -> common.Outcome:
    """The case's outcome."""
    if not quick:
        return common.Outcome(compute())
    return common.Outcome(shares("short beam, bend", (BEST,)))

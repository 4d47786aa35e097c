"""The ways to compute a scene, and what is said of their errors and times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import pdcorrect as pc

ERRORS, TIMES = "Errors, % of the RMS displacement", "Time a frame, ms"
"""Tables of the case's record; times are the least of all rounds."""
ROUNDS, FIRST = "Rounds", "first frame, s"
"""The table of what else the rounds gave, and its rows of times from the scene to that frame."""
EULER, ALPHA = "backward-euler", "generalised-alpha"
CORRECTORS = ("impulse-exact", "torsion-exact", "stretch-exact")
FAMILIES = ("backward Euler", "coarse cells", "hex27", "finer cells", "learned", "corrector")
CLASSICAL = FAMILIES[:4]
"""What needs no training."""
LOOSE = ", tolerance × 100"


def plain(scene: pc.Scene) -> pc.Scene:
    """As it is, on trilinear elements with lumped mass."""
    return scene


def hex27(scene: pc.Scene) -> pc.Scene:
    """On triquadratic elements."""
    return scene.with_changes(solver={"element": "hex27", "mass": "consistent"})


@dataclass(frozen=True)
class Method:
    """A solver, element, mesh and step.

    Attributes
    ----------
    family : str
        One of `FAMILIES`.
    element : callable
        Scene with element and mass.
    substeps, refine : int
        Steps a frame, and cells along each axis of a coarse one.
    share : float
        Of the solver's own tolerance.
    solver : callable
        Makes the stepper of a problem.
    """

    family: str
    element: Callable[[pc.Scene], pc.Scene]
    substeps: int = 1
    refine: int = 1
    integrator: str = ALPHA
    share: float = 1.0
    solver: Callable[..., Any] = pc.ProjectiveDynamics

    def stepper(self, scene: pc.Scene) -> Any:
        """What computes the scene."""
        time = {"substeps": self.substeps, "integrator": self.integrator}
        scene = self.element(scene.with_changes(time=time))
        tolerance = self.share * scene.solver.tolerance
        scene = scene.with_changes(solver={"tolerance": tolerance})
        return self.solver(pc.discretise(scene, self.refine))


@dataclass(frozen=True)
class Corrected:
    """A corrector of steps, by the time step's integrator that it was trained with."""

    model: str
    family: str = FAMILIES[5]

    def stepper(self, scene: pc.Scene) -> Any:
        """What computes the scene; its gate refuses corrections."""
        return pc.hybrid_of(scene.with_changes(time={"integrator": EULER}), self.model)


def _all() -> dict[str, Method | Corrected]:
    _, coarse, quadratic, finer, learned, _ = FAMILIES
    best, network = pc.best_coarse, pc.learned_coarse
    return {
        "plain, BE": Method(FAMILIES[0], plain, integrator=EULER),
        "best coarse, BE": Method(FAMILIES[0], best, integrator=EULER),
        **{f"hybrid {model}": Corrected(model) for model in CORRECTORS},
        **{f"plain, {n}": Method(coarse, plain, n) for n in (1, 2)},
        **{f"best coarse, {n}": Method(coarse, best, n) for n in (1, 2, 4)},
        f"best coarse, 1{LOOSE}": Method(coarse, best, share=100.0),
        "best coarse, 1, tolerance / 10": Method(coarse, best, share=0.1),
        "best coarse, 1, Newton": Method(coarse, best, solver=pc.Newton),
        **{f"hex27, {n}": Method(quadratic, hex27, n) for n in (1, 2, 4)},
        **{f"hex27, {n}{LOOSE}": Method(quadratic, hex27, n, share=100.0) for n in (1, 2)},
        **{f"hex27 on 2x2x2, {n}": Method(quadratic, hex27, n, 2) for n in (1, 2)},
        **{f"plain on 2x2x2, {n}": Method(finer, plain, n, 2) for n in (1, 2)},
        **{f"best on 2x2x2, {n}": Method(finer, best, n, 2) for n in (1, 2)},
        f"best on 2x2x2, 1{LOOSE}": Method(finer, best, 1, 2, share=100.0),
        **{f"best on 3x3x3, {n}": Method(finer, best, n, 3) for n in (1, 2)},
        **{f"best on 4x4x4, {n}": Method(finer, best, n, 4) for n in (1, 2)},
        **{f"learned, {n}": Method(learned, network, n) for n in (1, 2, 4)},
        **{f"learned, {n}{LOOSE}": Method(learned, network, n, share=100.0) for n in (1, 2)},
        **{f"learned on 2x2x2, {n}": Method(learned, network, n, 2) for n in (1, 2)},
    }


METHODS = _all()
"""By name; the number is of substeps."""
RIVALS = tuple(name for name, method in METHODS.items() if method.family in CLASSICAL)


@dataclass(frozen=True)
class Point:
    """What a method reached in a scene: ms a frame, and error, % of the RMS displacement."""

    name: str
    time: float
    error: float


def points_of(record: Any) -> dict[str, list[Point]]:
    """What all methods that did not fail reached, by scene."""
    times = {row[0]: row[1:] for row in record.table(TIMES)["rows"]}
    errors = record.table(ERRORS)
    return {
        row[0]: [
            Point(name, spent, error)
            for name, spent, error in zip(
                errors["headings"][3:], times[row[0]], row[3:], strict=True
            )
            if spent is not None
        ]
        for row in errors["rows"]
    }


def front(points: Sequence[Point]) -> list[Point]:
    """Those that nothing as quick is as near as, quickest first."""
    out: list[Point] = []
    for point in sorted(points, key=lambda p: (p.time, p.error)):
        if not out or point.error < out[-1].error:
            out.append(point)
    return out


def time_at(error: float, rivals: Sequence[Point]) -> float:
    """Time of the rivals' front at an error, between its points by their logarithms.

    The quickest one's where that is nearer; nan where none is so near.
    """
    points = front(rivals)
    errors, times = (np.log([getattr(p, key) for p in points[::-1]]) for key in ("error", "time"))
    return float(np.exp(np.interp(np.log(error), errors, times, left=np.nan)))


def error_at(time: float, rivals: Sequence[Point]) -> float:
    """Error of the rivals' front at a time, as in `time_at`; nan where none is so quick."""
    points = front(rivals)
    times, errors = (np.log([getattr(p, key) for p in points]) for key in ("time", "error"))
    return float(np.exp(np.interp(np.log(time), times, errors, left=np.nan)))

"""Projective dynamics: a constant global matrix, factorised once (thesis section 3.1)."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pdcorrect.errors import InputError
from pdcorrect.fem.factorisation import Backend
from pdcorrect.fem.hyperelasticity import COROTATED
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.implicit import ImplicitStepper, whole
from pdcorrect.solvers.lbfgs import MinimiserOptions, Minimum, minimise
from pdcorrect.solvers.step import StepObjective

Method = Literal["lbfgs", "local-global"]
FirstHessian = Literal["auto", "G", "G-scaled"]

VOLUME_SCALE = 0.25
"""Factor on the volume weight inside the first Hessian "G-scaled".

G overestimates the stiffness of the volume term where it acts.  In twist,
bending and free flight at Poisson's ratio 0.3 and 0.45 a quarter took 21 to 46
per cent fewer iterations than 1, and was the best or within a tenth of it
(``benchmarks``, case first_hessian).
"""


class ProjectiveDynamics(ImplicitStepper):
    """Steps a problem by projective dynamics.

    Minimises gamma of eq. 3-6 with quasi-Newton steps on the factor of G
    (eq. 3-14), which is built at the first step and kept.

    Parameters
    ----------
    problem : Problem
    tolerance : float, optional
        Of the coarse cell size; the scene's by default.
    method : {"lbfgs", "local-global"}
        L-BFGS with a line search, or the plain alternation of the thesis.
    first_hessian : {"auto", "G", "G-scaled"}
        L-BFGS's first approximation: G as in the thesis, or G with its volume
        weight scaled by `VOLUME_SCALE`; "auto" is "G-scaled".  The energy, and
        so the answer, is the same.
    max_iterations : int, optional
        1000 for L-BFGS and 20000 for local/global by default.
    time_step, integrator, backend, recover
        See `ImplicitStepper`.

    Examples
    --------
    >>> stepper = ProjectiveDynamics(problem)          # doctest: +SKIP
    >>> result = stepper(problem.rest_state())         # doctest: +SKIP
    """

    def __init__(
        self,
        problem: Problem,
        tolerance: float | None = None,
        *,
        method: Method = "lbfgs",
        first_hessian: FirstHessian = "auto",
        max_iterations: int | None = None,
        time_step: float | None = None,
        integrator: str | None = None,
        backend: Backend = "auto",
        recover: bool = True,
    ) -> None:
        if method not in ("lbfgs", "local-global"):
            raise InputError(f"method = {method!r}: expected 'lbfgs' or 'local-global'.")
        if first_hessian not in ("auto", "G", "G-scaled"):
            raise InputError(
                f"first_hessian = {first_hessian!r}: expected 'auto', 'G' or 'G-scaled'."
            )
        if method == "local-global" and first_hessian == "G-scaled":
            raise InputError("method = 'local-global' iterates with G itself: leave first_hessian.")
        if method == "local-global" and problem.materials.model != COROTATED:
            raise InputError(
                f"method = 'local-global' with energy = {problem.scene.material.energy!r}: "
                "expected the corotated energy, whose terms are projections, or method = 'lbfgs'."
            )
        tolerance = problem.scene.solver.tolerance if tolerance is None else tolerance
        super().__init__(problem, tolerance, time_step, integrator, backend, recover)
        self.method = method
        self.name = f"projective dynamics ({method})"
        self.first_hessian = "G" if method == "local-global" else first_hessian
        plain = method == "local-global"
        limit = (20000 if plain else 1000) if max_iterations is None else max_iterations
        self._options = replace(
            self._options,
            history=0 if plain else self._options.history,
            max_iterations=whole("max_iterations", limit),
        )

    def describe(self) -> dict[str, str]:
        """Method, first Hessian, tolerance, step and factorisation in use."""
        scaled = "G" if self._volume_scale() == 1.0 else f"G, volume weight x {VOLUME_SCALE:g}"
        return {**super().describe(), "first_hessian": scaled}

    def _volume_scale(self) -> float:
        return 1.0 if self.first_hessian == "G" else VOLUME_SCALE

    def _minimise(self, objective: StepObjective, options: MinimiserOptions) -> Minimum:
        solver = self._global_solver(objective.factors)
        return minimise(objective, objective.start, solver, options)

"""Natural frequencies and mode shapes of small vibrations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.factorisation import NotPositiveDefinite, factorise
from pdcorrect.fem.multigrid import rigid_motions
from pdcorrect.fem.problem import Problem

Array = NDArray[np.float64]

_SHIFT = 1e-6
"""Of the largest ratio of stiffness to mass of a component: how far below zero the search
starts.  The results do not depend on it, but at 1e-8 the systems of a body without clamps are
so nearly singular that multigrid loses twelve digits to four."""


class Modes(NamedTuple):
    """Modes of vibration, lowest frequency first.

    Attributes
    ----------
    frequencies : (count,)
        Hz.
    shapes : (count, N, 3)
        Displacements u, zero where clamped, with u . M u = 1 (so in kg^-1/2).
    """

    frequencies: Array
    shapes: Array


def modes(problem: Problem, count: int = 6, positions: Array | None = None) -> Modes:
    """The lowest modes: K u = (2 pi f)^2 M u on the free components, without damping.

    K is the tangent stiffness of the elastic energy with internal modes in equilibrium, M the
    problem's own mass matrix; loads are dead.  A body without clamps has six modes of about
    0 Hz at rest.

    ``positions`` (N, 3) are where to linearise, m: an equilibrium under load, say; at rest by
    default.

    Raises
    ------
    InputError
        If ``count`` is not below the number of free components.
    ConvergenceError
        If K has negative eigenvalues: the positions are no stable equilibrium; or if the search
        does not end.
    """
    at = problem.positions if positions is None else positions
    free = np.flatnonzero(problem.free)
    whole = isinstance(count, (int, np.integer)) and not isinstance(count, bool)
    if not whole or not 1 <= count < len(free):
        raise InputError(
            f"count = {count!r}: expected a whole number from 1 to {len(free) - 1}, fewer than the "
            "free components."
        )
    K = problem.stiffness(at)[free][:, free]
    M = sp.csr_matrix(sp.kron(problem.mass_matrix, sp.eye_array(3)))[free][:, free]
    shift = _SHIFT * float((K.diagonal() / M.diagonal()).max())
    try:
        factor = factorise(K + shift * M, unknowns=3, near_nullspace=rigid_motions(at)[free])
    except NotPositiveDefinite as error:
        raise ConvergenceError(
            f"the tangent stiffness is not positive semi-definite ({error}): expected positions "
            "in stable equilibrium, as of a quasi-static run, or none for the body at rest."
        ) from None
    inverse = spla.LinearOperator(K.shape, matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=len(free))  # for the same digits every time
    try:
        values, vectors = spla.eigsh(K, count, M, sigma=-shift, OPinv=inverse, v0=start)
    except spla.ArpackNoConvergence as error:
        raise ConvergenceError(f"the search for {count} modes: {error}.") from None
    order = np.argsort(values)
    shapes = np.zeros((count, problem.free.size))
    shapes[:, free] = vectors[:, order].T
    frequencies = np.sqrt(np.maximum(values[order], 0.0)) / (2.0 * np.pi)
    return Modes(frequencies, shapes.reshape(count, -1, 3))

"""Factor a sparse symmetric positive definite matrix once, solve many times.

Back ends: cholespy (CHOLMOD), SciPy's `splu` with a symmetric ordering where
cholespy is missing, and conjugate gradients preconditioned by algebraic
multigrid (pyamg) where a factor would fill too much.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from pdcorrect._environment import total_memory
from pdcorrect.errors import InputError
from pdcorrect.fem.multigrid import Multigrid, conjugate_gradients
from pdcorrect.fem.multigrid import NotPositiveDefinite as NotPositiveDefinite

Array = NDArray[np.float64]
Backend = Literal["auto", "band", "cholespy", "splu", "amg"]

_AMG_TOLERANCE = 1e-12
_AMG_STEPS = 500
LARGEST_DIRECT = 100_000
"""Nodes above which multigrid takes over where no more is known (``benchmarks``, case growth)."""
LARGEST_BANDWIDTH = 1000
"""Unknowns of a `BandOrder`'s half bandwidth above which multigrid takes over for G.

Size alone does not decide: a step takes less time with multigrid for a block of 6 859 nodes
(1 085), and more for a beam of 55 777 (923; case growth).
"""
MEMORY_SHARE = 0.5
"""Share of the memory that may be used which a factor may be expected to take."""


class Factor(Protocol):
    """A factorised matrix."""

    backend: str

    def solve(self, b: Array) -> Array:
        """X with A x = b, for b (n,) or (n, m)."""


class CholeskyFactor:
    """Supernodal Cholesky by cholespy."""

    backend = "cholespy"

    def __init__(self, matrix: sp.csc_matrix) -> None:
        from cholespy import CholeskySolverD, MatrixType

        matrix = sp.csc_matrix(matrix)
        matrix.sort_indices()
        self._size = matrix.shape[0]
        try:
            with _silent_stdout():
                self._solver = CholeskySolverD(
                    self._size,
                    matrix.indptr.astype(np.int32),
                    matrix.indices.astype(np.int32),
                    np.ascontiguousarray(matrix.data, dtype=np.float64),
                    MatrixType.CSC,
                )
        except ValueError as error:
            raise NotPositiveDefinite(str(error)) from None

    def solve(self, b: Array) -> Array:
        b = np.ascontiguousarray(b, dtype=np.float64)
        x = np.empty_like(b)
        self._solver.solve(b, x)
        return x


class LUFactor:
    """SuperLU in its symmetric mode, minimum degree on A^T + A."""

    backend = "splu"

    def __init__(self, matrix: sp.csc_matrix) -> None:
        try:
            self._lu = spla.splu(
                sp.csc_matrix(matrix),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise NotPositiveDefinite(str(error)) from None
        if not (self._lu.U.diagonal() > 0).all():
            raise NotPositiveDefinite("the LU factor has pivots that are not positive")

    def solve(self, b: Array) -> Array:
        return np.asarray(self._lu.solve(np.asarray(b, dtype=np.float64)))


class MultigridSolver:
    """Conjugate gradients preconditioned by smoothed aggregation, to near machine accuracy.

    The columns of a right-hand side advance together; ``steps`` are those of the last solve.
    """

    backend = "amg"

    def __init__(self, matrix: sp.spmatrix, near_nullspace: Array | None = None) -> None:
        self._matrix = sp.csr_matrix(matrix)
        self._cycle = Multigrid(self._matrix, near_nullspace)
        self.steps = 0

    def solve(self, b: Array) -> Array:
        b = np.asarray(b, dtype=np.float64)
        if not np.isfinite(b).all():  # as the direct back ends do
            return np.full_like(b, np.nan)
        found = conjugate_gradients(
            self._matrix.__matmul__, b, self._cycle.solve,
            tolerance=_AMG_TOLERANCE, max_steps=_AMG_STEPS,
        )  # fmt: skip
        self.steps = found.steps
        if not found.convex:
            raise NotPositiveDefinite("multigrid-preconditioned CG met negative curvature")
        if not found.converged:
            raise NotPositiveDefinite(
                f"multigrid-preconditioned CG did not converge in {found.steps} steps"
            )
        return found.x


_DIRECT: dict[str, Callable[[sp.csc_matrix], Factor]] = {
    "cholespy": CholeskyFactor,
    "splu": LUFactor,
}


def factorise(
    matrix: sp.spmatrix,
    backend: Backend = "auto",
    unknowns: int = 1,
    near_nullspace: Array | None = None,
    approximate: bool = False,
) -> Factor:
    """Factorise a symmetric positive definite matrix.

    Parameters
    ----------
    matrix : (n, n) sparse
    backend : {"auto", "cholespy", "splu", "amg"}
        "auto" takes what `choose_backend` does; so does "band", which is a choice
        for tangents only (`BandOrder`).
    unknowns : int
        For each node: 1 for G, 3 for a tangent.
    near_nullspace : (n, k), optional
        See `Multigrid`.
    approximate : bool
        Whether a fixed symmetric approximation of the inverse will do, as for
        a preconditioner or a first Hessian: with multigrid, one V-cycle.

    Raises
    ------
    NotPositiveDefinite
        If a pivot is not positive.  Multigrid may notice only when solving.
    """
    check_backend(backend)
    if backend in ("auto", "band"):
        backend = choose_backend(matrix.shape[0], unknowns)
    if backend == "amg":
        return (Multigrid if approximate else MultigridSolver)(matrix, near_nullspace)
    return _DIRECT[backend](sp.csc_matrix(matrix))


def check_backend(backend: str) -> None:
    """Refuse a name that is none of the back ends, "band" (for tangents) or "auto"."""
    names = ("auto", "band", *_DIRECT, "amg")
    if backend not in names:
        raise InputError(f"backend {backend!r}: expected {', '.join(names)}.")


def choose_backend(
    size: int, unknowns: int = 1, memory: float | None = None, bandwidth: int | None = None
) -> Backend:
    """The back end for a matrix of ``size`` rows and a ``memory``, bytes, by default the machine's.

    The half ``bandwidth`` of a `BandOrder` decides, where it is known, instead of the size.
    """
    memory = total_memory() if memory is None else memory
    needed = factor_bytes(size, unknowns)
    if bandwidth is None:
        slow = size > unknowns * LARGEST_DIRECT
    else:
        slow = bandwidth > LARGEST_BANDWIDTH
        needed = min(needed, 12.0 * size * unknowns * bandwidth / 3)  # it fills no more
    if slow or needed > MEMORY_SHARE * memory:
        return "amg"
    return "cholespy" if importlib.util.find_spec("cholespy") else "splu"


def factor_bytes(size: int, unknowns: int = 1) -> float:
    """Expected bytes of a Cholesky factor of a compact three-dimensional mesh's matrix.

    12 n^(4/3) entries of 12 bytes for n nodes, nine times as many with three unknowns a node:
    within a factor of three for 700 to 18 000 nodes (``benchmarks``, case factor_size).
    """
    return 12.0 * 12.0 * (size / unknowns) ** (4 / 3) * unknowns**2


_REDIRECTION = threading.Lock()


@contextmanager
def _silent_stdout() -> Iterator[None]:
    """Keep CHOLMOD's "not positive definite" line, printed by C code, off standard output.

    The exception says the same, and standard output belongs to the user.
    """
    with _REDIRECTION:  # the descriptor belongs to the process, not to a thread
        if sys.stdout is not None:
            sys.stdout.flush()
        try:
            kept = os.dup(1)
        except OSError:  # no standard output at all
            yield
            return
        sink = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(sink, 1)
            yield
        finally:
            os.dup2(kept, 1)
            os.close(sink)
            os.close(kept)

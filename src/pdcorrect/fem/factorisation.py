"""Factor a sparse symmetric positive definite matrix once, solve many times.

Back ends: cholespy (CHOLMOD), SciPy's `splu` with a symmetric ordering where
cholespy is missing, and conjugate gradients preconditioned by algebraic
multigrid (pyamg) where a factor would not fit into memory.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from pdcorrect.errors import InputError

Array = NDArray[np.float64]
Backend = Literal["auto", "cholespy", "splu", "amg"]

_AMG_TOLERANCE = 1e-12
_MEMORY_SHARE = 0.5
"""Share of the free memory that a factor may be expected to take."""


class NotPositiveDefinite(ArithmeticError):
    """The matrix has a pivot that is zero or negative."""


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
    """Conjugate gradients preconditioned by smoothed aggregation, to near machine accuracy."""

    backend = "amg"

    def __init__(self, matrix: sp.csc_matrix) -> None:
        import pyamg

        self._matrix = sp.csr_matrix(matrix)
        self._hierarchy = pyamg.smoothed_aggregation_solver(self._matrix)
        self._cycle = self._hierarchy.aspreconditioner(cycle="V")

    def solve(self, b: Array) -> Array:
        columns = np.asarray(b, dtype=np.float64).reshape(len(b), -1)
        out = np.empty_like(columns)
        for i, column in enumerate(columns.T):
            out[:, i], status = spla.cg(
                self._matrix, column, rtol=_AMG_TOLERANCE, maxiter=500, M=self._cycle
            )
            if status:
                raise NotPositiveDefinite(
                    f"multigrid-preconditioned CG did not converge in {status} iterations"
                )
        return out.reshape(np.shape(b))


_BACKENDS: dict[str, Callable[[sp.csc_matrix], Factor]] = {
    "cholespy": CholeskyFactor,
    "splu": LUFactor,
    "amg": MultigridSolver,
}


def factorise(matrix: sp.spmatrix, backend: Backend = "auto") -> Factor:
    """Factorise a symmetric positive definite matrix.

    Parameters
    ----------
    matrix : (n, n) sparse
    backend : {"auto", "cholespy", "splu", "amg"}
        "auto" takes a direct factor where it is expected to fit into memory
        (cholespy if installed), otherwise multigrid.

    Raises
    ------
    NotPositiveDefinite
        If a pivot is not positive.
    """
    if backend == "auto":
        backend = choose_backend(matrix.shape[0], matrix.nnz)
    if backend not in _BACKENDS:
        raise InputError(f"backend {backend!r}: expected auto, {', '.join(_BACKENDS)}.")
    return _BACKENDS[backend](sp.csc_matrix(matrix))


def choose_backend(size: int, nonzeros: int, memory: float | None = None) -> Backend:
    """The back end for a matrix of this size; ``memory`` (bytes) defaults to what is free."""
    memory = free_memory() if memory is None else memory
    if factor_bytes(size, nonzeros) > _MEMORY_SHARE * memory:
        return "amg"
    return "cholespy" if importlib.util.find_spec("cholespy") else "splu"


def factor_bytes(size: int, nonzeros: int) -> float:
    """Expected bytes of a Cholesky factor of a three-dimensional mesh's matrix.

    A compact 3-D mesh with n nodes fills about 12 n^(4/3) entries; a matrix of
    three unknowns a node has nine times as many.  Within a factor of three for
    blocks and beams of 700 to 18 000 nodes (``benchmarks``, case factor_size).
    """
    unknowns = 3 if nonzeros > 45 * size else 1
    nodes = size / unknowns
    return 12.0 * nodes ** (4 / 3) * unknowns**2 * 12.0


def free_memory() -> float:
    """Free physical memory in bytes; infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError, AttributeError):
        return float("inf")


@contextmanager
def _silent_stdout() -> Iterator[None]:
    """Keep CHOLMOD's "not positive definite" line, printed by C code, off standard output.

    The exception says the same, and standard output belongs to the user.
    """
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

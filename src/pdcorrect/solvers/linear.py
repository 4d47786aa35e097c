"""Linear combinations of nodal arrays, kept by their coefficients.

Time integrators are written with them once, and evaluated forwards for a step and
backwards (transposed) for its derivative, on NumPy arrays and tensors alike.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any


class Linear:
    """A sum of coefficients times arrays that are known by name.

    >>> p, v = Linear(positions=1.0), Linear(velocities=1.0)
    >>> p + 0.1 * v
    Linear(positions=1, velocities=0.1)
    >>> (p + 0.1 * v)({"positions": 2.0, "velocities": 10.0})
    3.0
    """

    def __init__(self, **coefficients: float) -> None:
        self.coefficients = {name: c for name, c in coefficients.items() if c != 0.0}

    def __repr__(self) -> str:
        terms = ", ".join(f"{name}={c:g}" for name, c in self.coefficients.items())
        return f"Linear({terms})"

    def __call__(self, arrays: Mapping[str, Any]) -> Any:
        """The sum; 0.0 where there are no terms.

        Raises
        ------
        KeyError
            If an array is missing.
        """
        total: Any = 0.0
        for name, c in self.coefficients.items():
            term = arrays[name] if c == 1.0 else c * arrays[name]
            total = term if isinstance(total, float) else total + term
        return total

    def transpose(self, x: Any, sums: MutableMapping[str, Any]) -> None:
        """Add coefficient times x to each name's entry of ``sums``."""
        for name, c in self.coefficients.items():
            sums[name] = sums[name] + c * x if name in sums else c * x

    def __add__(self, other: Linear) -> Linear:
        out = dict(self.coefficients)
        for name, c in other.coefficients.items():
            out[name] = out.get(name, 0.0) + c
        return Linear(**out)

    def __mul__(self, factor: float) -> Linear:
        return Linear(**{name: factor * c for name, c in self.coefficients.items()})

    __rmul__ = __mul__

    def __neg__(self) -> Linear:
        return self * -1.0

    def __sub__(self, other: Linear) -> Linear:
        return self + -other

    def __truediv__(self, divisor: float) -> Linear:
        return self * (1.0 / divisor)


def by_component(
    library: Any, free: Any, known: Mapping[str, Any], on_free: Linear, on_clamped: Linear | None
) -> Any:
    """One sum on free components and, if there is another, that one on clamped components.

    ``library`` is numpy or torch, whichever ``free`` (bool) and ``known``, with an entry
    "positions", belong to.
    """
    values = on_free(known)
    if isinstance(values, float):
        values = library.zeros_like(known["positions"])
    if on_clamped is None:
        return values
    return library.where(free, values, on_clamped(known))

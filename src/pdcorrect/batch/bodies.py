"""Scenes of a batch that differ by their loads alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdcorrect.fem.problem import Problem


@dataclass(frozen=True, eq=False)
class Bodies:
    """The problems of a batch without their loads, each once.

    What depends on nothing else is computed once a body.

    Attributes
    ----------
    distinct : list of Problem
        One of each body.
    owners : (B,) int
        Which of them each scene is.
    """

    distinct: list[Problem]
    owners: NDArray[np.int64]

    @classmethod
    def of(cls, problems: Sequence[Problem]) -> Bodies:
        """Known by the objects that `Problem.with_loads` shares; numbers are not compared."""
        seen: dict[tuple[object, ...], int] = {}
        distinct: list[Problem] = []
        owners = np.empty(len(problems), dtype=np.int64)
        for i, p in enumerate(problems):
            parts = (p.mesh, p.space, p.quadrature, p.materials, p.mass_matrix, p.clamps)
            key = (p.mass_rule, *map(id, parts))
            if key not in seen:
                seen[key] = len(distinct)
                distinct.append(p)
            owners[i] = seen[key]
        return cls(distinct, owners)

    @property
    def one_a_scene(self) -> bool:
        """Whether the scenes are the distinct bodies in their order."""
        return np.array_equal(self.owners, np.arange(len(self.distinct)))

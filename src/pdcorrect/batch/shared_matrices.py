"""Scenes of a batch that share a matrix."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect.fem.problem import Problem


def _kinds(
    problems: Sequence[Problem], key: Callable[[Problem], Hashable]
) -> tuple[list[Problem], list[int]]:
    """One problem of each key, and which of them each problem is like."""
    seen: dict[Hashable, int] = {}
    owners = [seen.setdefault(key(p), len(seen)) for p in problems]
    firsts = [owners.index(k) for k in range(len(seen))]
    return [problems[i] for i in firsts], owners


@dataclass(frozen=True, eq=False)
class DistinctBodies:
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
    def of(cls, problems: Sequence[Problem]) -> DistinctBodies:
        """Known by the objects that `Problem.with_loads` shares; numbers are not compared."""

        def key(p: Problem) -> tuple[Hashable, ...]:
            parts = (p.mesh, p.space, p.quadrature, p.materials, p.mass_matrix, p.clamps)
            return p.mass_rule, *map(id, parts)

        distinct, owners = _kinds(problems, key)
        return cls(distinct, np.array(owners, dtype=np.int64))

    @property
    def one_a_scene(self) -> bool:
        """Whether the scenes are the distinct bodies in their order."""
        return np.array_equal(self.owners, np.arange(len(self.distinct)))


class Sharing:
    """Which scenes have the same mesh, material and clamps.

    Attributes
    ----------
    distinct : list of Problem
        One of each kind.
    owners : list of int
        Which of them each scene is.
    """

    def __init__(self, problems: Sequence[Problem], device: torch.device) -> None:
        bodies = DistinctBodies.of(problems)
        self.distinct, kinds = _kinds(bodies.distinct, _key)
        self.owners: list[int] = [kinds[body] for body in bodies.owners]
        self._arrange(device)

    def _arrange(self, device: torch.device) -> None:
        members: list[list[int]] = [[] for _ in self.distinct]
        for scene, owner in enumerate(self.owners):
            members[owner].append(scene)
        most = max(map(len, members))
        self._scenes = len(self.owners)
        filled = [row + [self._scenes] * (most - len(row)) for row in members]
        self._members = torch.tensor(filled, device=device)
        self._alone = most == 1
        self._full = len(members) * most == self._scenes

    def gathered(self, x: Tensor) -> Tensor:
        """(B, ...) -> (K, m, ...): side by side what shares a matrix, filled up with zeros."""
        if self._alone:
            return x[:, None]
        if not self._full:
            x = torch.cat([x, x.new_zeros(1, *x.shape[1:])])
        return x[self._members]

    def scattered(self, x: Tensor) -> Tensor:
        """The reverse of `gathered`."""
        if self._alone:
            return x[:, 0]
        out = x.new_zeros(self._scenes + 1, *x.shape[2:])
        out[self._members] = x
        return out[: self._scenes]


def _key(problem: Problem) -> bytes:
    digest = hashlib.blake2b()
    materials, mass = problem.materials, problem.mass_matrix
    for array in (
        problem.positions, problem.cells, problem.free, materials.mu, materials.volume_weight,
        mass.data, mass.indices,
    ):  # fmt: skip
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def of_all(numbers: Tensor, size: int) -> Tensor:
    """Numbers (B, R, n) of each scene's own ``size`` rows as those of all scenes, (B R, n).

    Those below zero stand for nothing, and become B times ``size``.
    """
    scene = torch.arange(len(numbers), device=numbers.device)[:, None, None]
    of_its_own = numbers + size * scene
    return torch.where(numbers < 0, size * len(numbers), of_its_own).flatten(0, 1)


Batch = TypeVar("Batch")

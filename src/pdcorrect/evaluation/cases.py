"""The simulations of a split, ready to be stepped again and compared with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdcorrect.data.config import EVALUATION
from pdcorrect.data.damage import Damage, whole_files
from pdcorrect.data.folder import shard_paths
from pdcorrect.data.rebuild import rebuilt_problems
from pdcorrect.data.schema import PLAIN, REFERENCE, Shard
from pdcorrect.data.shard_reader import read_shard, stored_hashes
from pdcorrect.errors import InputError
from pdcorrect.evaluation.physics import energies
from pdcorrect.fem.coarse_models import BASES
from pdcorrect.fem.problem import Problem
from pdcorrect.metrics import EnergyBalance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Case:
    """A simulation of a split and what is known of it.

    Attributes
    ----------
    mesh, simulation : int
        Numbers of the mesh in its split and of the simulation on it.
    problems : mapping of str to Problem
        Coarse models by the run they made, "plain" among them.
    reference : (T+1, N, 3)
        m.
    runs : mapping of str to (T+1, N, 3)
        Stored rollouts, m.
    predictions : mapping of str to (T, N, 3)
        Stored single steps from the reference's frames, m.
    """

    mesh: int
    simulation: int
    problems: Mapping[str, Problem]
    reference: Array
    runs: Mapping[str, Array]
    predictions: Mapping[str, Array]
    _energies: dict[str, EnergyBalance] = field(default_factory=dict, repr=False)

    def reference_energies(self, base: str) -> EnergyBalance:
        """Of the reference by a coarse model; kept, for all runs are compared with them."""
        if base not in self._energies:
            self._energies[base] = energies(self.problems[base], self.reference)
        return self._energies[base]

    @property
    def steps(self) -> int:
        """T."""
        return len(self.reference) - 1

    @property
    def time_step(self) -> float:
        """In s."""
        return self.problems[PLAIN].time_step

    @property
    def cell_size(self) -> float:
        """Of the coarse mesh, m."""
        return self.problems[PLAIN].cell_size


@dataclass(frozen=True, eq=False)
class SplitCases:
    """A split's simulations in float64; see `read_cases`."""

    attributes: Mapping[str, str | int | float]
    cases: tuple[Case, ...]
    shards: Mapping[str, str]
    damaged: Damage


def read_cases(
    folder: str | Path, split: str = EVALUATION, bases: Iterable[str] = (), *, skip_damaged: bool
) -> SplitCases:
    """All simulations of a split and their coarse models' problems.

    Parameters
    ----------
    folder : path
    split : str
    bases : iterable of str
        Coarse models besides the plain one.
    skip_damaged : bool
        Leave out files that are damaged.

    Raises
    ------
    InputError
        If the split is missing, of several data sets, or its problems cannot be rebuilt.
    FileFormatError
        If a file is damaged; with ``skip_damaged`` if all are.
    """
    damaged: Damage = {}
    paths = whole_files(shard_paths(folder, split), damaged if skip_damaged else None)
    wanted = [PLAIN, *(base for base in dict.fromkeys(bases) if base != PLAIN)]
    shards: dict[str, str] = {}
    cases: list[Case] = []
    attributes: list[Mapping[str, str | int | float]] = []
    for path in paths:
        shard = read_shard(path)
        attributes.append(shard.attributes)
        shards[path.name] = stored_hashes(path)[1]
        cases += _cases(shard, path, wanted)
    if len({(a["config_hash"], a["time_step"]) for a in attributes}) > 1:
        raise InputError(f"{folder}, {split}: files of several configurations: expected one.")
    return SplitCases(attributes[0], tuple(cases), shards, damaged)


def _cases(shard: Shard, path: Path, bases: Sequence[str]) -> list[Case]:
    for base in bases:
        if base not in BASES:
            raise InputError(f"base {base!r}: expected one of {', '.join(BASES)}.")
    problems = {base: rebuilt_problems(shard, path, base) for base in bases}
    for base in BASES:  # what is told of a stored run does not depend on the candidates
        if base in shard.simulations[0].runs and base not in problems:
            problems[base] = rebuilt_problems(shard, path, base)
    out = []
    for k, simulation in enumerate(shard.simulations):
        reference = simulation.runs[REFERENCE].positions
        if reference is None:
            raise InputError(f"{path}: simulation {k} has no reference rollout.")
        others = {name: run for name, run in simulation.runs.items() if name != REFERENCE}
        rollouts = _float64({name: run.positions for name, run in others.items()})
        out.append(
            Case(
                int(shard.attributes["number"]),
                k,
                {base: each[k] for base, each in problems.items()},
                _from_rest(reference.astype(np.float64), shard.points),
                {name: _from_rest(x, shard.points) for name, x in rollouts.items()},
                _float64({name: run.predictions for name, run in others.items()}),
            )
        )
    return out


def _from_rest(positions: Array, rest: Array) -> Array:
    """A stored rollout with the rest shape in frame 0, which storing has rounded."""
    return np.concatenate([rest[None], positions[1:]])


def _float64(arrays: Mapping[str, NDArray[np.generic] | None]) -> dict[str, Array]:
    return {name: x.astype(np.float64) for name, x in arrays.items() if x is not None}

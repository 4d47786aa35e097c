"""Saved models as candidates of an evaluation."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.hybrid import HybridStepper
from pdcorrect.corrector.model_io import (
    LoadedModel,
    load_model,
    model_folder,
    unlike_ends,
    weights_digest,
)
from pdcorrect.data.configuration import TRAINING, VALIDATION
from pdcorrect.evaluation.evaluation import Candidate
from pdcorrect.evaluation.rollouts import Hybrid
from pdcorrect.fem.problem import Problem
from pdcorrect.solvers.projective import ProjectiveDynamics

DEFAULT_GATE = Gate()
_GROUP_DIGITS = 8


@dataclass(frozen=True, eq=False)
class SavedCandidate:
    """A model of a folder, to be evaluated.

    Attributes
    ----------
    candidate : Candidate
    folder : Path
    model : LoadedModel
    weights_sha256 : str
    """

    candidate: Candidate
    folder: Path
    model: LoadedModel
    weights_sha256: str

    def record(self) -> dict[str, Any]:
        """What identifies it, for results."""
        found = self.model.record
        return {
            "folder": str(self.folder),
            "weights_sha256": self.weights_sha256,
            "base": self.candidate.base,
            "group": self.candidate.group,
            "seed": self.model.configuration.get("seed"),
            "velocity": self.model.velocity,
            "dataset": found.dataset,
            "dataset_hash": found.dataset_hash,
            "code_digest": found.code_digest,
        }

    def warnings(self, dataset: str, config_hash: str, split: str) -> list[str]:
        """What speaks against taking its errors for those on unseen meshes of its own data."""
        name, trained = self.candidate.name, repr(self.model.record.dataset)
        known = [x for own, x in self.model.data_sets if own == dataset]
        if not {config_hash, None}.intersection(known):
            other = f"another configuration of {dataset!r}" if known else f"not on {dataset!r}"
            return [f"{name} was trained on {trained}, {other}: it may know meshes of this split."]
        if split == TRAINING:
            return [f"{name} was trained on this split: these are not unseen meshes."]
        if split == VALIDATION:
            return [f"{name}'s weights were chosen by this split: the figures are too good."]
        if len({own for own, _ in self.model.data_sets}) > 1:
            others = f"sets other than {dataset!r} may hold meshes of this split"
            return [f"{name} was trained on {trained}: {others}."]
        return []


def saved_candidates(
    paths: Sequence[str | Path], device: str = "cpu", *, gate: Gate | None = DEFAULT_GATE
) -> list[SavedCandidate]:
    """Models by folder or name; they are called by the ends of their paths that tell them apart.

    Models that differ by the seed of their training only are of one group.  Which coarse model
    one corrects, and how velocities follow, is what its training says; "plain" and
    "recomputed" where it says nothing.

    Parameters
    ----------
    paths : sequence of str or path
        As of `load_model`.
    device : str
    gate : Gate or None
        What else is refused than corrections that are not finite.

    Raises
    ------
    InputError
        If a model is missing or comes twice.
    FileFormatError
        If one is damaged.
    """
    names = unlike_ends([model_folder(path).resolve() for path in paths])
    return [_saved(path, name, device, gate) for path, name in zip(paths, names, strict=True)]


def _saved(path: str | Path, name: str, device: str, gate: Gate | None) -> SavedCandidate:
    folder = model_folder(path)
    model = load_model(path, device)

    def hybrid(stepper: BatchStepper) -> Hybrid:
        return BatchHybrid(stepper, model.corrector, velocity=model.velocity, gate=gate)

    def alone(problem: Problem) -> HybridStepper:
        coarse = ProjectiveDynamics(problem)
        return HybridStepper(coarse, model.corrector, velocity=model.velocity, gate=gate)

    candidate = Candidate(name, model.base, hybrid, _group(model), alone)
    return SavedCandidate(candidate, folder, model, weights_digest(folder))


def _group(model: LoadedModel) -> str | None:
    """A name shared by models of equal configuration but the seed; None without a seed."""
    configuration = dict(model.configuration)
    if configuration.pop("seed", None) is None:
        return None
    content = [
        model.corrector.config.model_dump(mode="json"), model.record.dataset_hash, configuration,
    ]  # fmt: skip
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return f"{model.base}-{digest[:_GROUP_DIGITS]}"

"""Which runs the simulations of a data set have, and how each of them is computed."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from pdcorrect.data.config import EVALUATION, TRAINING, VALIDATION, DatasetConfig
from pdcorrect.data.plan import MeshPlan
from pdcorrect.data.schema import BEST, CONVERGED, PLAIN, REFERENCE, TOTAL_MASS


@dataclass(frozen=True)
class Model:
    """How a simulation is discretised and stepped.

    Attributes
    ----------
    refine : int
    best : bool
        `pdcorrect.best_coarse`'s element and mass.
    predict : bool
        Whether to take single steps from the reference, too.
    divisor : int
        Parts of each time step.
    heavy : bool
        Density scaled so that the mass is the reference's.
    truth : bool
        Stepped by the reference's solver.
    sample : bool
        For the first simulation of the mesh only.
    """

    refine: int
    best: bool = False
    predict: bool = False
    divisor: int = 1
    heavy: bool = False
    truth: bool = False
    sample: bool = False


def models(config: DatasetConfig, mesh: MeshPlan) -> dict[str, Model]:
    """The runs of a mesh by name, the reference first."""
    exact = config.setting == "exact"
    found = {
        REFERENCE: Model(mesh.refine, best=exact, truth=True),
        PLAIN: Model(1, predict=True),
    }
    if exact:
        found[BEST] = Model(1, best=True, predict=True)
    else:
        found[TOTAL_MASS] = Model(1, heavy=True, predict=True)
    if mesh.split in (TRAINING, VALIDATION):
        return found
    if mesh.refine > 2:
        found["intermediate"] = Model(2)
    if mesh.split == EVALUATION:
        if config.converged_steps:
            found[CONVERGED] = Model(
                mesh.refine, best=exact, divisor=config.converged_steps, truth=True
            )
        if mesh.number < config.finest_meshes:
            found["finest"] = Model(2 * mesh.refine, best=exact, sample=True, truth=True)
    return found


def lacking(
    config: DatasetConfig,
    mesh: MeshPlan,
    number: int,
    runs: Collection[str],
    predictions: Collection[str],
) -> list[str]:
    """What a simulation of a mesh lacks that has these runs, and single steps of those."""
    found = []
    for name, model in sorted(models(config, mesh).items()):
        if model.sample and number:
            continue
        if name not in runs:
            found.append(f"run {name!r}")
        elif model.predict and name not in predictions:
            found.append(f"single steps of run {name!r}")
    return found


def work_per_node(config: DatasetConfig, mesh: MeshPlan) -> float:
    """About how much a simulation takes for each coarse node: steps of refined nodes."""
    runs = (m for m in models(config, mesh).values() if not m.sample)
    return float(mesh.frames * sum((1 + m.predict) * m.refine**3 * m.divisor for m in runs))

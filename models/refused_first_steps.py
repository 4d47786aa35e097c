"""Count the first steps of a split's scenes whose corrections models' default gates refuse.

python models/refused_first_steps.py MODEL=DATASET/config.toml ... [--split evaluation]
    [--loads 2] [--reference] [-o RECORD.json]

Each scene begins with one step from rest.  Told is how many steps' corrections are refused, for
which reason, how many have unknown inputs by nodes (`Gate.margin`) and by means over bodies
(`Gate.average`), and how far energy rises without a gate, in the unit of `Gate.energy`: the 95th
percentile and the most.  With ``--reference`` also how far it would rise if the coarse nodes went
where the reference's step puts them, which no bound should refuse.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from first_steps import first_steps, scenes_of
from program import pair_of, run_script
from run_record import write_record

import pdcorrect as pc
from pdcorrect.batch.states import BatchResult
from pdcorrect.corrector.batch_step import BatchCoarseStep
from pdcorrect.corrector.decision import corrected_step
from pdcorrect.corrector.gate import refusals
from pdcorrect.corrector.model_io import model_folder, weights_digest
from pdcorrect.data.config import EVALUATION, DatasetConfig

BATCH = 20


def main() -> None:
    """Count them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pairs", nargs="+", metavar="MODEL=CONFIG")
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--loads", type=int, default=2, help="of each mesh, at most")
    parser.add_argument("--reference", action="store_true", help="compute its first steps too")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    rows = []
    for pair in options.pairs:
        name, config = pair_of(pair)
        rows.append(
            refused(
                name, DatasetConfig.load(config), options.split, options.loads, options.reference
            )
        )
        print(rows[-1], flush=True)
    if options.output:
        write_record(options.output, gate=pc.Gate().model_dump(), models=rows)


@torch.no_grad()
def refused(
    name: str, config: DatasetConfig, split: str, loads: int, reference: bool
) -> dict[str, Any]:
    """Counts for one model."""
    model, gate = pc.load_model(name), pc.Gate()
    tests = {
        "unknown_by_nodes": gate.model_copy(update={"average": None}),
        "unknown_by_bodies": gate.model_copy(update={"margin": None}),
    }
    unknown = dict.fromkeys(tests, 0)
    reasons: list[int] = []
    rises: dict[str, list[float]] = {"corrected": [], "reference": []}
    scenes = scenes_of(config, split, loads)
    for number, step in enumerate(first_steps(model, scenes, "cpu", BATCH)):
        coarse = step.solved()
        good = step.ok(coarse)
        view = step.view(coarse if model.corrector.config.placement == "state" else None)
        for label, test in tests.items():
            unknown[label] += int((test.unknown(model.corrector, view) & good).sum())
        _, _, decision = corrected_step(step, model.corrector, gate)
        reasons += decision.reasons[good].tolist()
        answer, _, _ = corrected_step(step, model.corrector, None)
        rises["corrected"] += rise(step, answer, coarse)[good].tolist()
        if reference:
            some = scenes[number * BATCH : (number + 1) * BATCH]
            ends = np.concatenate([after_one_step(*each, config) for each in some])
            away = torch.from_numpy(ends) - step.view(coarse).snapshot.proposed
            right = step.moved(coarse, away)
            rises["reference"] += rise(step, right, coarse)[good].tolist()
    folder = model_folder(name)
    return {
        "model": folder.name, "weights_sha256": weights_digest(folder), "dataset": config.name,
        "split": split, "first_steps": len(reasons), "refused": refusals(reasons), **unknown,
        "rise_of_energy": {
            label: {"95_per_cent": float(np.quantile(found, 0.95)), "most": max(found)}
            for label, found in rises.items() if found
        },
    }  # fmt: skip


def rise(step: BatchCoarseStep, answer: BatchResult, coarse: BatchResult) -> torch.Tensor:
    """Of energy beside the coarse answer, (B,), in the unit of `Gate.energy`."""
    one, other = step.measured(answer), step.measured(coarse)
    risen = one.stored - one.work - (other.stored - other.work)
    return risen / (other.stored + other.work.abs())


def after_one_step(scene: pc.Scene, refine: int, config: DatasetConfig) -> np.ndarray:
    """Where one step of projective dynamics on the reference's mesh puts the coarse nodes.

    (N, 3), m.
    """
    own = pc.best_coarse(scene) if config.setting == "exact" else scene
    fine = pc.discretise(own, refine=refine)
    result = pc.ProjectiveDynamics(fine)(fine.rest_state())
    if not result.status.ok:
        raise SystemExit(f"{scene.name}: the reference's first step ended {result.status.name}.")
    return result.state.positions[fine.mesh.coarse_nodes]


if __name__ == "__main__":
    run_script(main)

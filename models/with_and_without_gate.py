"""Compute simulations of a split on the CPU, corrected with and without a gate.

python models/with_and_without_gate.py DATASET/config.toml --model MODEL ... [MESH/LOAD ...]
    [--split evaluation | --coarse-nodes LEAST MOST [--family NAME]] [--one-clamp]
    [--strength-factor 1.0] -o RECORD.json

The reference, the plain coarse mesh, each model's own base, and that corrected, with the default
gate and without one: Omega of each, how many have more than 1.05 times their base's error, what
the gate refused, and how far the body at rest lies outside the ranges of training bodies
(`Gate.body`).  With ``--coarse-nodes`` bodies of other sizes, and of another family, are drawn in
place of a split's; materials and loads are drawn as the data set's.  ``--one-clamp`` holds bodies
at the first of their clamps only.  Without MESH/LOAD it is one load of each mesh.  Loads are those
that are drawn first; where `pdcorrect dataset generate` has rejected one, this is another
simulation than the data set's.  The record is written after each simulation; the same command goes
on where it ended.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from program import run_script
from run_record import write_record

import pdcorrect as pc
from pdcorrect.corrector.gate import Reason
from pdcorrect.corrector.model_io import LoadedModel, model_folder, weights_digest
from pdcorrect.data.config import EVALUATION, DatasetConfig, FamilyName, Split
from pdcorrect.data.families import PUBLISHED, count_bodies
from pdcorrect.data.plan import MeshPlan, draw_scene, make_plan
from pdcorrect.errors import InputError


def main() -> None:
    """Repeat each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("config", type=Path, help="of a data set")
    parser.add_argument("cases", nargs="*", metavar="MESH/LOAD")
    parser.add_argument("--model", action="append", required=True, help="folder or name")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--coarse-nodes", type=int, nargs=2, metavar=("LEAST", "MOST"))
    parser.add_argument("--family", choices=sorted(PUBLISHED), help="the data set's by default")
    parser.add_argument("--one-clamp", action="store_true", help="hold bodies there only")
    parser.add_argument("--strength-factor", type=float, default=1.0, help="on the loads")
    parser.add_argument("--frames", type=int, default=None, help="all of the data set by default")
    options = parser.parse_intermixed_args()
    if options.family and not options.coarse_nodes:
        parser.error("--family: expected --coarse-nodes, too.")
    if options.coarse_nodes and options.split != EVALUATION:
        parser.error("--coarse-nodes: bodies of its own take the place of a split's: no --split.")
    config = DatasetConfig.load(options.config)
    if options.coarse_nodes:
        config = of_bodies(config, options.family or config.family, options.coarse_nodes)
    models = {model_folder(name).name: pc.load_model(name) for name in options.model}
    plans = {
        plan.number: replace(plan, strength_factor=options.strength_factor * plan.strength_factor)
        for plan in make_plan(config) if plan.split == options.split
    }  # fmt: skip
    digests = {
        model_folder(name).name: weights_digest(model_folder(name)) for name in options.model
    }
    about = {
        "dataset": config.name, "split": options.split, "frames": options.frames,
        "bodies": {"family": config.family, "coarse_nodes": list(config.coarse_nodes or ())},
        "one_clamp": options.one_clamp, "strength_factor": options.strength_factor,
        "gate": pc.Gate().model_dump(), "weights_sha256": digests,
    }  # fmt: skip
    rows = known_rows(options.output, about)
    for case in options.cases or [f"{number}/0" for number in plans]:
        mesh, load = numbers(case, plans)
        if any((row["mesh"], row["load"]) == (mesh, load) for row in rows):
            continue
        scene = draw_scene(config, plans[mesh], load)
        if options.one_clamp:
            scene = scene.model_copy(update={"clamps": scene.clamps[:1]})
        rows.append(repeated(models, config, plans[mesh], load, scene, options.frames))
        print(json.dumps(rows[-1]), flush=True)
        write_record(
            options.output,
            **about,
            omega={name: summary(rows, name) for name in models},
            error_over_base={name: harm(rows, name) for name in models},
            simulations=rows,
        )


def numbers(case: str, meshes: Iterable[int]) -> tuple[int, int]:
    """Mesh and load of a case that was asked for.

    Raises
    ------
    InputError
        If it is none of the split.
    """
    mesh, _, load = case.partition("/")
    if not (mesh.isdecimal() and load.isdecimal() and int(mesh) in set(meshes)):
        raise InputError(f"case {case!r}: expected MESH/LOAD, two numbers, of a mesh of the split.")
    return int(mesh), int(load)


def of_bodies(config: DatasetConfig, family: FamilyName, nodes: list[int]) -> DatasetConfig:
    """The configuration with ten evaluation meshes of other bodies, or as many as there are."""
    there = min(10, count_bodies(family, (nodes[0], nodes[1])) - 1)
    if there < 1:
        raise SystemExit(f"--coarse-nodes {nodes[0]} {nodes[1]}: fewer than two bodies there.")
    changes = {
        "family": family, "coarse_nodes": tuple(nodes), "extra": (),
        "training": Split(meshes=1, simulations=1),
        "evaluation": Split(meshes=there, simulations=there),
    }  # fmt: skip
    return config.model_copy(update=changes)


def known_rows(path: Path, about: dict[str, Any]) -> list[dict[str, Any]]:
    """Simulations of a record that was begun with the same models, gate, data set and frames."""
    if not path.exists():
        return []
    record = json.loads(path.read_text(encoding="utf-8"))
    if any(record.get(key) != value for key, value in about.items()):
        raise SystemExit(f"{path}: of other models, another gate, data set or number of frames.")
    rows: list[dict[str, Any]] = record["simulations"]
    return rows


def harm(rows: list[dict[str, Any]], name: str) -> dict[str, dict[str, float]]:
    """RMS error over that of the model's base: median, largest, and how many are above 1.05."""
    found = {}
    for label in ("with_gate", "without"):
        each = [row["models"][name] for row in rows]
        ratios = np.array([one[f"rms_mm_{label}"] / one["rms_mm_own_base"] for one in each])
        found[label] = {
            "median": float(np.median(ratios)), "largest": float(ratios.max()),
            "above_1.05": int((ratios > 1.05).sum()),
        }  # fmt: skip
    return found


def summary(rows: list[dict[str, Any]], name: str) -> dict[str, dict[str, float]]:
    """Mean, median and least Omega over the simulations, per cent."""
    return {
        label: {
            "mean": float(np.mean(found)), "median": float(np.median(found)),
            "least": float(np.min(found)),
        }
        for label in ("own_base", "with_gate", "without")
        if (found := [row["models"][name][label] for row in rows])
    }  # fmt: skip


def repeated(
    models: dict[str, LoadedModel], config: DatasetConfig, plan: MeshPlan, load: int,
    scene: pc.Scene, frames: int | None,
) -> dict[str, Any]:  # fmt: skip
    """Omega with and without a gate, per cent, and the steps that it refused."""
    frames = frames or plan.frames
    plain = pc.discretise(scene)
    truth = pc.best_coarse(scene) if config.setting == "exact" else scene
    fine = pc.discretise(truth, refine=plan.refine)
    reference = pc.restrict(pc.rollout(pc.ProjectiveDynamics(fine), frames), to=plain)
    zero = pc.rollout(pc.ProjectiveDynamics(plain), frames)
    found: dict[str, Any] = {}
    for name, model in models.items():
        coarse = pc.coarse_model(scene, model.base, plan.refine)
        base = pc.rollout(pc.ProjectiveDynamics(coarse), frames)
        row = {
            "own_base": pc.metrics.error_corrected(base, zero, reference),
            "rms_mm_own_base": 1e3 * pc.metrics.rms_error(base, reference),
        }
        for label, gate in (("with_gate", True), ("without", False)):
            hybrid = pc.hybrid_of(scene, model, gate=gate, problem=coarse)
            row["body_beyond"] = hybrid.body_excess()
            run = pc.rollout(hybrid, frames)
            row[label] = pc.metrics.error_corrected(run, zero, reference)
            row[f"rms_mm_{label}"] = 1e3 * pc.metrics.rms_error(run, reference)
            if gate:
                reasons = np.asarray(run.stats["gate"])
                row["refused"] = {
                    str(step + 1): Reason(int(reasons[step])).name.lower()
                    for step in np.flatnonzero(reasons)
                }
        found[name] = row
    return {
        "mesh": plan.number, "load": load, "nodes": len(plain.positions),
        "rms_mm_plain": 1e3 * pc.metrics.rms_error(zero, reference), "models": found,
    }  # fmt: skip


if __name__ == "__main__":
    run_script(main)

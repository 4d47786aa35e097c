"""What a corrected step costs beside the coarse and the fine solver's, at equal accuracy.

    python benchmarks/hybrid.py MODEL DATA [--device cuda] [--split evaluation]
        [--batches 1,4,16] [--accuracy 1e-4] [--steps 20] [--quick]

Scenes are the first ones of a data set's split, repeated where a batch is larger; the fine
mesh is that of its reference.  DATA is its folder, or a configuration, whose scenes are drawn
then: one load for each of ``--meshes``.  Network and gate count to the corrected step.
``--quick`` is one scene and three steps, to see that it works.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import torch
from machine_file import add
from speed import measure_speed

from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import BatchHybrid
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.gate import Gate
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.folder import shard_paths
from pdcorrect.data.plan import draw_scene, make_plan
from pdcorrect.data.schema import REFERENCE, read_shard
from pdcorrect.data.simulate import models, rebuilt_problems
from pdcorrect.evaluation.evaluation import saved_candidates
from pdcorrect.fem.problem import Problem, coarse_model, discretise
from pdcorrect.scene import trained_coarse


def options() -> argparse.Namespace:
    """From the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("data")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--split", default="evaluation")
    parser.add_argument("--batches", default="1,4,16", help="numbers of scenes")
    parser.add_argument("--accuracy", type=float, default=1e-4, help="of the coarse cell size")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--meshes", type=int, default=4, help="of a configuration")
    parser.add_argument("--recorded", action="store_true", help="see BatchHybrid")
    parser.add_argument("--quick", action="store_true")
    return parser.parse_args()


def stored(data: Path, split: str, base: str) -> Iterator[tuple[Problem, Problem]]:
    """Coarse and fine problems of a data set's simulations."""
    for path in shard_paths(data, split):
        shard = read_shard(path)
        coarse, fine = (rebuilt_problems(shard, path, run) for run in (base, REFERENCE))
        yield from zip(coarse, fine, strict=True)


def drawn(path: Path, split: str, base: str) -> Iterator[tuple[Problem, Problem]]:
    """The same of the first loads of a configuration's meshes."""
    config = DatasetConfig.load(path)
    for plan in make_plan(config):
        if plan.split == split:
            scene, reference = draw_scene(config, plan, 0), models(config, plan)[REFERENCE]
            truth = trained_coarse(scene) if reference.best else scene
            yield coarse_model(scene, base, plan.refine), discretise(truth, refine=plan.refine)


def main() -> None:
    """Measure each batch size and write the results."""
    chosen = options()
    batches = [1] if chosen.quick else [int(count) for count in chosen.batches.split(",")]
    steps = 3 if chosen.quick else chosen.steps
    (saved,) = saved_candidates([chosen.model], chosen.device)
    base, model = saved.base, saved.model

    def hybrid(stepper: BatchStepper) -> BatchHybrid:
        return BatchHybrid(
            stepper, model.corrector, velocity=model.velocity, gate=Gate(),
            recorded=chosen.recorded,
        )  # fmt: skip

    def refused(problems: list[Problem]) -> int:
        """Scenes that the gate refuses as a whole, whose steps are the coarse ones."""
        corrector, gate = model.corrector, Gate()
        device = corrector.normaliser.output_scale.device
        bodies = BodyGraph.of(problems, dtype=torch.float64, device=device)
        assert gate.outside is not None
        return int((corrector.envelope.rest_score(bodies) > gate.outside).sum())

    data = Path(chosen.data)
    source = drawn(data, chosen.split, base) if data.is_file() else stored(data, chosen.split, base)
    most = min(chosen.meshes, max(batches)) if data.is_file() else max(batches)
    pairs = list(islice(source, most))
    rows: list[dict[str, Any]] = []
    for count in batches:
        scenes = list(islice(cycle(pairs), count))
        found = measure_speed(
            [coarse for coarse, _ in scenes], [fine for _, fine in scenes],
            hybrid, device=chosen.device, accuracy=chosen.accuracy, steps=steps,
        )  # fmt: skip
        rows.append({
            **asdict(found), "speed_up": found.speed_up, "network_share": found.network_share,
            "bodies_refused": refused([coarse for coarse, _ in scenes]),
        })  # fmt: skip
        print(json.dumps(rows[-1], indent=1), flush=True)
    if chosen.quick:
        print("--quick: no file was written")
        return
    recorded = ", recorded" if chosen.recorded else ""
    add(
        f"hybrid {Path(chosen.model).name}{recorded}", rows,
        torch.cuda.get_device_name() if chosen.device != "cpu" else None,
        model=saved.record(), data=chosen.data, distinct_scenes=len(pairs),
        torch_threads=torch.get_num_threads(),
    )  # fmt: skip


if __name__ == "__main__":
    main()

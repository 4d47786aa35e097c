"""How many simulations repay the data and the training of a model, beside classical methods.

python validation/error_time/break_even.py

measures, on this machine, what no other record has, and writes
``validation/results/break_even.json``: the time of some of the learned element's bodies and of some
iterations of its training, as seconds of CPU on one thread.  `repaid` computes the rest from the
record of errors and times.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from methods import FIRST, METHODS, RIVALS, ROUNDS, Point, points_of, time_at

HERE = Path(__file__).resolve().parent
RECORD = HERE.parent / "results" / "break_even.json"
EACH = 6
"""Bodies of each of the ten kinds of file."""
EPOCHS = 2
NEVER = math.inf


class Repaid(NamedTuple):
    """Simulations that repay a cost in a scene beside the front of rivals, `NEVER`, or None where
    no rival is as near.

    ``fixed`` are beside the rivals `fixed`, by time alone, and ``near`` whether the error is no
    larger than theirs.
    """

    scene: str
    equal: float | None
    fixed: tuple[float, ...]
    near: tuple[bool, ...]


def simulations(cost: float, own: float, rival: float) -> float:
    """Simulations after which ``cost`` s and ``own`` s each are no more than ``rival`` s each."""
    return math.ceil(cost / (rival - own)) if rival > own else NEVER


def fixed(name: str) -> tuple[str, str]:
    """Rivals whatever their error: hex27 with as many steps a frame, and the fine mesh with one."""
    quadratic = f"hex27, {name.rpartition(', ')[2]}"
    return quadratic if quadratic in METHODS else "hex27, 1", "best on 4x4x4, 1"


def simulations_of(record: Any) -> dict[str, list[Point]]:
    """`points_of` a record of the case, with whole simulations, s, as times."""
    table = record.table(ROUNDS)
    first = {row[0]: row for row in table["rows"] if row[2] == FIRST}
    out = {}
    for scene, points in points_of(record).items():
        of = dict(zip(table["headings"], first[scene], strict=True))
        others = of["frames"] - 1
        out[scene] = [Point(p.name, of[p.name] + 1e-3 * others * p.time, p.error) for p in points]
    return out


def repaid(name: str, cost: float, reached: dict[str, list[Point]]) -> list[Repaid]:
    """Of a method whose data and training take ``cost`` s, in each scene's simulations."""
    out = []
    for scene, every in reached.items():
        of = {simulation.name: simulation for simulation in every}
        own = of[name]
        others = [of[other] for other in fixed(name)]
        rival = time_at(own.error, [s for s in every if s.name in RIVALS])
        equal = None if math.isnan(rival) else simulations(cost, own.time, rival)
        by_time = tuple(simulations(cost, own.time, other.time) for other in others)
        near = tuple(own.error <= other.error for other in others)
        out.append(Repaid(scene, equal, by_time, near))
    return out


# --- what is measured ----------------------------------------------------------------------


def element_times() -> dict[str, Any]:
    """Seconds a body and an iteration, from samples of both."""
    from pdcorrect.elements.answers import answers
    from pdcorrect.elements.bodies import draw
    from pdcorrect.elements.collection import _CUT, _FREE, _TURN, A_FILE
    from pdcorrect.elements.linear import sample
    from pdcorrect.elements.training import _VALIDATION, ElementRecipe, Trainer

    recipe = ElementRecipe()
    samples, spent = [], []
    for number in range(_TURN):
        for i in range(EACH):
            rng = np.random.default_rng([recipe.seed, number * A_FILE + i])
            started = time.process_time()
            found = answers(draw(rng, cut=number == _CUT, free=number == _FREE), rng)
            spent.append(time.process_time() - started)
            samples.append(sample(found))
        print(f"file {number}: {np.mean(spent):.2f} s a body", flush=True)
    trainer = Trainer(recipe, samples, samples[: recipe.batch], "cpu")
    trainer.epoch()
    before, started = trainer.iteration, time.process_time()
    for _ in range(EPOCHS):
        trainer.epoch()
    seconds = time.process_time() - started
    count = trainer.iteration - before
    return {
        "bodies": recipe.bodies + round(_VALIDATION * recipe.bodies),
        "sampled_bodies": len(spent),
        "seconds_a_body": float(np.mean(spent)),
        "standard_error": float(np.std(spent, ddof=1) / math.sqrt(len(spent))),
        "iterations": recipe.iterations,
        "sampled_iterations": count,
        "seconds_an_iteration": seconds / count,
    }


def main() -> None:
    """Measure and write the record."""
    import torch

    from pdcorrect._environment import environment
    from pdcorrect._files import write_text

    torch.set_num_threads(1)
    load = round(os.getloadavg()[0], 2)
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "command": "python validation/error_time/break_even.py",
        "environment": environment(),
        "load": load,
        "element": element_times(),
    }
    write_text(RECORD, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    main()

"""Train the network of elements on fewer bodies, and with parts left out, all for as long.

python models/element_studies.py FOLDER -o OUTPUT.json [--iterations 8000] [--device cuda]
    [--workers 4]

FOLDER is that of ``pdcorrect train-element``, with its bodies.  Each study is judged by the same
validation bodies, and OUTPUT gets its errors; studies that are there already are not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from program import origin, run_script
from torch import Tensor, nn
from torch.nn.functional import silu

from pdcorrect._files import write_text
from pdcorrect.elements.collection import A_FILE
from pdcorrect.elements.network import ElementNetwork
from pdcorrect.elements.training import ElementRecipe, Trainer, samples_of
from pdcorrect.fem.element_network import SCALARS, STRAINS
from pdcorrect.fem.neighbourhood import NEIGHBOURS, SIZE


class WithoutMass(ElementNetwork):
    """Corrects stiffness only."""

    def forward(
        self, numbers: Tensor, neighbours: Tensor, symmetries: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See `ElementNetwork`."""
        N, H = super().forward(numbers, neighbours, symmetries)
        return N, torch.zeros_like(H)


class OneOrientation(ElementNetwork):
    """Looks at each body as it lies, without the mean over the cube's symmetries."""

    def forward(
        self, numbers: Tensor, neighbours: Tensor, symmetries: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See `ElementNetwork`."""
        first = torch.zeros(1, dtype=torch.int64, device=numbers.device)
        return super().forward(numbers, neighbours, first)


class NeighbourhoodMLP(ElementNetwork):
    """A plain MLP on the numbers of a cell and its 26 neighbours, instead of rounds of messages."""

    def __init__(self, width: int = 256, rounds: int = 3) -> None:
        super().__init__(width, 0)
        sizes = [NEIGHBOURS * SIZE, *[width] * rounds]
        self.layers = nn.ModuleList(map(nn.Linear, sizes[:-1], sizes[1:]))
        self.hidden = nn.Linear(width, 128)

    def forward(
        self, numbers: Tensor, neighbours: Tensor, symmetries: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See `ElementNetwork`."""
        if symmetries is None:
            symmetries = torch.arange(48, device=numbers.device)
        turned = nn.functional.pad(numbers, (0, 0, 0, 1))[:, self.own[symmetries]]
        orientation = torch.arange(len(symmetries), device=numbers.device)[:, None]
        x = turned[neighbours[:, self.around[symmetries]], orientation].flatten(2)
        for layer in (*self.layers, self.hidden):
            x = silu(layer(x))
        lower = zip(self.last(x).split(self._lengths, dim=2), (STRAINS, SCALARS), strict=True)
        N, H = (self._mean(answers, size, symmetries) for answers, size in lower)
        return N, H


FULL = ElementRecipe()
STUDIES: dict[str, tuple[ElementRecipe, type[ElementNetwork]]] = {
    **{f"{n} bodies": (replace(FULL, bodies=n), ElementNetwork) for n in (50, 200, 1000)},
    f"{FULL.bodies} bodies": (FULL, ElementNetwork),
    "sees 5 cells across": (replace(FULL, rounds=1), ElementNetwork),
    "sees 7 cells across": (replace(FULL, rounds=2), ElementNetwork),
    "MLP that sees 5 cells across": (replace(FULL, width=256), NeighbourhoodMLP),
    "without mass": (FULL, WithoutMass),
    "one orientation": (FULL, OneOrientation),
}


def study(name: str, iterations: int, folder: Path, device: str) -> dict[str, Any]:
    """Train one network; its errors on the validation bodies."""
    torch.set_num_threads(1)
    recipe, kind = STUDIES[name]
    recipe = replace(recipe, iterations=iterations)
    judges = A_FILE * len(list((folder / "validation").glob("bodies-*.npz")))
    known, others = (
        samples_of(folder / part, count)
        for part, count in (("training", recipe.bodies), ("validation", judges))
    )
    trainer = Trainer(recipe, known, others, device, kind)
    started = time.monotonic()
    while trainer.iteration < iterations:
        trainer.epoch()
    seconds = round(time.monotonic() - started, 1)
    return {"recipe": asdict(recipe), "seconds": seconds, "validation": trainer.measured()}


def main() -> None:
    """Run those that are missing."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=8000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    found = json.loads(options.output.read_text())["studies"] if options.output.exists() else {}
    spawn = get_context("spawn")
    with ProcessPoolExecutor(options.workers, spawn, max_tasks_per_child=1) as pool:
        tasks = {
            pool.submit(study, name, options.iterations, options.folder, options.device): name
            for name in STUDIES
            if name not in found
        }
        for task in as_completed(tasks):
            name = tasks[task]
            found[name] = task.result()
            print(f"{name}: loss {found[name]['validation']['loss']:.3f}", flush=True)
            ordered = {name: found[name] for name in STUDIES if name in found}
            write_text(
                options.output, json.dumps({**origin(), "studies": ordered}, indent=1) + "\n"
            )


if __name__ == "__main__":
    run_script(main)

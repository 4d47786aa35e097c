"""Training of the network that writes elements, from nothing to weights and card; it resumes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pdcorrect._environment import environment
from pdcorrect._files import make_folder, replacing, write_text
from pdcorrect.elements.collection import DRAWN, file_paths, generate, read_file
from pdcorrect.elements.linear import Batch, Sample, collate, errors, loss, means, sample
from pdcorrect.elements.network import Descent, ElementNetwork
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.fem.element_network import write_network
from pdcorrect.fem.learned import LARGEST_POISSON

WEIGHTS, CARD = "hex8_learned.safetensors", "hex8_learned.json"
_CHECKPOINT = "checkpoint.pt"
_VALIDATION = 0.0625
"""Bodies that judge the network, of those that it learns from."""
_REPORTS = 20.0
"""Seconds from one line, and one checkpoint, to the next."""


@dataclass(frozen=True)
class ElementRecipe:
    """How the network is trained.

    Attributes
    ----------
    bodies : int
        Random bodies to learn from; others, and fewer, judge it.
    width, rounds : int
        See `ElementNetwork`.
    iterations, batch : int
        Steps of the optimiser, and bodies in each.
    symmetries : int
        Of the cube's 48, drawn anew in each step.
    rate : float
        Largest learning rate, see `Descent`.
    """

    bodies: int = 4000
    seed: int = 45
    width: int = 96
    rounds: int = 3
    iterations: int = 40_000
    batch: int = 16
    symmetries: int = 24
    rate: float = 1e-2


Report = Callable[[str], None]


def train(
    recipe: ElementRecipe,
    folder: Path,
    *,
    device: str = "cpu",
    workers: int = 1,
    seconds: float | None = None,
    report: Report = print,
) -> bool:
    """Generate bodies, train, and write weights and card into a folder; whether it is finished.

    What is there of an earlier call is taken up: files of bodies, and the last checkpoint.

    Raises
    ------
    InputError
        If the folder's checkpoint is of another recipe.
    """
    started = time.monotonic()

    def left() -> float | None:
        return None if seconds is None else max(0.0, seconds - (time.monotonic() - started))

    make_folder(folder)
    judges = max(1, round(_VALIDATION * recipe.bodies))
    sets = {"training": (recipe.bodies, recipe.seed), "validation": (judges, recipe.seed + 1)}
    for name, (count, seed) in sets.items():
        report(f"{name}: {count} bodies")
        if generate(folder / name, count, seed, workers, left()):
            return False
    known, others = (samples_of(folder / name, count, workers) for name, (count, _) in sets.items())
    trainer = Trainer(recipe, known, others, device)
    path = folder / _CHECKPOINT
    if path.exists():
        trainer.restore(path)
        report(f"goes on at iteration {trainer.iteration}")
    while trainer.iteration < recipe.iterations:
        if left() == 0.0:
            return False
        told = time.monotonic()
        while trainer.epoch(left()) and time.monotonic() < told + _REPORTS:
            pass
        trainer.save(path)
        report(trainer.line())
    write_network(folder / WEIGHTS, trainer.weights())
    write_text(folder / CARD, json.dumps(trainer.card(device), indent=1) + "\n")
    report(f"wrote {folder / WEIGHTS}")
    return True


class Trainer:
    """The network, its optimiser, and the batches of ``known`` bodies; ``others`` judge it."""

    def __init__(
        self,
        recipe: ElementRecipe,
        known: Sequence[Sample],
        others: Sequence[Sample],
        device: str,
        kind: type[ElementNetwork] = ElementNetwork,
    ) -> None:
        self._recipe, self._device = recipe, device
        if "cuda" in device:
            torch.cuda.set_device(torch.device(device).index or 0)  # which graphs are recorded on
        torch.manual_seed(recipe.seed)
        self._rng = np.random.default_rng(recipe.seed)
        self._network = network = kind(recipe.width, recipe.rounds).to(device)
        self._descent = Descent(network, recipe.rate, recipe.iterations)
        batches, self._validation = (
            _batches(samples, recipe.batch, device) for samples in (known, others)
        )
        with torch.no_grad():
            self._without = [errors(batch, None, None) for batch in self._validation]
        self._symmetries = torch.arange(recipe.symmetries, device=device)
        self._pool = torch.cuda.graph_pool_handle() if "cuda" in device else None
        self._slopes = [self._slopes_of(batch) for batch in batches]
        self.iteration, self.seconds = 0, 0.0  # of all epochs
        self._loss = float("nan")

    def epoch(self, seconds: float | None = None) -> bool:
        """Each body once, as far as the recipe's iterations and the time (s) go; if they do.

        Raises
        ------
        ConvergenceError
            If the loss is not finite, and with it the weights.
        """
        started = time.monotonic()
        deadline = None if seconds is None else started + seconds
        losses: list[Tensor] = []
        more = True
        for i in self._rng.permutation(len(self._slopes)):
            late = deadline is not None and time.monotonic() > deadline
            more = not late and self.iteration < self._recipe.iterations
            if not more:
                break
            chosen = self._rng.choice(48, len(self._symmetries), replace=False)
            self._symmetries.copy_(torch.as_tensor(chosen))
            losses.append(self._slopes[i]().clone())
            self._descent.step(self.iteration)
            self.iteration += 1
        if losses:
            self._loss = float(torch.stack(losses).mean())
            if not np.isfinite(self._loss):
                raise ConvergenceError(f"loss {self._loss} at iteration {self.iteration}.")
        self.seconds += time.monotonic() - started
        return more

    def _slopes_of(self, batch: Batch) -> Callable[[], Tensor]:
        """What gives a batch's loss, and its derivatives to the network."""
        with torch.no_grad():
            base = errors(batch, None, None)

        def slopes() -> Tensor:
            self._network.zero_grad(set_to_none=False)
            found = self._network(batch.numbers, batch.neighbours, self._symmetries)
            value = loss(errors(batch, *found), base).mean()
            value.backward()  # type: ignore[no-untyped-call]
            return value.detach()

        return slopes if self._pool is None else Recorded(slopes, self._pool)

    def measured(self) -> dict[str, float]:
        """Errors on the validation bodies, and without learning."""
        with torch.no_grad():
            found = [errors(b, *self._network(b.numbers, b.neighbours)) for b in self._validation]
            pairs = zip(found, self._without, strict=True)
            judged = torch.cat([loss(a, b) for a, b in pairs]).mean()
        return {
            "loss": float(judged),
            **{f"{k}, learned": v for k, v in means(found).items()},
            **{f"{k}, without": v for k, v in means(self._without).items()},
        }

    def line(self) -> str:
        """Where it is, in a line."""
        found = self.measured()
        return (
            f"iteration {self.iteration}: loss {self._loss:.3f}, validation {found['loss']:.3f}, "
            f"displacements {100 * found['displacements, learned']:.2f} % "
            f"({100 * found['displacements, without']:.2f} % without learning), "
            f"first frequency {100 * found['first frequency, learned']:.2f} % "
            f"({100 * found['first frequency, without']:.2f} %)"
        )

    def weights(self) -> dict[str, NDArray[np.float16]]:
        """By name, in half precision: corrections change by 1e-3 of themselves."""
        state = self._network.state_dict()
        return {k: v.detach().cpu().half().numpy() for k, v in state.items()}

    def card(self, device: str) -> dict[str, Any]:
        """What is written beside the weights."""
        recipe = self._recipe
        return {
            "format": 1,
            "command": f"pdcorrect train-element --bodies {recipe.bodies} --iterations "
            f"{recipe.iterations} --seed {recipe.seed}",
            "largest_poisson": LARGEST_POISSON,
            "recipe": self._kind(),
            "validation": self.measured(),
            "seconds": round(self.seconds, 3),
            "device": torch.cuda.get_device_name(device) if "cuda" in device else device,
            "environment": environment(),
        }

    def _kind(self) -> dict[str, Any]:
        return {**asdict(self._recipe), "drawn": DRAWN}

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        state = {
            "recipe": self._kind(),
            "iteration": self.iteration,
            "seconds": self.seconds,
            "network": self._network.state_dict(),
            "descent": self._descent.state(),
            "rng": self._rng.bit_generator.state,
        }
        with replacing(path) as part:
            torch.save(state, part)

    def restore(self, path: Path) -> None:
        """Take up a checkpoint.

        Raises
        ------
        InputError
            If it is of another recipe.
        """
        state = torch.load(path, map_location=self._device, weights_only=True)
        if state["recipe"] != self._kind():
            raise InputError(
                f"{path}: of recipe {state['recipe']}: expected {self._kind()}. Use another folder."
            )
        self.iteration, self.seconds = state["iteration"], state["seconds"]
        self._network.load_state_dict(state["network"])
        self._descent.restore(state["descent"])
        self._rng.bit_generator.state = state["rng"]


class Recorded:
    """Work on a GPU as a CUDA graph: its thousand kernels take longer to launch than to run.

    ``work`` is of the same shapes each time, and its answer is overwritten each time.  ``pool`` is
    memory that it shares with other graphs that never run at the same time.
    """

    def __init__(self, work: Callable[[], Tensor], pool: Any) -> None:
        self._work = work  # keeps what the kernels read
        work()  # libraries set themselves up
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=pool):
            self._answer = work()

    def __call__(self) -> Tensor:
        self._graph.replay()
        return self._answer


def samples_of(folder: Path, count: int, workers: int = 1) -> list[Sample]:
    """The first bodies of a folder, prepared by several processes."""
    paths = file_paths(folder, count)
    if workers == 1:
        return [s for path in paths for s in _of_file(path)][:count]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return [s for part in pool.map(_of_file, paths) for s in part][:count]


def _of_file(path: Path) -> list[Sample]:
    return [sample(body) for body in read_file(path)]


def _batches(samples: Sequence[Sample], size: int, device: str) -> list[Batch]:
    """Bodies of similar size together, which are padded to one."""
    order = sorted(range(len(samples)), key=lambda i: int(samples[i].free.sum()))
    parts = [order[i : i + size] for i in range(0, len(order), size)]
    return [collate([samples[i] for i in part]).to(device) for part in parts]

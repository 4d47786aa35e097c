"""Train a network without a solver on a data set and measure it, as a baseline for correctors.

python models/surrogate.py DATA -o OUTPUT [--base plain | total-mass | best] [--seconds 300]
    [--steps 1 2 4 8] [--batch 64] [--noise 1.0] [--at-rest 0.0] [--preset equivariant]
    [--changes layers=6 ...] [--amp bf16] [--fit 10000] [--validation 100] [--seed 0]
    [--device cuda] [--split evaluation] [--workers 1]

The network of a corrector is shown where inertia and loads alone would take the body, p + h v +
h^2 f/m, and says where it goes instead; no elastic solver is asked, in training or after it
(MeshGraphNet as a surrogate, arXiv 2010.03409).  Masses are those of the coarse model ``--base``,
whose errors are the unit of noise and losses, as for correctors.  Training takes windows of 1, 2, 4
and 8 steps (``--steps``), each for an equal share of ``--seconds``, which include making tables and
looking at the validation split.  Windows begin with states of the reference that noise makes wrong,
and derivatives go through all of their steps; losses, learning rate and averaged weights are those
of correctors.  Loads in training are those of the reference's states, in rollouts those of the
network's own, which differ for loads that follow the body.

The averaged weights with the fewest failed and the nearest free rollouts on the validation split
(by the geometric mean of errors, which may be of any size), looked at ten times, are measured like
correctors, by `pdcorrect.evaluation.evaluate`, beside the stored runs.  OUTPUT gets the same files
as by ``pdcorrect evaluate``, and the weights.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from program import origin, run_script
from safetensors.torch import save_file
from torch import Tensor

from pdcorrect import metrics
from pdcorrect.batch.states import BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_hybrid import BatchParts
from pdcorrect.corrector.config import preset
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import Snapshot
from pdcorrect.corrector.placements import ballistic
from pdcorrect.data.config import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.folder import shard_paths
from pdcorrect.data.folder import check_whole
from pdcorrect.data.schema import PLAIN
from pdcorrect.data.shard_arrays import read_header
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.evaluation.measures import Case, read_cases
from pdcorrect.evaluation.evaluation import Candidate, evaluate
from pdcorrect.evaluation.rollouts import roll_out
from pdcorrect.evaluation.tables import markdown, write_evaluation
from pdcorrect.fem.problem import Base
from pdcorrect._files import make_folder
from pdcorrect.state import Status
from pdcorrect.training.config import Stage
from pdcorrect.training.fitting import fit_normaliser
from pdcorrect.training.losses import BaseErrors, body_losses
from pdcorrect.training.optimisation import Optimiser
from pdcorrect.training.precision import network_precision
from pdcorrect.training.recordings import load_recordings
from pdcorrect.training.resident import StoredWindows
from pdcorrect.training.windows import StepBatch, StepWindows
from pdcorrect.training.world import World

NAME, WEIGHTS = "network alone", "weights.safetensors"
LOOKS = 10
"""At the validation split."""
MOST_SKIPPED = 20
"""Batches in a row without a finite gradient."""


class Alone:
    """Steps of a network without a solver, as a `Hybrid`.

    Parameters
    ----------
    stepper : BatchStepper
        Whose scenes they are; it is asked for loads and clamps only.
    corrector : Corrector
    """

    def __init__(self, stepper: BatchStepper, corrector: Corrector) -> None:
        self._parts, self._corrector = BatchParts(stepper, corrector, "recomputed"), corrector

    @torch.no_grad()
    def __call__(self, state: BatchState, previous: Tensor | None = None) -> AloneResult:
        """One step."""
        stepper, nodes = self._parts.stepper, self._parts.nodes
        view = self._parts.view(state, None, None)
        correction = self._corrector.of_view(view)
        positions = nodes.padded(view.snapshot.proposed + correction)
        positions = torch.where(stepper.node_mask[..., None], positions, state.positions)
        after = BatchState(
            positions, (positions - state.positions) / stepper.time_step,
            tuple(t + stepper.time_step for t in state.times),
        )  # fmt: skip
        scenes = len(positions)
        none = torch.zeros(scenes, dtype=torch.int64, device=positions.device)
        return AloneResult(after, correction, Unasked([Status.CONVERGED] * scenes), none)


@dataclass(frozen=True)
class Unasked:
    """What a solver would say that is not there."""

    statuses: list[Status]


@dataclass(frozen=True)
class AloneResult:
    """See `pdcorrect.evaluation.rollouts.HybridResult`."""

    state: BatchState
    correction: Tensor
    coarse: Unasked
    reasons: Tensor


class AloneWindows(StepWindows):
    """Steps of which all is to be given by the network, which sees no correction before it."""

    def step_batch(self, found: object, *, last: bool = True) -> StepBatch:
        """See `StepWindows`."""
        stored = found if isinstance(found, StoredWindows) else self._stored(found)
        batch = super().step_batch(stored, last=last)
        return replace(batch, target=stored.targets[0] - batch.snapshot.proposed)


class Draws:
    """Windows in random order, their first states wrong.

    Parameters
    ----------
    windows : StepWindows
    noise : float
        Deviation of positions, in root mean squared one-step errors (a component) of the coarse
        model on the same trajectory, and of velocities, in these over h.
    at_rest : float
        Share of the windows with which simulations begin.
    seed : int
    """

    def __init__(self, windows: StepWindows, noise: float, at_rest: float, seed: int) -> None:
        self._windows, self._noise, self._at_rest = windows, noise, at_rest
        every = np.arange(len(windows.dataset))
        self._beginnings = every[windows.dataset.places(every)[2] == 0]
        self._rng = np.random.default_rng((seed, windows.dataset.window))
        self._generator = torch.Generator(windows.device).manual_seed(seed)

    def __call__(self, size: int) -> tuple[StoredWindows, BaseErrors]:
        """A batch, and the coarse model's errors on the trajectories."""
        chosen = self._rng.integers(0, len(self._windows.dataset), size)
        first = self._rng.choice(self._beginnings, size)
        chosen = np.where(self._rng.random(size) < self._at_rest, first, chosen)
        stored = self._windows.windows(chosen.tolist())
        errors, bodies = self._windows.errors(stored), stored.bodies
        deviation = self._noise * bodies.by_node((errors.one_step / 3.0).sqrt())[:, None]
        h = bodies.by_node(bodies.time_step)[:, None]
        moved = self._gauss(stored.positions, deviation)
        pushed = self._gauss(stored.positions, deviation / h)
        free = bodies.free
        return replace(
            stored, positions=stored.positions + torch.where(free, moved, 0.0),
            velocities=stored.velocities + torch.where(free, pushed, 0.0),
        ), errors  # fmt: skip

    def _gauss(self, like: Tensor, deviation: Tensor) -> Tensor:
        return deviation * torch.randn(
            like.shape, generator=self._generator, dtype=like.dtype, device=like.device
        )


def unrolled(corrector: Corrector, stored: StoredWindows, amp: Any = "none") -> Iterator[Tensor]:
    """Positions (n, 3) after each of a window's steps, by the network alone.

    Parameters
    ----------
    corrector : Corrector
    stored : StoredWindows
        Of k steps, with the first state.
    amp
        See `Stage`.
    """
    bodies = stored.bodies
    h = bodies.by_node(bodies.time_step)[:, None]
    positions, velocities = stored.positions, stored.velocities
    for truth, forces in zip(stored.targets, stored.forces, strict=True):
        state = Snapshot(positions, velocities, positions, forces, None)
        start = ballistic(state, h, forces, bodies.mass, bodies.free, truth)
        with network_precision(corrector, amp):
            after = start + corrector(bodies, replace(state, proposed=start))
        positions, velocities = after, (after - positions) / h
        yield positions


def unrolled_loss(
    corrector: Corrector, stored: StoredWindows, errors: BaseErrors, stage: Stage
) -> Tensor:
    """Mean loss of the steps of some windows, as correctors have it."""
    bodies, total = stored.bodies, torch.zeros((), dtype=torch.float64, device=stored.file.device)
    for j, after in enumerate(unrolled(corrector, stored, stage.amp)):
        wrong, scale = after - stored.targets[j], errors.after(j + 1)
        total = (
            total
            + body_losses(stage.loss, wrong, bodies.node_sums, bodies.node_counts, scale).mean()
        )
    return total / len(stored.targets)


class Looks:
    """Free rollouts of some simulations, set up once.

    Parameters
    ----------
    cases : sequence of Case
    base : str
        Whose masses count.
    device : str
    """

    def __init__(self, cases: Sequence[Case], base: str, device: str) -> None:
        groups: dict[str, list[Case]] = {}
        for case in cases:
            groups.setdefault(case.problems[base].element, []).append(case)
        self._groups = [
            (BatchStepper([case.problems[base] for case in some], device=device), some)
            for some in groups.values()
        ]

    def __call__(self, corrector: Corrector) -> tuple[NDArray[np.float64], int]:
        """RMS errors over those of the plain mesh, (S,), and how many rollouts failed."""
        found, failed = [], 0
        for stepper, cases in self._groups:
            runs = roll_out(Alone(stepper, corrector), stepper, [case.steps for case in cases])
            for run, case in zip(runs, cases, strict=True):
                error, plain = (
                    metrics.rms_error(x, case.reference) for x in (run.positions, case.runs[PLAIN])
                )
                found.append(error / plain)
                failed += run.failed is not None
        return np.array(found), failed


class Learner:
    """A training, looked at from time to time.

    Parameters
    ----------
    options : argparse.Namespace
        See `main`.

    Attributes
    ----------
    best : Corrector
        With the averaged weights that were best so far.
    history : list of dict
        What was seen at each look.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._options, self._device = options, torch.device(options.device)
        self._config = preset(options.preset, placement="guess", **dict(options.changes))
        self._recordings = load_recordings(options.data, TRAINING, options.base, scenes=False)
        found = read_cases(options.data, VALIDATION, [options.base], skip_damaged=False).cases
        self._looks = Looks(found[: options.validation], options.base, options.device)
        torch.manual_seed(options.seed)
        self._corrector = Corrector(self._config).to(self._device)
        fit_normaliser(self._corrector, self._windows(1), options.fit, options.seed)
        self._averaged = copy.deepcopy(self._corrector)
        self._stage = Stage(
            kind="one-step", seconds=options.seconds, batch=options.batch, amp=options.amp,
            rate={"peak": 1e-3, "last": 1e-5}, loss={"bend": 0.3}, ema=0.99,
        )  # fmt: skip
        self._optimiser = Optimiser(self._corrector, self._stage, self._averaged, World())
        self.best = copy.deepcopy(self._corrector)
        self.history: list[dict[str, float]] = []

    def _windows(self, steps: int) -> StepWindows:
        return AloneWindows(
            self._options.data, self._recordings, self._config, self._options.base,
            device=self._device, steps=steps,
        )  # fmt: skip

    def run(self) -> None:
        """Train until time is up.

        Raises
        ------
        ConvergenceError
            If too many batches in a row had no finite gradient.
        """
        options, started = self._options, time.perf_counter()
        draws: Draws | None = None
        length = iterations = 0
        while (spent := time.perf_counter() - started) < options.seconds:
            share = spent / options.seconds
            steps = options.steps[int(share * len(options.steps))]
            if steps != length:
                draws, length = None, steps  # a table less before there is another
                draws = Draws(self._windows(steps), options.noise, options.at_rest, options.seed)
            stored, errors = draws(options.batch)
            loss = unrolled_loss(self._corrector, stored, errors, self._stage)
            self._optimiser.step(loss, share)
            iterations += 1
            if self._device.type == "cuda":
                torch.cuda.synchronize()
            spent = time.perf_counter() - started
            if spent >= (len(self.history) + 1) * options.seconds / LOOKS:
                self._look(spent, iterations, steps)
        if len(self.history) < LOOKS:
            self._look(spent, iterations, length)

    def _look(self, seconds: float, iterations: int, steps: int) -> None:
        """Roll out, and keep these weights if none were better."""
        told = self._optimiser.take_report()
        if told["longest"] >= MOST_SKIPPED:
            raise ConvergenceError(
                f"iteration {iterations}: {told['longest']:.0f} batches in a row had a loss or "
                "gradient that is not finite. Expected fewer --steps, or less --noise."
            )
        errors, failed = self._looks(self._averaged)
        row = {
            "seconds": seconds, "iterations": iterations, "steps": steps,
            "skipped": told["skipped"], "failed": failed,
            "error_over_plain": float(np.exp(np.log(errors).mean())),
            **({"loss": told["loss"]} if told["count"] else {}),
        }  # fmt: skip
        print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
        if all(_rank(row) < _rank(before) for before in self.history):
            self.best.load_state_dict(self._averaged.state_dict())
        self.history.append(row)


def _rank(row: Mapping[str, float]) -> tuple[float, float]:
    """Smaller is better: a rollout that failed is held, and so may be near by chance."""
    return row["failed"], row["error_over_plain"]


def changed(text: str) -> tuple[str, int]:
    """A changed number of a preset."""
    name, number = text.split("=")
    return name, int(number)


def check(options: argparse.Namespace) -> None:
    """Refuse now what would be found out when the training has ended."""
    shard_paths(options.data, options.split)
    check_whole(options.data, (TRAINING, VALIDATION, options.split))
    if options.workers < 1:
        raise InputError(f"--workers {options.workers}: expected 1 or more.")
    steps = [n for p in shard_paths(options.data, TRAINING) for n in read_header(p).steps]
    if not 1 <= min(options.steps) <= max(options.steps) <= max(steps):
        raise InputError(f"--steps {options.steps}: expected 1 to {max(steps)}.")
    if not options.seconds > 0.0:
        raise InputError(f"--seconds {options.seconds:g}: expected more than 0.")


def main() -> None:
    """Train and measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--base", default=PLAIN, choices=get_args(Base), help="whose masses")
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--preset", default="equivariant")
    parser.add_argument("--changes", type=changed, nargs="*", default=[], metavar="NAME=NUMBER")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--noise", type=float, default=1.0, help="in the coarse model's errors")
    parser.add_argument("--at-rest", type=float, default=0.0, help="share of first windows")
    parser.add_argument("--amp", default="none", choices=["none", "bf16"])
    parser.add_argument("--fit", type=int, default=10_000, help="windows of the normalisation")
    parser.add_argument("--validation", type=int, default=100, help="simulations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes that measure")
    options = parser.parse_args()
    check(options)
    learner = Learner(options)
    learner.run()
    corrector = learner.best
    make_folder(options.output)
    save_file(
        {name: x.contiguous() for name, x in corrector.state_dict().items()},
        options.output / WEIGHTS,
    )
    found = evaluate(
        [Candidate(NAME, options.base, lambda stepper: Alone(stepper, corrector))],
        options.data, options.split, device=options.device, batch=100, workers=options.workers,
    )  # fmt: skip
    parameters = sum(x.numel() for x in corrector.network.parameters())
    notes = [
        f"{NAME}: preset {options.preset}, {parameters} parameters, {options.seconds:g} s of "
        f"training, {learner.history[-1]['iterations']} iterations, seed {options.seed}"
    ]
    print(markdown(found), *notes, sep="\n")
    record = {**origin(), "history": learner.history, "notes": notes}
    for path in write_evaluation(found, options.output, record, notes):
        print(f"wrote {path}")


if __name__ == "__main__":
    run_script(main)

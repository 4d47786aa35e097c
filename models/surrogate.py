"""Train a network without a solver on a data set and measure it: what the solver is worth.

python models/surrogate.py DATA -o OUTPUT [--seconds 300] [--steps 1 2 4 8] [--batch 64]
    [--noise 1.0] [--preset equivariant] [--changes layers=6 ...] [--seed 0] [--device cuda]
    [--split evaluation]

The network of a corrector is shown where inertia and loads alone would take the body, p + h v +
h2 f/m, and says where it goes instead; no elastic solver is asked, in training or after it
(MeshGraphNet as a surrogate, arXiv 2010.03409).  It is trained on windows of so many steps from
states of the reference, whose velocities are made wrong by noise, derivatives through all of
them; the steps share the time equally.  The weights that are best on the validation split by free
rollouts, looked at ten times, are measured like correctors, by `pdcorrect.evaluation.evaluate`,
beside the stored runs; OUTPUT gets the same files as by ``pdcorrect evaluate``.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from run_record import origin
from torch import Tensor

from pdcorrect import metrics
from pdcorrect.batch.states import BatchResult, BatchState
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.batch_step import BatchParts
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.config import preset
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import Snapshot
from pdcorrect.corrector.placements import ballistic
from pdcorrect.data.config import EVALUATION, TRAINING, VALIDATION
from pdcorrect.data.reader import TrajectoryDataset
from pdcorrect.data.schema import PLAIN
from pdcorrect.evaluation.cases import Case, read_cases
from pdcorrect.evaluation.evaluation import Candidate, evaluate
from pdcorrect.evaluation.rollouts import roll_out
from pdcorrect.evaluation.tables import markdown, write_evaluation
from pdcorrect.state import Status
from pdcorrect.training.config import Stage
from pdcorrect.training.fitting import fit_normaliser
from pdcorrect.training.losses import body_losses
from pdcorrect.training.optimisation import Optimiser
from pdcorrect.training.precision import network_precision
from pdcorrect.training.recordings import Recording, load_recordings
from pdcorrect.training.resident import ResidentWindows, StoredWindows
from pdcorrect.training.validation import LEAST
from pdcorrect.training.windows import StepBatch, StepWindows
from pdcorrect.training.world import World

NAME = "network alone"
LOOKS = 10
"""At the validation split."""


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
        none = torch.zeros(scenes, dtype=torch.bool, device=positions.device)
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
    coarse: BatchResult | Unasked
    refused: Tensor


class AloneWindows(StepWindows):
    """Single steps of which all is to be given by the network."""

    def step_batch(self, found: object, *, last: bool = True) -> StepBatch:
        """See `StepWindows`."""
        stored = found if isinstance(found, StoredWindows) else self._stored(found)
        batch = super().step_batch(stored, last=last)
        return replace(batch, target=stored.targets[0] - batch.snapshot.proposed)


class Windows:
    """Windows of k steps of a training split in a device's memory, drawn at random.

    Parameters
    ----------
    folder : path
    recordings : sequence of Recording
        Of the split.
    steps : int
        k.
    device : torch.device
    seed : int
    """

    def __init__(
        self,
        folder: Path,
        recordings: Sequence[Recording],
        steps: int,
        device: torch.device,
        seed: int,
    ) -> None:
        self.steps, self._device = steps, device
        self._dataset = TrajectoryDataset(folder, TRAINING, window=steps, base=PLAIN)
        self._tables = ResidentWindows(self._dataset, self._body, device)
        self._rng = np.random.default_rng((seed, steps))
        self._generator = torch.Generator(device).manual_seed(seed)
        numbers = {header.path: k for k, header in enumerate(self._dataset.headers)}
        scales = torch.zeros(len(numbers), max(r.number for r in recordings) + 1).double()
        for r in recordings:
            scales[numbers[r.path], r.number] = r.one_step
        self._scales = scales.to(device)

    def _body(self, window: int) -> BodyGraph:
        found = self._dataset.batch([window]).to(self._device)
        return BodyGraph.of_batch(found).to(dtype=torch.float64)

    def draw(self, size: int, noise: float) -> tuple[StoredWindows, Tensor]:
        """A batch, and the plain mesh's mean squared one-step error on each trajectory, (B,), m2.

        Velocities are off by Gaussian noise, ``noise`` times the root of that error over h.
        """
        stored = self._tables.batch(self._rng.integers(0, len(self._dataset), size))
        scale, bodies = self._scales[stored.file, stored.simulation], stored.bodies
        wrong = torch.randn(
            stored.positions.shape, generator=self._generator, dtype=torch.float64,
            device=self._device,
        )  # fmt: skip
        size_of = bodies.by_node((scale / 3.0).sqrt() / bodies.time_step)[:, None]
        wrong = torch.where(bodies.free, noise * size_of * wrong, 0.0)
        return replace(stored, velocities=stored.velocities + wrong), scale


def unrolled_loss(
    corrector: Corrector, stored: StoredWindows, scale: Tensor, stage: Stage
) -> Tensor:
    """Mean loss of some steps of the network's own.

    Parameters
    ----------
    corrector : Corrector
    stored : StoredWindows
        Of k steps.
    scale : (B,)
        Mean squared one-step error of the plain mesh on each trajectory, m2; an error counts as
        that over it, and over the square of how far errors of one step carry, see
        `pdcorrect.training.losses`.
    stage : Stage
    """
    bodies, total = stored.bodies, torch.zeros((), dtype=torch.float64, device=scale.device)
    h = bodies.by_node(bodies.time_step)[:, None]
    positions, velocities = stored.positions, stored.velocities
    for j in range(len(stored.targets)):
        truth, forces = stored.targets[j], stored.forces[j]
        state = Snapshot(positions, velocities, positions, forces, None)
        start = ballistic(state, h, forces, bodies.mass, bodies.free, truth)
        with network_precision(corrector, stage.amp):
            correction = corrector(bodies, replace(state, proposed=start))
        after = start + correction
        positions, velocities = after, (after - positions) / h
        carried = scale * (0.5 * (j + 1) * (j + 2)) ** 2
        each = body_losses(stage.loss, after - truth, bodies.node_sums, bodies.node_counts, carried)
        total = total + each.mean()
    return total / len(stored.targets)


def omegas(cases: Sequence[Case], corrector: Corrector, device: str, batch: int) -> list[float]:
    """Omega of free rollouts, per cent, at least `LEAST`."""
    found = []
    for first in range(0, len(cases), batch):
        some = cases[first : first + batch]
        stepper = BatchStepper([case.problems[PLAIN] for case in some], device=device)
        runs = roll_out(Alone(stepper, corrector), stepper, [case.steps for case in some])
        for run, case in zip(runs, some, strict=True):
            omega = metrics.error_corrected(run.positions, case.runs[PLAIN], case.reference)
            found.append(max(float(omega), LEAST))
    return found


def train(options: argparse.Namespace) -> tuple[Corrector, list[dict[str, float]]]:
    """The network with the best weights, and what validation said."""
    device = torch.device(options.device)
    config = preset(options.preset, placement="guess", **dict(options.changes))
    recordings = load_recordings(options.data, TRAINING, PLAIN, scenes=False)
    cases = read_cases(options.data, VALIDATION, skip_damaged=False).cases[: options.validation]
    torch.manual_seed(options.seed)
    corrector = Corrector(config).to(device)
    single = AloneWindows(options.data, recordings, config, PLAIN, device=device)
    fit_normaliser(corrector, single, options.fit, options.seed)
    del single  # a table less
    stage = Stage(
        kind="one-step", seconds=options.seconds, batch=options.batch, amp=options.amp,
        rate={"peak": 1e-3, "last": 1e-5}, loss={"bend": 0.3},
    )  # fmt: skip
    optimiser = Optimiser(corrector, stage, None, World())
    best, history = copy.deepcopy(corrector.state_dict()), []
    windows: Windows | None = None
    spent, iterations = 0.0, 0
    while spent < options.seconds:
        share = spent / options.seconds
        steps = options.steps[int(share * len(options.steps))]
        if windows is None or windows.steps != steps:
            windows = None
            windows = Windows(options.data, recordings, steps, device, options.seed)
        started = time.perf_counter()
        stored, scale = windows.draw(options.batch, options.noise)
        optimiser.step(unrolled_loss(corrector, stored, scale, stage), share)
        if device.type == "cuda":
            torch.cuda.synchronize()
        spent += time.perf_counter() - started
        iterations += 1
        if spent >= (len(history) + 1) / LOOKS * options.seconds:
            found = omegas(cases, corrector, options.device, options.batch)
            row = {"seconds": spent, "iterations": iterations, "steps": steps,
                   "loss": optimiser.take_report()["loss"], "omega_mean": float(np.mean(found)),
                   "omega_median": float(np.median(found))}  # fmt: skip
            print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
            if row["omega_mean"] > max((r["omega_mean"] for r in history), default=-np.inf):
                best = copy.deepcopy(corrector.state_dict())
            history.append(row)
    corrector.load_state_dict(best)
    return corrector, history


def changed(text: str) -> tuple[str, int]:
    """A changed number of a preset."""
    name, number = text.split("=")
    return name, int(number)


def main() -> None:
    """Train and measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--split", default=EVALUATION)
    parser.add_argument("--preset", default="equivariant")
    parser.add_argument("--changes", type=changed, nargs="*", default=[], metavar="NAME=NUMBER")
    parser.add_argument("--seconds", type=float, default=300.0, help="of training")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--noise", type=float, default=1.0,
                        help="of velocities, in the plain mesh's errors over h")  # fmt: skip
    parser.add_argument("--amp", default="none", choices=["none", "bf16"])
    parser.add_argument("--fit", type=int, default=10_000, help="windows of the normalisation")
    parser.add_argument("--validation", type=int, default=100, help="simulations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes that measure")
    options = parser.parse_args()
    corrector, history = train(options)
    candidate = Candidate(NAME, PLAIN, lambda stepper: Alone(stepper, corrector))
    found = evaluate(
        [candidate], options.data, options.split, device=options.device, batch=100,
        workers=options.workers,
    )  # fmt: skip
    parameters = sum(x.numel() for x in corrector.network.parameters())
    notes = [
        f"{NAME}: preset {options.preset}, {parameters} parameters, {options.seconds:g} s of "
        f"training, {history[-1]['iterations']} iterations, seed {options.seed}"
    ]
    print(markdown(found), *notes, sep="\n")
    record = {**origin(), "history": history, "notes": notes}
    for path in write_evaluation(found, options.output, record, notes):
        print(f"wrote {path}")


if __name__ == "__main__":
    main()

"""Hybrids that need no network, and a saved model that corrects nothing."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from pdcorrect.batch.states import BatchState
from pdcorrect.corrector.bodies import SHAPE_MEASURES
from pdcorrect.corrector.corrector import Corrector, preset
from pdcorrect.corrector.gate import Reason
from pdcorrect.corrector.model_io import ModelRecord, save_model
from pdcorrect.corrector.normaliser import RunningMoments
from pdcorrect.evaluation.evaluation import Candidate
from pdcorrect.state import State, Status

TINY = Path(__file__).parent.parent / "datasets" / "tiny"
STEP = 0.01  # s


class Fake:
    """A hybrid whose next positions of a scene are `answer(case, frame, positions)`."""

    def __init__(self, stepper, cases, answer, refused=(), reason=Reason.OUTSIDE):
        self.stepper, self.answer = stepper, answer
        self.reasons = dict.fromkeys(refused, int(reason))
        known = {case.problems["plain"].scene.name: case for case in cases}
        self.cases = [known[p.scene.name] for p in stepper.problems]

    def __call__(self, state, previous=None):
        h, found = self.stepper.time_step, []
        for i, one in enumerate(self.stepper.states(state)):
            t = round(one.time / h)
            x = self.answer(self.cases[i], t, one.positions)
            found.append((x, (x - one.positions) / h, one.time + h))
        after = self.state(found)
        n, count = sum(self.stepper.node_counts), len(found)
        return SimpleNamespace(
            state=after,
            correction=torch.zeros(n, 3, dtype=torch.float64),
            coarse=SimpleNamespace(statuses=[Status.CONVERGED] * count),
            reasons=torch.tensor([self.reasons.get(round(s[2] / h), 0) for s in found]),
        )

    def state(self, found):
        finite = self.stepper.state(
            [State(np.nan_to_num(x), np.nan_to_num(v), t) for x, v, t in found]
        )
        positions = finite.positions.clone()
        for i, (x, _, _) in enumerate(found):
            positions[i, : len(x)] = torch.as_tensor(x)
        return BatchState(positions, finite.velocities, finite.times, finite.memory)


def fake(cases, answer, name="fake", base="plain", **options):
    return Candidate(name, base, lambda stepper: Fake(stepper, cases, answer, **options))


def perfect(case, t, x):
    return case.reference[min(t + 1, case.steps)]


def as_stored(name):
    """What a stored run does, from the reference's frames and from its own."""

    def answer(case, t, x):
        if t and np.allclose(x, case.reference[t], rtol=0, atol=1e-12):
            return case.predictions[name][t]
        return case.runs[name][t + 1]

    return answer


def seen(values):
    """Moments of values (m, k)."""
    moments = RunningMoments()
    moments.add(values)
    return moments


def untrained(folder, base="plain", seed=0, dataset="tiny", step=STEP):
    """A saved model whose correction is zero."""
    corrector = Corrector(preset("compact", layers=1, width=8))
    corrector.normaliser.output_scale.fill_(1e-3)
    of_5_cm = torch.tensor([[step / 0.05]], dtype=torch.float64).log()
    nothing = (
        torch.zeros(1, k) for k in (len(corrector.envelope.average_low), len(SHAPE_MEASURES))
    )
    corrector.envelope.fit(
        dict(zip(("average", "shape", "time_step"), map(seen, (*nothing, of_5_cm)), strict=True))
    )
    with torch.no_grad():
        corrector.network.decoder[-1].weight.zero_()
        corrector.network.decoder[-1].bias.zero_()
    training = {
        "config": {"base": base, "seed": seed, "velocity": "recomputed"}, "seconds": seed,
        "config_hash": "x",
    }  # fmt: skip
    record = ModelRecord(dataset=dataset, dataset_hash="abc", training=training)
    return save_model(corrector, folder, record=record)

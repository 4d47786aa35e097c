"""`Training`: a corrector's weights from a data set, stage by stage, to be resumed at any time."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pdcorrect._config import as_toml
from pdcorrect._files import make_folder, write_text
from pdcorrect.batch.cells import usable_device
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_io import (
    JOINT,
    LoadedModel,
    ModelRecord,
    load_model,
    save_model,
    weights_digest,
)
from pdcorrect.data.configuration import TRAINING, VALIDATION
from pdcorrect.data.folder import check_whole, splits_of
from pdcorrect.data.schema import INTEGRATOR, SUFFIX
from pdcorrect.errors import ConvergenceError, InputError
from pdcorrect.training.distributed import ProcessGroup
from pdcorrect.training.fitting import check_time_steps, fit_normaliser, widen_ranges
from pdcorrect.training.optimisation import Optimiser, rate_at
from pdcorrect.training.progress import (
    HistoryFile,
    Progress,
    check_same,
    read_checkpoint,
    write_checkpoint,
)
from pdcorrect.training.recipe import Stage, TrainingConfig
from pdcorrect.training.scenes import Recording, SceneGroups, data_hash, load_recordings
from pdcorrect.training.unrolled import UnrolledBatches
from pdcorrect.training.validation import Validation
from pdcorrect.training.windows import OneStepBatches, StepWindows, seed_of

MOST_SKIPPED = 20
"""Batches in a row whose loss or gradient is not finite, at which training fails."""
CHECKPOINT, MODEL, CONFIG = "checkpoint.safetensors", "model", "config.toml"

Source = OneStepBatches | UnrolledBatches
"""Losses of one batch after the other, and states to go on from."""
Report = Callable[[Progress, Mapping[str, Any]], None]
"""Told where the training is, and the numbers of a row of the history."""


class Training:
    """A training in a folder.

    The folder gets ``config.toml``, ``checkpoint.safetensors``, ``history.csv``, ``tensorboard``
    and the best ``model``.  ``resume`` goes on from its checkpoint, if there is one; ``incomplete``
    takes the data set's files that are there, if its configuration asks for more; ``on_report`` is
    called with each row of the history.  ``corrector`` is in its present state, ``progress`` says
    where it is.

    Raises
    ------
    InputError
        If the folder holds a training and ``resume`` is not set, or it was another one; if files
        of the data set are missing, or do not have what the configuration wants; if the model to
        start from is missing, or of another architecture or base, or its ranges stay and the data
        have another time step.
    FileFormatError
        If the checkpoint, a file of the data set, or the model to start from is damaged.
    """

    def __init__(
        self,
        config: TrainingConfig,
        data: str | Path,
        output: str | Path,
        *,
        device: str = "cpu",
        resume: bool = False,
        incomplete: bool = False,
        world: ProcessGroup | None = None,
        on_report: Report | None = None,
    ) -> None:
        self.config, self.world = config, ProcessGroup() if world is None else world
        self.device = usable_device(device)
        self.output, self._on_report = Path(output), on_report
        if not incomplete:
            check_whole(data, (TRAINING, VALIDATION))
        self._recordings, validated = self._recorded(Path(data))
        digest = data_hash([*self._recordings, *validated])
        self._identity = json.loads(
            json.dumps({"config": config.model_dump(mode="json"), "data": digest})
        )
        start = load_start(config, self.device)
        if start is not None:
            self._identity["start"] = weights_digest(str(config.start_from))
        found = self._checkpoint(resume)
        own = self._recordings[0].dataset, self._recordings[0].config_hash
        self._data_sets = list(dict.fromkeys([*(start.data_sets if start else ()), own]))
        self._windows = StepWindows(
            data, self._recordings, config.corrector.config(), config.base, device=self.device,
            without=config.without,
        )  # fmt: skip
        self._groups = SceneGroups(
            self._recordings, config.base, self.device, seed=config.seed, world=self.world,
        )  # fmt: skip
        self.corrector = self._new_corrector(start, fit=found is None)
        self._averaged = copy.deepcopy(self.corrector)
        self._best: dict[str, Tensor] = {}
        self._validation: Validation | None = None
        if validated:
            self._validation = Validation(
                validated, config.base, device=self.device, world=self.world,
            )  # fmt: skip
        self.progress = Progress()
        self._waiting: tuple[dict[str, Any], dict[str, Tensor]] | None = None
        length = 0 if found is None else self._restore(*found)
        self._history: HistoryFile | None = None
        if self.world.first:
            make_folder(self.output)
            write_text(self.output / CONFIG, config.to_toml())
            self._history = HistoryFile(self.output, length, self.progress.total)

    def _recorded(self, data: Path) -> tuple[list[Recording], list[Recording]]:
        """Simulations to learn from, and those to validate with, if there are any."""
        base, without = self.config.base, self.config.without
        for name in without:
            if not (data / f"{name}{SUFFIX}").exists():
                raise InputError(f"without = {name!r}: {data} has no such file.")
        unrolled = any(stage.kind == "unrolled" for stage in self.config.stages)
        learned = load_recordings(data, TRAINING, base, scenes=unrolled, without=without)
        if VALIDATION not in splits_of(data):
            return learned, []
        return learned, load_recordings(data, VALIDATION, base, without=without)

    # --- running ----------------------------------------------------------------------------

    def run(self, seconds: float | None = None) -> bool:
        """Train until the end, or for about so many seconds; whether it is finished.

        `ConvergenceError` if too many batches in a row had no finite gradient.
        """
        self._limit = math.inf if seconds is None else self.progress.seconds + seconds
        self._ticked = time.perf_counter()
        try:
            if self.config.start_from is not None and self.progress.total == 0:
                self._validate(self.corrector)  # nothing worse than it is kept
            while self.progress.stage < len(self.config.stages):
                if not self._run_stage(self.config.stages[self.progress.stage]):
                    return False
        finally:
            if self._history is not None:
                self._history.close()
        return True

    def _run_stage(self, stage: Stage) -> bool:
        """One stage, or what is left of it; whether it came to its end."""
        at = self.progress
        seed = seed_of(self.config.seed, at.stage)
        source: Source
        if stage.kind == "one-step":
            source = OneStepBatches(self._windows, stage, seed, self.world)
        else:
            source = UnrolledBatches(self._groups, stage, seed=seed)
        optimiser = self._optimiser(stage, source)
        shown = self.corrector if stage.ema is None else self._averaged
        while (share := stage.share_done(len(source), at.iteration, at.stage_seconds)) < 1.0:
            loss = source.loss(self.corrector, at.iteration, stage.horizon(share))
            optimiser.step(loss, share)
            at.stepped(self._tick())
            if at.total % self.config.report_every == 0:
                self._report(stage, optimiser, source, share)
            kept = False
            if at.due(self.config.validate_every, at.validated):
                kept = self._validate(shown)
            late = at.seconds >= self._limit
            if late or kept or at.due(self.config.checkpoint_every, at.saved):
                self._save(optimiser, source)  # with new best weights, of which model/ is made
            if late:
                return False
        self._report(stage, optimiser, source, 1.0)
        if at.total > at.validated.iteration:
            self._validate(shown)
        if self._validation is None:
            self._keep(shown, {})
        at.next_stage()
        self.corrector.network.load_state_dict(self._best)
        self._save()
        return True

    def _optimiser(self, stage: Stage, source: Source) -> Optimiser:
        """For a stage that begins, or one that goes on from a checkpoint."""
        if self._waiting is None:
            self._averaged.load_state_dict(self.corrector.state_dict())
        optimiser = Optimiser(self.corrector, stage, self._averaged, self.world)
        if self._waiting is not None:
            numbers, tensors = self._waiting
            optimiser.load_state_dict(_part(tensors, "optimiser."))
            source.load_state_dict(numbers, _part(tensors, "source."))
            self._waiting = None
        return optimiser

    def _tick(self) -> float:
        """Seconds since the last call; all processes go by the first one's clock."""
        now = time.perf_counter()
        passed, self._ticked = now - self._ticked, now
        return self.world.of_first(passed)

    def _report(self, stage: Stage, optimiser: Optimiser, source: Source, share: float) -> None:
        """A row about the batches since the last one."""
        told = optimiser.take_report()
        if told["longest"] >= MOST_SKIPPED:
            raise ConvergenceError(
                f"stage {self.progress.stage}, iteration {self.progress.iteration}: "
                f"{told['longest']:.0f} batches in a row had a loss or gradient that is not "
                "finite. Expected a smaller learning rate, or data without extreme values."
            )
        failed = self.world.total(torch.tensor([source.failed], dtype=torch.float64))
        if told["count"] + told["skipped"]:
            loss = {"loss": told["loss_sum"] / told["count"]} if told["count"] else {}
            self._tell(
                **loss, rate=rate_at(stage.rate, share), steps=stage.horizon(share),
                skipped=int(told["skipped"]), failed_scenes=int(failed),
            )  # fmt: skip

    def _validate(self, shown: Corrector) -> bool:
        """Free rollouts; whether these weights are the best so far and were kept."""
        at = self.progress
        at.validated = at.now()
        if self._validation is None:
            return False
        scores = self._validation(shown)
        at.passed(self._tick())
        at.validated = at.now()
        metrics = scores.metrics()
        self._tell(**metrics)
        if at.best is not None and not scores.mean > at.best:
            return False
        at.best = scores.mean
        self._keep(shown, metrics)
        return True

    def _tell(self, **values: Any) -> None:
        at = self.progress
        row = {"stage": at.stage, "seconds": at.seconds, **values}
        if self._history is not None:
            self._history.add(at.total, **row)
            if self._on_report is not None:
                self._on_report(at, row)

    # --- states -----------------------------------------------------------------------------

    def _new_corrector(self, start: LoadedModel | None, fit: bool) -> Corrector:
        config = self.config
        if start is not None:
            corrector = start.corrector.train()
        else:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(config.seed)
                corrector = Corrector(config.corrector.config()).to(self.device)
        if fit:
            windows, seed = config.fitting.windows, config.seed
            if start is None:
                fit_normaliser(corrector, self._windows, windows, seed)
            elif config.fitting.widen:
                widen_ranges(corrector, self._windows, windows, seed)
            else:
                check_time_steps(corrector, self._windows)
            self.world.same(list(corrector.state_dict().values()))
        return corrector

    def _keep(self, shown: Corrector, metrics: dict[str, float]) -> None:
        """These weights are the best so far."""
        self.progress.metrics = metrics
        self._best = {n: x.detach().clone() for n, x in shown.network.state_dict().items()}
        if self.world.first:
            record = ModelRecord(
                dataset=JOINT.join(dict.fromkeys(name for name, _ in self._data_sets)),
                dataset_hash=self._identity["data"],
                training={
                    **self._identity,
                    "integrator": INTEGRATOR,
                    "data_sets": [{"name": name, "config_hash": x} for name, x in self._data_sets],
                    "iterations": self.progress.total, "seconds": self.progress.seconds,
                    "processes": self.world.size,
                },
                metrics=dict(metrics),
            )  # fmt: skip
            save_model(shown, self.output / MODEL, record=record)

    def _save(self, optimiser: Optimiser | None = None, source: Source | None = None) -> None:
        """Write the checkpoint; between stages there is no optimiser."""
        self.progress.saved = self.progress.now()
        if self._history is None:
            return
        content = {
            "identity": self._identity, "progress": asdict(self.progress),
            "history": self._history.length,
        }  # fmt: skip
        tensors = {f"model.{n}": x for n, x in self.corrector.state_dict().items()}
        tensors |= {f"best.{n}": x for n, x in self._best.items()}
        if optimiser is not None and source is not None:
            content["source"], own = source.state_dict()
            tensors |= {f"averaged.{n}": x for n, x in self._averaged.state_dict().items()}
            tensors |= {f"optimiser.{n}": x for n, x in optimiser.state_dict().items()}
            tensors |= {f"source.{n}": x for n, x in own.items()}
        write_checkpoint(self.output / CHECKPOINT, content, tensors)

    def _checkpoint(self, resume: bool) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
        path = self.output / CHECKPOINT
        if not path.exists():
            return None
        if not resume:
            raise InputError(f"{path}: a training: expected --resume, or another folder.")
        content, tensors = read_checkpoint(path)
        check_same(content["identity"], self._identity, str(path))
        return content, tensors

    def _restore(self, content: dict[str, Any], tensors: dict[str, Tensor]) -> int:
        """Take over a checkpoint; the length of the history then."""
        self.progress = Progress.from_json(content["progress"])
        moved = {name: x.to(self.device) for name, x in tensors.items()}
        self.corrector.load_state_dict(_part(moved, "model."))
        self._best = _part(moved, "best.")
        if "source" in content:
            self._averaged.load_state_dict(_part(moved, "averaged."))
            self._waiting = content["source"], tensors
        return int(content["history"])


def load_start(config: TrainingConfig, device: torch.device) -> LoadedModel | None:
    """The model that a training goes on with, if there is one."""
    if config.start_from is None:
        return None
    model = load_model(config.start_from, device)
    own, wanted = (c.model_dump() for c in (model.corrector.config, config.corrector.config()))
    own |= {"base": model.base, "velocity": model.velocity}
    wanted |= {"base": config.base, "velocity": "recomputed"}
    unlike = [name for name in own if own[name] != wanted[name]]
    if unlike:
        found, expected = (
            ", ".join(f"{name} = {as_toml(each[name])}" for name in unlike)
            for each in (own, wanted)
        )
        raise InputError(
            f"start_from = {config.start_from!r}: that model has {found}: expected {expected}, as "
            "here."
        )
    return model


def _part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {n.removeprefix(prefix): x for n, x in tensors.items() if n.startswith(prefix)}

"""`TrainingConfig`: everything that determines a training but its data, as TOML."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.config import JsonDict

from pdcorrect._config import Count, NonNegative, Positive, PositiveCount, Strict, TomlConfig
from pdcorrect.corrector.corrector import CorrectorConfig, changed
from pdcorrect.data.configuration import TRAINING, VALIDATION

Share = Annotated[float, Field(strict=True, ge=0, le=1)]
Decay = Annotated[float, Field(strict=True, gt=0, lt=1)]
Flag = Annotated[bool, Field(strict=True)]


def _several(steps: Any) -> Any:
    return (steps,) if isinstance(steps, int) else steps


def _rising(steps: tuple[int, ...]) -> tuple[int, ...]:
    if not steps or sorted(steps) != list(steps):
        raise ValueError("expected one number of steps, or several that do not fall")
    return steps


ModelName = Annotated[str, Field(min_length=1)]
FileName = Annotated[str, Field(pattern=rf"^({TRAINING}|{VALIDATION})/mesh-\d{{4,}}$")]
Horizon = Annotated[tuple[PositiveCount, ...], BeforeValidator(_several), AfterValidator(_rising)]


_CHANGES: JsonDict = {name: {} for name in CorrectorConfig.model_fields}
"""Keys that may be changed, where unknown ones are told of those that there are."""


class Architecture(Strict):
    """A preset of `PRESETS`, and the values that differ from it."""

    preset: Literal["thesis", "equivariant", "compact"] = "compact"
    changes: Annotated[dict[str, Any], Field(json_schema_extra={"properties": _CHANGES})] = Field(
        default_factory=dict
    )

    @field_validator("changes")
    @classmethod
    def _possible(cls, changes: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if "preset" in info.data:
            changed(info.data["preset"], changes)
        return changes

    def config(self) -> CorrectorConfig:
        """The architecture."""
        return changed(self.preset, self.changes)


class Loss(Strict):
    """What is minimised; see `pdcorrect.training.losses`."""

    # "relative": mean squared distance over that of the base model on the same trajectory.
    # "absolute": of positions in units of 1 / ``scale`` metres (thesis: 1000)
    kind: Literal["relative", "absolute"] = "relative"
    power: Literal[1, 2] = 2  # of "absolute": 1 sums distances over nodes, 2 their squares
    scale: Positive = 1000.0
    # of "relative": a body's loss x counts as ``bend`` log(1 + x / ``bend``); None: as x
    bend: Positive | None = None
    # of "relative", in unrolled stages: weight of what the error of a state will come to in the
    # frames ahead
    ahead: Positive | None = None

    @model_validator(mode="after")
    def _possible(self) -> Loss:
        for name in ("bend", "ahead"):
            if self.kind == "absolute" and getattr(self, name) is not None:
                raise ValueError(f"{name} has no meaning in a loss of kind 'absolute'")
        return self


class Noise(Strict):
    """Gaussian noise on what the network sees of the coarse solver's answer (eq. 5-5, 5-6).

    The target makes good for it, too.  ``tau`` is the deviation of a component, in root mean
    squared one-step errors (a component) of the base model on the same trajectory.
    """

    tau: NonNegative = 0.0


class Rate(Strict):
    """Adam's learning rate: linear rise, then half a cosine; constant if ``last`` is ``peak``.

    ``warmup`` is the share of the stage in which it rises.
    """

    peak: Positive = 1e-3
    last: Positive = 1e-5
    warmup: Share = 0.02


class Every(Strict):
    """How often: exactly one of both."""

    seconds: Positive | None = None
    iterations: PositiveCount | None = None

    @model_validator(mode="after")
    def _one(self) -> Every:
        if (self.seconds is None) == (self.iterations is None):
            raise ValueError("expected exactly one of seconds, iterations")
        return self


class Stage(Strict):
    """A part of training; Adam starts afresh in each."""

    # "one-step": on the stored predictions of the base model, without the simulator.  "unrolled":
    # steps of the hybrid, simulator included
    kind: Literal["one-step", "unrolled"]
    steps: Horizon = (1,)  # of "unrolled"; several numbers share the stage equally, in order
    through_solver: Flag = False  # of "unrolled": whether derivatives go through the coarse solver
    # of "unrolled": states of the reference, or of a pool of the model's own rollouts.  Those go
    # back to the reference with probability ``restart`` after each use, and where their mean
    # squared distance from it is more than that of the base model's rollout
    start: Literal["reference", "pool"] = "reference"
    restart: Share = 0.2
    # of "unrolled": share of the states of the reference that are those before the first step; the
    # others are of any frame.  For loads that act in the first steps only, as kicks
    at_rest: Share = 0.0
    # exactly one; epochs only of "one-step"
    seconds: Positive | None = None
    iterations: PositiveCount | None = None
    epochs: PositiveCount | None = None
    batch: PositiveCount = 16  # windows or scenes, for each process
    rate: Rate = Rate()
    loss: Loss = Loss()
    noise: Noise = Noise()
    # decay a step of the averaged weights that are validated and kept; None: no average
    ema: Decay | None = None
    amp: Literal["none", "bf16"] = "none"  # "bf16": matrix products of the network in bfloat16

    @model_validator(mode="after")
    def _possible(self) -> Stage:
        budgets = [self.seconds, self.iterations, self.epochs]
        if sum(b is not None for b in budgets) != 1:
            raise ValueError("expected exactly one of seconds, iterations, epochs")
        if self.kind == "one-step":
            told = {
                "steps": self.steps != (1,), "through_solver": self.through_solver,
                "start": self.start != "reference", "at_rest": self.at_rest > 0.0,
                "loss.ahead": self.loss.ahead is not None,
            }  # fmt: skip
        else:
            told = {"epochs": self.epochs is not None, "noise": self.noise.tau > 0.0}
        for name, given in told.items():
            if given:
                raise ValueError(f"{name} has no meaning in a stage of kind {self.kind!r}")
        return self

    def horizon(self, progress: float) -> int:
        """Steps at a share 0 to 1 of the stage."""
        return self.steps[min(len(self.steps) - 1, int(progress * len(self.steps)))]

    def share_done(self, batches: int, iteration: int, seconds: float) -> float:
        """How much of the stage is done, where an epoch has so many batches."""
        if self.seconds is not None:
            return seconds / self.seconds
        return iteration / (self.iterations or (self.epochs or 1) * batches)


class Fitting(Strict):
    """Of the normalisation."""

    windows: PositiveCount = 10_000  # most that are taken from the training split
    # whether a training that goes on with another model widens that one's ranges of known inputs
    # and bodies to what it learns; weights do not depend on it.  If not, the data's time step has
    # to be one that the other model's gate lets pass
    widen: Flag = True


class TrainingConfig(TomlConfig):
    """A training."""

    corrector: Architecture = Architecture()
    # folder or name of a model (`pdcorrect.load_model`) whose weights and normalisation the
    # training begins with; ``corrector`` must describe its architecture
    start_from: ModelName | None = None
    # files of the data set that are left out, such as "training/mesh-0042"
    without: tuple[FileName, ...] = ()
    # whose steps are corrected, see `pdcorrect.coarse_model`
    base: Literal["plain", "best"] = "plain"
    seed: Count = 0
    fitting: Fitting = Fitting()
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)]
    # the last in iterations
    validate_every: Every = Every(seconds=60.0)
    checkpoint_every: Every = Every(seconds=60.0)
    report_every: PositiveCount = 50

    @model_validator(mode="after")
    def _possible(self) -> TrainingConfig:
        if self.start_from is None and not self.fitting.widen:
            raise ValueError("fitting.widen = false is about a model to start from: expected one")
        return self

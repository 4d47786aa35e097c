"""A corrector's answers, and what a gate measures, as work that a GPU replays.

Features, network, energies and volumes are hundreds of small operations, whose launches take
longer than they do.  They are the same in every step of the same bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields
from itertools import chain
from operator import is_
from typing import Any

import torch
from torch import Tensor

from pdcorrect.batch.gpu import Recorder
from pdcorrect.batch.objective import dot
from pdcorrect.batch.stepper import BatchStepper
from pdcorrect.corrector.bodies import BodyGraph
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.features import FeatureView, Snapshot
from pdcorrect.corrector.frames import unrolled_products
from pdcorrect.corrector.gate import GateMeasures
from pdcorrect.errors import InputError


def recordable(corrector: Corrector) -> bool:
    """Whether a corrector's answers can be recorded.

    Not where it has code of its own, such as hooks, nor with ``momentum_neutral``, whose solution
    of linear systems a GPU does not record for a single body.
    """
    own = any(callable(value) for value in vars(corrector).values())
    plain = type(corrector) is Corrector and not own and usual(corrector)
    return plain and not corrector.config.momentum_neutral


def check_recordable(corrector: Corrector) -> Corrector:
    """A corrector that can be recorded; others are refused with an `InputError`."""
    if not recordable(corrector):
        raise InputError(
            "recorded = True with a corrector of another class, with hooks, with a network that "
            "was changed or with momentum_neutral: what it does would not be recorded. Expected "
            "False."
        )
    return corrector


def usual(corrector: Corrector) -> bool:
    """Whether its network is as it was made, weights apart, and without hooks."""
    with torch.device("meta"):
        new = Corrector(corrector.config)
    mine, made = (list(each.network.modules()) for each in (corrector, new))
    return len(mine) == len(made) and all(
        type(one) is type(other)
        and one.extra_repr() == other.extra_repr()
        and not (one._forward_hooks or one._forward_pre_hooks)
        for one, other in zip(mine, made, strict=True)
    )


class Contents:
    """Modules and tensors of a corrector as they are now, whatever is written to them."""

    def __init__(self, corrector: Corrector) -> None:
        self._corrector, self._config = corrector, corrector.config
        tables = [
            table
            for module in corrector.modules()
            for table in (module._parameters, module._buffers, module._modules)
        ]
        self._tables: list[dict[str, Any]] = [table for table in tables if table]
        self._empty = [table for table in tables if not table]
        self._names, self._parts = [*chain.from_iterable(self._tables)], [*self._there()]
        self._tensors = [part for part in self._parts if isinstance(part, Tensor)]
        self._places = self._where()

    @property
    def replaced(self) -> bool:
        """Whether there are other modules, tensors or storage than there were."""
        if self._corrector.config is not self._config or self._where() != self._places:
            return True
        if any(self._empty) or [*chain.from_iterable(self._tables)] != self._names:
            return True
        return not all(map(is_, self._there(), self._parts))

    def _where(self) -> list[int]:
        return [*map(Tensor.data_ptr, self._tensors)]

    def _there(self) -> Iterator[Any]:
        return chain.from_iterable(map(dict.values, self._tables))


class RecordedCorrector:
    """Answers as of a `Corrector`, without derivatives, with what a gate asks of it.

    On a GPU the network is compiled, which changes its rounding, and all is recorded at the first
    call and replayed; elsewhere it is run.  Recorded anew for other bodies, so also for each
    change of material, and where modules or tensors of the corrector are replaced.  Values of
    weights are those of the last `of_view`.  What is recorded holds memory for all intermediate
    results.  For a corrector that `recordable` accepts, and one thread at a time.
    """

    def __init__(self, corrector: Corrector) -> None:
        self._corrector, self.config = check_recordable(corrector), corrector.config
        self._forget()

    def _forget(self) -> None:
        self._bodies: BodyGraph | None = None
        self._view: FeatureView | None = None
        self._replay: Callable[[], None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_corrector": self._corrector, "config": self.config}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    @torch.no_grad()
    def of_view(self, view: FeatureView) -> Tensor:
        """The correction (n, 3), m."""
        if view.bodies is not self._bodies or self._contents.replaced:
            self._record(view.bodies)
        assert self._replay is not None
        for field in fields(Snapshot):
            given, own = (getattr(x, field.name) for x in (view.snapshot, self._snapshot))
            own.zero_() if given is None else own.copy_(given)
        self._replay()
        self._view = view
        return self._answer.clone()

    @torch.no_grad()
    def rest_score(self, bodies: BodyGraph) -> Tensor:
        """See `Corrector.rest_score`."""
        return self._corrector.rest_score(bodies)

    @torch.no_grad()
    def score(self, view: FeatureView) -> Tensor:
        """See `Corrector.score`."""
        return self._score.clone() if view is self._view else self._corrector.score(view)

    def _record(self, bodies: BodyGraph) -> None:
        """Until it has succeeded nothing is known."""
        self._forget()
        corrector, rest = check_recordable(self._corrector), bodies.rest
        with torch.inference_mode(False), torch.no_grad():
            self.config, self._contents = corrector.config, Contents(corrector)
            self._snapshot = Snapshot(*(rest.clone() for _ in fields(Snapshot)))
            self._answer = torch.zeros_like(rest)
            self._score = torch.zeros_like(bodies.cell_size)
            self._network: Callable[..., Tensor] = corrector.network
            if rest.is_cuda:
                self._network = torch.compile(corrector.network, dynamic=True)
            self._recorded = bodies
            corrector.rest_score(bodies)  # which measures bodies on the CPU, once
            self._replay = Recorder(rest.device)(self._compute)
        self._bodies = bodies

    def _compute(self) -> None:
        corrector, view = self._corrector, FeatureView(self._recorded, self._snapshot)
        with unrolled_products():
            self._answer.copy_(corrector.of_view(view, self._network))
            self._score.copy_(corrector.score(view))


class RecordedMeasures:
    """Volumes and energies of states of a `BatchStepper`'s scenes, recorded likewise."""

    def __init__(self, stepper: BatchStepper) -> None:
        self._stepper = stepper
        self._replay: Callable[[], None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_stepper": self._stepper, "_replay": None}

    def __call__(
        self, positions: Tensor, velocities: Tensor, y: Tensor, work: Tensor
    ) -> GateMeasures:
        """Of positions and velocities (B, N, 3) and configurations y (B, U, 3)."""
        if self._replay is None:
            self._record(positions, y)
        assert self._replay is not None
        self._positions.copy_(positions)
        self._velocities.copy_(velocities)
        self._y.copy_(y)
        self._replay()
        return GateMeasures(self._ratios.clone(), self._stored.clone(), work)

    def _record(self, positions: Tensor, y: Tensor) -> None:
        sizes = self._stepper.cells.sizes
        self._positions, self._y = positions.clone(), y.clone()
        self._velocities = torch.zeros_like(positions)
        self._ratios = positions.new_zeros(sizes.scenes, sizes.cells)
        self._stored = positions.new_zeros(sizes.scenes)
        self._replay = Recorder(self._stepper.device)(self._compute)

    def _compute(self) -> None:
        stored, ratios = stored_and_ratios(
            self._stepper, self._positions, self._velocities, self._y
        )
        self._stored.copy_(stored)
        self._ratios.copy_(ratios)


def stored_and_ratios(
    stepper: BatchStepper, positions: Tensor, velocities: Tensor, y: Tensor
) -> tuple[Tensor, Tensor]:
    """Kinetic and elastic energy (B,), J, and smallest det F of each cell (B, C)."""
    elastic, _ = stepper.cells.energy_and_forces(y)
    v = stepper.staging.extended(velocities)
    kinetic = 0.5 * dot(v, stepper.objective.mass(v))
    return elastic + kinetic, stepper.cells.volume_ratios(positions)

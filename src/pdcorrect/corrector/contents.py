"""`Contents`: what a corrector is made of, for copies and recordings of it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from operator import attrgetter, is_
from typing import Any

from torch import Tensor

from pdcorrect.corrector.config import CorrectorConfig
from pdcorrect.corrector.corrector import Corrector


class Contents:
    """Modules, weights and normaliser of a corrector as they are now.

    Values that are written to ``.data`` are not noticed, as torch does not count them.

    Attributes
    ----------
    config : CorrectorConfig
    """

    config: CorrectorConfig

    def __init__(self, corrector: Corrector) -> None:
        self._corrector, self.config = corrector, corrector.config
        tables = [*_tables(corrector)]
        self._tables = [table for table in tables if table]
        self._empty = [table for table in tables if not table]
        self._names, self._parts = [*chain.from_iterable(self._tables)], [*self._there()]
        self._tensors = [part for part in self._parts if isinstance(part, Tensor)]
        # of inference tensors torch does not count how often they are written
        self._counted = [tensor for tensor in self._tensors if not tensor.is_inference()]
        self._places, self._writes = self._where(), self._written()

    @property
    def replaced(self) -> bool:
        """Whether there are other modules, tensors or storage than there were."""
        if self._corrector.config is not self.config or self._where() != self._places:
            return True
        if any(self._empty) or [*chain.from_iterable(self._tables)] != self._names:
            return True
        return not all(map(is_, self._there(), self._parts))

    @property
    def changed(self) -> bool:
        """Whether they are replaced, or a tensor was written."""
        return self._written() != self._writes or self.replaced

    def _where(self) -> list[int]:
        return [*map(Tensor.data_ptr, self._tensors)]

    def _written(self) -> list[int]:
        return [*map(_VERSION, self._counted)]

    def _there(self) -> Iterator[Any]:
        return chain.from_iterable(map(dict.values, self._tables))


_VERSION = attrgetter("_version")


def _tables(corrector: Corrector) -> Iterator[dict[str, Any]]:
    """Where its modules keep what they are made of."""
    for module in corrector.modules():
        yield from (module._parameters, module._buffers, module._modules)

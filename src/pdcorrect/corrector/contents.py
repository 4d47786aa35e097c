"""`Contents`: what a corrector is made of, for copies and recordings of it."""

from __future__ import annotations

from collections.abc import Iterator
from operator import is_
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
        self._tables = [(table, tuple(table)) for table in _tables(corrector)]
        self._parts = [
            (table, name, table[name]) for table, names in self._tables for name in names
        ]
        self._kept = [part for _, _, part in self._parts]
        self._tensors = [part for _, _, part in self._parts if isinstance(part, Tensor)]
        # of inference tensors torch does not count how often they are written
        self._counted = [tensor for tensor in self._tensors if not tensor.is_inference()]
        self._places, self._writes = self._where(), self._written()

    @property
    def replaced(self) -> bool:
        """Whether there are other modules, tensors or storage than there were."""
        if self._corrector.config is not self.config or self._where() != self._places:
            return True
        if any(tuple(table) != names for table, names in self._tables):
            return True
        there = (table[name] for table, name, _ in self._parts)
        return not all(map(is_, there, self._kept))

    @property
    def changed(self) -> bool:
        """Whether they are replaced, or a tensor was written."""
        return self._written() != self._writes or self.replaced

    def _where(self) -> list[int]:
        return [tensor.data_ptr() for tensor in self._tensors]

    def _written(self) -> list[int]:
        return [tensor._version for tensor in self._counted]


def _tables(corrector: Corrector) -> Iterator[dict[str, Any]]:
    """Where its modules keep what they are made of."""
    for module in corrector.modules():
        yield from (module._parameters, module._buffers, module._modules)

"""Going on with some scenes of a batch."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

from torch import Tensor

Batch = TypeVar("Batch")


def with_rows(batch: Batch, rows: Tensor, *names: str, **others: Any) -> Batch:
    """A copy with only some rows of the tensors ``names``, and other values of ``others``."""
    out = copy.copy(batch)
    for name in names:
        setattr(out, name, getattr(batch, name)[rows])
    for name, value in others.items():
        setattr(out, name, value)
    return out

"""What a decision computes with: arrays of one scene on the CPU, tensors of a batch.

Of a few numbers NumPy's operations take a fraction of the time of torch's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

Values = Any
"""A NumPy array or a tensor."""


def where(condition: Values, one: Values, other: Values) -> Values:
    """``one`` where a condition holds, else ``other``; either may be a number."""
    library = np if isinstance(condition, np.ndarray) else torch
    return library.where(condition, one, other)


def filled(like: Values, value: float) -> Values:
    """A number in the shape and type of other values."""
    return (np if isinstance(like, np.ndarray) else torch).full_like(like, value)

"""A bounded memory of what was read last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class RecentlyUsed(Generic[Value]):
    """Values by number; the least recently used go first when they exceed ``limit`` bytes.

    The value asked for last always stays, however large.  A pickled copy is empty.

    Parameters
    ----------
    load : callable
        Number -> value.
    size : callable
        Value -> bytes.
    limit : int
        Bytes.
    """

    def __init__(
        self, load: Callable[[int], Value], size: Callable[[Value], int], limit: int
    ) -> None:
        self.load, self.size, self.limit = load, size, limit
        self.bytes = 0
        self._values: OrderedDict[int, Value] = OrderedDict()

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, number: int) -> bool:
        return number in self._values

    def __getitem__(self, number: int) -> Value:
        if number in self._values:
            self._values.move_to_end(number)
            return self._values[number]
        value = self.load(number)
        self._values[number] = value
        self.bytes += self.size(value)
        while self.bytes > self.limit and len(self._values) > 1:
            _, oldest = self._values.popitem(last=False)
            self.bytes -= self.size(oldest)
        return value

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "bytes": 0, "_values": OrderedDict()}

"""What a function of numbers computes, written down as a list of operations.

A function of lists of tensors that works on each point by itself, such as `signed_svd`, is
called once with `Value` in the place of tensors.  What it does to them is its `Program`, of which
`pdcorrect.batch.point_kernel` makes a kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

Number = int | float
PointFunction = Callable[..., Sequence[Sequence[Any]]]
"""Lists of components, one for each argument, to lists of components."""


@dataclass(frozen=True, slots=True)
class Operation:
    """One line of a program.

    Attributes
    ----------
    name : str
        "constant", "+", "<", "where", ...; see `pdcorrect.batch.point_kernel`.
    operands : tuple
        Numbers of earlier lines; of a constant its value.
    """

    name: str
    operands: tuple[Any, ...]


@dataclass(eq=False)
class Program:
    """Operations, each written once.

    Attributes
    ----------
    dtype : torch.dtype
        Of all numbers.
    inputs : list of list of int
        Lines that stand for the components of each argument.
    outputs : list of list of int
        Lines that are the components of each result.
    lines : list of Operation
    """

    dtype: torch.dtype
    inputs: list[list[int]] = field(default_factory=list)
    outputs: list[list[int]] = field(default_factory=list)
    lines: list[Operation] = field(default_factory=list)
    _known: dict[tuple[Any, ...], int] = field(default_factory=dict)

    @classmethod
    def of(cls, function: PointFunction, sizes: Sequence[int], dtype: torch.dtype) -> Program:
        """Trace a function whose arguments have so many components each.

        Raises
        ------
        NotImplementedError, TypeError, AttributeError
            If it does to them what no kernel can, or decides by their values.
        """
        program = cls(dtype)
        arguments = []
        for number, size in enumerate(sizes):
            components = [program.add("input", number, i) for i in range(size)]
            program.inputs.append([value.line for value in components])
            arguments.append(components)
        for result in function(*arguments):
            program.outputs.append([program.value(x).line for x in result])
        return program

    def add(self, name: str, *operands: Any) -> Value:
        """The result of an operation."""
        operation = Operation(name, operands)
        key = (name, *((type(x), repr(x)) for x in operands))
        if key not in self._known:
            self._known[key] = len(self.lines)
            self.lines.append(operation)
        return Value(self, self._known[key])

    def value(self, x: Any) -> Value:
        """A number as a constant; a value as it is."""
        return x if isinstance(x, Value) else self.add("constant", float(x))


class Value:
    """A number at each point, of which only the line of the program is known that computes it."""

    __slots__ = ("line", "program")

    def __init__(self, program: Program, line: int) -> None:
        self.program, self.line = program, line

    @property
    def dtype(self) -> torch.dtype:
        """As of a tensor."""
        return self.program.dtype

    @classmethod
    def __torch_function__(
        cls, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Value:
        found = _FUNCTIONS.get(function)
        if found is None:
            raise NotImplementedError(f"{function.__name__} in a function of points")
        return found(*args, **(kwargs or {}))

    def abs(self) -> Value:
        return _do("abs", self)

    def __abs__(self) -> Value:
        return self.abs()

    def __neg__(self) -> Value:
        return _do("*", self, -1.0)

    def __add__(self, other: Any) -> Value:
        return _do("+", self, other)

    def __radd__(self, other: Any) -> Value:
        return _do("+", other, self)

    def __sub__(self, other: Any) -> Value:
        return _do("-", self, other)

    def __rsub__(self, other: Any) -> Value:
        return _do("-", other, self)

    def __mul__(self, other: Any) -> Value:
        return _do("*", self, other)

    def __rmul__(self, other: Any) -> Value:
        return _do("*", other, self)

    def __truediv__(self, other: Any) -> Value:
        return _do("/", self, other)

    def __rtruediv__(self, other: Any) -> Value:
        return _do("/", other, self)

    def __pow__(self, exponent: int) -> Value:
        if exponent != 2:
            raise NotImplementedError(f"power {exponent} in a function of points")
        return self * self

    def __lt__(self, other: Any) -> Value:
        return _do("<", self, other)

    def __le__(self, other: Any) -> Value:
        return _do("<=", self, other)

    def __gt__(self, other: Any) -> Value:
        return _do(">", self, other)

    def __ge__(self, other: Any) -> Value:
        return _do(">=", self, other)

    def __and__(self, other: Value) -> Value:
        return _do("&", self, other)

    def __bool__(self) -> bool:
        raise NotImplementedError("a decision in a function of points: expected torch.where")

    def __eq__(self, other: object) -> bool:
        raise NotImplementedError("equality in a function of points: expected < or >")

    __hash__ = object.__hash__


def _do(name: str, *operands: Any) -> Value:
    program = next(x.program for x in operands if isinstance(x, Value))
    return program.add(name, *(program.value(x).line for x in operands))


def _clamp(x: Value, *, min: Number) -> Value:
    return _do("maximum", x, min)


_FUNCTIONS: dict[Any, Callable[..., Value]] = {
    torch.where: lambda condition, x, y: _do("where", condition, x, y),
    torch.sqrt: lambda x: _do("sqrt", x),
    torch.rsqrt: lambda x: _do("rsqrt", x),
    torch.maximum: lambda x, y: _do("maximum", x, y),
    torch.minimum: lambda x, y: _do("minimum", x, y),
    torch.clamp: _clamp,
    torch.zeros_like: lambda x: x.program.value(0.0),
    torch.ones_like: lambda x: x.program.value(1.0),
}

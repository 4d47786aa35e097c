"""What is written for Triton by hand, each for what was measured without it.

`at_points` makes one kernel of all that a function does at a point: a thousand operations, and
nothing but arithmetic.  `torch.compile` takes a minute and more to find out what may be fused;
Triton compiles the same lines written out in a second or two (torch 2.11 on an H200; a fresh
machine's first files: ``fresh_machine`` in ``benchmarks/results/nvidia-h200.json``).

`skinny_product` multiplies matrices by one to four columns, in which the libraries' products reach
half of a GPU's memory bandwidth.
"""

from __future__ import annotations

import itertools
import linecache
from collections.abc import Callable, Sequence
from functools import cache, partial
from math import isfinite
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pdcorrect.errors import MissingExtraError

PointFunction = Callable[..., Sequence[Sequence[Any]]]
"""Lists of components, one for each argument, to lists of components."""


class Operation(NamedTuple):
    """One line of a program: "constant" with its value, or "+", "where", ... of earlier lines."""

    name: str
    operands: tuple[Any, ...]


class Program:
    """Operations on numbers of one type, each written once.

    ``inputs`` and ``outputs`` are the lines of each argument's and result's components.
    """

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.inputs: list[list[int]] = []
        self.outputs: list[list[int]] = []
        self.lines: list[Operation] = []
        self._known: dict[tuple[Any, ...], int] = {}

    @classmethod
    def of(cls, function: PointFunction, sizes: Sequence[int], dtype: torch.dtype) -> Program:
        """Trace a function whose arguments have so many components each.

        Raises
        ------
        NotImplementedError, TypeError, AttributeError
            If it does to them what no kernel can, or decides by their values.
        """
        program = cls(dtype)
        arguments = [
            [program.add("input", number, i) for i in range(size)]
            for number, size in enumerate(sizes)
        ]
        program.inputs = [[value.line for value in components] for components in arguments]
        for result in function(*arguments):
            program.outputs.append([program.value(x).line for x in result])
        return program

    def add(self, name: str, *operands: Any) -> Value:
        """The result of an operation."""
        key = (name, *((type(x), repr(x)) for x in operands))
        if key not in self._known:
            self._known[key] = len(self.lines)
            self.lines.append(Operation(name, operands))
        return Value(self, self._known[key])

    def value(self, x: Any) -> Value:
        """A number as a constant; a value as it is."""
        return x if isinstance(x, Value) else self.add("constant", float(x))


def _do(name: str, *operands: Any) -> Value:
    program = next(x.program for x in operands if isinstance(x, Value))
    return program.add(name, *(program.value(x).line for x in operands))


Operator = Callable[["Value", Any], "Value"]


def _operators(sign: str) -> tuple[Operator, Operator]:
    """What x sign y does, for its left and for its right operand."""
    return lambda x, y: _do(sign, x, y), lambda y, x: _do(sign, x, y)


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

    def __neg__(self) -> Value:
        return _do("*", self, -1.0)

    __abs__ = abs
    __add__, __radd__ = _operators("+")
    __sub__, __rsub__ = _operators("-")
    __mul__, __rmul__ = _operators("*")
    __truediv__, __rtruediv__ = _operators("/")
    __lt__, __gt__ = _operators("<")[0], _operators(">")[0]
    __le__, __ge__ = _operators("<=")[0], _operators(">=")[0]
    __and__, _ = _operators("&")

    def __pow__(self, exponent: int) -> Value:
        if exponent != 2:
            raise NotImplementedError(f"power {exponent} in a function of points")
        return self * self

    def __bool__(self) -> bool:
        raise NotImplementedError("a decision in a function of points: expected torch.where")

    def __eq__(self, other: object) -> bool:
        raise NotImplementedError("equality in a function of points: expected < or >")

    __hash__ = object.__hash__


_FUNCTIONS: dict[Any, Callable[..., Value]] = {
    torch.where: lambda condition, x, y: _do("where", condition, x, y),
    torch.sqrt: lambda x: _do("sqrt", x),
    torch.rsqrt: lambda x: _do("rsqrt", x),
    torch.maximum: lambda x, y: _do("maximum", x, y),
    torch.minimum: lambda x, y: _do("minimum", x, y),
    torch.clamp: lambda x, *, min: _do("maximum", x, min),
    torch.zeros_like: lambda x: x.program.value(0.0),
    torch.ones_like: lambda x: x.program.value(1.0),
}


BLOCK = 128
"""Points of a thread block, one a thread."""

_FORMS = {
    "abs": "tl.abs({})",
    "rsqrt": "tl.rsqrt({})",
    "where": "tl.where({}, {}, {})",
    "maximum": "tl.maximum({}, {}, propagate_nan=tl.PropagateNan.ALL)",
    "minimum": "tl.minimum({}, {}, propagate_nan=tl.PropagateNan.ALL)",
    **{sign: f"{{}} {sign} {{}}" for sign in ("+", "-", "*", "/", "<", "<=", ">", ">=", "&")},
}

_TYPES = {torch.float64: "tl.float64", torch.float32: "tl.float32"}
_ROOTS = {torch.float64: "tl.sqrt({})", torch.float32: "tl.sqrt_rn({})"}
"""The former is rounded correctly of float64 alone; quotients of float32 are to two units."""

_files = itertools.count()


def at_points(function: PointFunction, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> None:
    """Fill ``outputs`` with the function of ``inputs`` at every point, on a GPU.

    All tensors are (k, C, Q) for k components at Q points of C cells, or (k, B, C, Q) in B scenes,
    anywhere in memory.  The function's kernel is found again by its identity: pass the same object
    each time.

    Raises
    ------
    MissingExtraError
        If there is no Triton.
    ValueError
        If tensors differ by their points, type or device.
    """
    first, tensors = outputs[0], [*inputs, *outputs]
    if len({(x.shape[1:], x.dtype, x.device) for x in tensors}) > 1:
        raise ValueError("expected tensors of the same points, type and device")
    *scenes, cells, points = first.shape[1:]
    count = first[0].numel()
    if not count:
        return
    sizes = tuple(len(x) for x in inputs)
    kernel = _kernel(function, sizes, first.dtype)
    strides = [s for x in tensors for s in (x if scenes else x[:, None]).stride()]
    with torch.cuda.device(first.device):
        kernel[(-(-count // BLOCK),)](
            *tensors, *strides, count, cells, points, BLOCK=BLOCK, num_warps=4
        )


@cache
def _kernel(function: PointFunction, sizes: tuple[int, ...], dtype: torch.dtype) -> Any:
    try:
        import triton
        from triton import language
    except ImportError as error:
        raise MissingExtraError(
            f"triton is needed on a GPU and could not be imported ({error}): expected a PyTorch "
            "for CUDA on Linux, which brings it."
        ) from error
    program, name = Program.of(function, sizes, dtype), _name(function)
    plain = as_function(kernel_source(program, name), name, language)
    names = plain.__code__.co_varnames[: plain.__code__.co_argcount]
    return triton.jit(plain, do_not_specialize=[n for n in names if n != "BLOCK"])


def _name(function: PointFunction) -> str:
    """What profilers and tracebacks show: the function's without what was bound to it."""
    while isinstance(function, partial):
        function = function.func
    found = str(getattr(function, "__name__", ""))
    return found if found.isidentifier() else "points"


def kernel_source(program: Program, name: str) -> str:
    """A Triton kernel in Python.

    Of tensors, their strides, how many points, and how many cells a scene and points a cell has.
    """
    every = [f"x{i}" for i in range(len(program.inputs))]
    every += [f"y{i}" for i in range(len(program.outputs))]
    strides = [f"{x}_{axis}" for x in every for axis in ("component", "scene", "cell", "point")]
    arguments = [*every, *strides, "count", "cells", "points", "BLOCK: tl.constexpr"]
    lines = [
        f"def {name}({', '.join(arguments)}):",
        "lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)",
        "within = lane < count",
        "scene = (lane // (cells * points)).to(tl.int64)",
        "cell = (lane // points % cells).to(tl.int64)",
        "point = (lane % points).to(tl.int64)",
        *(f"{x} = {x} + scene * {x}_scene + cell * {x}_cell + point * {x}_point" for x in every),
    ]
    for number, operation in enumerate(program.lines):
        lines.append(f"v{number} = {_text(program, operation.name, operation.operands)}")
    for i, components in enumerate(program.outputs):
        for k, line in enumerate(components):
            lines.append(f"tl.store({_place(f'y{i}', k)}, v{line}, mask=within)")
    return "\n    ".join(lines) + "\n"


def _text(program: Program, kind: str, operands: tuple[Any, ...]) -> str:
    if kind == "input":
        number, component = operands
        return f"tl.load({_place(f'x{number}', component)}, mask=within, other=1.0)"
    if kind == "constant":
        value = repr(operands[0]) if isfinite(operands[0]) else f'float("{operands[0]}")'
        return f"tl.full((), {value}, {_TYPES[program.dtype]})"
    form = _ROOTS[program.dtype] if kind == "sqrt" else _FORMS[kind]
    return form.format(*(f"v{line}" for line in operands))


def _place(tensor: str, component: int) -> str:
    return f"{tensor} + {component} * {tensor}_component.to(tl.int64)"


def as_function(text: str, name: str, language: Any) -> Callable[..., None]:
    """The function of this name that a source defines, with ``triton.language`` as tl.

    Triton compiles what `inspect.getsource` finds, which looks where the lines are left here.
    """
    file = f"<pdcorrect {name} {next(_files)}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    space: dict[str, Any] = {"tl": language, "__name__": __name__}
    exec(compile(text, file, "exec"), space)
    found: Callable[..., None] = space[name]
    return found


_MOST_COLUMNS = 4
_ROWS, _COLUMNS, _WARPS = 8, 256, 4


def skinny_product(matrices: Tensor, columns: Tensor) -> Tensor:
    """(K, n, n) @ (K, n, m) -> (K, n, m)."""
    count, size, _ = matrices.shape
    few = columns.shape[2] <= _MOST_COLUMNS
    if not (few and matrices.is_cuda and matrices.dtype == torch.float32 and size >= _COLUMNS):
        return matrices @ columns
    import triton

    columns = columns.contiguous()
    out = torch.empty_like(columns)
    grid = (triton.cdiv(size, _ROWS), count)
    _skinny_kernel()[grid](
        matrices, columns, out, size, M=columns.shape[2], ROWS=_ROWS, COLUMNS=_COLUMNS,
        num_warps=_WARPS,
    )  # fmt: skip
    return out


@cache
def _skinny_kernel() -> Any:
    import triton
    import triton.language as tl

    @triton.jit
    def kernel(a, x, y, n, M: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr):  # type: ignore[no-untyped-def]
        k = tl.program_id(1).to(tl.int64)
        row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
        rows = (k * n + row.to(tl.int64)) * n
        s0 = tl.zeros((ROWS, COLUMNS), tl.float32)
        s1 = tl.zeros((ROWS, COLUMNS), tl.float32)
        s2 = tl.zeros((ROWS, COLUMNS), tl.float32)
        s3 = tl.zeros((ROWS, COLUMNS), tl.float32)
        for begin in range(0, n, COLUMNS):
            col = begin + tl.arange(0, COLUMNS)
            inside = col < n
            mask = (row[:, None] < n) & inside[None, :]
            block = tl.load(a + rows[:, None] + col[None, :], mask=mask, other=0.0)
            place = x + (k * n + col) * M
            s0 += block * tl.load(place, mask=inside, other=0.0)[None, :]
            if M > 1:
                s1 += block * tl.load(place + 1, mask=inside, other=0.0)[None, :]
            if M > 2:
                s2 += block * tl.load(place + 2, mask=inside, other=0.0)[None, :]
            if M > 3:
                s3 += block * tl.load(place + 3, mask=inside, other=0.0)[None, :]
        target = y + (k * n + row) * M
        fits = row < n
        tl.store(target, tl.sum(s0, axis=1), mask=fits)
        if M > 1:
            tl.store(target + 1, tl.sum(s1, axis=1), mask=fits)
        if M > 2:
            tl.store(target + 2, tl.sum(s2, axis=1), mask=fits)
        if M > 3:
            tl.store(target + 3, tl.sum(s3, axis=1), mask=fits)

    return kernel

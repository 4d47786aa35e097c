"""One kernel for all that a function does at a point.

The functions are a thousand operations long, and nothing but arithmetic: what `torch.compile` does
to find out what may be fused takes far longer than Triton needs for the same lines written out.
"""

from __future__ import annotations

import itertools
import linecache
from collections.abc import Callable, Sequence
from functools import cache, partial
from math import isfinite
from typing import Any

import torch
from torch import Tensor

from pdcorrect.batch.tracing import PointFunction, Program
from pdcorrect.errors import MissingExtraError

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


def at_points(
    function: PointFunction,
    inputs: Sequence[Tensor],
    outputs: Sequence[Tensor],
) -> None:
    """Fill ``outputs`` with the function of ``inputs`` at every point, on a GPU.

    Parameters
    ----------
    function : callable
        Of lists of components, as `pdcorrect.batch.tracing` has it.  Its kernel is found again by
        its identity: pass the same object each time.
    inputs, outputs : sequence of tensor
        Each (k, C, Q) for k components at Q points of C cells, of one type, anywhere in memory;
        k may differ.

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
    _, cells, points = first.shape
    count = cells * points
    if not count:
        return
    sizes = tuple(len(x) for x in inputs)
    kernel = _kernel(function, sizes, first.dtype)
    strides = [s for x in tensors for s in x.stride()]
    with torch.cuda.device(first.device):
        kernel[(-(-count // BLOCK),)](*tensors, *strides, count, points, BLOCK=BLOCK, num_warps=4)


@cache
def _kernel(function: PointFunction, sizes: tuple[int, ...], dtype: torch.dtype) -> Any:
    try:
        import triton
    except ImportError as error:
        raise MissingExtraError(
            f"triton is needed on a GPU and could not be imported ({error}): expected a PyTorch "
            "for CUDA on Linux, which brings it."
        ) from error
    program, name = Program.of(function, sizes, dtype), _name(function)
    plain = as_function(kernel_source(program, name), name)
    names = plain.__code__.co_varnames[: plain.__code__.co_argcount]
    return triton.jit(plain, do_not_specialize=[n for n in names if n != "BLOCK"])


def _name(function: PointFunction) -> str:
    """What profilers and tracebacks show: the function's without what was bound to it."""
    while isinstance(function, partial):
        function = function.func
    found = str(getattr(function, "__name__", ""))
    return found if found.isidentifier() else "points"


def kernel_source(program: Program, name: str) -> str:
    """A Triton kernel in Python: tensors, their strides, how many points, and points of a cell."""
    tensors = [f"x{i}" for i in range(len(program.inputs))]
    results = [f"y{i}" for i in range(len(program.outputs))]
    every = [*tensors, *results]
    strides = [f"{x}_{axis}" for x in every for axis in ("component", "cell", "point")]
    lines = [
        f"def {name}({', '.join([*every, *strides, 'count', 'points', 'BLOCK: tl.constexpr'])}):",
        "lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)",
        "within = lane < count",
        "cell = (lane // points).to(tl.int64)",
        "point = (lane % points).to(tl.int64)",
        *(f"{x} = {x} + cell * {x}_cell + point * {x}_point" for x in every),
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


def as_function(text: str, name: str, language: Any = None) -> Callable[..., None]:
    """The function of this name that a source defines, with ``triton.language`` or another.

    Triton compiles what `inspect.getsource` finds, which looks where the lines are left here.
    """
    if language is None:
        from triton import language as triton_language

        language = triton_language
    file = f"<pdcorrect {name} {next(_files)}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    space: dict[str, Any] = {"tl": language, "__name__": __name__}
    exec(compile(text, file, "exec"), space)
    found: Callable[..., None] = space[name]
    return found

"""Functions of points as kernels: what Triton would be given is run here by torch, lane by lane."""

import ast
import contextlib
import math
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pdcorrect.batch import points, triton_kernels, turned_strains, viscosity
from pdcorrect.batch.triton_kernels import Program
from pdcorrect.errors import MissingExtraError
from pdcorrect.fem.hyperelasticity import COROTATED, NEO_HOOKEAN, ST_VENANT_KIRCHHOFF

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
ENERGIES = [COROTATED, NEO_HOOKEAN, ST_VENANT_KIRCHHOFF]


class Pointer:
    """Places in a tensor's storage, counted from its first number."""

    def __init__(self, tensor, places=0):
        self.tensor, self.places = tensor, places

    def __add__(self, more):
        assert more.dtype == torch.int64  # 32 bits would not do for large batches
        return Pointer(self.tensor, self.places + more)

    def storage(self):
        size = self.tensor.untyped_storage().nbytes() // self.tensor.element_size()
        return self.tensor.as_strided((size,), (1,), 0), self.places + self.tensor.storage_offset()


def whole(number):
    """A whole number as Triton gives it to a kernel."""
    return torch.tensor(number, dtype=torch.int32)


def language(block):
    """What the kernels need of `triton.language`, for the thread block of this number."""

    def load(pointer, mask, other):
        numbers, places = pointer.storage()
        return torch.where(mask, numbers[torch.where(mask, places, 0)], other)

    def store(pointer, value, mask):
        numbers, places = pointer.storage()
        numbers[places[mask]] = torch.broadcast_to(value, mask.shape)[mask]

    def extreme(function):
        return lambda x, y, propagate_nan: function(x, y) if propagate_nan == "all" else None

    return SimpleNamespace(
        constexpr=int, int64=torch.int64, float64=torch.float64, float32=torch.float32,
        PropagateNan=SimpleNamespace(ALL="all"), program_id=lambda axis: whole(block),
        arange=partial(torch.arange, dtype=torch.int32), load=load, store=store,
        where=torch.where, abs=torch.abs, sqrt=torch.sqrt, sqrt_rn=torch.sqrt, rsqrt=torch.rsqrt,
        maximum=extreme(torch.maximum), minimum=extreme(torch.minimum),
        full=lambda shape, value, dtype: torch.full(shape, value, dtype=dtype),
    )  # fmt: skip


class Interpreted:
    """A kernel that is launched as Triton's are."""

    def __init__(self, function, sizes, dtype):
        self._text = triton_kernels.kernel_source(Program.of(function, sizes, dtype), "kernel")

    def __getitem__(self, grid):
        return partial(self._launch, grid)

    def _launch(self, grid, *arguments, BLOCK, num_warps):
        given = [Pointer(x) if torch.is_tensor(x) else whole(x) for x in arguments]
        for block in range(*grid):
            triton_kernels.as_function(self._text, "kernel", language(block))(*given, BLOCK=BLOCK)


@pytest.fixture
def interpreted(monkeypatch):
    """`points` uses kernels, which torch runs; results are poisoned before."""
    monkeypatch.setattr(triton_kernels, "_kernel", Interpreted)
    monkeypatch.setattr(torch.cuda, "device", lambda device: contextlib.nullcontext())

    def computed(function, inputs, sizes, cell_by_cell=False):
        out = [x.fill_(math.nan) for x in points._room(inputs[0], sizes, cell_by_cell)]
        triton_kernels.at_points(function, inputs, out)
        return out

    monkeypatch.setattr(points, "computed", computed)


def gradients(dtype, cells=41, in_a_cell=8, device="cpu"):
    """H (9, C, Q), cell by cell in memory; some of rank 0 to 2, inverted or stretched."""
    rng = np.random.default_rng(0)
    H = 0.4 * rng.normal(size=(cells, 9, in_a_cell))
    eye = np.eye(3).reshape(9, 1)
    H[0] = -eye
    H[1] = np.diag([1.0, 0.0, 0.0]).reshape(9, 1) - eye
    H[2] = np.diag([2.0, 1.0, 0.0]).reshape(9, 1) - eye
    H[3] = -2.0 * eye
    H[4] *= 1e-9
    H[5] += 3.0 * eye
    return torch.as_tensor(H, dtype=dtype, device=device).transpose(0, 1)


def everything(p, H, weights):
    """All that `Points` computes."""
    D = torch.sin(H + 1.0)
    tangent = p.tangent(H, weights)
    flat = H.reshape(9, -1)[:, :77].clone()
    flat[:, 3] = math.nan
    return {
        "stress": p.stress(H, weights),
        "tangent": tangent,
        "product": p.product(tangent, D),
        "rotations": p.rotations(flat),
        "volume ratios": p.volume_ratios(H),
    }


def some_weights(H):
    numbers = np.random.default_rng(1).uniform(1.0, 2.0, (2, *H.shape[1:]))
    return torch.as_tensor(numbers, dtype=H.dtype, device=H.device)


@pytest.mark.parametrize("first", [0, 6, 8])
@pytest.mark.parametrize("model", ENERGIES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_kernels_compute_what_torch_does(request, dtype, model, first):
    H = gradients(dtype)
    weights, p = some_weights(H), points.Points(model, first, 8)
    expected = everything(p, H, weights)
    request.getfixturevalue("interpreted")
    found = everything(p, H, weights)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance, check_stride=True)


def test_stretches_have_kernels_too(interpreted):
    H = gradients(torch.float64)[:, 4:].contiguous()
    found = points.computed(viscosity._stretch, [H], (6, 9, 3, 9))
    for got, expected in zip(found, viscosity._stretch(list(H)), strict=True):
        torch.testing.assert_close(got, torch.stack(expected), rtol=1e-12, atol=1e-12)


def test_learned_elements_have_kernels_too(interpreted):
    rng = np.random.default_rng(2)

    def some(*sizes):
        return [torch.as_tensor(rng.normal(size=(k, 30, 1))) for k in sizes]

    v, (size,) = 0.2 * some(21)[0], torch.rand(1, 1, 30, 1, dtype=torch.float64) + 1.0
    at = check(turned_strains.frame, [v, size], (9, 9, 9, 9, 18, 8, 18))[:-1]
    raw, dv, more = some(18, 21, 18)
    y, w, _ = check(turned_strains.derivatives, [*at, raw], (18, 3, 21))
    known = check(turned_strains.rates, [*at, dv], (18, 9, 1, 3, 18))[:-1]
    check(turned_strains.changes, [*at, raw, y, w, *known, more], (21,))


def check(function, inputs, sizes):
    """What a kernel computes, which is what torch does."""
    found = points.computed(function, inputs, sizes)
    expected = [torch.stack(x) for x in function(*(list(x) for x in inputs))]
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    return found


@pytest.mark.parametrize("alike", [True, False])
def test_deformation_of_scenes_has_a_kernel(interpreted, alike):
    """Of gradients that all cells of a scene share, and of each cell's own."""
    rows = torch.rand(2, 5, 3, 11, dtype=torch.float64)
    shape = (2, 11, 51) if alike else (2, 5, 11, 51)
    gradients = torch.rand(*shape, dtype=torch.float64)
    each = gradients[:, None].expand(2, 5, 11, 51) if alike else gradients
    expected = torch.einsum("bcil,bcljq->ijbcq", rows, each.unflatten(-1, (3, 17)))
    found = points.deformation(rows, gradients)
    torch.testing.assert_close(found, expected.reshape(9, 10, 17), rtol=1e-13, atol=1e-13)


@needs_gpu
@pytest.mark.parametrize("model", ENERGIES)
@pytest.mark.parametrize("first", [0, 6, 8])
def test_kernels_on_a_gpu_compute_what_torch_does(model, first):
    """Of cells that are not flat or inverted, but for frames, which alike stretches leave open."""
    H = gradients(torch.float64)[:, 4:]
    p = points.Points(model, first, 8)
    expected = everything(p, H, some_weights(H))
    H = gradients(torch.float64, device="cuda")[:, 4:]
    found = everything(p, H, some_weights(H))
    del expected["tangent"], found["tangent"]
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10, check_device=False)


def test_no_points_are_no_work():
    triton_kernels.at_points(None, [torch.zeros(9, 0, 8)], [torch.zeros(1, 0, 8)])


def test_without_triton_it_is_told_what_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(MissingExtraError, match="expected a PyTorch for CUDA on Linux"):
        triton_kernels._kernel.__wrapped__(points._volume_ratio, (9,), torch.float64)


def test_not_a_number_stays_one(interpreted):
    def extremes(x, y):
        return [[torch.maximum(x[0], y[0]), torch.minimum(x[0], y[0]), torch.clamp(x[0], min=0.0)]]

    x = torch.tensor([[[1.0, math.nan, 2.0, -3.0]]])
    y = torch.tensor([[[2.0, 1.0, math.nan, -4.0]]])
    found, expected = (torch.zeros(3, 1, 4) for _ in range(2))
    triton_kernels.at_points(extremes, [x, y], [found])
    torch.stack([z for row in extremes(x, y) for z in row], out=expected)
    torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("other", [torch.zeros(9, 3, 8), torch.zeros(9, 2, 8, dtype=torch.float64)])
def test_tensors_of_other_points_or_types_are_refused(other):
    with pytest.raises(ValueError, match="the same points, type and device"):
        triton_kernels.at_points(points._volume_ratio, [other], [torch.zeros(1, 2, 8)])


def test_numbers_may_lie_anywhere_in_memory(interpreted):
    """Also where places are of other tensors, which must stay as they are."""

    def both(a, b):
        return [[a[0] + b[1], a[1] - b[0]]]

    space = torch.zeros(5, 4, 7, 3, dtype=torch.float64)
    a, b, out = (space[k].permute(2, 0, 1)[1:] for k in (0, 2, 4))
    a.copy_(torch.rand(2, 4, 7))
    b.copy_(torch.rand(2, 4, 7))
    before = space.clone()
    triton_kernels.at_points(both, [a, b], [out])
    assert torch.equal(out, torch.stack([a[0] + b[1], a[1] - b[0]]))
    space[4] = before[4]
    assert torch.equal(space, before)


def test_what_is_computed_twice_is_written_once():
    program = Program.of(lambda x: [[x[0] * x[1] + x[0] * x[1], x[0] * 2.0]], [2], torch.float64)
    assert [line.name for line in program.lines] == ["input", "input", "*", "+", "constant", "*"]
    assert program.inputs == [[0, 1]]
    assert program.outputs == [[3, 5]]


def test_constants_are_written_as_they_are():
    def numbers(x):
        return [[torch.where(x[0] < -2.0, 1e-300, 0.0), torch.where(x[0] < 0.0, math.inf, x[0])]]

    program = Program.of(numbers, [1], torch.float64)
    constants = [line.operands[0] for line in program.lines if line.name == "constant"]
    assert sorted(map(repr, constants)) == ["-2.0", "0.0", "1e-300", "inf"]
    text = triton_kernels.kernel_source(program, "constants")
    ast.parse(text)
    assert 'float("inf")' in text
    assert "1e-300" in text


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: [[torch.sin(x[0])]], "sin"),
        (lambda x: [[x[0] ** 3]], "power 3"),
        (lambda x: [[x[0] if x[0] > 0 else -x[0]]], "torch.where"),
        (lambda x: [[x[0] if x[0] == 0 else -x[0]]], "equality"),
    ],
)
def test_what_no_kernel_can_do_is_refused(function, reason):
    with pytest.raises(NotImplementedError, match=reason):
        Program.of(function, [1], torch.float64)

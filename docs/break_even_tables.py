"""Tables of what data and training of models take, and of the simulations that repay them."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator
from statistics import median

from model_tables import knows, minutes
from records import RECORDS, ROOT, Rows, read

sys.path += [str(ROOT / "validation"), str(ROOT / "validation" / "error_time")]
import harness
from break_even import Repaid, repaid, simulations_of
from methods import CORRECTORS

LEARNED = ("learned, 1", "learned, 2", "learned, 4")
STUDY = "4000 bodies"
"""Of `models/element_studies.py`: the released recipe with fewer iterations, on a GPU."""


def element_seconds() -> tuple[float, float, float]:
    """Of the learned element's data, its training on a GPU, and its training on a CPU."""
    found = read(RECORDS / "break_even.json")["element"]
    study = read(RECORDS / "element_studies.json")["studies"][STUDY]
    share = found["iterations"] / study["recipe"]["iterations"]
    return (
        found["bodies"] * found["seconds_a_body"],
        share * study["seconds"],
        found["iterations"] * found["seconds_an_iteration"],
    )


def corrector_seconds(model: str) -> tuple[float, float, bool]:
    """Of a corrector's data and training, and whether some of its data sets have no time."""
    names = read(f"models/{model}/model.json")["record"]["dataset"].split("+")
    spent = []
    for name in names:
        card = ROOT / "datasets" / name / "README.md"
        text = card.read_text(encoding="utf-8") if card.exists() else ""
        if match := re.search(r"in (\d+) worker seconds", text):
            spent.append(float(match[1]))
    return sum(spent), 60.0 * minutes(model), len(spent) < len(names)


def costs() -> Rows:
    """Seconds of data and training, and what a training serves."""
    record = read(RECORDS / "break_even.json")
    found = record["element"]
    thread = f"one thread of {record['environment']['processor']}"
    timed = read(RECORDS / "element_studies.json")["studies"][STUDY]["recipe"]["iterations"]
    data, gpu, cpu = element_seconds()
    rows = [[
        "learned element", "cubic cells; any load, step, integrator",
        f"{many(data)}, {thread}, from {found['sampled_bodies']} of {found['bodies']} bodies",
        f"{many(gpu)}, a GPU, from {timed} of {found['iterations']} iterations; "
        f"or {many(cpu)}, {thread}, from {found['sampled_iterations']}",
    ]]  # fmt: skip
    for model in CORRECTORS:
        data, training, lacks = corrector_seconds(model)
        family, load, step = knows(model)
        rows.append([
            f"`{model}`", f"{family}, {load}, {step} s/m",
            f"{'≥ ' * lacks}{many(data)}, workers of an NVIDIA H200",
            f"{many(training)}, NVIDIA H200 or H100",
        ])  # fmt: skip
    return ("trained once", "serves", "data, s", "training asked for, s"), rows


def break_even() -> Rows:
    """Simulations that repay data and training: over all scenes, of correctors in their own."""
    record = harness.load(RECORDS / "error_time.json")
    assert record is not None
    reached = simulations_of(record)
    data, gpu, cpu = element_seconds()
    rows = [_row(name, repaid(name, data + gpu, reached)) for name in LEARNED]
    on_cpu = repaid(LEARNED[1], data + cpu, reached)
    rows.append(_row(f"{LEARNED[1]}, trained on a CPU", on_cpu))
    for model in CORRECTORS:
        *spent, _ = corrector_seconds(model)
        name, own = f"hybrid {model}", model.partition("-")[0]
        rows.append(_row(name, repaid(name, sum(spent), {own: reached[own]})))
    head = ("run, steps a frame", "scenes", "beside the front: median", "least", "never",
            "hex27, as many steps, by time (as near)", "4×4×4, by time (as near)")  # fmt: skip
    return head, rows


def _row(name: str, found: list[Repaid]) -> list[str]:
    equal = [each.equal for each in found if each.equal is not None]
    ends = [many(median(equal)), many(min(equal))] if equal else ["–"] * 2
    beside = [
        f"{many(median(each.fixed[k] for each in found))} ({sum(each.near[k] for each in found)})"
        for k in range(2)
    ]
    never = f"{sum(map(math.isinf, equal))} of {len(equal)}"
    return [name, str(len(found)), *ends, never, *beside]


def many(count: float) -> str:
    """A large number to two significant digits.

    >>> [many(x) for x in (15234.0, 87.4, math.inf)]
    ['15 000', '87', 'never']
    """
    if math.isinf(count):
        return "never"
    return f"{float(f'{count:.2g}'):,.0f}".replace(",", " ")


def tables() -> Iterator[tuple[str, Callable[[], Rows]]]:
    """By name."""
    yield "break-even-costs", costs
    yield "break-even", break_even

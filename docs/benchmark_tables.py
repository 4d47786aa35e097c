"""Tables of run time, from ``benchmarks/results``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from records import Rows, number, read

RESULTS = "benchmarks/results"
AMD, INTEL, H200 = (
    f"{RESULTS}/{name}.json"
    for name in (
        "amd-epyc-2cores",
        "intel-r-xeon-r-processor-2cores",
        "nvidia-h200",
    )
)
TOLERANCE = 1e-4
"""Of the cell size, of our steps beside DiffPD's."""


def results_of(path: str, case: str) -> Any:
    return read(path)[case]["results"]


def chosen(rows: Iterable[dict[str, Any]], **keys: Any) -> dict[int, dict[str, Any]]:
    """Rows with some values, by their number of nodes."""
    return {
        row["nodes"]: row
        for row in rows
        if all(str(row[key]).startswith(str(value)) for key, value in keys.items())
    }


def peer() -> Rows:
    """Steps of one beam by DiffPD and here, on one kind of processor."""
    ours = chosen(
        results_of(AMD, "beam_steps"),
        rules="diffpd", first_hessian="true Hessian", tolerance=TOLERANCE, threads=2,
    )  # fmt: skip
    newton = chosen(results_of(AMD, "newton"), rules="diffpd", linear_solver="direct")
    memory = chosen(results_of(AMD, "memory"), first_hessian="true Hessian")
    rows = []
    for row in read(f"{RESULTS}/diffpd.json")["results"]:
        nodes = row["nodes"]
        step, error = ours[nodes]["median_step_ms"], ours[nodes]["tip_error_m"]
        rows.append([
            str(nodes), number(row["step_ms"]), number(step),
            f"{row['step_ms'] / step:.0f}", f"{micro(row['tip_error_m'])}, {micro(error)}",
            f"{number(row['newton_s'])}, {number(newton[nodes]['median_step_s'], 2)}",
            f"{row['peak_megabytes']}, {number(memory[nodes]['peak_megabytes'])}",
        ])  # fmt: skip
    head = ("nodes", "DiffPD, ms a step", "here", "ratio", "error of the tip, µm: DiffPD, here",
            "Newton, s: DiffPD, here", "peak MB: DiffPD, here")  # fmt: skip
    return head, rows


def micro(metres: float | None) -> str:
    return "–" if metres is None else number(1e6 * metres, 2)


def derivatives() -> Rows:
    """A step and its derivative on a CPU."""
    rows = results_of(INTEL, "adjoint")
    found = chosen(rows, rules="diffpd", tolerance=1e-6, threads=2)
    return ("nodes", "step, ms", "derivative, ms"), [
        [str(nodes), number(row["forward_ms"]), number(row["backward_ms"])]
        for nodes, row in found.items()
    ]


def integrators() -> Rows:
    """Steps by integrator, over those of backward Euler at the same tolerance."""
    rows = results_of(AMD, "integrators")
    first = {r["nodes"]: r["median_step_ms"] for r in rows if r["integrator"] == "backward-euler"}
    cells = []
    for row in rows:
        ms, nodes = row["median_step_ms"], row["nodes"]
        counts = number(ms / first[nodes], 2), number(row["iterations"], 2), number(row["peak_mb"])
        name = row["integrator"] + (", viscosity" if row["viscosity"] else "")
        cells.append([str(nodes), name, number(ms), *counts])
    return ("nodes", "integrator", "ms", "over backward Euler's", "iterations", "peak MB"), cells


def batches() -> Rows:
    """Batches of scenes on a GPU."""
    found = results_of(H200, "batch")
    coarse = {row["scenes"]: row for row in found["coarse"]}
    fine = {row["scenes"]: row for row in found["fine"]}
    rows = []
    for scenes in sorted(coarse | fine):
        one, other = coarse.get(scenes), fine.get(scenes)
        rows.append([
            str(scenes), _cell(one, "scene_steps_a_second"),
            _cell(one, "forward_and_backward_a_second"), _cell(other, "step_ms_a_scene"),
        ])  # fmt: skip
    head = ("scenes", "coarse: steps a second", "steps and derivatives a second",
            "fine: ms a scene and step")  # fmt: skip
    return head, rows


def elements() -> Rows:
    """A step with the learned element over one with the best coarse one."""
    rows = [
        [
            str(row["nodes"]), number(row["best_ms"]), number(row["learned_ms"]),
            number(row["ratio"], 2), number(row["best_setup_ms"]), number(row["learned_setup_ms"]),
        ]
        for row in results_of(AMD, "elements")
    ]  # fmt: skip
    head = ("nodes", "best coarse, ms", "learned, ms", "ratio", "set-up, ms", "learned, ms")
    return head, rows


def batch_elements() -> Rows:
    """256 scenes of 405 nodes, and 16 of the fine mesh, on a GPU."""
    found = results_of(H200, "batch elements")
    rows = [
        [
            f"`{row['element']}`", str(row["nodes"]), str(row["scenes"]),
            number(row["step_ms_a_scene"]),
            number(found[-1]["step_ms_a_scene"] / row["step_ms_a_scene"], 2),
            number(row["backward_ms"] / row["scenes"]), number(row["memory_bytes"] / 1e9, 2),
        ]
        for row in found
    ]  # fmt: skip
    head = ("element", "nodes", "scenes", "step, ms a scene", "fine step over it",
            "derivative, ms a scene", "memory, GB")  # fmt: skip
    return head, rows


def _cell(row: dict[str, Any] | None, key: str) -> str:
    return "" if row is None else number(row[key])


def corrected_steps() -> Rows:
    """Coarse, corrected and fine steps of batches on a GPU."""
    rows = []
    for case in ("hybrid torsion-exact", "hybrid torsion-exact, recorded"):
        for row in results_of(H200, case):
            times = (row[name]["seconds"] for name in ("coarse", "hybrid", "fine"))
            rows.append([
                str(row["scenes"]), "yes" if case.endswith("recorded") else "no",
                *(number(1e3 * seconds) for seconds in times), number(row["speed_up"], 2),
            ])  # fmt: skip
    head = ("scenes", "network recorded", "coarse, ms", "corrected, ms", "fine, ms", "speed-up")
    return head, rows


def networks() -> Rows:
    """What a correction costs on a CPU beside the step that it corrects, 405 nodes."""
    found = [
        row for row in results_of(INTEL, "corrector") if row["nodes"] == 405 and row["threads"] == 2
    ]
    return ("preset", "weights", "best coarse step, ms", "correction, ms"), [
        [
            f"`{row['preset']}`", str(row["parameters"]), number(row["best_coarse_ms"]),
            number(row["best_correction_ms"]),
        ]
        for row in found
    ]  # fmt: skip


def reading() -> Rows:
    """Graph samples a second read from a data set."""
    rows = [
        [str(row["files_samples_per_second"]), str(row["memory_samples_per_second"])]
        for row in results_of(INTEL, "reading")
        if not row.get("workers")  # earlier records have rows of a loader with worker processes
    ]
    return ("first epoch", "from memory"), rows


def tables() -> Iterable[tuple[str, Any]]:
    """Names of the tables here and what makes them."""
    yield from {
        "peer": peer, "derivatives": derivatives, "integrators": integrators, "batches": batches,
        "batch-elements": batch_elements, "elements": elements,
        "corrected-steps": corrected_steps, "networks": networks, "reading": reading,
    }.items()  # fmt: skip

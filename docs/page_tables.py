"""Tables of the pages on choosing a solver and on one's own body."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from records import RECORDS, Rows, number, read

_INTEGRATORS = ("backward-euler", "bdf2", "generalised-alpha", "midpoint")
_MESHES = {
    "hex8 1x": "coarse mesh, `hex8`",
    "hex8-bubble-mean 1x": "coarse mesh, best coarse model",
    "hex8 2x": "2×2×2, `hex8`",
    "hex27 1x": "coarse mesh, `hex27`",
}
_OWN = "examples/bring_your_own/hook.json"


def time_and_mesh_error() -> Rows:
    """Errors of integrators and of meshes on one scene."""
    figures = read(RECORDS / "four_errors.json")["figures"]
    names = {f"time, {name}, h": f"time, `{name}`" for name in _INTEGRATORS}
    names |= {f"mesh, {mesh}": f"mesh, {label}" for mesh, label in _MESHES.items()}
    rows = (
        [label, number(figures[f"{name}, mm"]), number(figures[f"{name}, per cent"], 2)]
        for name, label in names.items()
    )
    return ("error", "RMS, mm", "% of the displacement"), rows


def gallery() -> Rows:
    """Scenes of the gallery by two elements."""
    table, _ = read(RECORDS / "gallery.json")["tables"]
    rows = [
        [name.replace("_", " "), str(nodes), str(frames), *map(number, found)]
        for name, nodes, frames, *found, _ in table["rows"]
    ]
    return table["headings"][:-1], rows


def own_body_evaluation() -> Rows:
    """Means over the evaluation simulations of the hook, before and after fine-tuning."""
    record = read(_OWN)
    before, after = record["before"]["runs"], record["after"]["runs"]
    runs = {
        "plain coarse mesh": before["plain"],
        "best coarse model": before["best"],
        "`torsion-exact` on it": before["torsion-exact"],
        "fine-tuned": after["model"],
    }
    header = ("run", "Ω, %", "RMS, mm", "stress error, %", "momentum error, %", "refused, %")
    return header, (
        [
            label,
            number(run["omega"]),
            number(1e3 * run["rms_error"]),
            number(1e2 * run["stress_error"]),
            number(1e2 * run["linear_momentum_error"], 2),
            number(run["gate_rate"]),
        ]
        for label, run in runs.items()
    )


def own_body_runs() -> Rows:
    """One simulation of the hook by several solvers."""
    labels = {
        "plain": "plain coarse mesh",
        "best coarse": "best coarse model",
        "hybrid": "fine-tuned corrector",
        "intermediate": "intermediate mesh (plain, 2×2×2)",
        "fine": "fine (`hex8-bubble-mean`, 3×3×3)",
    }
    runs = {row["run"]: row for row in read(_OWN)["rows"]}
    header = ("first evaluation simulation", "nodes", "RMS, mm", "ms a frame")
    return header, (
        [
            label,
            str(runs[name]["nodes"]),
            number(runs[name]["rms_mm"]) if name != "fine" else "reference",
            number(runs[name]["processor_ms_a_frame"], 2),
        ]
        for name, label in labels.items()
    )


def tables() -> Iterator[tuple[str, Callable[[], Rows]]]:
    """By their names on the pages."""
    every = (time_and_mesh_error, own_body_evaluation, own_body_runs, gallery)
    for table in every:
        yield table.__name__.replace("_", "-"), table

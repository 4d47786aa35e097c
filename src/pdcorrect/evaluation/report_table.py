"""The table of a `Comparison`, and labels and numbers for readers."""

from __future__ import annotations

import numpy as np

from pdcorrect.evaluation.compare import Comparison, Row

_HEADINGS = (
    "solver", "nodes", "RMS mm", "worst mm", "corrected", "ms/frame", "speed-up", "iter."
)  # fmt: skip
_CONVERGED_FIRST = (
    "solver", "error", "ms/frame", "speed-up", "corrected", "RMS mm", "worst mm", "nodes", "iter."
)  # fmt: skip


def headings(comparison: Comparison) -> tuple[str, ...]:
    """Of `table`; where there is a converged motion, first the error to it."""
    found = _HEADINGS if comparison.converged is None else _CONVERGED_FIRST
    return found if comparison.finer is None else (found[0], "estimated", *found[1:])


def table(comparison: Comparison) -> list[tuple[str, ...]]:
    """The comparison as rows of text under `headings`."""
    order = headings(comparison)
    seconds = {row.label: row.seconds_a_frame for row in comparison.rows}[comparison.reference]
    shown = shown_labels(comparison)
    found = [
        {"solver": shown[row.label], **_cells(row, seconds, row.label == comparison.reference)}
        for row in comparison.rows
    ]
    failed = "error" if "error" in order else "RMS mm"
    found += [{"solver": label, failed: "failed"} for label in comparison.failures]
    return [tuple(cells.get(name, "") for name in order) for cells in found]


def _cells(row: Row, reference_seconds: float, is_reference: bool) -> dict[str, str]:
    distances = {
        "RMS mm": f"{1e3 * row.rms_error:.3g}",
        "worst mm": f"{1e3 * row.largest_error:.3g}",
        "corrected": _percent(row.omega),
    }
    return {
        "error": "" if row.relative_error is None else relative_text(row.relative_error),
        "estimated": "" if row.estimated_error is None else relative_text(row.estimated_error),
        "nodes": str(row.nodes),
        **(dict.fromkeys(distances, "ref.") if is_reference else distances),
        "ms/frame": three_digits(1e3 * row.seconds_a_frame),
        "speed-up": f"{three_digits(reference_seconds / row.seconds_a_frame)}x",
        "iter.": f"{row.iterations_a_frame:.1f}",
    }


def relative_text(share: float) -> str:
    """A share in per cent, with three significant digits."""
    return f"{three_digits(100.0 * share)} %"


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{round(share, 1) + 0.0:.1f} %"  # no minus zero


def three_digits(value: float) -> str:
    """A number with three significant digits and without powers of ten where it is large."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def shown_labels(comparison: Comparison) -> dict[str, str]:
    """Labels for readers: of a hybrid also how many of its corrections were refused."""
    shares = {row.label: refused_share(comparison, row) for row in comparison.rows}
    return {label: f"{label} ({share})" if share else label for label, share in shares.items()}


def refused_share(comparison: Comparison, row: Row) -> str:
    """As "3 of 40 refused" or "all refused"; empty where no correction was refused."""
    if not row.refused_frames:
        return ""
    frames = len(comparison.runs[row.label])
    every = row.refused_frames == frames
    return "all refused" if every else f"{row.refused_frames} of {frames} refused"

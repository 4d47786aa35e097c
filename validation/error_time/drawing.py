"""Error against time as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
from rows import FAMILIES, FITTED, Row, front

PLACES = ((7, 4), (7, -11), (-7, 4), (-7, -11), (7, 14), (-7, 14), (7, -21), (-7, -21))
"""Of a name beside its point, in points of the page, the best first."""


def draw(path: Path, rows: Sequence[Row], scale: float) -> None:
    """Error, per cent of the largest displacement, against time, with the Pareto front."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    best = front(rows)
    points = [(r.milliseconds, 100.0 * r.error / scale) for r in best]
    axis.step(*zip(*points, strict=True), where="post", color="0.6", label="Pareto front")
    for k, family in enumerate(FAMILIES):
        label: str | None = family
        for row in (r for r in rows if r.family == family):
            face = "none" if row.name == FITTED else common.COLOURS[k]
            axis.scatter(
                row.milliseconds, 100.0 * row.error / scale, 42, marker="osD^vP"[k], zorder=3,
                facecolors=face, edgecolors=common.COLOURS[k],
                label=None if row.name == FITTED else label,
            )  # fmt: skip
            label = label if row.name == FITTED else None
    common.plain_log_axes(axis, ("ms a frame", "RMS error, per cent of the largest displacement"))
    axis.margins(x=0.14, y=0.08)
    figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    last = [r for r in rows if r not in best and r.family != FAMILIES[3]]  # tolerances crowd
    named = [*(r for r in best if r.family != FAMILIES[3]), *last]
    write_names(axis, [(r.name, r.milliseconds, 100.0 * r.error / scale) for r in named])
    figure.savefig(path, dpi=150)


def write_names(axis: Any, points: Sequence[tuple[str, float, float]]) -> None:
    """Names beside points, those that come first where there is no room for all."""
    from matplotlib.transforms import Bbox

    axis.figure.canvas.draw()  # for the sizes of texts
    centres = axis.transData.transform([(x, y) for _, x, y in points])
    taken: list[Any] = [Bbox.from_bounds(x - 6, y - 6, 12, 12) for x, y in centres]
    for name, x, y in points:
        for dx, dy in PLACES:
            side = "left" if dx > 0 else "right"
            text = axis.annotate(
                name.removeprefix("hybrid, "), (x, y), (dx, dy), textcoords="offset points",
                fontsize=7.5, ha=side,
            )  # fmt: skip
            box = text.get_window_extent()
            inside = axis.bbox.x0 <= box.x0 and box.x1 <= axis.bbox.x1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()

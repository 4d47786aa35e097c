"""Plots of curves with matplotlib, always with units and never on a screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError, require_extra
from pdcorrect.figures.panels import picture_file
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_MARKS = "osD^vPX*"
_STYLES = ("-", "--", "-.", ":")  # of the first round of colours, the second and so on
_FONT = 9  # of legends, points

_ENERGIES = {
    "elastic_energy": "elastic [J]",
    "kinetic_energy": "kinetic [J]",
    "external_work": "work of the loads [J]",
}
_OTHER_WORK = {
    "clamp_work": "work of the clamps [J]",
    "obstacle_work": "work of the obstacles [J]",
    "actuator_work": "work of the actuators [J]",
    "damping_loss": "lost to damping [J]",
    "friction_loss": "lost to friction [J]",
}
"""Drawn where a run has any."""


def _axes(rows: int, height: float) -> tuple[Any, Any]:
    figure = require_extra("matplotlib.figure", "view").Figure(
        figsize=(7.5, height), layout="constrained"
    )
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(figure: Any, output: str | Path) -> Path:
    require_extra("matplotlib.backends.backend_agg", "view").FigureCanvasAgg(figure)
    suffix = Path(output).suffix[1:].lower()
    known = figure.canvas.get_supported_filetypes()
    if suffix not in known:
        raise InputError(f"{output}: expected a name ending in .{', .'.join(sorted(known))}.")
    with picture_file(Path(output)) as part:
        figure.savefig(part, dpi=150)
    return Path(output)


def _labelled(
    trajectories: Sequence[Trajectory] | Trajectory, labels: Sequence[str]
) -> list[tuple[Trajectory, str]]:
    runs = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    if not 0 < len(runs) == len(labels):
        raise InputError(f"{len(labels)} labels for {len(runs)} runs: expected as many, and some.")
    return list(zip(runs, labels, strict=True))


def _legend(figure: Any, axes: Sequence[Any]) -> None:
    """Above the axes, so that it hides nothing, in as many columns as fit.

    The figure grows by the rows beyond the first; a name that is wider than it is written smaller.
    """
    lines: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        lines |= dict(zip(labels, handles, strict=True))
    font, columns = _FONT, min(4, len(lines))
    while True:
        legend = figure.legend(
            lines.values(), lines, loc="outside upper center", ncols=columns, frameon=False,
            fontsize=font,
        )  # fmt: skip
        extent = legend.get_window_extent()
        if extent.width <= figure.bbox.width:
            break
        legend.remove()
        if columns > 1:
            columns -= 1
        else:
            font *= 0.95 * figure.bbox.width / extent.width
    rows = -(-len(lines) // columns)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + extent.height / figure.dpi * (rows - 1) / rows)


def _style(index: int) -> dict[str, Any]:
    turn, colour = divmod(index, len(_COLOURS))
    style = _STYLES[turn % len(_STYLES)]
    return {"color": _COLOURS[colour], "linestyle": style, "linewidth": 1.8}


def _curve(axis: Any, x: Array, y: Array, label: str, index: int) -> None:
    """A line with a few marks, at other places than those of its neighbours."""
    axis.plot(
        x, y, label=label, marker=_MARKS[index % len(_MARKS)], markersize=5,
        markevery=(0.02 * (index % 7), 0.14), **_style(index),
    )  # fmt: skip


def plot_node_trajectories(
    trajectories: Sequence[Trajectory] | Trajectory,
    output: str | Path,
    *,
    node_point: Sequence[float] | Array,
    labels: Sequence[str],
) -> Path:
    """Displacement in x, y, z over time of the node nearest to a rest point (m), each run."""
    runs, place = _labelled(trajectories, labels), np.asarray(node_point, dtype=np.float64)
    if place.shape != (3,):
        raise InputError(f"node_point has shape {place.shape}: expected three coordinates.")
    nodes = [int(np.linalg.norm(run.points - place, axis=1).argmin()) for run, _ in runs]
    histories = {
        label: (run.times, run.positions[:, node] - run.points[node])
        for (run, label), node in zip(runs, nodes, strict=True)
    }
    where = ", ".join(f"{x:.3g}" for x in runs[0][0].points[nodes[0]])
    return plot_displacements(histories, output, title=f"node at rest at ({where}) m")


def plot_displacements(
    histories: Mapping[str, tuple[Array, Array]], output: str | Path, *, title: str
) -> Path:
    """Displacement in x, y, z over time: by label, times (T,), s, and values (T, 3), m."""
    figure, axes = _axes(3, 7.0)
    for index, (label, (times, moved)) in enumerate(histories.items()):
        for axis, values, name in zip(axes, 1e3 * moved.T, "xyz", strict=True):
            _curve(axis, times, values, label, index)
            axis.set_ylabel(f"{name} displacement [mm]")
    axes[0].set_title(title, fontsize=11)
    _legend(figure, axes)
    axes[-1].set_xlabel("time [s]")
    return _save(figure, output)


def plot_energy(
    trajectories: Sequence[Trajectory] | Trajectory, output: str | Path, *, labels: Sequence[str]
) -> Path:
    """Elastic and kinetic energy and the work of the loads so far, over time, J.

    Likewise the work of clamps, obstacles and actuators and the losses, where there are any.
    """
    runs = _labelled(trajectories, labels)
    names = {name: t for name, t in _ENERGIES.items() if any(name in r.stats for r, _ in runs)}
    if not names:
        raise InputError(f"no run has any of {', '.join(_ENERGIES)} among its statistics.")
    for name, title in _OTHER_WORK.items():
        if any(name in run.stats and np.any(run.stats[name]) for run, _ in runs):
            names[name] = title
    figure, axes = _axes(len(names), 1.0 + 2.0 * len(names))
    for axis, (name, title) in zip(axes, names.items(), strict=True):
        axis.set_ylabel(title)
        for index, (run, label) in enumerate(runs):
            if name in run.stats:
                values = np.asarray(run.stats[name], dtype=np.float64)
                values = values if name.endswith("energy") else np.cumsum(values)
                _curve(axis, run.times[1:], values, label, index)
    _legend(figure, axes)
    axes[-1].set_xlabel("time [s]")
    return _save(figure, output)


def plot_error_over_time(
    errors: Mapping[str, Array], times: Array, output: str | Path, truth: str = "reference"
) -> Path:
    """RMS node distance (m) from what ``truth`` names over time, one curve a label."""
    for label, values in errors.items():
        if values.shape != times.shape:
            raise InputError(f"{label}: {values.shape} errors at {times.shape} times.")
    figure, (axis,) = _axes(1, 4.0)
    for index, (label, values) in enumerate(errors.items()):
        _curve(axis, times[1:], 1e3 * values[1:], label, index)
    axis.set_ylabel(f"RMS distance from the {truth} [mm]")
    axis.set_xlabel("time [s]")
    axis.set_ylim(bottom=0)
    _legend(figure, [axis])
    return _save(figure, output)


def plot_error_against_time(
    points: Mapping[str, tuple[float | Array, float | Array]],
    output: str | Path,
    relative: bool = False,
) -> Path:
    """RMS error (m) against seconds a frame, both axes logarithmic, one kind of mark a label.

    ``relative``: errors are shares of the motion and shown in per cent.
    """
    figure, (axis,) = _axes(1, 4.2)
    for index, (label, (seconds, error)) in enumerate(points.items()):
        axis.loglog(
            1e3 * seconds, (100 if relative else 1e3) * error, _MARKS[index % len(_MARKS)],
            markersize=9, label=label, color=_COLOURS[index % len(_COLOURS)],
        )  # fmt: skip
    axis.set_xlabel("time a frame [ms]")
    axis.set_ylabel("error to the converged motion [%]" if relative else "RMS error [mm]")
    axis.margins(0.25)
    ticker = require_extra("matplotlib.ticker", "view")
    for direction in (axis.xaxis, axis.yaxis):
        direction.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        direction.set_major_formatter("{x:g}")
        direction.set_minor_formatter(ticker.NullFormatter())
    _legend(figure, [axis])
    return _save(figure, output)


_BINS = 24


def plot_omega(values: Mapping[str, Sequence[float]], output: str | Path) -> Path:
    """Histograms over trajectories of Omega, per cent, one outline a model."""
    if not values or not all(len(found) for found in values.values()):
        raise InputError("Omega by model: expected one model or more, each with values.")
    edges = np.histogram_bin_edges(np.concatenate([*map(np.asarray, values.values())]), _BINS)
    figure, (axis,) = _axes(1, 4.0)
    for index, (label, found) in enumerate(values.items()):
        axis.hist(found, edges, histtype="step", label=label, **_style(index))
    axis.axvline(0.0, color="0.5", linewidth=0.8)
    axis.set_xlabel("share of the plain run's squared error removed [%]")
    axis.set_ylabel("trajectories")
    _legend(figure, [axis])
    return _save(figure, output)

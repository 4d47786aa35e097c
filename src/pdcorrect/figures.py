"""Off-screen pictures of bodies (pyvista) and plots of curves (matplotlib).

Both libraries are loaded when a function needs them.  All panels of a picture
share one camera (parallel projection), one colour scale and one length scale.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError, OutputError, require_extra
from pdcorrect.fem.mesh import coincident_nodes
from pdcorrect.state import Trajectory

Array = NDArray[np.float64]
Colour = Literal["displacement", "error"]

_VIEW = np.array([-0.55, -1.0, 0.55])
"""From the body to the camera."""
_PALETTES = {"displacement": "viridis", "error": "inferno"}
_TITLES = {"displacement": "displacement [mm]", "error": "distance from the reference [mm]"}
_PANEL = (560, 560)
_BAR = 110
"""Pixels below the panels for colour bar and scale."""
_MARGIN = 1.06


@dataclass(frozen=True, eq=False)
class _Panel:
    """What one panel shows: values (T+1, N) to colour by, or None."""

    run: Trajectory
    label: str
    values: Array | None


def render(
    trajectories: Sequence[Trajectory] | Trajectory,
    output: str | Path,
    *,
    labels: Sequence[str] | None = None,
    colour: Colour | None = "displacement",
    reference: Trajectory | None = None,
    frame: int | None = None,
    fps: float = 25.0,
    scale: float = 1.0,
) -> Path:
    """Draw one run or several side by side, without a screen.

    Parameters
    ----------
    trajectories : Trajectory or sequence of Trajectory
    output : path
        ``.png`` for one frame; ``.gif`` or ``.mp4`` for all.
    labels : sequence of str, optional
        Panel titles; may have several lines.
    colour : {"displacement", "error"}, optional
        Distance from rest, or from ``reference`` at the nodes it shares, in mm;
        None draws plain bodies.
    reference : Trajectory, optional
        For ``colour = "error"``; its mesh may be finer or coarser.
    frame : int, optional
        The frame of a PNG; the last by default.
    fps : float
        Frames a second of a film.
    scale : float
        Size factor of the picture.

    Returns
    -------
    Path
        ``output``.

    Raises
    ------
    InputError
        If labels, frame, suffix or reference do not fit.
    OutputError
        If the file cannot be written.
    MissingExtraError
        Without the extra "view".
    """
    runs = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    output = Path(output)
    panels = _panels(runs, labels, colour, reference)
    last = min(len(run.times) for run in runs) - 1
    film = output.suffix.lower() in (".gif", ".mp4")
    if output.suffix.lower() not in (".png", ".gif", ".mp4"):
        raise InputError(f"{output}: expected a name ending in .png, .gif or .mp4.")
    if frame is not None and not -last - 1 <= frame <= last:
        raise InputError(f"frame {frame}: expected -{last + 1} to {last}.")
    if not output.parent.is_dir():
        raise OutputError(f"{output}: the folder {output.parent} does not exist.")
    first = (last if frame is None else frame) % (last + 1)
    frames = range(last + 1) if film else range(first, first + 1)
    stage = _Stage(panels, frames, colour, scale)
    try:
        if film:
            stage.film(output, frames, fps)
        else:
            stage.picture(output, frames[0])
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error}).") from error
    finally:
        stage.close()
    return output


def _panels(
    runs: list[Trajectory],
    labels: Sequence[str] | None,
    colour: Colour | None,
    reference: Trajectory | None,
) -> list[_Panel]:
    if not runs:
        raise InputError("render: expected at least one trajectory.")
    if labels is not None and len(labels) != len(runs):
        raise InputError(f"{len(labels)} labels for {len(runs)} runs: expected as many.")
    if colour not in (None, "displacement", "error"):
        raise InputError(f"colour = {colour!r}: expected 'displacement', 'error' or None.")
    if colour == "error" and reference is None:
        raise InputError("colour = 'error': expected a reference trajectory.")
    names = list(labels) if labels is not None else [""] * len(runs)
    panels = []
    for run, name in zip(runs, names, strict=True):
        values = None
        if colour == "displacement":
            values = np.linalg.norm(run.positions - run.points, axis=2)
        elif reference is not None and colour == "error":
            run, values = _distance(run, reference)
        panels.append(_Panel(run, name, values))
    return panels


def _distance(run: Trajectory, reference: Trajectory) -> tuple[Trajectory, Array]:
    """The run on the nodes it shares with the reference, and its distance from it."""
    from pdcorrect.solvers.rollout import restrict

    if len(run.points) > len(reference.points):
        run = restrict(run, to=reference)
    tolerance = 1e-6 * float(np.ptp(run.points[run.cells[0]], axis=0).max())
    nodes = coincident_nodes(reference.points, run.points, tolerance)
    frames = min(len(run.times), len(reference.times))
    difference = run.positions[:frames] - reference.positions[:frames, nodes]
    return run, np.linalg.norm(difference, axis=2)


def _pyvista() -> Any:
    """pyvista, without VTK's warning that there is no X server."""
    pyvista = require_extra("pyvista", "view")
    logger = require_extra("vtkmodules.vtkCommonCore", "view").vtkLogger
    logger.SetStderrVerbosity(logger.VERBOSITY_ERROR)
    return pyvista


class _Stage:
    """A pyvista plotter with one panel a run above a strip with colour bar and scale."""

    def __init__(
        self, panels: list[_Panel], frames: range, colour: Colour | None, scale: float
    ) -> None:
        self._pv = _pyvista()
        self._panels, self._frames, self._colour = panels, frames, colour
        self._size = scale
        count = len(panels)
        width = int(_PANEL[0] * count * scale)
        height = int((_PANEL[1] + _BAR) * scale)
        share = _PANEL[1] / (_PANEL[1] + _BAR)
        self._plotter = self._pv.Plotter(
            off_screen=True,
            window_size=(max(width, 2), max(height, 2)),
            shape=(2, count),
            groups=[(1, slice(None))],
            row_weights=[share, 1 - share],
            border=False,
            lighting="light kit",
        )
        self._plotter.set_background("white")
        self._limits = self._colour_limits()
        self._grids = [self._add_body(i, panel) for i, panel in enumerate(panels)]
        self._clocks: list[Any] = []
        self._aim()
        self._add_strip()

    def picture(self, output: Path, frame: int) -> None:
        self._show(frame)
        self._plotter.screenshot(str(output))

    def film(self, output: Path, frames: range, fps: float) -> None:
        if output.suffix.lower() == ".gif":
            require_extra("imageio", "view")
            self._plotter.open_gif(str(output), fps=fps, loop=0)
        else:
            require_extra("imageio_ffmpeg", "view")
            self._plotter.open_movie(str(output), framerate=fps, quality=7)
        for frame in frames:
            self._show(frame)
            self._plotter.write_frame()

    def close(self) -> None:
        self._plotter.close()

    def _colour_limits(self) -> tuple[float, float]:
        tops = [p.values[list(self._frames)].max() for p in self._panels if p.values is not None]
        return 0.0, 1e3 * float(max([*tops, 1e-9]))

    def _add_body(self, column: int, panel: _Panel) -> Any:
        pv, plotter = self._pv, self._plotter
        plotter.subplot(0, column)
        run = panel.run
        cells = run.cells[:, :8]
        grid = pv.UnstructuredGrid({pv.CellType.HEXAHEDRON: cells}, run.points.copy())
        outline = grid.extract_surface(algorithm="dataset_surface").extract_feature_edges(30)
        plotter.add_mesh(outline, color="#b5b5b5", line_width=1.5 * self._size)
        style: dict[str, Any] = {"color": "#7f9fc4"}
        if panel.values is not None and self._colour is not None:
            grid["value"] = np.zeros(len(run.points))
            style = {
                "scalars": "value",
                "cmap": _PALETTES[self._colour],
                "clim": self._limits,
                "show_scalar_bar": False,
            }
        dense = len(cells) > 3000
        plotter.add_mesh(
            grid,
            show_edges=True,
            edge_color="#303030",
            edge_opacity=0.25 if dense else 0.7,
            line_width=(0.6 if dense else 1.2) * self._size,
            smooth_shading=False,
            ambient=0.25,
            **style,
        )
        return grid

    def _aim(self) -> None:
        """One parallel camera for all panels, fitted to the rest shape and every frame shown."""
        points = [p.run.points for p in self._panels]
        points += [p.run.positions[list(self._frames)].reshape(-1, 3) for p in self._panels]
        cloud = np.concatenate(points)
        back = self._back = _VIEW / np.linalg.norm(_VIEW)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        up = np.cross(back, right)
        flat = cloud @ np.stack([right, up, back]).T
        low, high = flat.min(axis=0), flat.max(axis=0)
        middle = (0.5 * (low + high)) @ np.stack([right, up, back])
        size = float(np.linalg.norm(high - low))
        # the text at the top takes a sixth of the panel
        half_width, half_height = 0.5 * _MARGIN * (high - low)[:2]
        self._half = max(half_width * _PANEL[1] / _PANEL[0], half_height / 0.80)
        middle = middle + 0.17 * self._half * up
        for column in range(len(self._panels)):
            self._plotter.subplot(0, column)
            camera = self._plotter.camera
            camera.focal_point = middle
            camera.position = middle + 3 * size * back
            camera.up = up
            camera.parallel_projection = True
            camera.parallel_scale = self._half
            camera.clipping_range = (0.01 * size, 10 * size)

    def _add_strip(self) -> None:
        """Colour bar, length scale and axes below the panels."""
        plotter, count = self._plotter, len(self._panels)
        for column, panel in enumerate(self._panels):
            plotter.subplot(0, column)
            title = plotter.add_text(
                panel.label or " ", position=(0.03, 0.97), viewport=True,
                font_size=self._font(11), color="black",
            )  # fmt: skip
            title.prop.justification_vertical = "top"
            self._clocks.append(
                plotter.add_text(
                    " ",
                    position=(0.03, 0.03),
                    viewport=True,
                    font_size=self._font(10),
                    color="#404040",
                )
            )
        self._add_ruler()
        plotter.subplot(1, 0)
        plotter.camera.position = self._back
        plotter.camera.focal_point = (0.0, 0.0, 0.0)
        plotter.camera.up = (0.0, 0.0, 1.0)
        share = _BAR / (_PANEL[0] * count)
        plotter.add_axes(
            viewport=(0.01, 0.0, 0.01 + share, 1.0), interactive=False, color="black", line_width=2
        )
        if self._colour is None:
            return
        anchor = self._pv.Plane(i_size=1e-6, j_size=1e-6)
        anchor["value"] = np.zeros(anchor.n_points)
        actor = plotter.add_mesh(
            anchor, scalars="value", cmap=_PALETTES[self._colour], clim=self._limits,
            show_scalar_bar=False, opacity=0.0,
        )  # fmt: skip
        width = 0.7 if count == 1 else 0.5
        left = 0.5 * (1 - width) + (0.1 if count == 1 else 0.0)
        plotter.add_text(
            _TITLES[self._colour], position=(left, 0.76), viewport=True,
            font_size=self._font(10), color="black",
        )  # fmt: skip
        plotter.add_scalar_bar(
            title="",
            mapper=actor.mapper,
            vertical=False,
            width=width,
            height=0.6,
            position_x=left,
            position_y=0.14,
            n_labels=5,
            fmt="%.3g",
            label_font_size=int(16 * self._size),
            color="black",
        )

    def _add_ruler(self) -> None:
        """A bar of round length in the lower right corner of the first panel."""
        length = _round_length(0.6 * self._half)
        plotter = self._plotter
        plotter.subplot(0, 0)
        camera = plotter.camera
        middle, up = np.array(camera.focal_point), np.array(camera.up)
        back = np.array(camera.position) - middle
        right = np.cross(up, back / np.linalg.norm(back))
        aspect = _PANEL[0] / _PANEL[1]
        end = middle + self._half * (0.93 * aspect * right - 0.86 * up)
        line = self._pv.Line(end - length * right, end)
        plotter.add_mesh(line, color="black", line_width=4 * self._size)
        text = f"{1e3 * length:g} mm" if length < 0.1 else f"{length:g} m"
        share = 0.5 * (1 + 0.93 - length / self._half / aspect)
        plotter.add_text(
            text, position=(share, 0.085), viewport=True, font_size=self._font(10), color="black"
        )

    def _font(self, points: int) -> int:
        return max(6, int(points * self._size))

    def _show(self, frame: int) -> None:
        for grid, panel, clock in zip(self._grids, self._panels, self._clocks, strict=True):
            grid.points = panel.run.positions[frame]
            if panel.values is not None:
                grid["value"] = 1e3 * panel.values[frame]
            clock.SetInput(f"t = {panel.run.times[frame]:.3f} s")
        self._plotter.render()


def _round_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-12)))


# --- curves --------------------------------------------------------------------------

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_STYLES = ("-", "--", "-.", ":")


def _axes(rows: int, height: float) -> tuple[Any, Any]:
    matplotlib = require_extra("matplotlib", "view")
    matplotlib.use("Agg")
    plt = require_extra("matplotlib.pyplot", "view")
    figure, axes = plt.subplots(
        rows, 1, sharex=True, figsize=(7.5, height), layout="constrained", squeeze=False
    )
    for axis in axes[:, 0]:
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes[:, 0]


def _save(figure: Any, output: str | Path) -> Path:
    plt = require_extra("matplotlib.pyplot", "view")
    try:
        figure.savefig(output, dpi=150)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error}).") from error
    finally:
        plt.close(figure)
    return Path(output)


def _style(index: int) -> dict[str, Any]:
    return {
        "color": _COLOURS[index % len(_COLOURS)],
        "linestyle": _STYLES[index % len(_STYLES)],
        "linewidth": 1.8,
    }


def plot_node_trajectories(
    trajectories: Sequence[Trajectory],
    output: str | Path,
    *,
    node_point: Sequence[float] | Array,
    labels: Sequence[str],
) -> Path:
    """Displacement in x, y, z over time of the node nearest to a rest point (m), each run."""
    figure, axes = _axes(3, 7.0)
    for index, (run, label) in enumerate(zip(trajectories, labels, strict=True)):
        node = int(np.linalg.norm(run.points - np.asarray(node_point), axis=1).argmin())
        moved = 1e3 * (run.positions[:, node] - run.points[node])
        for axis, values, name in zip(axes, moved.T, "xyz", strict=True):
            axis.plot(run.times, values, label=label, **_style(index))
            axis.set_ylabel(f"{name} displacement [mm]")
    place = ", ".join(f"{x:.3g}" for x in np.asarray(node_point))
    axes[0].set_title(f"node at rest at ({place}) m", fontsize=11)
    axes[0].legend(frameon=False, fontsize=9)
    axes[-1].set_xlabel("time [s]")
    return _save(figure, output)


def plot_energy(
    trajectories: Sequence[Trajectory], output: str | Path, *, labels: Sequence[str]
) -> Path:
    """Elastic and kinetic energy and the work of the loads over time, each run, J."""
    figure, axes = _axes(3, 7.0)
    names = {
        "elastic_energy": "elastic [J]",
        "kinetic_energy": "kinetic [J]",
        "external_work": "work of the loads [J]",
    }
    for index, (run, label) in enumerate(zip(trajectories, labels, strict=True)):
        missing = set(names) - set(run.stats)
        if missing:
            raise InputError(f"{label}: the run has no {', '.join(sorted(missing))}.")
        for axis, (name, title) in zip(axes, names.items(), strict=True):
            values = np.asarray(run.stats[name], dtype=np.float64)
            values = np.cumsum(values) if name == "external_work" else values
            axis.plot(run.times[1:], values, label=label, **_style(index))
            axis.set_ylabel(title)
    axes[0].legend(frameon=False, fontsize=9)
    axes[-1].set_xlabel("time [s]")
    return _save(figure, output)


def plot_error_over_time(errors: Mapping[str, Array], times: Array, output: str | Path) -> Path:
    """RMS node distance (m) from the reference over time, one curve a label."""
    figure, (axis,) = _axes(1, 4.0)
    for index, (label, values) in enumerate(errors.items()):
        axis.plot(times[1:], 1e3 * values[1:], label=label, **_style(index))
    axis.set_ylabel("RMS distance from the reference [mm]")
    axis.set_xlabel("time [s]")
    axis.set_ylim(bottom=0)
    axis.legend(frameon=False, fontsize=9)
    return _save(figure, output)


def plot_error_against_time(points: Mapping[str, tuple[float, float]], output: str | Path) -> Path:
    """RMS error (m) against seconds a frame, both axes logarithmic, one mark a label."""
    figure, (axis,) = _axes(1, 4.2)
    for index, (label, (seconds, error)) in enumerate(points.items()):
        axis.loglog(
            1e3 * seconds, 1e3 * error, "o", markersize=9, label=label,
            color=_COLOURS[index % len(_COLOURS)],
        )  # fmt: skip
    axis.set_xlabel("time a frame [ms]")
    axis.set_ylabel("RMS error [mm]")
    axis.margins(0.25)
    ticker = require_extra("matplotlib.ticker", "view")
    for direction in (axis.xaxis, axis.yaxis):
        direction.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        direction.set_major_formatter("{x:g}")
        direction.set_minor_formatter(ticker.NullFormatter())
    axis.legend(frameon=False, fontsize=9)
    return _save(figure, output)


# --- is there a way to draw? -----------------------------------------------------------

_PROBE = """
import pyvista as pv
plotter = pv.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pv.Cube(), color="red")
image = plotter.screenshot(return_img=True)
assert image.reshape(-1, 3).std() > 0
window = plotter.render_window
lines = window.ReportCapabilities().splitlines() if window else []
found = [line.split(":", 1)[1].strip() for line in lines if "renderer string" in line]
print(pv.__version__, type(window).__name__, found[0] if found else "")
"""


def check_offscreen(timeout: float = 120.0) -> str:
    """Draw a cube in another process, which may crash: "ok (...)" or what to install."""
    remedy = (
        "install EGL with `apt-get install libegl1 libgl1` (Debian, Ubuntu) or use a VTK built "
        "with OSMesa"
    )
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=timeout
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {timeout:g} s; {remedy}"
    if probe.returncode == 0:
        return f"ok ({' '.join(probe.stdout.split())})"
    last = probe.stderr.strip().splitlines()[-1:] or [f"exit status {probe.returncode}"]
    return f"failed ({last[0]}); {remedy}"

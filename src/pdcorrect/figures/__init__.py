"""Off-screen pictures of bodies (pyvista) and plots of curves (matplotlib).

Both libraries are loaded when a function needs them.  All panels of a picture
share one camera (parallel projection), one colour scale and one length scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import InputError
from pdcorrect.figures.curves import (
    plot_displacements,
    plot_energy,
    plot_error_against_time,
    plot_error_over_time,
    plot_node_trajectories,
)
from pdcorrect.figures.fields import COLOURS, Colour, body_of, on_nodes_of, scaled
from pdcorrect.figures.obstacles import obstacles_of
from pdcorrect.figures.panels import (
    Body,
    Camera,
    Direction,
    Image,
    Painter,
    camera_axes,
    check_offscreen,
    picture_file,
    shown_points,
    write_film,
    write_png,
)
from pdcorrect.figures.sheet import ColourBar, Sheet, height_of_text
from pdcorrect.trajectory import Trajectory

__all__ = [
    "check_offscreen",
    "plot_displacements",
    "plot_energy",
    "plot_error_against_time",
    "plot_error_over_time",
    "plot_node_trajectories",
    "render",
    "render_overlay",
]

_OVERLAID = ("#aab2bd", "#0058a0", "#d55e00", "#009e73", "#96457a", "#b08900")
"""Grey of the body that is filled, then blue, orange, green, purple and ochre."""
_STILL, _FILM = 1600, 1000  # default widths of pictures and films, pixels
_ROW = 5  # panels side by side in a picture, at most


def render(
    trajectories: Sequence[Trajectory] | Trajectory,
    output: str | Path,
    *,
    labels: Sequence[str] | None = None,
    colour: Colour | None = "displacement",
    reference: Trajectory | None = None,
    frame: int | Sequence[int] | None = None,
    fps: float = 25.0,
    window: int | None = None,
    size: tuple[int, int] | None = None,
    camera: str | Direction | None = None,
    warp: float = 1.0,
    section: tuple[str, float] | None = None,
) -> Path:
    """Draw one run or several side by side, without a screen.

    Runs are compared at the times that all of them have.  Obstacles of a run's scene are drawn
    where they are at that time.

    Parameters
    ----------
    trajectories : Trajectory or sequence of Trajectory
    output : path
        ``.png`` for a picture; ``.gif`` or ``.mp4`` for a film.
    labels : sequence of str, optional
        One for each run; may have several lines.
    colour : {"displacement", "error", "stress", "volume"}, optional
        Distance from rest, or from ``reference`` at the nodes that both have; von Mises stress or
        det F, averaged to the nodes, of runs that hold their scene; None draws plain bodies.  A run
        finer than the reference is drawn with the reference's cells.
    reference : Trajectory, optional
        For ``colour = "error"``; its mesh may be finer or coarser.
    frame : int or sequence of int, optional
        Which of the common frames; negative ones count from the end.  By
        default the last one in a picture, all in a film.  Several in a picture of several runs
        are drawn in rows below each other.  More than five frames of one run, or runs in one
        frame, are drawn in several rows.
    fps : float
        Frames a second of a film.
    window : int, optional
        Width of the picture in pixels; the height and the size of the text follow.
    size : (int, int), optional
        Width and height of the picture in pixels, in place of ``window``.
    camera : {"x", "y", "z", "iso"} or (float, float), optional
        Where it is looked from: along an axis, or azimuth (from x towards y) and elevation,
        degrees.
    warp : float
        Displacements are drawn that many times as large; obstacles stay.
    section : (str, float), optional
        Axis and place, m: a plane through the body at rest; cells whose centre is on the camera's
        side of it are left out, of all bodies of a scene.

    Returns
    -------
    Path
        ``output``.

    Raises
    ------
    InputError
        If labels, frames, suffix, times, reference, camera, section or size do not fit, or a run
        does not hold what stress is computed from.
    OutputError
        If the file cannot be written.
    MissingExtraError
        Without the extra "view".
    """
    runs = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    output = Path(output)
    film = _check_arguments(runs, output, labels, colour, reference)
    names = list(labels) if labels is not None else [""] * len(runs)
    shared = _common_frames([*runs, reference] if colour == "error" and reference else runs)
    chosen = shared[:, _choose(frame, shared.shape[1], film)]
    axes = camera_axes(camera)
    bodies, bar = _coloured(runs, chosen, colour, reference)
    bodies = [_shown(body, warp, section, axes) for body in bodies]
    count, side = chosen.shape[1], len(runs)
    panels = [(body, time) for time in range(count) for body in range(side)]
    a_page = side if film else len(panels)
    in_rows = film or side == 1 or count == 1
    columns = -(-a_page // -(-a_page // _ROW)) if in_rows else side  # about as many in each row
    captions, rest = names + [""] * (a_page - side), _moves(bodies)
    width, height = size or (window or _usual_width(columns, film), None)
    view = _view(shown_points(bodies, rest), axes, captions, columns, width, height)
    longest = max(float(body.run.times[body.frames].max()) for body in bodies)
    font = _font(width, columns)
    sheet = Sheet(view, captions, columns, bar, font, longest=longest, size=size)
    palette, limits = (bar.palette, (bar.low, bar.limit)) if bar else ("viridis", (0.0, 1.0))
    with closing(Painter(bodies, view, palette, limits, rest)) as painter:
        parts = [panels[start : start + a_page] for start in range(0, len(panels), a_page)]
        _write(output, (_page(painter, sheet, bodies, part) for part in parts), film, fps)
    return output


def _coloured(
    runs: list[Trajectory],
    chosen: NDArray[np.int64],
    colour: Colour | None,
    reference: Trajectory | None,
) -> tuple[list[Body], ColourBar | None]:
    """Runs at their chosen frames (runs, n) as bodies with obstacles, and their colour scale."""
    bodies = [
        replace(body_of(run, frames, colour, reference, chosen[-1]), obstacles=obstacles_of(run))
        for run, frames in zip(runs, chosen, strict=False)
    ]
    return scaled(bodies, colour) if colour else (bodies, None)


def _view(
    points: NDArray[np.float64],
    axes: NDArray[np.float64],
    captions: Sequence[str],
    columns: int,
    width: int,
    height: int | None,
) -> Camera:
    """The camera of panels that fill a width with their captions, and a height if one is given."""
    if height is not None:
        rows = -(-len(captions) // columns)
        room = height - height_of_text(captions, columns, _font(width, columns))
        if room < 16 * rows:
            raise InputError(
                f"size {(width, height)}: expected more room for the bodies beside the text."
            )
        height = room // rows
    return Camera.fitted(points, max(16, width // columns), axes, height)


def _page(
    painter: Painter, sheet: Sheet, bodies: list[Body], panels: list[tuple[int, int]]
) -> Image:
    """A sheet of panels, each a body at one of its times."""
    times = [float(bodies[body].run.times[bodies[body].frames[time]]) for body, time in panels]
    return sheet.page([painter.image(body, time) for body, time in panels], times)


def _write(output: Path, pages: Iterator[Image], film: bool, fps: float) -> None:
    with picture_file(output) as part:
        if film:
            write_film(part, pages, fps)
        else:
            write_png(part, next(pages))


def render_overlay(
    trajectories: Sequence[Trajectory],
    output: str | Path,
    *,
    labels: Sequence[str],
    frame: int = -1,
    window: int = 1200,
    camera: str | Direction | None = None,
) -> Path:
    """Draw runs over each other in one picture, each in a colour of its own; returns ``output``.

    The first is filled, of the others the edges are drawn.  Two to six runs, on meshes that hold
    the nodes of the coarsest, are drawn with its cells, so that the same cells compare.
    For the other arguments see `render`; one frame, ``.png`` only.

    Raises
    ------
    InputError, OutputError, MissingExtraError
        As by `render`, and if the meshes do not fit.
    """
    runs, output = list(trajectories), Path(output)
    if _check_arguments(runs, output, labels, None, None):
        raise InputError(f"{output}: expected a name ending in .png.")
    if not 2 <= len(runs) <= len(_OVERLAID):
        raise InputError(f"{len(runs)} runs: expected two to {len(_OVERLAID)}.")
    shared = _common_frames(runs)
    (place,) = _choose(frame, shared.shape[1], film=False)
    coarsest = min(runs, key=lambda run: len(run.points))
    bodies = [
        Body(on_nodes_of(run, coarsest), frames[[place]], None)
        for run, frames in zip(runs, shared, strict=True)
    ]
    bodies[0] = replace(bodies[0], obstacles=obstacles_of(runs[0]))
    points, colours = shown_points(bodies, rest=False), _OVERLAID[: len(runs)]
    view = Camera.fitted(points, window, camera_axes(camera))
    time = float(runs[0].times[shared[0, place]])
    key = list(zip(labels, colours, strict=True))
    sheet = Sheet(view, [""], 1, None, _font(window, 2), longest=time, key=key)
    drawn = Painter(bodies, view, "viridis", (0.0, 1.0), rest=False, colours=colours)
    with closing(drawn) as painter, picture_file(output) as part:
        write_png(part, sheet.page([painter.overlay(0)], [time]))
    return output


def _usual_width(columns: int, film: bool) -> int:
    return 900 if columns == 1 else _FILM if film else _STILL


def _shown(
    body: Body, warp: float, section: tuple[str, float] | None, axes: NDArray[np.float64]
) -> Body:
    """A body as it is drawn: cut and with displacements of another size."""
    if section is not None:
        name, place = section
        if name not in ("x", "y", "z"):
            raise InputError(f"section {name!r}: expected x, y or z.")
        body = body.cut("xyz".index(name), place, axes)
    return body if warp == 1.0 else body.warped(warp)


def _font(width: int, columns: int) -> float:
    """Height of the text: a sixtieth of a picture, and of many panels an eighteenth of one."""
    if columns > 2:
        return min(width / 62, width / columns / 18)
    return width / 50 if columns == 2 else width / 36


def _check_arguments(
    runs: list[Trajectory],
    output: Path,
    labels: Sequence[str] | None,
    colour: Colour | None,
    reference: Trajectory | None,
) -> bool:
    """Whether the output is a film."""
    if not runs:
        raise InputError("render: expected at least one trajectory.")
    if labels is not None and len(labels) != len(runs):
        raise InputError(f"{len(labels)} labels for {len(runs)} runs: expected as many.")
    if colour not in (None, *COLOURS):
        raise InputError(f"colour = {colour!r}: expected one of {', '.join(COLOURS)}, or None.")
    if colour == "error" and reference is None:
        raise InputError("colour = 'error': expected a reference trajectory.")
    suffix = output.suffix.lower()
    if suffix not in (".png", ".gif", ".mp4"):
        raise InputError(f"{output}: expected a name ending in .png, .gif or .mp4.")
    return suffix != ".png"


def _common_frames(runs: list[Trajectory]) -> NDArray[np.int64]:
    """Frames (runs, n) of the times that all runs have."""
    times = runs[0].times
    tolerance = 1e-6 * float(np.diff(times).min()) if len(times) > 1 else 1e-9
    frames = []
    for run in runs:
        after = np.clip(np.searchsorted(run.times, times), 1, max(1, len(run.times) - 1))
        near = np.stack([after - 1, np.minimum(after, len(run.times) - 1)])
        best = np.abs(run.times[near] - times).argmin(axis=0)
        frames.append(near[best, np.arange(len(times))])
    found = np.array(frames, dtype=np.int64)
    gaps = np.array([np.abs(r.times[f] - times) for r, f in zip(runs, found, strict=True)])
    common = found[:, (gaps <= tolerance).all(axis=0)]
    if not common.shape[1]:
        raise InputError("the runs have no time in common: expected some.")
    return common


def _choose(frame: int | Sequence[int] | None, count: int, film: bool) -> list[int]:
    """Places among ``count`` common frames."""
    if frame is None:
        return list(range(count)) if film else [count - 1]
    wanted = [frame] if isinstance(frame, (int, np.integer)) else list(frame)
    if not wanted:
        raise InputError("frame is an empty list: expected at least one frame.")
    for number in wanted:
        if not -count <= number < count:
            raise InputError(f"frame {number}: expected {-count} to {count - 1}.")
    return [int(number) % count for number in wanted]


def _moves(bodies: list[Body]) -> bool:
    """Whether some body is seen away from rest, by a hundredth of its size."""
    return any(
        np.abs(body.run.positions[body.frames] - body.run.points).max()
        > 0.01 * np.ptp(body.run.points, axis=0).max()
        for body in bodies
    )

"""One body in one picture: camera, surface, colours; picture files (pyvista, off-screen).

All panels share a camera with parallel projection, so that lengths compare.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect._files import replacing
from pdcorrect.errors import InputError, OutputError, require_extra
from pdcorrect.fem.hexahedron import VTK_EDGES
from pdcorrect.fem.mesh import boundary_faces
from pdcorrect.fem.obstacles import RigidObstacle
from pdcorrect.figures.obstacles import Surface
from pdcorrect.trajectory import Trajectory

Array = NDArray[np.float64]
Direction = tuple[float, float]
VIEWS: dict[str, Direction] = {
    "x": (0.0, 0.0), "y": (-90.0, 0.0), "z": (-90.0, 90.0), "iso": (45.0, 35.2644)
}  # fmt: skip
"""Named cameras: azimuth from x towards y, and elevation above the plane x, y, degrees."""
_USUAL: Direction = -118.8, 23.7
_MARGIN = 0.04  # of the panel's width, kept free on each side
_SHAPES = 0.42, 1.25  # smallest and largest height of a panel, in widths
_OVERSAMPLING = 2
_LIGHTS = ((-0.3, 0.6, 1.0), 0.75), ((0.6, -0.5, 1.0), 0.5)
"""Places (right, up, towards the camera) and strengths."""

_WINDOW = "VTK_DEFAULT_OPENGL_WINDOW"
"""Variable of the environment that VTK reads."""
_PLAIN, _INK, OBSTACLE = "#7f9fc4", "#202020", "#7d8590"
_NEAR = 0.6  # of the body's diagonal: what is seen of obstacles around it


@dataclass(frozen=True, eq=False)
class Body:
    """What a panel shows: a run at frames (n,), nodes coloured by values (n, N) or not."""

    run: Trajectory
    frames: NDArray[np.int64]
    values: Array | None
    obstacles: tuple[RigidObstacle, ...] = ()

    @property
    def positions(self) -> Array:
        """Of its nodes in its frames, (n, N, 3), m."""
        return self.run.positions[self.frames]

    def warped(self, factor: float) -> Body:
        """With displacements that many times as large."""
        moved = self.run.points + factor * (self.run.positions - self.run.points)
        return replace(self, run=replace(self.run, positions=moved))

    def cut(self, axis: int, place: float, axes: Array) -> Body:
        """Without the cells on the camera's side of a plane through the body at rest.

        A cell is on the side of its centre; ``axes`` are the camera's.
        """
        run = self.run
        centres = run.points[run.cells].mean(axis=1)[:, axis]
        kept = run.cells[centres < place if axes[2, axis] > 0.0 else centres > place]
        if not len(kept):
            name = "xyz"[axis]
            raise InputError(
                f"section {name} = {place:g}: no cell is left behind it: expected a place between "
                f"{run.points[:, axis].min():g} and {run.points[:, axis].max():g} m."
            )
        nodes, cells = np.unique(kept, return_inverse=True)
        run = replace(
            run, points=run.points[nodes], positions=run.positions[:, nodes],
            velocities=run.velocities[:, nodes], cells=cells.reshape(kept.shape),
        )  # fmt: skip
        return replace(self, run=run, values=None if self.values is None else self.values[:, nodes])


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera fitted to points.

    Rows of ``axes`` (3, 3) point to the right, upwards and towards the camera; ``low`` and ``high``
    (3,) are corners of what is seen in these directions, m; ``size`` is in pixels.
    """

    axes: Array
    low: Array
    high: Array
    size: tuple[int, int]

    @classmethod
    def fitted(cls, points: Array, width: int, axes: Array, height: int | None = None) -> Camera:
        """Show all points (n, 3) in panels of ``width`` pixels, and of ``height`` or what fits."""
        flat = points @ axes.T
        low, high = flat.min(axis=0), flat.max(axis=0)
        extent = np.maximum(high - low, 1e-9 * np.abs(flat).max() + 1e-12)
        free = 1 - 2 * _MARGIN
        shape = float(np.clip(extent[1] / extent[0] * free + 2 * _MARGIN, *_SHAPES))
        shape = shape if height is None else height / width
        height = round(width * shape)
        metres = max(extent[0] / free, extent[1] / (shape - 2 * _MARGIN))  # across the width
        half = 0.5 * metres * np.array([1.0, height / width])
        middle = 0.5 * (low + high)
        low = np.array([*(middle[:2] - half), low[2]])
        high = np.array([*(middle[:2] + half), high[2]])
        return cls(axes, low, high, (width, height))

    @property
    def pixels_a_metre(self) -> float:
        """Scale of the picture, 1/m."""
        return float(self.size[0] / (self.high[0] - self.low[0]))

    @property
    def depth(self) -> float:
        """Distance between the nearest and the farthest point that fits, m."""
        return float(np.linalg.norm(self.high - self.low))

    def aim(self, camera: Any) -> None:
        """Point a pyvista camera."""
        middle = 0.5 * (self.low + self.high) @ self.axes
        camera.focal_point = middle
        camera.position = middle + 3 * self.depth * self.axes[2]
        camera.up = self.axes[1]
        camera.parallel_projection = True
        camera.parallel_scale = 0.5 * (self.high[1] - self.low[1])
        camera.clipping_range = (0.5 * self.depth, 6 * self.depth)


def camera_axes(camera: str | Direction | None) -> Array:
    """Directions (3, 3) to the right, upwards and towards a camera, by name or by its angles."""
    if isinstance(camera, str) and camera not in VIEWS:
        raise InputError(f"camera {camera!r}: expected azimuth, elevation or {', '.join(VIEWS)}.")
    angles = VIEWS[camera] if isinstance(camera, str) else camera or _USUAL
    turn, tilt = np.radians(angles)
    back = [np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)]
    right = [-np.sin(turn), np.cos(turn), 0.0]
    return np.stack([right, np.cross(back, right), back])


def shown_points(bodies: Sequence[Body], rest: bool) -> Array:
    """All positions that a picture has to hold, (n, 3), with those at rest or without.

    Of obstacles what is near the bodies.
    """
    clouds = [body.positions.reshape(-1, 3) for body in bodies]
    clouds += [body.run.points for body in bodies if rest]
    points = np.concatenate(clouds)
    beside = [
        surface.points(float(body.run.times[frame]))
        for body, surfaces in zip(bodies, obstacle_surfaces(bodies), strict=True)
        for surface in surfaces
        for frame in body.frames
    ]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _NEAR * float(np.linalg.norm(high - low))
    vertices = np.concatenate([np.empty((0, 3)), *beside])
    near = ((low - margin < vertices) & (vertices < high + margin)).all(axis=1)
    return np.concatenate([points, vertices[near]])


def obstacle_surfaces(bodies: Sequence[Body]) -> list[list[Surface]]:
    """The obstacles of each body, beside the place that all bodies take."""
    low = np.min([body.positions.min(axis=(0, 1)) for body in bodies], axis=0)
    high = np.max([body.positions.max(axis=(0, 1)) for body in bodies], axis=0)
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    return [[Surface(one, middle, size) for one in body.obstacles] for body in bodies]


class Painter:
    """Draws bodies one by one into images of equal size.

    The colour map ``palette`` is between two ``limits``.  ``rest`` draws the edges of the shape at
    rest behind the body.  ``colours``, for `overlay`: the first body is filled with its own, and
    of the others the edges have theirs.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        view: Camera,
        palette: str,
        limits: tuple[float, float],
        rest: bool,
        colours: Sequence[str] | None = None,
    ) -> None:
        self._pv = quiet_pyvista()
        self._view = view
        size = tuple(_OVERSAMPLING * s for s in view.size)
        self._plotter = self._pv.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.set_background("white")
        for place, strength in _LIGHTS:
            self._plotter.add_light(
                self._pv.Light(position=place, light_type="camera light", intensity=strength)
            )
        self._bodies = list(bodies)
        self._palette, self._limits, self._colours = palette, limits, colours
        self._actors: list[list[Any]] = []
        self._surfaces = [self._add(body, rest) for body in bodies]
        if colours:
            for (drawn, *_), colour in zip(self._actors[1:], colours[1:], strict=True):
                _as_wires(drawn, colour)
            self._actors[0][0].prop.color = colours[0]
        self._obstacles = [
            [(surface, self._add_obstacle(surface)) for surface in surfaces]
            for surfaces in obstacle_surfaces(bodies)
        ]
        view.aim(self._plotter.camera)

    def image(self, body: int, time: int) -> NDArray[np.uint8]:
        """RGB picture (height, width, 3) of a body at one of its times."""
        for number, actors in enumerate(self._actors):
            for actor in actors:
                actor.visibility = number == body
        shown, (surface, nodes) = self._bodies[body], self._surfaces[body]
        for number, obstacles in enumerate(self._obstacles):
            for obstacle, actor in obstacles:
                actor.visibility = number == body
                actor.user_matrix = obstacle.transform(float(shown.run.times[shown.frames[time]]))
        surface.points = shown.run.positions[shown.frames[time]][nodes]
        surface.cell_data.active_normals = _normals(surface.points[surface.regular_faces])
        if shown.values is not None:
            surface["value"] = shown.values[time][nodes]
        self._plotter.render()
        raw = np.asarray(self._plotter.screenshot(None, return_img=True), dtype=np.float64)
        k = _OVERSAMPLING
        raw = raw.reshape(raw.shape[0] // k, k, raw.shape[1] // k, k, 3).mean(axis=(1, 3))
        return np.rint(raw).astype(np.uint8)

    def overlay(self, time: int) -> NDArray[np.uint8]:
        """The first body, and the edges of the others over it, each in its own colour."""
        assert self._colours
        page = self.image(0, time) / 255.0
        for body, colour in enumerate(self._colours[1:], 1):
            ink = np.array(self._pv.Color(colour).float_rgb)
            share = (1.0 - self.image(body, time) / 255.0) @ (1.0 - ink) / ((1.0 - ink) ** 2).sum()
            share = np.clip(share, 0.0, 1.0)[:, :, None]
            page = (1.0 - share) * page + share * ink
        return np.rint(255.0 * page).astype(np.uint8)

    def close(self) -> None:
        """Free the window."""
        self._plotter.close()

    def _add_obstacle(self, surface: Surface) -> Any:
        """Translucent, so that it hides no body."""
        actor = self._plotter.add_mesh(
            surface.mesh, color=OBSTACLE, opacity=0.3, ambient=0.5, diffuse=0.55,
            show_edges=surface.flat, edge_color=OBSTACLE, line_width=1.5 * _OVERSAMPLING,
        )  # fmt: skip
        return actor

    def _add(self, body: Body, rest: bool) -> tuple[Any, NDArray[np.int64]]:
        """Add a body's surface; returns it and the node of each of its points."""
        nodes, faces = _surface(body.run)
        surface = self._pv.PolyData.from_regular_faces(body.run.points[nodes], faces)
        style: dict[str, Any] = {"color": _PLAIN}
        if body.values is not None:
            surface["value"] = np.zeros(len(nodes))
            style = {"scalars": "value", "cmap": self._palette, "clim": self._limits}
            style["show_scalar_bar"] = False
        drawn = self._plotter.add_mesh(surface, ambient=0.5, diffuse=0.55, specular=0.0, **style)
        actors = [drawn]
        drawn.prop.edge_color = _INK
        cell = self._view.pixels_a_metre * _edge_length(body.run)
        if cell > 4:
            drawn.prop.show_edges = True
            drawn.prop.edge_opacity = float(np.clip(cell / 25, 0.15, 0.75))
            drawn.prop.line_width = 1.1 * _OVERSAMPLING
        if rest:
            outline = self._pv.PolyData.from_regular_faces(body.run.points[nodes], faces)
            outline = outline.extract_feature_edges(30)
            outline.points -= 1.5 * self._view.depth * self._view.axes[2]  # behind the body
            width = 1.3 * _OVERSAMPLING
            actors.append(self._plotter.add_mesh(outline, color="#c4c4c4", line_width=width))
        self._actors.append(actors)
        return surface, nodes


def _as_wires(drawn: Any, colour: str) -> None:
    """White faces, which hide the edges behind them, and edges of one colour."""
    drawn.prop.color, drawn.prop.lighting, drawn.prop.show_edges = "white", False, True
    drawn.prop.edge_color, drawn.prop.edge_opacity = colour, 1.0
    drawn.prop.line_width = 1.6 * _OVERSAMPLING


def _surface(run: Trajectory) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes (n,) of the boundary, and its faces (f, 4) in their numbering."""
    faces, _ = boundary_faces(run.cells[:, :8])
    nodes, local = np.unique(faces, return_inverse=True)
    return nodes, local.reshape(faces.shape)


def _normals(corners: Array) -> Array:
    """One unit normal (f, 3) for each face (f, 4, 3), also for a warped one."""
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _edge_length(run: Trajectory) -> float:
    """Median length of the cells' edges at rest, m."""
    ends = run.points[run.cells[:, :8][:, VTK_EDGES]]  # (C, 12, 2, 3)
    return float(np.median(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)))


def quiet_pyvista() -> Any:
    """pyvista, without VTK's warning that there is no X server.

    Where the environment asks VTK for an X window, drawing may crash: another process tries first.
    """
    if "X" in os.environ.get(_WINDOW, "") and not (found := check_offscreen()).startswith("ok"):
        raise OutputError(
            f"nothing can be drawn with {_WINDOW}={os.environ[_WINDOW]}: {found}; or unset it."
        )
    pyvista = require_extra("pyvista", "view")
    logger = require_extra("vtkmodules.vtkCommonCore", "view").vtkLogger
    logger.SetStderrVerbosity(logger.VERBOSITY_ERROR)
    return pyvista


Image = NDArray[np.uint8]
"""RGB picture, (height, width, 3)."""


@contextlib.contextmanager
def picture_file(output: Path) -> Iterator[Path]:
    """A name to write to, which becomes ``output`` when all is written."""
    if output.is_dir():
        raise OutputError(f"{output}: is a folder; give the name of a file in it.")
    if not output.parent.is_dir():
        raise OutputError(f"{output}: there is no folder {output.parent}; create it first.")
    part = output.with_name(f"{output.stem}.part{output.suffix}")
    try:
        with replacing(output, part):
            yield part
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror or error}).") from error


def write_png(path: Path, page: Image) -> None:
    """Write one picture."""
    require_extra("PIL.Image", "view").fromarray(page).save(path, optimize=True)


def write_film(path: Path, pages: Iterator[Image], fps: float) -> None:
    """Write a GIF or MP4, by the suffix, with ``fps`` pictures a second."""
    if not fps > 0:
        raise InputError(f"fps = {fps}: expected more than 0.")
    if path.suffix.lower() == ".gif":
        _write_gif(path, list(pages), fps)
        return
    require_extra("imageio_ffmpeg", "view")
    writer = require_extra("imageio.v2", "view").get_writer(
        path, fps=fps, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
    )
    with writer:
        for page in pages:
            writer.append_data(page)


def _write_gif(path: Path, pages: list[Image], fps: float) -> None:
    """All pages share one palette, so that nothing flickers."""
    pil = require_extra("PIL.Image", "view")
    palette = _palette(np.concatenate([pages[k] for k in {0, len(pages) // 2, len(pages) - 1}]))
    drawn = [pil.fromarray(page).quantize(palette=palette, dither=0) for page in pages]
    duration = max(20, round(1000 / fps))  # ms; browsers slow down faster ones
    drawn[0].save(
        path, save_all=True, append_images=drawn[1:], duration=duration, loop=0, optimize=False
    )


def _palette(sample: Image) -> Any:
    """An image whose palette is white and 255 other colours."""
    pil = require_extra("PIL.Image", "view")
    # each colour once, to 8 levels, however often it is used: small things keep theirs
    levels = (sample.reshape(-1, 3) >> 3) @ np.array([1024, 32, 1])
    used = np.flatnonzero(np.bincount(levels))
    colours = np.stack([used >> 10, used >> 5 & 31, used & 31], axis=1).astype(np.uint8) << 3 | 4
    chosen = pil.fromarray(colours[None]).quantize(255, kmeans=3).getpalette()[: 3 * 255]
    palette = pil.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *chosen])
    return palette


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
    remedy = "install EGL (apt-get install libegl1 libgl1) or use a VTK built with OSMesa"
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

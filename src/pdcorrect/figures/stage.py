"""One run in a window of pyvista that is turned and moved through time."""

from __future__ import annotations

import numpy as np

from pdcorrect.figures.fields import Colour, body_of, scaled
from pdcorrect.figures.obstacles import obstacles_of
from pdcorrect.figures.panels import OBSTACLE, Body, camera_axes, obstacle_surfaces, quiet_pyvista
from pdcorrect.trajectory import Trajectory


class Stage:
    """A body and its obstacles, which are moved from frame to frame."""

    def __init__(self, run: Trajectory) -> None:
        self.run, self._frames, self._body = run, np.arange(len(run.times)), run.to_pyvista(0)
        self.plotter = quiet_pyvista().Plotter(off_screen=True)
        self.plotter.set_background("white")
        (surfaces,) = obstacle_surfaces([Body(run, self._frames, None, obstacles_of(run))])
        self._obstacles = [
            (surface, self.plotter.add_mesh(surface.mesh, color=OBSTACLE, opacity=0.3))
            for surface in surfaces
        ]
        self.colour_by("displacement")
        self.move_to(0)
        _, up, back = camera_axes(None)
        self.plotter.view_vector(back, up)
        self.plotter.add_axes()

    def colour_by(self, colour: Colour) -> None:
        """Colour the body by a field, on one scale for all frames."""
        (body,), bar = scaled([body_of(self.run, self._frames, colour)], colour)
        self._values = np.asarray(body.values)
        self._body["value"] = self._values[0]
        for title in list(self.plotter.scalar_bars.keys()):
            self.plotter.remove_scalar_bar(title)
        self.plotter.add_mesh(
            self._body, name="body", scalars="value", cmap=bar.palette,
            clim=(bar.low, bar.limit), show_edges=True, reset_camera=False,
            scalar_bar_args={
                "title": bar.title, "color": "black", "n_labels": 5, "fmt": "%.4g",
                "title_font_size": 18, "label_font_size": 16, "position_x": 0.25, "width": 0.5,
            },
        )  # fmt: skip

    def move_to(self, frame: int) -> None:
        """Move everything to a frame."""
        self._body.points = self.run.positions[frame]
        self._body["value"] = self._values[frame]
        for surface, actor in self._obstacles:
            actor.user_matrix = surface.transform(float(self.run.times[frame]))

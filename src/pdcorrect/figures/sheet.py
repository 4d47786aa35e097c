"""The sheet on which panels are laid out: labels, times, colour bar, scale, axes.

Text is drawn by matplotlib and has its own place, so that it never lies on a
body; the panels are pasted between it, pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdcorrect.errors import require_extra
from pdcorrect.figures.panels import Camera

_INK, _GREY = "#111111", "#555555"
_AXES = {"x": "#c0392b", "y": "#2e8b57", "z": "#2364aa"}
_MARKS = {"nbins": 7, "steps": [1, 2, 2.5, 4, 5, 10]}
_LINE = 1.3  # of the font size


@dataclass(frozen=True)
class ColourBar:
    """Title, colour map and ends of the shared colour scale."""

    title: str
    palette: str
    limit: float
    low: float = 0.0


class Sheet:
    """Rows and columns of panels, a caption above each, a legend below them all.

    ``labels``, row by row, may have several lines.  ``font`` is the height of the text, pixels;
    ``longest`` the last time on any page, s, which chooses the unit of times; ``key`` names and
    their colours, in place of a bar; ``size`` that of the sheet, pixels, if it is not what fits.
    """

    def __init__(
        self,
        view: Camera,
        labels: Sequence[str],
        columns: int,
        bar: ColourBar | None,
        font: float,
        longest: float = 1.0,
        key: Sequence[tuple[str, str]] = (),
        size: tuple[int, int] | None = None,
    ) -> None:
        self._longest = longest
        figure = require_extra("matplotlib.figure", "view")
        agg = require_extra("matplotlib.backends.backend_agg", "view")
        self._view, self._labels, self._font = view, list(labels), font
        self._columns, self._gap = columns, round(0.5 * font)
        self._caption = _caption(labels, font)
        width, height = view.size
        total = -(-len(labels) // columns) * height + height_of_text(labels, columns, font)
        self.size = size or (_even(width * columns), _even(total))
        self._figure = figure.Figure(figsize=(self.size[0] / 100, self.size[1] / 100), dpi=100)
        self._canvas = agg.FigureCanvasAgg(self._figure)
        self._times: list[Any] = []
        self._add_captions()
        self._add_scale()
        self._add_axes()
        if bar:
            self._add_bar(bar)
        self._add_key(key)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def page(
        self, images: Sequence[NDArray[np.uint8]], times: Sequence[float]
    ) -> NDArray[np.uint8]:
        """The whole picture (height, width, 3); images and times (s) row by row."""
        self._canvas.restore_region(self._background)
        for text, time in zip(self._times, times, strict=True):
            text.set_text(f"t = {time_text(time, self._longest)}")
            self._figure.draw_artist(text)
        page = np.array(self._canvas.buffer_rgba())[:, :, :3]
        for number, image in enumerate(images):
            left, top = self._corner(number)
            page[top : top + image.shape[0], left : left + image.shape[1]] = image
        return page

    def _corner(self, panel: int) -> tuple[int, int]:
        """Left and upper pixel of a panel."""
        row, column = divmod(panel, self._columns)
        width, height = self._view.size
        return column * width, row * (self._caption + height) + self._caption

    def _text(self, x: float, y: float, text: str, size: float, **style: Any) -> Any:
        """Text with its upper left corner at pixel (x, y) from the upper left."""
        options = {"ha": "left", "va": "top", "color": _INK, **style}
        return self._figure.text(
            x / self.size[0], 1 - y / self.size[1], text, fontsize=0.72 * size, **options
        )

    def _add_captions(self) -> None:
        pad, room = 2 * self._gap, self._view.size[0] - 3 * self._gap
        texts = []
        for number, label in enumerate(self._labels):
            left, below = self._corner(number)
            x, top = left + pad, below - self._caption + self._gap
            for line, words in enumerate(label.splitlines()):
                style = {"weight": "bold"} if line == 0 else {"color": _GREY}
                y = top + line * _LINE * self._font
                texts.append(self._text(x, y, words, self._font, **style))
        widest = max((t.get_window_extent().width for t in texts), default=0.0)
        font = self._font * min(1.0, room / max(widest, 1.0))
        for text in texts:
            text.set_fontsize(0.72 * font)
        for number in range(len(self._labels)):
            x, y = self._corner(number)
            y -= round(_LINE * self._font + 0.2 * self._gap)
            time = self._text(x + pad, y, "", font, color=_GREY, animated=True)
            self._times.append(time)

    def _add_scale(self) -> None:
        """A bar of round length, true in the plane of the picture."""
        pixels = self._view.pixels_a_metre
        length = round_length(0.8 * 7 * self._font / pixels)
        left, y = 6.5 * self._font, self.size[1] - 1.2 * self._font
        self._line([left, left + length * pixels], [y, y], _INK, 0.16 * self._font)
        for x in (left, left + length * pixels):
            self._line([x, x], [y - 0.3 * self._font, y + 0.3 * self._font], _INK, 1.5)
        factor, unit = length_unit(length)
        self._text(
            left + 0.5 * length * pixels, y - 0.5 * self._font, f"{factor * length:.6g} {unit}",
            self._font, ha="center", va="bottom",
        )  # fmt: skip

    def _add_axes(self) -> None:
        """The directions x, y, z as the camera sees them."""
        origin = np.array([2.3 * self._font, self.size[1] - 1.7 * self._font])
        for index in np.argsort(self._view.axes[2]):  # the one pointing at the viewer last
            if abs(self._view.axes[2, index]) > 0.99:  # as good as a point
                continue
            name = "xyz"[index]
            arrow = 1.6 * self._font * self._view.axes[:2, index] * [1, -1]
            tip, mark = origin + arrow, origin + 1.38 * arrow
            self._line([origin[0], tip[0]], [origin[1], tip[1]], _AXES[name], 0.11 * self._font)
            style = {"color": _AXES[name], "ha": "center", "va": "center"}
            self._text(mark[0], mark[1], name, 0.9 * self._font, **style)

    def _line(self, x: list[float], y: list[float], colour: str, width: float) -> None:
        lines = require_extra("matplotlib.lines", "view")
        places = (np.array(x) / self.size[0], 1 - np.array(y) / self.size[1])
        self._figure.add_artist(
            lines.Line2D(*places, color=colour, linewidth=0.72 * width, solid_capstyle="butt")
        )

    def _add_bar(self, bar: ColourBar) -> None:
        cm = require_extra("matplotlib.cm", "view")
        colors = require_extra("matplotlib.colors", "view")
        ticker = require_extra("matplotlib.ticker", "view")
        width, height, font = *self.size, self._font
        left = max(0.3 * width, 14.5 * font)
        right = max(0.72 * width, min(width - 2 * font, left + 18 * font))
        axes = self._figure.add_axes(
            (left / width, 1.75 * font / height, (right - left) / width, 0.75 * font / height)
        )
        mapping = cm.ScalarMappable(colors.Normalize(bar.low, bar.limit), bar.palette)
        drawn = self._figure.colorbar(mapping, cax=axes, orientation="horizontal")
        marks = ticker.MaxNLocator(**_MARKS).tick_values(bar.low, bar.limit)
        slack = 1e-9 * (bar.limit - bar.low)
        drawn.set_ticks(marks[(marks >= bar.low - slack) & (marks <= bar.limit + slack)])
        axes.tick_params(labelsize=0.72 * 0.9 * font, length=0.25 * font, width=1, pad=2)
        drawn.outline.set_visible(False)
        self._text(left, height - 2.75 * font, bar.title, font, va="bottom")

    def _add_key(self, key: Sequence[tuple[str, str]]) -> None:
        """Names in their colours, from the right of the scale on, smaller if they are long."""
        left, y = max(0.3 * self.size[0], 15.5 * self._font), self.size[1] - 1.7 * self._font
        texts = [self._text(0.0, y, name, self._font, va="center") for name, _ in key]
        widths = [text.get_window_extent().width + 3.6 * self._font for text in texts]
        room = self.size[0] - left - self._font
        factor = min(1.0, room / max(1.0, sum(widths)))
        font = factor * self._font
        for (_, colour), text, width in zip(key, texts, widths, strict=True):
            self._line([left, left + 1.6 * font], [y, y], colour, 0.3 * font)
            text.set_x((left + 2.1 * font) / self.size[0])
            text.set_fontsize(0.72 * font)
            left += factor * width


def _caption(labels: Sequence[str], font: float) -> int:
    """Height of what is above a panel, pixels."""
    lines = max(len(label.splitlines()) for label in labels)
    return round((lines + 1) * _LINE * font + 1.2 * round(0.5 * font))


def height_of_text(labels: Sequence[str], columns: int, font: float) -> int:
    """Height of all captions and the legend, pixels."""
    return -(-len(labels) // columns) * _caption(labels, font) + round(4.2 * font)


def round_limit(largest: float) -> float:
    """The end of a scale with round marks that holds 0 to ``largest``."""
    ticker = require_extra("matplotlib.ticker", "view")
    return float(ticker.MaxNLocator(**_MARKS).tick_values(0.0, largest)[-1])


def round_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above ``length`` (m)."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-12)))


def time_text(time: float, longest: float) -> str:
    """A time (s) with three decimals, in the unit in which the longest time reads best."""
    units = (1.0, "s") if longest >= 0.02 else (1e3, "ms") if longest >= 2e-5 else (1e6, "µs")
    return f"{units[0] * time:.3f} {units[1]}"


def length_unit(length: float) -> tuple[float, str]:
    """Factor and name of the unit in which a length in m reads best."""
    if length >= 1.0:
        return 1.0, "m"
    return (1e3, "mm") if length >= 1e-3 else (1e6, "µm")


def pressure_unit(pressure: float) -> tuple[float, str]:
    """Factor and name of the unit in which a pressure in Pa reads best."""
    if pressure >= 1e6:
        return 1e-6, "MPa"
    return (1e-3, "kPa") if pressure >= 1e3 else (1.0, "Pa")


def _even(size: int) -> int:
    return size + size % 2  # films need it

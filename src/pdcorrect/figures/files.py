"""Pictures and films as files: PNG, GIF, MP4."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pdcorrect import _files as replacement
from pdcorrect.errors import InputError, OutputError, require_extra

Image = NDArray[np.uint8]
"""RGB picture, (height, width, 3)."""


@contextlib.contextmanager
def replacing(output: Path) -> Iterator[Path]:
    """A name to write to, which becomes ``output`` when all is written."""
    if output.is_dir():
        raise OutputError(f"{output}: is a folder; give the name of a file in it.")
    if not output.parent.is_dir():
        raise OutputError(f"{output}: there is no folder {output.parent}; create it first.")
    part = output.with_name(f"{output.stem}.part{output.suffix}")
    try:
        with replacement.replacing(output, part):
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
    levels = 4.0 * np.arange(64) + 2.0
    cube = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1)
    nearest = cKDTree(palette).query(cube)[1].astype(np.uint8)  # (64, 64, 64)
    drawn = []
    for page in pages:
        image = pil.fromarray(nearest[tuple(np.moveaxis(page >> 2, -1, 0))])
        image.putpalette(palette.astype(np.uint8).tobytes())
        drawn.append(image)
    duration = max(20, round(1000 / fps))  # ms; browsers slow down faster ones
    drawn[0].save(
        path, save_all=True, append_images=drawn[1:], duration=duration, loop=0, optimize=False
    )


def _palette(sample: Image) -> NDArray[np.float64]:
    """White and 255 other colours (256, 3) for a picture."""
    pil = require_extra("PIL.Image", "view")
    # each colour once, to 8 levels, however often it is used: small things keep theirs
    colours = np.unique(sample.reshape(-1, 3) & 0xF8, axis=0) | 4
    chosen = pil.fromarray(colours[None]).quantize(255, kmeans=3).getpalette()
    palette = np.full((256, 3), 255.0)
    palette[1 : 1 + len(chosen) // 3] = np.reshape(chosen, (-1, 3))[:255]
    return palette

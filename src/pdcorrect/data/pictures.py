"""Pictures of a data set: histograms of its quantities, and some of its simulations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pdcorrect.data.measuring import MeasuredMesh, dataset_files, measure_dataset
from pdcorrect.data.schema import PLAIN, REFERENCE, Array
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.errors import InputError, require_extra
from pdcorrect.figures.panels import (
    Body,
    Camera,
    Image,
    Painter,
    replacing,
    shown_points,
    write_png,
)
from pdcorrect.figures.sheet import ColourBar, Sheet, length_unit, round_limit
from pdcorrect.trajectory import Trajectory

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_COLUMNS, _WIDTH, _FONT = 4, 420, 19
"""Of the sheet of simulations: panels in a row, their width and the height of text, pixels."""


def histograms(
    folder: str | Path, path: str | Path, meshes: Sequence[MeasuredMesh] | None = None
) -> Path:
    """Draw how sizes, materials, motions and errors are distributed in each split.

    Parameters
    ----------
    folder : path
        Of the data set.
    path : path
        Picture to write: .png, .pdf or .svg.
    meshes : sequence of MeasuredMesh, optional
        What `measure_dataset` found in the folder, to save reading it again.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    InputError, OutputError, MissingExtraError
        If the data set cannot be read, the picture not be written, or "view" is missing.
    """
    figure = require_extra("matplotlib.figure", "view").Figure(
        figsize=(12, 6), layout="constrained"
    )
    agg = require_extra("matplotlib.backends.backend_agg", "view")
    path = Path(path)
    canvas = agg.FigureCanvasAgg(figure)
    if path.suffix[1:].lower() not in canvas.get_supported_filetypes():
        raise InputError(f"{path}: expected a name ending in .png, .pdf or .svg.")
    found = _quantities(measure_dataset(folder) if meshes is None else meshes)
    axes = figure.subplots(2, 4).ravel()
    for axis, (label, values) in zip(axes, found.items(), strict=True):
        _histogram(axis, label, values)
    splits = list(next(iter(found.values())))
    patches = require_extra("matplotlib.patches", "view")
    handles = [patches.Patch(color=_colour(k), label=split) for k, split in enumerate(splits)]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(splits), frameon=False)
    figure.supylabel("share of the split's simulations [%]", fontsize=11)
    with replacing(path) as part:
        figure.savefig(part, dpi=150)
    return path


def _quantities(meshes: Sequence[MeasuredMesh]) -> dict[str, dict[str, list[float]]]:
    """Values of each simulation by quantity and split."""
    found: dict[str, dict[str, list[float]]] = {}
    for mesh in meshes:
        for simulation in mesh.simulations:
            plain = simulation.runs.get(PLAIN)
            values = {
                "nodes": mesh.nodes,
                "Young's modulus [kPa]": 1e-3 * mesh.young[0],
                "Poisson's ratio": mesh.poisson[0],
                "largest nodal force [N]": simulation.force,
                "largest displacement [mm]": 1e3 * simulation.displacement,
                "largest speed [m/s]": simulation.speed,
                "RMS error of the plain run [mm]": _scaled(plain.rms_error if plain else None),
                "its RMS error of one step [mm]": _scaled(plain.step_error if plain else None),
            }
            for label, value in values.items():
                own = found.setdefault(label, {}).setdefault(mesh.split, [])
                own += [] if value is None else [float(value)]
    return found


def _scaled(length: float | None) -> float | None:
    return None if length is None else 1e3 * length


def _histogram(axis: Any, label: str, values: dict[str, list[float]]) -> None:
    """Outlines of all splits over the same bins."""
    everything = np.concatenate([np.array(own) for own in values.values()])
    if everything.size:
        edges = np.histogram_bin_edges(everything, bins=20)
        for k, own in enumerate(values.values()):
            if own:
                weights = np.full(len(own), 100.0 / len(own))
                style = {"color": _colour(k), "histtype": "step", "linewidth": 1.6}
                axis.hist(own, edges, weights=weights, **style)
    axis.set_xlabel(label)
    axis.locator_params(axis="x", nbins=5)
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def _colour(number: int) -> str:
    return _COLOURS[number % len(_COLOURS)]


# --- some simulations --------------------------------------------------------------------


class _Sample(NamedTuple):
    """The reference of one simulation at the frame at which it is farthest from rest."""

    label: str
    run: Trajectory
    frame: int
    distances: Array


def thumbnails(folder: str | Path, path: str | Path, count: int = 8) -> Path:
    """Draw simulations from all over a data set, each at its largest displacement.

    All are seen from the same side and at the same scale, each in the middle of its panel,
    coloured by the reference's displacement, with the outline of the rest shape behind.

    Parameters
    ----------
    folder : path
        Of the data set.
    path : path
        Picture to write: .png.
    count : int
        How many; fewer where there are not as many.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    InputError, OutputError, MissingExtraError
        If the data set cannot be read, the picture not be written, or "view" is missing.
    """
    path = Path(path)
    if path.suffix.lower() != ".png" or count < 1:
        raise InputError(f"{path}, count = {count}: expected a name ending in .png and count >= 1.")
    samples = [_sample(file, number) for file, number in _choice(dataset_files(folder), count)]
    with replacing(path) as part:
        write_png(part, _page(samples))
    return path


def _choice(files: Sequence[Path], count: int) -> list[tuple[Path, int]]:
    """Files spread over all of them; further simulations of each where files are few."""
    if count <= len(files):
        return [(files[k * len(files) // count], 0) for k in range(count)]
    lengths = [len(read_shard(file, runs=(), verify=False).simulations) for file in files]
    rounds = range(max(lengths))
    every = [(f, k) for k in rounds for f, n in zip(files, lengths, strict=True) if k < n]
    return sorted(every[:count], key=lambda pair: (files.index(pair[0]), pair[1]))


def _sample(path: Path, number: int) -> _Sample:
    shard = read_shard(path, simulations=[number], runs=[REFERENCE])
    found = shard.simulations[0].runs[REFERENCE].positions
    if found is None:
        raise InputError(f"{path}: simulation {number:04d} has no rollout {REFERENCE!r}.")
    middle = 0.5 * (shard.points.min(axis=0) + shard.points.max(axis=0))
    points, positions = shard.points - middle, found.astype(np.float64) - middle
    distances = np.linalg.norm(positions - points, axis=2)
    step = float(shard.attributes["time_step"])
    run = Trajectory(
        positions=positions,
        velocities=np.zeros_like(positions),
        times=step * np.arange(len(positions), dtype=np.float64),
        stats={},
        points=points,
        cells=shard.cells.astype(np.int64),
    )
    label = f"{path.parent.name} {shard.attributes['number']}-{number}\n"
    label += f"E = {_kilo(shard.young.mean())} kPa, ν = {shard.poisson.mean():.2f}"
    return _Sample(label, run, int(distances.max(axis=1).argmax()), distances)


def _kilo(value: float) -> str:
    """In thousands, with three digits or all before the point."""
    thousands = 1e-3 * value
    return f"{thousands:.0f}" if thousands >= 100 else f"{thousands:.3g}"


def _page(samples: Sequence[_Sample]) -> Image:
    """The sheet with all samples."""
    largest = max(float(sample.distances.max()) for sample in samples)
    factor, unit = length_unit(largest or 1e-3)
    bar = ColourBar(f"displacement [{unit}]", "viridis", round_limit(factor * largest or 1.0))
    bodies = [
        Body(s.run, np.array([s.frame]), factor * s.distances[s.frame : s.frame + 1])
        for s in samples
    ]
    columns = min(_COLUMNS, len(samples))
    view = Camera.fitted(shown_points(bodies, rest=True), _WIDTH)
    labels = [sample.label for sample in samples]
    sheet = Sheet(view, labels, -(-len(samples) // columns), bar, _FONT, columns)
    painter = Painter(bodies, view, bar.palette, bar.limit, rest=True)
    try:
        images = [painter.image(k, 0) for k in range(len(samples))]
    finally:
        painter.close()
    return sheet.page(images, [float(s.run.times[s.frame]) for s in samples])

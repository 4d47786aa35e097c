"""The card of a data set: a short page that says what it is, what it cost and how to use it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from pdcorrect.data.configuration import EVALUATION, DatasetConfig, MotionRange
from pdcorrect.data.families import PUBLISHED
from pdcorrect.data.folder import all_shards
from pdcorrect.data.schema import BEST, CONFIG, CONVERGED, MANIFEST, PLAIN, read_shard
from pdcorrect.data.summary import DatasetInfo, SplitInfo
from pdcorrect.errors import FileFormatError, InputError

_BODIES = {
    "beam": "beams of 2×2 cells' section, held at x = 0",
    "cross": "beams of 2×2 cells' section with two or four branches, held at x = 0",
    "weight": "beams held at both ends with a hanging weight",
}
_LOADS = {
    "torsion": "a constant torsional field",
    "impulse": "a force during {duration:g} s",
    "stretch": "a force that rises in {duration:g} s and stays",
    "body-force": "an acceleration of the whole body that rises in {duration:g} s and stays",
}


def dataset_card(folder: str | Path, info: DatasetInfo) -> str:
    """The card of a generated data set, Markdown.

    Parameters
    ----------
    folder : path
        With ``config.toml``, ``manifest.json`` and the files.
    info : DatasetInfo
        Of the folder.

    Raises
    ------
    InputError
        If the data set was not generated, or is not complete.
    """
    folder = Path(folder)
    if not (folder / CONFIG).exists():
        raise InputError(
            f"{folder}: no {CONFIG}: expected a generated data set; imported ones have no card."
        )
    config = DatasetConfig.load(folder / CONFIG)
    try:
        content = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        content_hash = str(content["content_hash"])
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise FileFormatError(
            f"{folder / MANIFEST}: damaged: expected JSON with a content_hash ({error})."
        ) from None
    except OSError:
        raise InputError(
            f"{folder}: no {MANIFEST}: expected a complete data set. Start generate again, which "
            "computes what is missing and writes it."
        ) from None
    made_with = read_shard(all_shards(folder)[0], runs=()).provenance
    return card_text(config, info, made_with, content_hash)


def card_text(
    config: DatasetConfig, info: DatasetInfo, made_with: Mapping[str, str], content_hash: str
) -> str:
    """The card of a data set from its numbers alone.

    Parameters
    ----------
    config : DatasetConfig
    info : DatasetInfo
    made_with : mapping of str to str
        Provenance: date, pdcorrect, and device or processor.
    content_hash : str
        Of the manifest.
    """
    sections = [
        f"# {config.name}",
        "\n".join(f"- {line}" for line in _what(config)),
        _table(_SPLIT_HEADS, (_split_cells(name, split) for name, split in info.splits.items())),
        "\n".join(f"- {line}" for line in _use(config, info, made_with, content_hash)),
    ]
    return "\n\n".join(sections) + "\n"


def _what(config: DatasetConfig) -> Iterable[str]:
    material = config.material
    nodes = config.coarse_nodes or PUBLISHED[config.family].coarse
    integrator = "generalised-α" if config.setting == "converged" else "backward Euler"
    yield (
        f"**Equation**: elastodynamics, corotated energy with a volume term, {integrator}, "
        f"{config.frames} frames of {config.step:g} s from rest."
    )
    yield (
        f"**Bodies**: {_BODIES.get(config.family, config.family)}; {nodes[0]} to {nodes[1]} nodes, "
        f"cells of {config.cell_size:g} m."
    )
    several = "one or two of these a simulation: " if config.mixed else ""
    yield f"**Loads**: {several}{'; '.join(map(_load, config.motions))}."
    yield (
        f"**Material**: E {_range(material.young)} Pa, ν {_range(material.poisson)}, "
        f"ρ {_range(material.density)} kg/m³."
    )
    refine = "×".join([str(config.reference.refine)] * 3)
    yield (
        f"**Setting** `{config.setting}`. "
        f"**Reference**: {config.reference.solver.upper()} on cells cut {refine}."
    )


def _load(motion: MotionRange) -> str:
    unit = "m/s" if motion.kind == "impulse" else "m/s²"
    told = _LOADS[motion.kind].format(duration=motion.duration)
    return f"{told}, {_range(motion.strength)} {unit}"


_SPLIT_HEADS = (
    "split", "meshes", "simulations", "nodes", "loads rejected, %", f"`{PLAIN}` RMS, mm",
    f"`{BEST}` Ω, %",
)  # fmt: skip


def _split_cells(name: str, split: SplitInfo) -> tuple[object, ...]:
    plain, best = split.runs.get(PLAIN), split.runs.get(BEST)
    error = None if plain is None else plain.rms_error
    return (
        name, split.meshes, split.simulations, f"{split.nodes[0]:.0f} to {split.nodes[1]:.0f}",
        f"{100 * split.rejection_rate:.2g}", "" if error is None else f"{1e3 * error:.3g}",
        "" if best is None or best.omega is None else f"{best.omega:.3g}",
    )  # fmt: skip


def _use(
    config: DatasetConfig, info: DatasetInfo, made_with: Mapping[str, str], content: str
) -> Iterable[str]:
    where = made_with.get("device", "cpu")
    machine = made_with.get("processor", "?") if where == "cpu" else where
    yield (
        f"**Made** with seed {config.seed} in {info.whole.seconds:.0f} worker seconds, "
        f"{made_with.get('date', '?')}, pdcorrect {made_with.get('pdcorrect', '?')}, {machine}; "
        f"{info.whole.bytes / 1e6:.0f} MB. SHA-256 `{content}`."
    )
    yield f"**Limits**: {_time_error(info)}"


def _time_error(info: DatasetInfo) -> str:
    """What is known of the error that the reference itself has from its time step."""
    runs = info.splits[EVALUATION].runs if EVALUATION in info.splits else {}
    converged = runs.get(CONVERGED)
    if converged is None or converged.rms_error is None:
        return "the reference has the time step's error, not measured here."
    return (
        f"the reference is itself {1e3 * converged.rms_error:.3g} mm (RMS) from the motion "
        "converged in time."
    )


def _range(ends: tuple[float, float]) -> str:
    return f"{ends[0]:g} to {ends[1]:g}"


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    rule = "|".join(["---", *["---:"] * (len(heads) - 1)])
    lines = [f"|{'|'.join(heads)}|", f"|{rule}|"]
    return "\n".join([*lines, *(f"|{'|'.join(map(str, row))}|" for row in rows)])

"""The card of a data set: a page that says what it is, what it cost and what it is good for."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from pdcorrect.data.configuration import EVALUATION, DatasetConfig, ExtraSplit
from pdcorrect.data.families import PUBLISHED
from pdcorrect.data.folder import all_shards
from pdcorrect.data.info import FEWEST, DatasetInfo, SplitInfo
from pdcorrect.data.schema import CONFIG, CONVERGED, MANIFEST, PLAIN
from pdcorrect.data.shard_reader import read_shard
from pdcorrect.errors import FileFormatError, InputError

_BODIES = {
    "beam": "beams of 2 x 2 cells' section, held at x = 0",
    "cross": "a beam of 2 x 2 cells' section along x, held at x = 0, with two or four "
    "perpendicular branches of the same section at a random place (CrossMesh, fig. 6.1)",
    "weight": "a beam along x held at both ends, alone or crossed by a second one along y, and a "
    "pendulum with an inflated part, all of random sizes (WeightMesh, fig. 6.2)",
}
_MOTIONS = {
    "torsion": "the rotational field of eq. 6-1 to 6-3 about the axis of the beam along x, "
    "constant in time, in either sense",
    "impulse": "a force on the inflated part (or the last two cells) in a random direction during "
    "the first {duration:g} s",
    "stretch": "a force on the inflated part (or the last two cells) along the axis that leads "
    "away from the clamps, with a transverse share, rising in {duration:g} s and constant then",
}
_SETTINGS = {
    "as-published": "mass density times cell volume on every node, volume weight lambda, forces on "
    "the coarse nodes of every mesh, the same element everywhere: the setting of the thesis as far "
    "as it is described. Its coarse meshes are too heavy, and point loads have no limit under "
    "refinement",
    "exact": "lumped masses that sum to density times volume, volume weight 3 lambda, loads "
    "integrated on each mesh, and in the reference the best coarse model's element and mass",
}
_PUBLISHED_PARTS = (
    ". The force is divided among all coarse nodes of its part, inner ones too, where the thesis "
    "speaks of the part's borders"
)
_LIMITS = (
    "Loads under which a run failed or turned a cell inside out were drawn again, so the errors "
    "are those of survivable loads. All runs of a simulation count, so splits with more runs than "
    "`training`, as `evaluation`, pass a stricter filter.",
    "No contact, no gravity, one material a body.",
)


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
    made_with = read_shard(all_shards(folder)[0], simulations=(), verify=False).provenance
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
        _what(config),
        "## Sizes\n\n" + _sizes(config, info),
        "## Errors of the models\n\n" + _errors(info),
        "## Generation\n\n" + _generation(config, info, made_with, content_hash),
        "## Evaluation\n\n" + _evaluation(config),
        "## Known limits\n\n" + _limits(config, info),
    ]
    return "\n\n".join(sections) + "\n"


def _what(config: DatasetConfig) -> str:
    motion, material = config.motion, config.material
    loads = _MOTIONS[motion.kind].format(duration=motion.duration)
    nodes = config.coarse_nodes or PUBLISHED[config.family].coarse
    setting = _SETTINGS[config.setting]
    if config.setting == "as-published" and motion.kind != "torsion":
        setting += _PUBLISHED_PARTS
    return "\n".join((
        "- **Equation**: elastodynamics with the corotated energy and a volume term, backward "
        f"Euler, {config.frames} frames of {config.step:g} s from rest.",
        f"- **Bodies**: {_BODIES[config.family]}; {nodes[0]} to {nodes[1]} nodes, cells of "
        f"{config.cell_size:g} m.",
        f"- **Loads**: {loads}; strength {_range(motion.strength)} "
        f"{'m/s' if motion.kind == 'impulse' else 'm/s2'} times the density or the part's mass.",
        f"- **Material**, one draw a mesh: E {_range(material.young)} Pa (log-uniform), Poisson's "
        f"ratio {_range(material.poisson)}, density {_range(material.density)} kg/m3.",
        f"- **Setting** `{config.setting}`: {setting}.",
        f"- **Reference**: {config.reference.solver.upper()} on cells cut into "
        f"{config.reference.refine} x {config.reference.refine} x {config.reference.refine}, to "
        f"{config.tolerance:g} of a cell in each step.",
        "- Everything else is in `config.toml`; `docs/datasets.md` explains its keys and why "
        "material and strength are drawn so.",
    ))  # fmt: skip


def _range(ends: tuple[float, float]) -> str:
    return f"{ends[0]:g} to {ends[1]:g}"


def _sizes(config: DatasetConfig, info: DatasetInfo) -> str:
    refines = {extra.name: extra.refine for extra in config.extra}
    rows = [
        (
            name, split.meshes, split.simulations, _whole(split.nodes),
            refines.get(name) or config.reference.refine, f"{1e3 * split.displacement.median:.3g}",
            f"{1e3 * split.displacement.largest:.3g}", f"{100 * split.rejection_rate:.3g}",
        )
        for name, split in info.splits.items()
    ]  # fmt: skip
    heads = (
        "split", "meshes", "simulations", "nodes", "reference's cut", "displacement: median, mm",
        "largest, mm", "loads rejected, %",
    )  # fmt: skip
    size = f"{info.whole.bytes / 1e6:.3g} MB in all."
    return "\n\n".join([_table(heads, rows), *_rejections(info), size])


def _rejections(info: DatasetInfo) -> Iterable[str]:
    """Which runs rejected loads, and why."""
    if info.whole.rejections:
        rows = [
            (name, "`{}`".format(text.partition(", ")[0]), text.partition(", ")[2], count)
            for name, split in info.splits.items()
            for text, count in split.rejections.items()
        ]
        yield _table(("split", "rejected by the run", "reason", "loads"), rows)
    elif info.whole.rejected:
        yield "Each file says which run rejected its loads and why (attribute `rejected`)."


def _whole(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.0f} – {ends[1]:.0f}"


def _errors(info: DatasetInfo) -> str:
    heads = (
        "split", "run", "RMS, mm", "one step, mm", "Omega: mean", "median", "5 %", "worst",
    )  # fmt: skip
    rows = [row for name, split in info.splits.items() for row in _runs(name, split)]
    return _table(heads, rows) + (
        "\n\nDistances from the reference on the coarse nodes, means over simulations; Omega (eq. "
        "7-3) is the share of the plain run's squared error that is gone, per cent. A dash: fewer "
        f"than {FEWEST} simulations give no 5 % quantile."
    )


def _runs(name: str, split: SplitInfo) -> Iterable[tuple[object, ...]]:
    for run, found in split.runs.items():
        if found.rms_error is None and found.step_error is None:
            continue
        errors = (found.rms_error, found.step_error)
        texts = ["" if e is None else f"{1e3 * e:.3g}" for e in errors]
        texts += found.omega_texts()
        yield (name, f"`{run}`", *texts)


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def _generation(
    config: DatasetConfig, info: DatasetInfo, made_with: Mapping[str, str], content: str
) -> str:
    where = made_with.get("device", "cpu")
    machine = made_with.get("processor", "?") if where == "cpu" else where
    device = "" if where == "cpu" else " --device cuda --workers N"
    return (
        f"`pdcorrect dataset generate {CONFIG} -o FOLDER{device}`, seed {config.seed}: "
        f"{info.whole.seconds['total']:.3g} s of all workers in all, those that share a GPU "
        "waiting for each other and compiling of kernels included, begun on "
        f"{made_with.get('date', '?')} with pdcorrect {made_with.get('pdcorrect', '?')} on "
        f"{machine}.\n\nSHA-256 of all files' contents: `{content}`. On another processor or "
        "device numbers agree to the solver's tolerance, and the hash differs."
    )


def _evaluation(config: DatasetConfig) -> str:
    lines = [
        "Omega of rollouts from rest on the split `evaluation`, in the mean over simulations, with "
        f"`{PLAIN}` as zero; choices while developing are made on `validation`. Splits are by mesh."
    ]
    lines += [f"- `{extra.name}`: {_difference(extra)}." for extra in config.extra]
    return "\n".join(lines)


def _difference(extra: ExtraSplit) -> str:
    """What a split changes against the data set."""
    keys = ("family", "young", "poisson", "refine")
    told = [f"{key} {getattr(extra, key)}" for key in keys if getattr(extra, key) is not None]
    factors = {"strength": extra.strength_factor, "step": extra.step_factor}
    factors["frames"] = extra.frames_factor
    told += [f"{name} times {factor:g}" for name, factor in factors.items() if factor != 1]
    return ", ".join(told).replace("refine", "reference cut into") or "the same distribution"


def _limits(config: DatasetConfig, info: DatasetInfo) -> str:
    return "\n".join(f"- {line}" for line in (_time_error(config, info), *_LIMITS))


def _time_error(config: DatasetConfig, info: DatasetInfo) -> str:
    """What is known of the error that the reference itself has from its time step."""
    runs = info.splits[EVALUATION].runs if EVALUATION in info.splits else {}
    errors = [run.rms_error for n in (CONVERGED, PLAIN) if (run := runs.get(n)) is not None]
    text = "The errors above leave out the reference's own error of the time step"
    if len(errors) < 2 or None in errors:
        return text + "; no run here measures it."
    converged, plain = (f"{1e3 * e:.3g} mm" for e in errors if e is not None)
    return (
        f"{text}. In `{EVALUATION}` the run `{CONVERGED}`, the reference with each time step cut "
        f"into {config.converged_steps}, is {converged} RMS from the reference, and the `{PLAIN}` "
        f"run {plain}."
    )

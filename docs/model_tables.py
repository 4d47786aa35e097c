"""Tables of released models, their baselines, and models that are no more."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

from records import RECORDS, ROOT, Rows, interval, number, percent, read

MODELS = (
    "impulse-as-published", "stretch-as-published", "torsion-as-published",
    "impulse-exact", "stretch-exact", "torsion-exact",
)  # fmt: skip
EXACT = MODELS[3:]
THESIS = {"impulse": 95.9, "stretch": 99.1, "torsion": 91.3}
"""Mean Omega of the thesis's own models, of its own meshes and loads (table 7.1)."""
RECIPES = {
    "impulse-as-published": "impulse-more/through-windows-longer",
    "stretch-as-published": "stretch-more/through-more",
    "torsion-as-published": "torsion-as-published/through",
    "impulse-exact": "impulse-exact/through-longer",
    "stretch-exact": "stretch-exact/through-further",
    "torsion-exact": "torsion-more/best-four",
}
"""The last recipe of each model."""
RUNS = {
    "plain": "plain coarse mesh",
    "total-mass": "reference's total mass",
    "best": "best coarse model",
    "intermediate": "intermediate mesh",
    "corrected": "corrected",
}
BASELINES = {
    "hex8-mean": "element `hex8-mean`",
    "hex8-bubble": "element `hex8-bubble`",
    "hex8-bubble-mean": "element `hex8-bubble-mean`",
    "hex8-learned": "element `hex8-learned`",
    "consistent mass": "consistent mass",
    "fitted stiffness": "one factor on Young's modulus, fitted",
    "total-mass": "the reference's total mass",
    "best": "best coarse model",
    "intermediate": "intermediate mesh",
}


def record_of(model: str) -> Any:
    return read(f"models/{model}/evaluation.json")


def base_of(record: Mapping[str, Any]) -> str:
    return "plain" if record["base"] == "plain" else "best coarse"


def released() -> Rows:
    """The models, what they correct, and how near they come."""
    rows = []
    for model in (*MODELS, "tiny"):
        record = record_of(model)
        omega = record["runs"]["corrected"]["omega"]
        rows.append([
            f"[`{model}`]({model}/README.md)", base_of(record), f"{minutes(model):.0f}",
            percent(omega["mean"]), percent(omega["smallest"]),
        ])  # fmt: skip
    return ("model", "corrects", "training, min", "Ω mean", "Ω worst"), rows


def minutes(model: str) -> float:
    """Of training, as all recipes that led to a model ask for."""
    if model in RECIPES:
        return sum(map(seconds_of, chain(RECIPES[model]))) / 60.0
    record = read(f"models/{model}/model.json")["record"]
    return float(record["training"]["seconds"]) / 60.0


def recipe_of(name: str) -> dict[str, Any]:
    return _toml(f"models/recipes/{name}.toml")


def _toml(path: str) -> dict[str, Any]:
    return tomllib.loads((ROOT / path).read_text(encoding="utf-8"))


def start_of(name: str) -> str | None:
    """The recipe whose model a recipe starts from."""
    start = recipe_of(name).get("start_from")
    return None if start is None else start.removeprefix("trainings/").removesuffix("/model")


def chain(name: str) -> list[str]:
    """A recipe and all that it goes on with, first to last."""
    start = start_of(name)
    return [*(chain(start) if start else []), name]


def seconds_of(name: str) -> float:
    return float(sum(stage["seconds"] for stage in recipe_of(name)["stages"]))


def recipes() -> Rows:
    """The recipes that led to each model, first to last."""
    rows = []
    for model, last in RECIPES.items():
        each = [f"`{name}` ({seconds_of(name):.0f} s)" for name in chain(last)]
        rows.append([f"`{model}`", ", ".join(each)])
    return ("model", "recipes, each going on with the one before"), rows


def card(model: str) -> Rows:
    """A model on its evaluation split, beside what needs no network."""
    runs = record_of(model)["runs"]
    rows = []
    for run, label in RUNS.items():
        if run in runs:
            found, omega = runs[run], runs[run]["omega"]
            spread = "–" if run == "plain" else interval(omega["interval"])
            rows.append([
                label, percent(omega["mean"]), spread, percent(omega["smallest"]),
                number(1e3 * found["rms_error"]), number(found["stress_error"]),
            ])  # fmt: skip
    return ("run", "Ω mean", "95 %", "worst", "RMS, mm", "stress error, %"), rows


def knows(model: str) -> list[str]:
    """Bodies, load and time step over cell size of the data sets that a model learned from."""
    names = read(f"models/{model}/model.json")["record"]["dataset"].split("+")
    sets = [_toml(f"datasets/{name}/config.toml") for name in names]
    cells = [
        (each["family"], each["motion"]["kind"], f"{each['step'] / each['cell_size']:.2g}")
        for each in sets
    ]
    return [", ".join(dict.fromkeys(column)) for column in zip(*cells, strict=True)]


def results() -> Rows:
    """The six models beside the thesis, their base and the intermediate mesh."""
    rows = []
    for model in MODELS:
        record = record_of(model)
        runs = record["runs"]
        omega = runs["corrected"]["omega"]
        thesis = THESIS[model.partition("-")[0]]
        exact = model in EXACT
        rows.append([
            f"`{model}`", *knows(model), base_of(record),
            f"({thesis})" if exact else f"{thesis}",
            f"**{percent(omega['mean'])}**", interval(omega["interval"]),
            percent(omega["smallest"]), percent(runs[record["base"]]["omega"]["mean"]),
            percent(runs["intermediate"]["omega"]["mean"]),
            number(1e3 * runs["corrected"]["rms_error"]),
        ])  # fmt: skip
    head = ("model", "bodies", "load", "step over cell", "corrects", "thesis", "Ω mean", "95 %",
            "worst", "base alone", "intermediate mesh", "RMS, mm")  # fmt: skip
    return head, rows


def right_masses() -> Rows:
    """The thesis's scenes with right masses: mean and worst Omega, mean distances."""
    record = read(RECORDS / "thesis_scenes.json")
    figures, count = record["figures"], _scenes(record, "Omega, %")[1]
    runs = ("learned", "hex27", "best coarse", "intermediate")
    rows = []
    for motion, thesis in THESIS.items():
        omegas = [
            [percent(figures[f"{motion}, {run}, Omega, %, {kind}"]) for kind in ("mean", "worst")]
            for run in runs
        ]
        distances = (figures[f"{motion}, {r}, RMS from the fine run, mm, mean"]
                     for r in runs[:3])  # fmt: skip
        corrected = record_of(f"{motion}-as-published")["runs"]["corrected"]["omega"]["mean"]
        rows.append([
            f"{motion}, {count[motion]}", f"{thesis}", percent(corrected),
            *(f"{mean} ({worst})" for mean, worst in omegas), ", ".join(map(number, distances)),
        ])  # fmt: skip
    head = ("motion, scenes", "thesis", "as published", *runs,
            "RMS, mm: learned, hex27, best coarse")  # fmt: skip
    return head, rows


def right_masses_converged() -> Rows:
    """The same scenes: mean distances from the converged motion."""
    record, name = read(RECORDS / "thesis_scenes.json"), "Errors, % of the RMS displacement"
    heads, count = _scenes(record, name)
    figures = record["figures"]
    rows = [
        [
            f"{motion}, {count[motion]}",
            *(number(figures[f"{motion}, {run}, {name}, mean"], 2) for run in heads[1:]),
        ]
        for motion in THESIS
    ]
    return ("motion, scenes", *heads[1:]), rows


def _scenes(record: Mapping[str, Any], name: str) -> tuple[list[str], dict[str, int]]:
    """Headings of a table of `validation/thesis_scenes`, and its scenes by motion."""
    table = next(table for table in record["tables"] if table["name"] == name)
    scenes = [str(row[0]) for row in table["rows"]]
    return table["headings"], {m: sum(s.startswith(m) for s in scenes) for m in THESIS}


def losses() -> Rows:
    """Where the six models are behind their base or the intermediate mesh."""
    rows = []
    for model in MODELS:
        record = record_of(model)
        runs, over = record["runs"], record["error_over_base"]
        stress = (runs[run]["stress_error"] for run in ("corrected", "intermediate"))
        rows.append([
            f"`{model}`", number(over["median"], 2), number(over["largest"], 2),
            str(over["above 1.05"]), str(record["nearer"]["intermediate"]),
            ", ".join(number(one, 2) for one in stress),
            str(record["nearer_in_stress"]["intermediate"]),
        ])  # fmt: skip
    head = ("model", "error over base's: median", "largest", "above 1.05",
            "intermediate mesh nearer", "stress error, %: corrected, intermediate",
            "intermediate nearer in stress")  # fmt: skip
    return head, rows


def time_error() -> Rows:
    """Distances from the run that is converged in time."""
    rows = []
    for model in EXACT:
        record = record_of(model)
        distance = record["time_error"]["rms_error"]
        rows.append([
            f"`{model}`", number(1e3 * record["runs"]["corrected"]["rms_error"]),
            *(number(1e3 * distance[run]) for run in ("best", "corrected", "reference")),
        ])  # fmt: skip
    head = ("model", "corrected to reference", "best coarse to converged",
            "corrected to converged", "reference to converged")  # fmt: skip
    return head, rows


def further_splits() -> Rows:
    """The exact models on data unlike those of their training."""
    found = [
        {split["split"]: split for split in record_of(model)["further_splits"]} for model in EXACT
    ]
    rows = []
    for split in found[0]:
        each = [splits[split] for splits in found]
        cells = [
            ", ".join(
                percent(omega, 0)
                for omega in (one["omega_base"], one["omega"]["mean"], one["omega_without_gate"])
            )
            for one in each
        ]
        refused = ", ".join(f"{one['refused_steps']:.0f}" for one in each)
        largest = ", ".join(number(one["error_over_base"]["largest"], 2) for one in each)
        rows.append([split.replace("-", " "), *cells, refused, largest])
    names = [model.partition("-")[0] for model in EXACT]
    head = ("split", *(f"{name}: base, gate, no gate" for name in names),
            "steps refused, %", "largest error over base's, with gate")  # fmt: skip
    return head, rows


def baselines() -> Rows:
    """What needs no network, mean and worst Omega."""
    found = read(RECORDS / "baselines.json")
    rows = [
        [label, *(_omega(found[name]["omega"].get(run)) for name in MODELS)]
        for run, label in BASELINES.items()
    ]
    return ("coarse mesh with", *MODELS), rows


def _omega(found: Mapping[str, float] | None) -> str:
    return "" if found is None else f"{percent(found['mean'])}, {percent(found['smallest'])}"


def element_studies() -> Rows:
    """Trainings of the learned element on fewer bodies, and with parts left out."""
    found = read(RECORDS / "element_studies.json")["studies"]
    names = ("displacements", "first frequency", "frequencies")
    some = next(iter(found.values()))["validation"]
    rows = [["without learning", "1.00", *(percent(100 * some[f"{n}, without"], 2) for n in names)]]
    for study, record in found.items():
        judged = record["validation"]
        errors = (percent(100 * judged[f"{name}, learned"], 2) for name in names)
        rows.append([study, number(judged["loss"], 2), *errors])
    return ("trained on", "loss", *(f"{name}, %" for name in names)), rows


def trainings(*studies: str) -> Rows:
    """Other trainings of some studies."""
    found = [t for t in read("models/withdrawn.json")["trainings"] if t["study"] in studies]
    rows = [
        [t["name"], *(percent(t["omega"][key]) for key in ("mean", "median", "smallest"))]
        for t in found
    ]
    return ("training", "Ω mean", "median", "worst"), rows


def tables() -> Iterable[tuple[str, Any]]:
    """Names of the tables here and what makes them."""
    yield from {
        "models": released, "recipes": recipes, "results": results, "losses": losses,
        "right-masses": right_masses, "right-masses-converged": right_masses_converged,
        "time-error": time_error,
        "further-splits": further_splits, "baselines": baselines,
        "element-studies": element_studies,
        "recipes-compared": partial(trainings, "recipes"),
        "changes-one-by-one": partial(trainings, "ablation"),
        "bodies-and-seeds": partial(trainings, "seeds", "bodies"),
    }.items()  # fmt: skip
    for model in (*MODELS, "tiny"):
        yield f"model-{model}", partial(card, model)

"""What the numbers of a `Comparison` mean on its scene, in sentences."""

from __future__ import annotations

import numpy as np

from pdcorrect.evaluation.compare import Comparison, Row
from pdcorrect.evaluation.refusal_text import by_name, refused_corrections
from pdcorrect.evaluation.run_text import foreign_integrator, inverted_frames
from pdcorrect.metrics import energy_balance, largest_displacement
from pdcorrect.scene import Scene
from pdcorrect.trajectory import Trajectory


def notes(comparison: Comparison) -> list[str]:
    """What the table's numbers mean on this scene, some sentences each."""
    return [
        *_of_the_errors(comparison),
        *_of_the_scene(comparison),
        *(
            f"{label} failed and has no errors or times: {why}"
            for label, why in comparison.failures.items()
        ),
        *_of_the_reference(comparison),
        *_of_the_rows(comparison),
        *_of_the_solvers(comparison),
        *_of_the_models(comparison),
        *_of_the_cells(comparison),
    ]


def shown_labels(comparison: Comparison) -> dict[str, str]:
    """Labels for readers: of a hybrid also how many of its corrections were refused."""
    shares = {row.label: refused_share(comparison, row) for row in comparison.rows}
    return {label: f"{label} ({share})" if share else label for label, share in shares.items()}


def refused_share(comparison: Comparison, row: Row) -> str:
    """As "3 of 40 refused" or "all refused"; empty where no correction was refused."""
    if not row.refused_frames:
        return ""
    frames = len(comparison.runs[row.label])
    every = row.refused_frames == frames
    return "all refused" if every else f"{row.refused_frames} of {frames} refused"


# --- one group of notes each --------------------------------------------------------------


def _of_the_errors(comparison: Comparison) -> list[str]:
    step = comparison.scene.time.step
    moved = largest_displacement(comparison.on_coarse[comparison.reference])
    return [
        f"{_frames(comparison)} frames of {step:g} s; the reference moves by up to "
        f"{1e3 * moved:.3g} mm. Errors (RMS, worst) are distances of the coarse nodes from the "
        f"reference, {comparison.reference}, with the same time step, over all frames. Times and "
        "iterations are for one frame."
    ]


def _frames(comparison: Comparison) -> int:
    return len(comparison.runs[comparison.reference])


def _of_the_scene(comparison: Comparison) -> list[str]:
    scene = comparison.scene
    effective = scene.material.effective
    accuracy = (
        f"Solver tolerance: {scene.solver.tolerance:g} of the coarse cell size for PD, 1e-10 for "
        "Newton."
    )
    if any(np.isfinite(row.omega) for row in comparison.rows):
        accuracy += (
            " 'Corrected' is the share of the coarse PD run's squared error that is gone (eq. 7-2)."
        )
    return [
        f"Material: E = {scene.material.young:.6g} Pa and Poisson's ratio "
        f"{scene.material.poisson:g} asked for; the energy's small-strain moduli are "
        f"E = {effective.young:.6g} Pa and {effective.poisson:.4g} "
        f"(volume weight '{scene.material.volume_weight}'){_elsewhere(scene)}.",
        f"Of the scene itself: element {scene.solver.element}, mass {scene.solver.mass}, time "
        f"integrator {scene.time.integrator}. They are those of all rows whose names do not tell "
        "another.",
        accuracy,
    ]


def _elsewhere(scene: Scene) -> str:
    """What a scene's regions change of its material."""
    count = len(scene.materials)
    return f"; {count} region{'s' if count > 1 else ''} with other values" if count else ""


def _of_the_reference(comparison: Comparison) -> list[str]:
    """What is left of the reference's own error, in space and in time."""
    scene, run = comparison.scene, comparison.runs[comparison.reference]
    case = next(c for c in comparison.cases if c.label == comparison.reference)
    cut = f"with each cell cut {case.refine}×{case.refine}×{case.refine}" if case.refine > 1 else (
        "on the coarse mesh itself"
    )  # fmt: skip
    found = [
        f"The reference, {case.label}, is not the truth: it is the scene {cut} "
        f"({_discretisation(run)}). Its own mesh error is in none of these numbers, and rows that "
        "are nearer to it than that cannot be told apart; nor is the error of the time step, which "
        "all rows share. A finer mesh and a smaller step show how large both are."
    ]
    lost = _lost_share(run)
    if lost is not None:
        found.append(
            f"The time integrator ({scene.time.integrator}, {scene.time.step:g} s) dissipates "
            f"{100 * lost:.0f} % of the work that the loads do on the reference (time error, which "
            "all rows share)."
        )
    return found


def _discretisation(run: Trajectory) -> str:
    return f"element {run.attributes['element']}, mass {run.attributes['mass']}"


def _lost_share(run: Trajectory) -> float | None:
    """Share of the work of loads and clamps that the integrator lost; None if unclear."""
    if run.problem is None or run.problem.scene.time.integrator == "quasi-static":
        return None
    balance = energy_balance(run)
    work = float(balance.external_work[-1] + balance.clamp_work[-1])
    lost = float(balance.dissipation[-1])
    return lost / work if work > lost > 0 else None


def _of_the_rows(comparison: Comparison) -> list[str]:
    """Elements and masses of the rows, beside the reference's, and what is special about some."""
    shown = {row.label for row in comparison.rows} - {comparison.reference}
    found = []
    for case in comparison.cases:
        if case.label not in shown or case.model is not None:
            continue
        run = comparison.runs[case.label]
        if case.element is not None:
            found.append(
                f"{case.label}: {_discretisation(run)}, on the scene's cells; it has "
                f"{len(run.points)} nodes, and its errors are those of the coarse ones among them."
            )
        elif case.base == "total-mass":
            found.append(_of_the_total_mass(case.label, run))
        elif case.base == "best" and not _unlike(run, comparison.runs[comparison.reference]):
            found.append(
                f"{case.label}: {_discretisation(run)}, as the reference; speed-ups are over that, "
                "which takes longer than a fine mesh of the scene's own element."
            )
    found += _unlike_the_reference(comparison)
    if comparison.without_best:
        found.append(f"There is no row of the best coarse model: {comparison.without_best}.")
    return found


def _of_the_total_mass(label: str, run: Trajectory) -> str:
    """What the coarse model of the base "total-mass" is."""
    rule = run.attributes["mass"]
    what = (
        f"{label}: the scene's coarse mesh, its density scaled so that it is as heavy as the mesh "
        "with each cell cut 4×4×4. "
    )
    if rule == "per-node":
        return what + "By the mass rule per-node a mesh is the heavier the coarser it is."
    return what + (
        f"By the mass rule {rule} meshes have one mass, so it changes nothing but for regions of "
        "another density that end inside of cells."
    )


def _unlike_the_reference(comparison: Comparison) -> list[str]:
    """The rows that differ from the reference, those that do in the same way together."""
    truth = comparison.runs[comparison.reference]
    alike: dict[str, list[str]] = {}
    for row in comparison.rows:
        run = comparison.runs[row.label]
        unlike = _unlike(run, truth)
        if unlike:
            mass = f", total mass {_total_mass(run):.4g} kg" if "total mass" in unlike else ""
            alike.setdefault(_discretisation(run) + mass, []).append(row.label)
    if not alike:
        return []
    groups = "; ".join(f"{', '.join(labels)}: {what}" for what, labels in alike.items())
    return [
        f"{groups}, unlike the reference's ({_discretisation(truth)}, total mass "
        f"{_total_mass(truth):.4g} kg). Their errors are distances from a run whose own errors are "
        "in them: from a fine mesh of their own element and mass they may be nearer."
    ]


def _unlike(run: Trajectory, other: Trajectory) -> list[str]:
    """In which of element, mass (the rule) and total mass (by a millionth) two runs differ."""
    found = [name for name in ("element", "mass") if run.attributes[name] != other.attributes[name]]
    same = np.isclose(_total_mass(run), _total_mass(other), rtol=1e-6, atol=0.0, equal_nan=True)
    return found if same else [*found, "total mass"]


def _total_mass(run: Trajectory) -> float:
    """Of all nodes, kg; not a number where the run does not know what was stepped."""
    return float("nan") if run.problem is None else float(run.problem.mass.sum())


def _of_the_solvers(comparison: Comparison) -> list[str]:
    found = []
    if comparison.solver_error is not None:
        coarse = [c.label for c in comparison.cases if c.plain and c.solver == "pd"][-1]
        unlike = _unlike(comparison.runs[coarse], comparison.runs[comparison.reference])
        parts = ["the mesh's", *(f"the {name}'s" for name in unlike)]
        rest = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        found.append(
            f"PD and Newton on the coarse mesh differ by at most "
            f"{1e3 * comparison.solver_error:.2g} mm (solver error); the rest of their error is "
            f"{rest}."
        )
    return found + [
        f"{row.label}: {row.unusual_frames} of {_frames(comparison)} frames converged only by a "
        "fallback (Newton-CG or smaller steps), which changes their time error."
        for row in comparison.rows
        if row.unusual_frames
    ]


def _of_the_models(comparison: Comparison) -> list[str]:
    gated = {case.label: case.gate for case in comparison.cases}
    found = [
        f"{label}: trained on scenes of {about['dataset']!r} and with references of their "
        "setting; on others it may be of no use, and "
        + ("its gate need not notice." if gated[label] else "it has no gate.")
        for label, about in comparison.models.items()
    ]
    found += filter(
        None,
        (
            foreign_integrator(comparison.scene.time.integrator, about["trained_integrator"], label)
            for label, about in comparison.models.items()
        ),
    )
    told: dict[str, list[str]] = {}
    for row in comparison.rows:
        if not row.refused_frames:
            continue
        run, refused = comparison.runs[row.label], comparison.refused.get(row.label)
        counted, *told[row.label] = refused_corrections(run.stats["gate"], refused)
        found.append(f"{row.label}: {counted}")
        if row.refused_frames == len(run):
            base = comparison.models[row.label]["base"]
            found.append(
                f"{row.label} is no corrected run: with all corrections refused its steps are "
                f"those of the coarse model that it would correct ({base!r}), to the last bit, "
                "and take longer."
            )
    return found + by_name(told)


def _of_the_cells(comparison: Comparison) -> list[str]:
    told = {
        row.label: inverted_frames(comparison.runs[row.label].stats, comparison.scene.time.step)
        for row in comparison.rows
    }
    return [f"{label}: {inverted}." for label, inverted in told.items() if inverted]

"""What is told of one run: sentences, and a page with them and its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pdcorrect import figures
from pdcorrect._files import make_folder
from pdcorrect.evaluation.page import PAGE, write_page
from pdcorrect.evaluation.report import (
    draw_places,
    farthest_point,
    film_frames,
    refused_corrections,
    three_digits,
)
from pdcorrect.fem.problem import Problem
from pdcorrect.metrics import energies, largest_displacement
from pdcorrect.solvers.rollout import gained_energy, inverted_frames, stored_and_put_in
from pdcorrect.trajectory import Stepper, Trajectory

_WORK = {
    "clamp_work": "work of the clamps",
    "obstacle_work": "work of the obstacles",
    "actuator_work": "work of the actuators",
    "damping_loss": "lost to damping",
    "friction_loss": "lost to friction",
}
"""Told of where there is any."""
_LOST = 0.2
"""Share of the energy of whose loss by the integrator is told."""


def summary(stats: Mapping[str, Any], stepper: Stepper, resumed: int = 0) -> list[str]:
    """Frames, time, iterations, energy, and what is unusual about a run, one sentence each."""
    seconds = stats["seconds"]  # the first frame may load kernels: hence the median
    count = len(seconds)
    problem, status = stepper.problem, stats["status"].tolist()
    ends = ", ".join(f"{status.count(name)} {name.lower()}" for name in dict.fromkeys(status))
    ran = f"{count} frames ({resumed} resumed)" if resumed else f"{count} frames"
    element, correction = problem.element, problem.correction
    if correction is not None and not correction.learned.all():
        element += f", {int(correction.learned.sum())} of them learned"
    work = {"external_work": "work of the loads"}
    work |= {name: text for name, text in _WORK.items() if name in stats and stats[name].any()}
    found = [
        f"{ran} of {problem.scene.time.step:g} s on {len(problem.positions)} nodes "
        f"and {len(problem.cells)} cells ({element}, {problem.mass_rule} mass) in "
        f"{seconds.sum():.2f} s: median {three_digits(1e3 * np.median(seconds))} ms a frame",
        f"iterations a frame: mean {stats['iterations'].mean():.1f}, most "
        f"{stats['iterations'].max()}; frames: {ends}",
        f"energy at the end: elastic {stats['elastic_energy'][-1]:.4g} J, kinetic "
        f"{stats['kinetic_energy'][-1]:.4g} J; over the run "
        + ", ".join(f"{text} {stats[name].sum():.4g} J" for name, text in work.items()),
    ]
    if problem.scene.time.integrator != "quasi-static":
        found += [gained_energy(stats), lost_energy(problem, stats)]
    if "gate" in stats:
        if not stats["refused"].all():
            largest = 1e3 * stats["correction"].max()
            found.append(f"corrections: at most {largest:.3g} mm of a node in a frame")
        found.append(refused_corrections(stats["gate"]))
    return [*filter(None, [*found, inverted_frames(stats, problem.scene.time.step)])]


def lost_energy(problem: Problem, stats: Mapping[str, Any]) -> str:
    """What the integrator lost of the energy that a run had or was given; empty if little."""
    stored, put_in = stored_and_put_in(stats)
    start = sum(energies(problem, problem.initial_state()))
    lost, most = start + put_in[-1] - stored[-1], start + max(float(put_in.max()), 0.0)
    if not lost > _LOST * most > 0.0:
        return ""
    return (
        f"the time steps lost {lost:.4g} J, {lost / most:.0%} of the energy that there was: "
        "take smaller ones, substeps or another integrator if motion matters"
    )


def write_run_report(
    run: Trajectory, stepper: Stepper, folder: str | Path, more: tuple[str, ...] = ()
) -> Path:
    """Write a page about a run, its table, sentences and pictures; ``more`` are more sentences."""
    folder, problem = make_folder(folder), stepper.problem
    run, scene = replace(run, problem=problem), problem.scene
    rows = [
        {"quantity": name, "value": value}
        for name, value in {
            "frames": f"{len(run)} of {scene.time.step:g} s",
            "nodes, cells": f"{len(run.points)}, {len(run.cells)}",
            "largest displacement": f"{1e3 * largest_displacement(run):.4g} mm",
            **run.attributes,
        }.items()
    ]
    sentences = [*summary(run.stats, stepper), *more]
    return write_page(folder / PAGE, scene.name, rows, sentences, _draw(run, folder))


def _draw(run: Trajectory, folder: Path) -> dict[str, str]:
    """An animation and curves; captions by file name."""
    assert run.problem is not None
    frames = film_frames(len(run.times))
    figures.render(
        run, folder / "motion.gif", colour="stress", frame=frames, fps=len(frames) / 3, window=700
    )
    figures.plot_energy(run, folder / "energy.png", labels=["run"])
    point = farthest_point(run, run.problem.free.all(axis=1))
    places = draw_places({"run": run}, run.problem.scene, point, folder)
    captions = {"motion.gif": "The motion, coloured by von Mises stress averaged to the nodes."}
    return {**captions, **places, "energy.png": "Energies, and work so far."}

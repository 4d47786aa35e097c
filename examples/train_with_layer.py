"""A network that finds the forces which bring a beam's tip to a target, trained through `PDLayer`.

A small network maps a displacement of the tip to forces along x, y and z on an inner and on
the last section of a beam.  The forces act for five steps; the loss is the tip's squared
distance from where it should be, and its derivatives go back through the steps into
the network.  Sixteen scenes with a target each are stepped as one batch.

    python examples/train_with_layer.py [FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor, nn

import pdcorrect as pc

CELL, STEPS = 0.02, 5
SCENES, ITERATIONS = 16, 30
REACH = torch.tensor([0.2, 1.0, 1.0])
"""Largest displacements of the tip that are asked for, in cells."""
STRONGEST = torch.tensor([0.3, 0.1, 0.1], dtype=torch.float64)
"""Unit of the forces along x, y and z, N."""

SCENE = pc.Scene(
    name="train with layer",
    body={"shape": "beam", "cells": [5, 1, 1], "cell_size": CELL},
    material={"young": 1e5, "poisson": 0.4, "density": 1e3},
    clamps=[{"region": {"plane": "x", "at": "min"}}],
    loads=[{"kind": "gravity", "acceleration": [0.0, 0.0, -9.81]}],
    time={"step": 0.01, "frames": STEPS},
    solver={"tolerance": 1e-3},
)


class Reacher(nn.Module):
    """From where the tip should be to where it gets.

    Parameters
    ----------
    problem : Problem
        Of which ``SCENES`` are stepped together.
    """

    def __init__(self, problem: pc.Problem) -> None:
        super().__init__()
        self.layer = pc.PDLayer(pc.BatchStepper([problem] * SCENES), steps=STEPS, tolerance=1e-4)
        self.network = nn.Sequential(
            nn.Linear(3, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 6)
        ).double()
        x = problem.positions[:, 0] / problem.positions[:, 0].max()
        sections = np.stack([np.isclose(x, at) / np.isclose(x, at).sum() for at in (0.6, 1.0)])
        self.sections = torch.tensor(sections)
        self.tip = torch.tensor(np.flatnonzero(np.isclose(x, 1.0)))

    def forward(self, wanted: Tensor) -> Tensor:
        """Displacements (B, 3) of the tip after the steps, in cells, for those wanted."""
        amplitudes = self.network(wanted / REACH).reshape(-1, 2, 3) * STRONGEST
        forces = torch.einsum("sn,bsi->bni", self.sections, amplitudes)
        rest = self.layer.stepper.rest_state()
        positions, _ = self.layer(rest.positions, rest.velocities, forces)
        return (positions - rest.positions)[:, self.tip].mean(dim=1) / CELL


def targets(generator: torch.Generator) -> Tensor:
    """Displacements (B, 3) in cells, uniform in a box."""
    return (2.0 * torch.rand(SCENES, 3, generator=generator, dtype=torch.float64) - 1.0) * REACH


def main(folder: Path = Path()) -> dict[str, float]:
    """Train, print a summary, and draw ``train_with_layer.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    model = Reacher(pc.discretise(SCENE))
    optimiser = torch.optim.Adam(model.network.parameters(), lr=2e-2)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, ITERATIONS, 1e-3)
    seen, unseen = torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)
    held_out = targets(unseen)

    def validate() -> tuple[float, Tensor]:
        with torch.no_grad():
            reached = model(held_out)
        return float(((reached - held_out) ** 2).sum(dim=1).mean()), reached

    trained, validated = [], [(0, validate()[0])]
    for i in range(ITERATIONS):
        wanted = targets(seen)
        loss = ((model(wanted) - wanted) ** 2).sum(dim=1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        decay.step()
        trained.append(loss.item())
        if (i + 1) % 10 == 0:
            validated.append((i + 1, validate()[0]))
    last, reached = validate()
    summary = {"untrained": validated[0][1], "trained": last}
    summary["factor"] = summary["untrained"] / last
    print(
        f"{ITERATIONS} iterations of {SCENES} scenes: mean squared distance of held-out targets "
        f"{summary['untrained']:.3g} -> {last:.3g} cells², {summary['factor']:.0f} times less"
    )
    draw(trained, validated, held_out, reached, folder)
    return summary


def draw(
    trained: list[float],
    validated: list[tuple[int, float]],
    wanted: Tensor,
    reached: Tensor,
    folder: Path,
) -> None:
    """Both losses, and held-out targets with the points reached."""
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    losses, *views = figure.subplots(1, 3)
    losses.semilogy(trained, color="#0072b2", label="training")
    losses.semilogy(*zip(*validated, strict=True), "o-", color="#d55e00", label="held-out targets")
    losses.set(xlabel="iteration", ylabel="mean squared distance, cells²", title="Loss")
    losses.legend(frameon=False)
    for points, (across, up) in zip(views, ((0, 2), (1, 2)), strict=True):
        for a, b in zip(wanted, reached, strict=True):
            points.plot([a[across], b[across]], [a[up], b[up]], "-", color="#999999", linewidth=1)
        points.plot(wanted[:, across], wanted[:, up], "kx", markersize=8, label="target")
        points.plot(
            reached[:, across], reached[:, up], "o", color="#009e73", markersize=5, label="reached"
        )
        points.set(xlabel=f"{'xyz'[across]}, cells", ylabel=f"{'xyz'[up]}, cells")
        points.set_title("Tip after five steps")
        points.set_aspect("equal", adjustable="datalim")
    views[-1].legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for axis in (losses, *views):
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "train_with_layer.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="for the figure")
    main(parser.parse_args().folder)

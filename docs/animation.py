"""Draws images/unseen_cross.gif, the animation of the README (extras learn and view).

python docs/animation.py
"""

from pathlib import Path

import numpy as np

import pdcorrect as pc
from pdcorrect.scene import trained_coarse

ROOT = Path(__file__).parents[1]
IMAGE = ROOT / "docs" / "images" / "unseen_cross.gif"
COLOURS = 48


def runs() -> dict[str, pc.Trajectory]:
    """Four runs of one scene by their names in the picture, the reference last."""
    scene = pc.Scene.load(ROOT / "examples" / "unseen_cross.toml")
    best = trained_coarse(scene)
    steppers: dict[str, pc.Stepper] = {
        "coarse": pc.ProjectiveDynamics(pc.discretise(scene)),
        "best coarse": pc.ProjectiveDynamics(pc.discretise(best)),
        "corrected": pc.hybrid_of(scene, ROOT / "models" / "torsion-exact"),
        "fine": pc.ProjectiveDynamics(pc.discretise(best, refine=4)),
    }
    return {name: pc.rollout(stepper) for name, stepper in steppers.items()}


def reduced(path: Path) -> None:
    """Write a film again with few colours and every second frame; the last one stays longer."""
    from PIL import Image, ImageSequence

    with Image.open(path) as film:
        pages = [page.convert("RGB") for page in ImageSequence.Iterator(film)][::2]
        times = [2 * film.info["duration"]] * (len(pages) - 1) + [2000]
    sample = Image.fromarray(np.concatenate([np.asarray(page) for page in pages[::5]]))
    palette = sample.quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    drawn = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pages]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=times, loop=0)


def main(path: Path = IMAGE) -> None:
    """Run, draw, reduce."""
    found = runs()
    fine = found["fine"]
    truth = pc.restrict(fine, to=found["coarse"])
    labels = [
        f"{name}\n{len(run.points)} nodes"
        + ("" if run is fine else f", RMS {1e3 * pc.metrics.rms_error(run, truth):.1f} mm")
        for name, run in found.items()
    ]
    pc.render(
        list(found.values()),
        path,
        labels=labels,
        colour="error",
        reference=fine,
        fps=10,
        window=1000,
    )
    reduced(path)


if __name__ == "__main__":
    main()

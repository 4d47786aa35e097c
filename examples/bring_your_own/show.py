"""The corrected hook beside the coarse models and finer ones: error, time, picture, ParaView.

    python examples/bring_your_own/show.py hook_evaluation.toml hook_model/model

prints a line for each run, and writes ``hook.png``, ``hook_hybrid.h5`` and ``hook_vtu/``.
"""

import sys
import time
from pathlib import Path

import pdcorrect as pc

REFINE = 3  # as in record.py


def main(
    scene_file: Path, model: Path, folder: Path, frames: int | None = None
) -> dict[str, float]:
    """Draw, write, and return the RMS distances from the fine run, mm."""
    scene = pc.Scene.load(scene_file)
    better = pc.best_coarse(scene)
    coarse = pc.ProjectiveDynamics(pc.discretise(better))
    hybrid = pc.hybrid_of(scene, model)
    steppers = {
        "fine": pc.ProjectiveDynamics(pc.discretise(better, refine=REFINE)),
        "plain": pc.ProjectiveDynamics(pc.discretise(scene)),
        "best coarse": coarse,
        "hybrid": hybrid,
        "intermediate": pc.ProjectiveDynamics(pc.discretise(scene, refine=2)),
    }
    runs, errors = {}, {}
    for name, stepper in steppers.items():
        stepper.prepare()
        before = time.process_time()
        run = pc.rollout(stepper, frames)
        took = 1e3 * (time.process_time() - before) / len(run)
        runs[name] = pc.restrict(run, to=coarse.problem)
        errors[name] = 1e3 * pc.metrics.rms_error(runs[name], runs["fine"])
        print(f"{name}: RMS {errors[name]:.2f} mm from the fine run, {took:.0f} ms a frame")
    refused = int(runs["hybrid"].stats["refused"].sum())
    print(f"{refused} of {len(runs['hybrid'])} corrections refused")
    drawn = ("plain", "best coarse", "hybrid")
    pc.render(
        [runs[name] for name in drawn],
        folder / "hook.png",
        labels=[f"{name}, RMS {errors[name]:.1f} mm" for name in drawn],
        colour="error",
        reference=runs["fine"],
    )
    pc.save_trajectory(folder / "hook_hybrid.h5", runs["hybrid"], overwrite=True)
    pc.write_vtu_series(runs["hybrid"], folder / "hook_vtu", name="hook_hybrid")
    return errors


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path())

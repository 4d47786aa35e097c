"""The corrected hook beside the coarse models and the fine one, as a picture and for ParaView.

    python examples/bring_your_own/show.py hook.toml hook_model/model

writes ``hook.png``, ``hook_hybrid.h5`` and ``hook_vtu/``.
"""

import sys
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
    hybrid = pc.HybridStepper(coarse, pc.load_model(model).corrector, gate=pc.Gate())
    fine = pc.rollout(pc.ProjectiveDynamics(pc.discretise(better, refine=REFINE)), frames)
    truth = pc.restrict(fine, to=coarse.problem)
    runs = {
        "plain": pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)), frames),
        "best coarse": pc.rollout(coarse, frames),
        "hybrid": pc.rollout(hybrid, frames),
    }
    errors = {name: 1e3 * pc.metrics.rms_error(run, truth) for name, run in runs.items()}
    refused = int(runs["hybrid"].stats["refused"].sum())
    for name, error in errors.items():
        print(f"{name}: RMS {error:.2f} mm from the fine run")
    print(f"{refused} of {len(runs['hybrid'])} corrections refused")
    labels = [f"{name}, RMS {error:.1f} mm" for name, error in errors.items()]
    picture = folder / "hook.png"
    pc.render([*runs.values()], picture, labels=labels, colour="error", reference=truth)
    pc.save_trajectory(folder / "hook_hybrid.h5", runs["hybrid"], overwrite=True)
    pc.write_vtu_series(runs["hybrid"], folder / "hook_vtu")
    return errors


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path())

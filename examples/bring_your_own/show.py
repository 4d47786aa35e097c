"""The corrected hook beside the coarse models and finer ones: error, time, picture, ParaView.

    python examples/bring_your_own/show.py hook_evaluation.toml hook_model/model

prints a line for each run, and writes ``hook.json``, ``hook.png``, ``hook_hybrid.h5`` and
``hook_vtu/``.
"""

import json
import os
import sys
import time
from pathlib import Path

import pdcorrect as pc
from pdcorrect.scene import trained_coarse

REFINE = 3  # as in record.py


def main(
    scene_file: Path, model: Path, folder: Path, frames: int | None = None
) -> dict[str, float]:
    """Draw, write, and return the RMS distances from the fine run, mm."""
    scene = pc.Scene.load(scene_file)
    better = trained_coarse(scene)
    coarse = pc.ProjectiveDynamics(pc.discretise(better))
    hybrid = pc.hybrid_of(scene, model)
    steppers = {
        "fine": pc.ProjectiveDynamics(pc.discretise(better, refine=REFINE)),
        "plain": pc.ProjectiveDynamics(pc.discretise(scene)),
        "best coarse": coarse,
        "hybrid": hybrid,
        "intermediate": pc.ProjectiveDynamics(pc.discretise(scene, refine=2)),
    }
    runs, errors, rows = {}, {}, []
    for name, stepper in steppers.items():
        stepper.prepare()
        before = time.process_time()
        run = pc.rollout(stepper, frames)
        took = 1e3 * (time.process_time() - before) / len(run)
        runs[name] = pc.restrict(run, to=coarse.problem)
        errors[name] = 1e3 * pc.metrics.rms_error(runs[name], runs["fine"])
        print(f"{name}: RMS {errors[name]:.2f} mm from the fine run, {took:.0f} ms a frame")
        row = {"run": name, "nodes": len(run.points), "rms_mm": errors[name]}
        rows.append(row | {"processor_ms_a_frame": took})
    refused = int(runs["hybrid"].stats["refused"].sum())
    print(f"{refused} of {len(runs['hybrid'])} corrections refused")
    record = {"rows": rows, "refused": refused, "frames": len(runs["hybrid"])}
    record |= {"load": os.getloadavg()[0], "cores": os.cpu_count()}  # of the machine, last minute
    record |= {name: judged(folder / name) for name in ("before", "after")}
    (folder / "hook.json").write_text(json.dumps(record, indent=1) + "\n")
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


def judged(folder: Path) -> dict[str, object]:
    """Means that `pdcorrect evaluate` has written to a folder; nothing where it has not."""
    if not (folder / "summary.json").exists():
        return {}
    summary = json.loads((folder / "summary.json").read_text())
    names = ("omega", "rms_error", "stress_error", "linear_momentum_error", "gate_rate")
    runs = {
        run: {name: found["measures"].get(name, {}).get("mean") for name in names}
        for run, found in summary["runs"].items()
    }
    return {"runs": runs} | {key: summary[key] for key in ("command", "date", "environment")}


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path())

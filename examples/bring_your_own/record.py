"""A data set of one body: drawn loads, fine and coarse runs.

    python examples/bring_your_own/record.py hook

writes ``hook/`` with the splits training, validation and evaluation, and the scene of the first
evaluation simulation, ``hook_evaluation.toml``.
"""

import sys
from pathlib import Path

import numpy as np

import pdcorrect as pc
from pdcorrect.data.import_files import shard_from_trajectories
from pdcorrect.data.schema import write_shard
from pdcorrect.scene import trained_coarse

SCENE = Path(__file__).parent / "hook.toml"
SPLITS = {"training": 6, "validation": 2, "evaluation": 4}  # simulations
REFINE = 3  # of the reference; 4 in the data sets of the toolkit


def draw_force(rng: np.random.Generator) -> list[float]:
    """5 to 15 N in any direction."""
    direction = rng.normal(size=3)
    force = rng.uniform(5.0, 15.0) * direction / np.linalg.norm(direction)
    return [round(float(part), 2) for part in force]


def main(
    folder: Path,
    splits: dict[str, int] = SPLITS,
    frames: int | None = None,
    refine: int = REFINE,
) -> None:
    """Simulate all splits and write them."""
    scene = pc.Scene.load(SCENE)
    if frames is not None:
        scene = scene.with_changes(time={"frames": frames})
    load = scene.loads[0].model_dump(exclude_none=True)
    rng = np.random.default_rng(1)
    # mesh, operators and factorisation are those of all simulations
    fine = pc.discretise(trained_coarse(scene), refine=refine)
    coarse = pc.discretise(scene)
    for split, count in splits.items():
        references, plain = [], []
        for k in range(count):
            loads = [{**load, "force": draw_force(rng)}]
            if split == "evaluation" and k == 0:
                text = scene.with_changes(loads=loads).to_toml()
                Path(f"{folder}_evaluation.toml").write_text(text)
            references.append(rolled(fine.with_loads(loads)))
            plain.append(rolled(coarse.with_loads(loads)))
            print(f"{split} {k}: {loads[0]['force']} N", flush=True)
        shard = shard_from_trajectories(
            references, plain, dataset=folder.name, split=split, best=True
        )
        write_shard(folder / split / "mesh-0000.h5", shard)


def rolled(problem: pc.Problem) -> pc.Trajectory:
    """A run of all frames; a step that fails raises."""
    return pc.rollout(pc.ProjectiveDynamics(problem))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Small trainings on a few files of datasets/tiny."""

import shutil
from dataclasses import replace
from pathlib import Path

import torch

from dataset_configs import small
from pdcorrect.data.generate import generate
from pdcorrect.data.schema import read_shard, write_shard
from pdcorrect.training.fitting import fit_normaliser
from pdcorrect.training.recipe import Stage, TrainingConfig
from pdcorrect.training.scenes import load_recordings
from pdcorrect.training.windows import StepWindows

TINY = Path(__file__).parent.parent / "datasets" / "tiny"
SMALL = {"preset": "compact", "changes": {"layers": 1, "width": 8}}


def dataset(folder, training=(0, 3), validation=(1,), frames=20):
    """Some meshes of tiny: 72 nodes with one simulation and 90 with two; 72 with two."""
    for split, numbers in (("training", training), ("validation", validation)):
        (folder / split).mkdir(parents=True)
        for number in numbers:
            name = f"{split}/mesh-{number:04d}.h5"
            if frames == 20:
                shutil.copy(TINY / name, folder / name)
            else:
                write_shard(folder / name, shortened(read_shard(TINY / name), frames), "float32")
    return folder


def published(folder):
    """A small data set as published, all three splits."""
    config = small(
        setting="as-published", frames=4, training={"meshes": 3, "simulations": 5},
        validation_share=0.34,
    )  # fmt: skip
    assert generate(config, folder, splits=["training", "validation", "evaluation"])
    return folder


def shortened(shard, frames):
    """Simulations up to a frame."""

    def run(found):
        return replace(
            found,
            positions=found.positions[: frames + 1],
            predictions=None if found.predictions is None else found.predictions[:frames],
            statistics={name: x[:frames] for name, x in found.statistics.items()},
        )

    simulations = tuple(
        replace(
            s, forces=s.forces[:frames], runs={name: run(found) for name, found in s.runs.items()}
        )
        for s in shard.simulations
    )
    return replace(shard, simulations=simulations)


def config(*stages, **changes):
    """A training of a very small network; never validated between, unless asked."""
    never = {"iterations": 10**6}
    return TrainingConfig(**{
        "corrector": SMALL, "base": "plain", "stages": stages, "validate_every": never,
        "checkpoint_every": never, "report_every": 1000, **changes,
    })  # fmt: skip


def one_step(**changes):
    """A stage."""
    return Stage(**{"kind": "one-step", "iterations": 4, "batch": 3, **changes})


def unrolled(**changes):
    """A stage."""
    return Stage(**{"kind": "unrolled", "iterations": 2, "batch": 3, **changes})


def windows(folder, settings, **options):
    """The windows of a configuration's training split, and its recordings."""
    recordings = load_recordings(folder, "training", settings.base)
    architecture = settings.corrector.config()
    return StepWindows(folder, recordings, architecture, settings.base, **options), recordings


def fitted(folder, settings, silent=False):
    """A corrector with a normaliser; ``silent`` ones correct nothing."""
    from pdcorrect.corrector.corrector import Corrector

    torch.manual_seed(0)
    corrector = Corrector(settings.corrector.config())
    fit_normaliser(corrector, windows(folder, settings)[0], 50)
    if silent:
        with torch.no_grad():
            corrector.network.decoder[-1].weight.zero_()
            corrector.network.decoder[-1].bias.zero_()
    return corrector


def weights(corrector):
    """All weights of a corrector's network, one after another; a copy."""
    return torch.cat([p.detach().reshape(-1).clone() for p in corrector.network.parameters()])

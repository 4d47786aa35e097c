"""Generate data sets, check them and write what is kept of them here; start again to go on.

python datasets/make_all.py FOLDER SUMMARIES [NAME ...] [--device cuda] [--workers 2]
    [--batch 60] [--seconds 1500]

FOLDER/NAME gets the data; SUMMARIES/NAME the card, all numbers of `pdcorrect dataset info`,
the manifest with the files' hashes, the normalisation statistics, and one file of the
evaluation split to draw.  A set that is not complete when time is up has no summary.
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

from pdcorrect.data.card import dataset_card
from pdcorrect.data.check import check_dataset
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.generate import Workers, generate
from pdcorrect.data.info import dataset_info
from pdcorrect.data.schema import CONFIG, MANIFEST
from pdcorrect.data.statistics import compute_statistics
from pdcorrect.progress import FileLines
from pdcorrect.replacement import make_folder, write_text

HERE = Path(__file__).parent
NAMES = [
    f"{motion}-{setting}"
    for setting in ("as-published", "exact")
    for motion in ("impulse", "stretch", "torsion")
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("summaries", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME", default=NAMES)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--batch", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=None)
    options = parser.parse_args()
    workers = Workers(options.workers, None, options.device, options.batch)
    deadline = None if options.seconds is None else time.monotonic() + options.seconds
    for name in options.names:
        left = None if deadline is None else deadline - time.monotonic()
        if left is not None and left <= 0:
            print(f"{name}: no time left")
            continue
        started = time.monotonic()
        config = DatasetConfig.load(HERE / name / CONFIG)
        print(name, flush=True)
        target = options.folder / name
        complete = generate(config, target, workers, seconds=left, on_file=FileLines())
        seconds = time.monotonic() - started
        print(f"{name}: {seconds:.0f} s, {'complete' if complete else 'cut off'}", flush=True)
        if complete:
            summarise(options.folder / name, options.summaries / name)


def summarise(data: Path, target: Path) -> None:
    """Check a complete data set and write its summary."""
    findings = check_dataset(data)
    for finding in findings[:10]:
        print(f"  {finding}")
    print(f"  {len(findings)} findings")
    compute_statistics(data).save(data)
    info = dataset_info(data)
    make_folder(target)
    write_text(target / "info.json", info.to_json() + "\n")
    write_text(target / "README.md", dataset_card(data, info))
    for name in (MANIFEST, "statistics.json"):
        shutil.copyfile(data / name, target / name)
    shutil.copyfile(data / "evaluation" / "mesh-0000.h5", target / "sample.h5")


if __name__ == "__main__":
    main()

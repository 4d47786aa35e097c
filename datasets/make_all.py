"""Generate data sets, check them and write what is kept of them here; start again to go on.

python datasets/make_all.py FOLDER SUMMARIES [NAME ...] [--device cuda] [--workers 2]
    [--batch 60] [--seconds 1500]

FOLDER/NAME gets the data; SUMMARIES/NAME the card, all numbers of `pdcorrect dataset info`,
the manifest with the files' hashes, the normalisation statistics, and one file of the
evaluation split to draw.  A set that is not complete when time is up has no summary.

Several workers are started once and compute all sets; a set is begun when too little is left
of the one before to keep them busy, and summaries are written by processes of their own.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import shutil
import threading
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path

from pdcorrect.data.card import dataset_card
from pdcorrect.data.check import check_dataset
from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.generate import generate
from pdcorrect.data.info import dataset_info
from pdcorrect.data.schema import CONFIG, MANIFEST
from pdcorrect.data.statistics import compute_statistics
from pdcorrect.data.workers import Workers, local_cluster
from pdcorrect.progress import FileLines
from pdcorrect.replacement import make_folder, write_text

HERE = Path(__file__).parent
NAMES = [
    f"{motion}-{setting}"
    for setting in ("as-published", "exact")
    for motion in ("impulse", "stretch", "torsion")
]
SUMMARIES_AT_ONCE = 2
ATTEMPTS = 2
"""Since a worker may have died, and what it had finished is kept."""


class Production(threading.Thread):
    """Generates one set, and has its summary written.

    Attributes
    ----------
    nearly : threading.Event
        Set when the workers have, or will soon have, nothing more to begin.
    """

    def __init__(
        self,
        name: str,
        options: argparse.Namespace,
        workers: Workers,
        deadline: float | None,
        summaries: Executor,
    ) -> None:
        super().__init__(name=name)
        self._options, self._workers, self._deadline = options, workers, deadline
        self._summaries = summaries
        self._lines = FileLines()
        self.nearly = threading.Event()

    def run(self) -> None:
        try:
            for _ in range(ATTEMPTS):
                with contextlib.suppress(_Failed):
                    self._generate()
                    break
        finally:
            self.nearly.set()

    def _generate(self) -> None:
        started, target = time.monotonic(), self._options.folder / self.name
        config = DatasetConfig.load(HERE / self.name / CONFIG)
        left = None if self._deadline is None else max(self._deadline - started, 0.0)
        print(f"{self.name}: begun", flush=True)
        try:
            complete = generate(config, target, self._workers, seconds=left, on_file=self._note)
        except Exception as error:
            traceback.print_exc()
            raise _Failed from error
        seconds = time.monotonic() - started
        what = "complete" if complete else "cut off"
        print(f"{self.name}: {seconds:.0f} s, {what}", flush=True)
        if complete:
            self._summaries.submit(summarise, target, self._options.summaries / self.name)

    def _note(self, name: str, done: int, total: int, new: int) -> None:
        self._lines(f"{self.name}/{name}", done, total, new)
        if total - done <= self._workers.count * self._workers.batch:
            self.nearly.set()


class _Failed(Exception):
    """A generation that raised; its traceback has been printed."""


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
    deadline = None if options.seconds is None else time.monotonic() + options.seconds
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(SUMMARIES_AT_ONCE, mp_context=context) as summaries,
        _scheduler(options.workers) as address,
    ):
        workers = Workers(options.workers, address, options.device, options.batch)
        begun: list[Production] = []
        for name in options.names:
            if deadline is not None and time.monotonic() > deadline:
                print(f"{name}: no time left", flush=True)
                continue
            begun.append(Production(name, options, workers, deadline, summaries))
            begun[-1].start()
            if address is None:
                begun[-1].join()
            begun[-1].nearly.wait()
        for production in begun:
            production.join()


@contextlib.contextmanager
def _scheduler(workers: int) -> Iterator[str | None]:
    """The address of a cluster on this machine; None for a single worker, which is this process."""
    if workers < 2:
        yield None
        return
    with local_cluster(workers) as cluster:
        yield cluster.scheduler_address


def summarise(data: Path, target: Path) -> None:
    """Check a complete data set and write its summary."""
    started = time.monotonic()
    findings = check_dataset(data)
    compute_statistics(data).save(data)
    info = dataset_info(data)
    make_folder(target)
    write_text(target / "info.json", info.to_json() + "\n")
    write_text(target / "README.md", dataset_card(data, info))
    for name in (MANIFEST, "statistics.json"):
        shutil.copyfile(data / name, target / name)
    shutil.copyfile(data / "evaluation" / "mesh-0000.h5", target / "sample.h5")
    lines = [f"{data.name}: {len(findings)} findings", *map(str, findings[:10])]
    print("\n  ".join(lines), f"({time.monotonic() - started:.0f} s)", flush=True)


if __name__ == "__main__":
    main()

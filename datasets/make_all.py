"""Generate data sets, check them and write what is kept of them here; start again to go on.

python datasets/make_all.py FOLDER SUMMARIES [NAME ...] [--device cuda] [--workers 2]
    [--batch 60] [--seconds 1500]

FOLDER/NAME gets the data; SUMMARIES/NAME the card and the manifest with the files' hashes.  A set
that is not complete when time is up has no summary.  Exit status 1 if one is not complete, or its
check finds something.

Several workers are started once and compute all sets; a set is begun when too little is left
of the one before to keep them busy, and summaries are written by processes of their own.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shutil
import sys
import threading
import time
import traceback
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from pathlib import Path

from card import dataset_card

from pdcorrect._files import make_folder, write_text
from pdcorrect.cli.common import FileLines
from pdcorrect.data.check import check_dataset
from pdcorrect.data.configuration import DatasetConfig
from pdcorrect.data.generate import generate
from pdcorrect.data.schema import CONFIG, MANIFEST
from pdcorrect.data.summary import dataset_info
from pdcorrect.data.workers import Workers, local_scheduler
from pdcorrect.errors import InputError

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
        self._summary: Future[int] | None = None
        self.nearly = threading.Event()

    def run(self) -> None:
        try:
            for _ in range(ATTEMPTS):
                try:
                    self._generate()
                    return
                except InputError as error:
                    print(f"{self.name}: {error}", flush=True)
                    return
                except Exception:
                    traceback.print_exc()
        finally:
            self.nearly.set()

    def _generate(self) -> None:
        started, target = time.monotonic(), self._options.folder / self.name
        config = DatasetConfig.load(HERE / self.name / CONFIG)
        left = None if self._deadline is None else max(self._deadline - started, 0.0)
        print(f"{self.name}: begun", flush=True)
        found = generate(config, target, self._workers, seconds=left, on_file=self._note)
        print(f"{self.name}: {time.monotonic() - started:.0f} s, {found}", flush=True)
        if found:
            self._summary = self._summaries.submit(
                summarise, target, self._options.summaries / self.name
            )

    def succeeded(self) -> bool:
        """Wait for the set and its summary; whether both are there and nothing was found."""
        self.join()
        if self._summary is None:
            return False
        try:
            return self._summary.result() == 0
        except Exception:
            traceback.print_exc()
            return False

    def _note(self, name: str, done: int, total: int, new: int) -> None:
        self._lines(f"{self.name}/{name}", done, total, new)
        if total - done <= self._workers.count * self._workers.batch:
            self.nearly.set()


def main() -> int:
    """1 if a set is not complete, or its check finds something."""
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
        local_scheduler(options.workers) as address,
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
        good = [production.succeeded() for production in begun]
    return 0 if sum(good) == len(options.names) else 1


def summarise(data: Path, target: Path) -> int:
    """Check a complete data set and write its summary; how much the check found."""
    started = time.monotonic()
    findings = check_dataset(data)
    make_folder(target)
    write_text(target / "README.md", dataset_card(data, dataset_info(data)))
    shutil.copyfile(data / MANIFEST, target / MANIFEST)
    lines = [f"{data.name}: {len(findings)} findings", *map(str, findings[:10])]
    print("\n  ".join(lines), f"({time.monotonic() - started:.0f} s)", flush=True)
    return len(findings)


if __name__ == "__main__":
    sys.exit(main())

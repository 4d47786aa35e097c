"""Median milliseconds of a step of the twisted cross; prints JSON.

Usage: threads.py REFINE BLAS_THREADS GOMP_SPINCOUNT
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np

import pdcorrect as pc
from pdcorrect.evaluation.compare import make_stepper  # sets GOMP_SPINCOUNT
from pdcorrect.solvers import implicit

SCENE = Path(__file__).parent.parent / "examples" / "twisted_cross.toml"


def main() -> None:
    """Time six frames."""
    refine, blas, spin = int(sys.argv[1]), sys.argv[2], sys.argv[3]
    if spin == "system's":  # read when the first kernel runs; the package has set its own
        del os.environ["GOMP_SPINCOUNT"]
    if blas == "all":
        implicit.limited_threads = nullcontext
    problem = pc.discretise(pc.Scene.load(SCENE), refine=refine)
    run = pc.rollout(make_stepper(problem, "pd"), frames=6)
    print(json.dumps(1e3 * float(np.median(run.stats["seconds"]))))


if __name__ == "__main__":
    main()

"""What the scripts here share: how they end, and what they record of their origin."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pdcorrect._environment import environment
from pdcorrect.errors import ConvergenceError, OutputError, PdcorrectError

FAILED, BAD_INPUT = 1, 2
"""Exit statuses, as of the program ``pdcorrect``."""


def run_script(main: Callable[[], None]) -> None:
    """Run a script; wrong input and failures end it by one sentence and a status."""
    try:
        main()
    except (ConvergenceError, OutputError) as error:
        _stop(error, FAILED)
    except PdcorrectError as error:
        _stop(error, BAD_INPUT)
    except OSError as error:
        if error.filename is None:
            raise
        _stop(f"{error.filename}: cannot be read or written ({error.strerror}).", BAD_INPUT)
    except SystemExit as error:
        if not isinstance(error.code, str):
            raise  # a status, as of argparse, which has said why
        _stop(error.code, BAD_INPUT)


def origin() -> dict[str, Any]:
    """When, by which command and on what the program runs."""
    script = Path(sys.argv[0]).name
    return {
        "date": time.strftime("%Y-%m-%d"),
        "command": " ".join(["python", f"models/{script}", *sys.argv[1:]]),
        "environment": environment(),
    }


def _stop(message: object, status: int) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(status)

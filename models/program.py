"""How the scripts here end: by one sentence and a status where a user can mend what is wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable

from pdcorrect.errors import ConvergenceError, InputError, OutputError, PdcorrectError

FAILED, BAD_INPUT = 1, 2
"""Exit statuses, as of the program ``pdcorrect``."""


def run_script(main: Callable[[], None]) -> None:
    """Run a script; errors of input, and what it refuses itself, are told without a traceback."""
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


def pair_of(text: str) -> tuple[str, str]:
    """Model and configuration of an argument MODEL=CONFIG.

    Raises
    ------
    InputError
        If one of them is missing.
    """
    model, _, config = text.partition("=")
    if not model or not config:
        raise InputError(f"{text!r}: expected MODEL=CONFIG, a model and a data set's config.toml.")
    return model, config


def _stop(message: object, status: int) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(status)

"""SIGTERM as an exception, so that files are closed before the process ends; and Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

_PAUSE = 0.01  # s
INTERRUPTED, TERMINATED = 130, 143
"""Exit status after Ctrl-C and after SIGTERM."""


class Terminated(BaseException):
    """The process was asked to end; as `KeyboardInterrupt`, it is no `Exception`."""


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` in the main thread at the first SIGTERM; later ones are ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler, hook = signal.signal(signal.SIGTERM, _terminate), sys.unraisablehook
    sys.unraisablehook = _insist
    try:
        yield
    except Terminated:
        hook = _silent  # the process ends
        raise
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def ctrl_c_ignored() -> Iterator[None]:
    """For processes started now: this one ends them, and they need not complain of Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _silent(lost: Any) -> None:
    """Nothing: what was half made when the signal came may fail to be deleted."""


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)  # closing takes a moment; let nothing cut it short
    raise Terminated


def _insist(lost: Any) -> None:
    """Signal again if Python dropped the exception, as it does in destructors and callbacks.

    Other errors in destructors after the signal are those of objects whose making it cut short.
    """
    if lost.exc_type is not Terminated:
        if signal.getsignal(signal.SIGTERM) is not signal.SIG_IGN:
            sys.__unraisablehook__(lost)
        return
    signal.signal(signal.SIGTERM, _terminate)
    again = threading.Timer(_PAUSE, signal.raise_signal, [signal.SIGTERM])
    again.daemon = True
    again.start()

"""The program ``pdcorrect``: one module a command, each importing what it needs when it runs."""

from pdcorrect.cli.program import app, main

__all__ = ["app", "main"]

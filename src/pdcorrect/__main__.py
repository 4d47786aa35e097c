"""``python -m pdcorrect``."""

from pdcorrect.cli.program import main

main()

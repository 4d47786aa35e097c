"""``python -m pdcorrect``."""

from pdcorrect.cli.main import main

main()

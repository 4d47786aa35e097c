"""``python -m pdcorrect``."""

from pdcorrect.cli.program import main

if __name__ == "__main__":  # worker processes import this module again
    main()

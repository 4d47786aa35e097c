"""Learning what `pdcorrect.fem.learned` writes into cells: bodies, answers, network, training."""

"""Learning: networks, algorithms, checkpoints."""

"""Training: networks, algorithms, checkpoints."""

"""Data streams, training loop and checkpoints."""

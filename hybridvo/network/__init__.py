"""Frame pairs to pixel-wise predictions (PWVO and its baselines)."""

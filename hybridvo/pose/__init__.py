"""Frame pairs to relative poses: residuals, refinement, hypotheses and baselines."""

"""The refinement: one residual, a numba path for one pair and a torch path for batches."""

"""The same refinement for batches in torch, differentiable."""

"""Refinement of a camera motion on flow, depth and images, with its covariance."""

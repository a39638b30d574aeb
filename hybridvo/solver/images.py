"""The choice of pixels for the photometric refinement."""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous
from hybridvo.solver.calibration import MIN_STATIC_WEIGHT
from hybridvo.solver.image_kernels import select_pixels


def choose_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray, count: int
) -> np.ndarray:
    """Return static pixels with strong gradients, evenly distributed over the image.

    Args:
        grey: (H, W) float32 grey values.
        depth: (H, W) metres.
        weights: (H, W) static weights, from 0 to 1.
        count: number of cells, of which each gives one pixel or none.

    Returns:
        (N, 2) int32 rows and columns.
    """
    cell = np.sqrt(grey.size / count)
    return select_pixels(
        grey,
        as_contiguous(depth),
        as_contiguous(weights, np.float32),
        np.float32(MIN_STATIC_WEIGHT),
        cell,
    )

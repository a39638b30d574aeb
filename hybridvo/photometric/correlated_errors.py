"""How much information residuals hold whose errors neighbours share.

The scores of a fit (its weighted residuals times their derivatives) are summed over
tiles of the image. Were the errors independent, the sums would vary as the sum of
the squared scores states; the ratio is how many times too large the information
is.
"""

from __future__ import annotations

import numpy as np

from hybridvo.calibration import (
    COMPARED_PARTS,
    IMAGE_INFLATION,
)
from hybridvo.refinement.shared_errors import part_sums
from hybridvo.refinement.shared_errors import shared_covariance as shared_covariance
from hybridvo.refinement.solver import positive_inverse, tile_size

# standard deviation of normal numbers over the median of their absolute values
MAD_TO_STD = 1.4826


class Tiles:
    """The tiles of an image in which some pixels lie."""

    def __init__(self, shape: tuple[int, int], index: np.ndarray) -> None:
        """Assign pixels (N, 2), rows and columns, to the tiles of an image (H, W)."""
        size = tile_size(shape)
        tile_rows = -(-shape[0] // size)
        tile_columns = -(-shape[1] // size)
        self.shape = (tile_rows, tile_columns)
        self._tile_of = index[:, 0] // size * tile_columns + index[:, 1] // size

    def sums(self, scores: np.ndarray) -> np.ndarray:
        """Return the sums (rows, columns, M) of scores (M, N) over each tile."""
        count = self.shape[0] * self.shape[1]
        sums = [np.bincount(self._tile_of, row, count) for row in scores]
        return np.stack(sums, axis=1).reshape(*self.shape, -1)


def robust_std(lengths: np.ndarray) -> float:
    """Return the standard deviation of normal numbers by their upper median length."""
    middle = len(lengths) // 2
    median = float(np.partition(lengths, middle)[middle])
    return MAD_TO_STD * median


def information_scale(
    tile_sums: np.ndarray, meat: np.ndarray, expected_inverse: np.ndarray
) -> float:
    """Return the factor on the information that is left by errors that are alike.

    Args:
        tile_sums: (rows, columns, 6) sums of the scores over tiles.
        meat: (6, 6) sum of the products of the scores of each residual with
            themselves.
        expected_inverse: (6, 6) inverse of the meat that the noise model expects.

    Returns:
        From 0 to 1 / IMAGE_INFLATION; 0 where the meat is not positive definite.
    """
    independent = positive_inverse(meat)
    if independent is None:
        return 0.0
    sums = tile_sums.reshape(-1, 6)
    # variance of the sums over tiles, relative to that of independent errors
    clustering = np.trace(independent @ sums.T @ sums) / 6
    # variance of the residuals, relative to that of the model
    dispersion = max(1.0, clustering) * np.trace(expected_inverse @ meat) / 6
    return float(1 / (IMAGE_INFLATION * max(1.0, dispersion)))


def parts_dispersion(tile_sums: np.ndarray, expected_inverse: np.ndarray) -> float:
    """Return how much the parts of the image disagree, relative to the model.

    Args:
        tile_sums: (rows, columns, 6) sums of the scores over tiles.
        expected_inverse: (6, 6) as in :func:`information_scale`.

    Returns:
        The mean over :data:`COMPARED_PARTS` of the variance of the parts' sums; 1 is what
        the model states.
    """
    dispersions = []
    for shape in COMPARED_PARTS:
        sums = part_sums(tile_sums, shape)
        squared = np.einsum("rcp,pq,rcq->", sums, expected_inverse, sums)
        count = shape[0] * shape[1]
        dispersions.append(squared / 6 * count / (count - 1))
    return float(np.mean(dispersions))

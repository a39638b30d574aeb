"""How much information residuals hold whose errors neighbours share.

The scores of a fit (its weighted residuals times their derivatives) are summed over
tiles of the image. Were the errors independent, the sums would vary as the sum of
the squared scores states; the ratio is how many times too large the information
is. Errors that whole parts of the image share do not show in the differences of
neighbours; their covariance is added.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver.calibration import IMAGE_INFLATION
from hybridvo.solver.kernels import ZERO
from hybridvo.solver.newton import tile_size
from hybridvo.solver.newton_kernels import inverse_or_nan
from hybridvo.solver.products import add_products, entrywise_sum
from hybridvo.solver.rows import MOTION_TERMS
from hybridvo.solver.shared_errors import (
    part_sums,
    parts_of_tiles,
    shared_covariance,
)

# standard deviation of normal numbers over the median of their absolute values
MAD_TO_STD = 1.4826


class Tiling(NamedTuple):
    """Where pixels lie in an image: in which tile, and each tile in which part."""

    tile_of: np.ndarray  # (N,) int32 tile of each pixel
    # (S, tiles) int32 part of each tile, for S ways to cut the image into parts
    part_of: np.ndarray


class Information(NamedTuple):
    """The information of residuals about a motion, less what they share."""

    matrix: np.ndarray  # (6, 6); zero where they do not determine the motion
    # factor that makes the normal equations state about as much; 0 where they do not
    scale: float
    # factor in (0, 1] by which parts of the image that disagree lowered it
    agreement: float


def view_of(shape: tuple[int, int], index: np.ndarray, tiles: int) -> Tiling:
    """Assign pixels to the tiles of an image, and these to its parts.

    Args:
        shape: (H, W) of the image.
        index: (N, 2) rows and columns of the pixels.
        tiles: about how many tiles there are, see ``refine.tiles``.
    """
    size = tile_size(shape, tiles)
    rows = -(-shape[0] // size)
    columns = -(-shape[1] // size)
    tile_of = index[:, 0] // size * columns + index[:, 1] // size
    return Tiling(tile_of.astype(np.int32), parts_of_tiles(rows, columns))


@njit(error_model="numpy", cache=True, nogil=True)
def robust_std(lengths):
    """Return the standard deviation of normal numbers by their upper median length (N,)."""
    middle = len(lengths) // 2
    # numba takes seconds to compile the partition, for each type of numbers
    return MAD_TO_STD * np.partition(lengths.astype(np.float64), middle)[middle]


@njit(error_model="numpy", cache=True, nogil=True)
def estimate_information(rows, weights, shared, products, view, even_parts):
    """Return the information of residuals about a motion.

    Args:
        rows: (1 + M, N) float32: residuals, then their derivatives in the motion and
            in M - 6 other unknowns, which are marginalised out.
        weights: (N,) float32 of the residuals, in units of information.
        shared: (K, N) float32 change of the residuals by each of K independent
            errors that whole parts of the image share.
        products: (1 + M, 1 + M) sums of the weighted products of the rows.
        view: a :class:`Tiling`.
        even_parts: dispersion of the parts' scores, as a fraction of the model's, below
            which they agree; 0: they are not compared, and the motion is the optimum of
            these residuals alone, from which no other terms pull it away.

    Returns:
        An :class:`Information`.
    """
    unknown = Information(np.zeros((MOTION_TERMS, MOTION_TERMS)), 0.0, 1.0)
    covariance = inverse_or_nan(products[1:, 1:].copy())
    motion_covariance = covariance[:MOTION_TERMS, :MOTION_TERMS].copy()
    H = inverse_or_nan(motion_covariance)
    if np.isnan(H[0, 0]):
        return unknown
    step = np.zeros(len(covariance))
    if even_parts > 0:
        step = covariance @ products[1:, 0].copy()
    to_motion = np.ascontiguousarray(covariance[:, :MOTION_TERMS])
    tile_sums, meat = sum_scores(rows, weights, shared, step, view)
    meat = to_motion.T @ meat @ to_motion
    scores = tile_sums[0] @ to_motion

    scale = information_scale(scores, meat, H)
    if scale <= 0:
        return unknown
    agreement = 1.0
    if even_parts > 0:
        measured = scale * parts_dispersion(scores, view.part_of, H)
        dispersion = max(measured, even_parts)
        # errors on which the parts disagree show; as much again is common to the
        # parts and does not
        agreement = min(1.0, (even_parts / dispersion) ** 2)
        scale *= agreement
    effects = np.empty((tile_sums.shape[1], len(shared), MOTION_TERMS))
    for kind in range(len(shared)):
        of_kind = tile_sums[1 + kind] @ to_motion
        for tile in range(len(of_kind)):
            for term in range(MOTION_TERMS):
                effects[tile, kind, term] = of_kind[tile, term]
    common = shared_covariance(effects, view.part_of)
    information = inverse_or_nan(motion_covariance / scale + common)
    reduced_scale = 1.0 / (1.0 / scale + entrywise_sum(common, H) / MOTION_TERMS)
    return Information(information, reduced_scale, agreement)


@njit(error_model="numpy", cache=True, nogil=True)
def sum_scores(rows, weights, shared, step, view):
    """Sum scores over tiles, and their products over all residuals.

    Args:
        rows: (1 + M, N) float32, see :func:`estimate_information`.
        weights: (N,) float32.
        shared: (K, N) float32.
        step: (M,) from the unknowns at which the rows were taken to the optimum; to
            first order it corrects the residuals.
        view: a :class:`Tiling`.

    Returns:
        The sums (1 + K, tiles, M) of the scores of the residuals, then of the shared
        errors; and the sums (M, M) of the products of the residuals' scores.
    """
    unknowns = len(rows) - 1
    kinds = 1 + len(shared)
    tile_sums = np.zeros((kinds, view.part_of.shape[1], unknowns))
    squared = np.empty(len(weights), np.float32)
    correction = step.astype(np.float32)
    for k in range(len(weights)):
        residual = rows[0, k]
        for m in range(unknowns):
            residual -= correction[m] * rows[1 + m, k]
        score = weights[k] * residual
        squared[k] = score * score
        if weights[k] == ZERO:
            continue
        tile = view.tile_of[k]
        for m in range(unknowns):
            tile_sums[0, tile, m] += score * rows[1 + m, k]
        for kind in range(len(shared)):
            error = weights[k] * shared[kind, k]
            for m in range(unknowns):
                tile_sums[1 + kind, tile, m] += error * rows[1 + m, k]
    meat = np.zeros((unknowns, unknowns))
    add_products(rows[1:], squared, 1.0, meat)
    return tile_sums, meat


@njit(error_model="numpy", cache=True, nogil=True)
def information_scale(scores, meat, H):
    """Return the factor on the information that is left by errors that are alike.

    Args:
        scores: (tiles, 6) sums of the scores over tiles.
        meat: (6, 6) sum of the products of the scores of each residual with
            themselves.
        H: (6, 6) inverse of the meat that the noise model expects.

    Returns:
        From 0 to 1 / IMAGE_INFLATION; 0 where the meat is not positive definite.
    """
    independent = inverse_or_nan(meat)
    if np.isnan(independent[0, 0]):
        return 0.0
    # variance of the sums over tiles, relative to that of independent errors
    clustering = entrywise_sum(independent, scores.T @ scores) / MOTION_TERMS
    # variance of the residuals, relative to that of the model
    dispersion = max(1.0, clustering) * entrywise_sum(H, meat) / MOTION_TERMS
    return 1.0 / (IMAGE_INFLATION * max(1.0, dispersion))


@njit(error_model="numpy", cache=True, nogil=True)
def parts_dispersion(scores, part_of, H):
    """Return how much the parts of the image disagree, relative to the model.

    Args:
        scores: (tiles, 6) sums of the scores over tiles.
        part_of: (S, tiles) part of each tile, for S ways to cut the image.
        H: (6, 6) as in :func:`information_scale`.

    Returns:
        The mean over all ways of the variance of the parts' sums; 1 is what the
        model states.
    """
    total = 0.0
    for parts in part_of:
        count = parts.max() + 1
        sums = part_sums(scores.reshape(-1, 1, MOTION_TERMS), parts, count)
        sums = sums.reshape(count, MOTION_TERMS)
        squared = entrywise_sum(H, sums.T @ sums)
        total += squared / MOTION_TERMS * count / (count - 1)
    return total / len(part_of)

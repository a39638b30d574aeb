"""Errors that whole parts of a view share, and what they do to a motion.

Such errors do not show in the differences of neighbours, nor do blocks of tiles hold enough of
them: what parts of the view have in common the fit takes into the motion. They are modelled
instead: an error of every part by itself, as a fraction of each residual's noise. For the flow
that fraction is estimated from the pair: it is what the errors of neighbours have in common.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver import kernels
from hybridvo.solver.calibration import (
    COHERENCE_CUTOFF,
    COHERENT_STDS,
    SHARED_BLOCK,
)
from hybridvo.solver.kernels import (
    BLOCK,
    EXTERNAL_SUM,
    NO_PARALLAX2,
    PADDING,
    PD,
    PF,
    SUMS,
    WORK_ROWS,
    ResidualNoise,
    W,
    WorkRow,
)
from hybridvo.solver.noise_estimation import FLOW_NOISE_FLOOR_PX
from hybridvo.solver.pixels import GridShape

# Rows and columns of the parts into which an image is cut to see whether they agree
# (:data:`EVEN_PARTS`): a lens errs by quadrant, a rolling shutter by row.
COMPARED_PARTS = ((2, 2), (4, 1))

# Flow along each axis of the image, and log depth.
SHARED_ERRORS = 3


class SharedErrors(NamedTuple):
    """What errors that parts of the view share do to the score of a fit."""

    # (rows, columns, 3, 6) change of each tile's score where the flow of all its pixels errs by
    # one standard deviation along x or y, or their log depth
    pulls: np.ndarray
    # fraction of the variance that neighbours share, see :func:`coherent_fraction`
    coherent: float


@functools.cache
def parts_of_tiles(rows: int, columns: int) -> np.ndarray:
    """Return in which part of an image each of its tiles lies.

    Args:
        rows: of tiles.
        columns: of tiles.

    Returns:
        (S, tiles) int32, for the S ways of :data:`COMPARED_PARTS` to cut it; it is kept, and
        not to be changed.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    parts = [
        row * down // rows * across + column * across // columns
        for down, across in COMPARED_PARTS
    ]
    return np.stack(parts).astype(np.int32)


@njit(error_model="numpy", cache=True, nogil=True)
def shared_covariance(effects, part_of):
    """Return the covariance of the motion by errors that whole parts of the image share.

    Args:
        effects: (tiles, M, 6) change of the motion by the error of each tile, for M
            independent errors.
        part_of: (S, tiles) part of each tile, for S ways to cut the image.

    Returns:
        (6, 6), the mean over all ways.
    """
    covariance = np.zeros((6, 6))
    for parts in part_of:
        change = part_sums(effects, parts, parts.max() + 1).reshape(-1, 6)
        covariance += change.T @ change
    return covariance / len(part_of)


@njit(error_model="numpy", cache=True, nogil=True)
def part_sums(tile_sums, parts, count):
    """Return the sums (count, M, 6) of tiles (tiles, M, 6) over the parts they lie in."""
    sums = np.zeros((count, tile_sums.shape[1], tile_sums.shape[2]))
    for tile in range(len(tile_sums)):
        sums[parts[tile]] += tile_sums[tile]
    return sums


def tile_pulls(
    samples: np.ndarray,
    grid: GridShape,
    pose: np.ndarray,
    K: np.ndarray,
    noise: ResidualNoise,
    tile: int,
    tiles: tuple[int, int],
) -> np.ndarray:
    """Return the pulls of :class:`SharedErrors` per external weight, from a grid of pixels.

    Args:
        samples: pixel buffer of the grid.
        grid: its rows, columns and the distance of its pixels.
        pose: (3, 4) T_curr_prev.
        K: (4,) float32 fx, fy, cx, cy of the current camera.
        noise: noise and robust kernel.
        tile: side of a tile, px.
        tiles: rows and columns of tiles.
    """
    first = grid.stride // 2
    row_of = (first + grid.stride * np.arange(grid.rows)) // tile
    column_of = (first + grid.stride * np.arange(grid.columns)) // tile
    tile_of = (row_of[:, None] * tiles[1] + column_of).ravel()
    pulls = np.zeros((tiles[0] * tiles[1], SHARED_ERRORS, 6))
    external = sum_pulls(samples, pose, K, noise, tile_of, pulls)
    return pulls.reshape(*tiles, SHARED_ERRORS, 6) / max(external, 1e-12)


@njit(error_model="numpy", cache=True, nogil=True)
def sum_pulls(samples, pose, K, noise, tile_of, pulls):
    """Add the pulls of gathered pixels to those of their tiles; return their external weight."""
    n = len(tile_of)
    acc = np.zeros(SUMS)
    work = np.empty((WORK_ROWS, BLOCK + PADDING), np.float32)
    tx = pose[0, 3]
    ty = pose[1, 3]
    tz = pose[2, 3]
    for o in range(0, n, BLOCK):
        m = min(BLOCK, n - o)
        robust = work[WorkRow.ROBUST]
        kernels.project_block(samples, o, m, pose, K, noise, work, robust, acc)
        for k in range(m):
            if not robust[k] * samples[W, o + k] > 0:
                continue
            pull = pulls[tile_of[o + k]]
            a = work[WorkRow.A, k]
            b = work[WorkRow.B, k]
            i = work[WorkRow.INVERSE_Z, k]
            information = noise.flow_information * samples[PF, o + k]
            flow_std = 1.0 / math.sqrt(information)
            depth_std = math.sqrt(noise.depth_variance * samples[PD, o + k])
            # errors in units of the focal lengths, as the information is
            x_error = flow_std / K[0]
            y_error = flow_std / K[1]
            add_pull(pull[0], work, k, x_error, 0.0)
            add_pull(pull[1], work, k, 0.0, y_error)
            x_error = depth_std * i * (a * tz - tx)
            y_error = depth_std * i * (b * tz - ty)
            add_pull(pull[2], work, k, x_error, y_error)
    return acc[EXTERNAL_SUM]


@njit(error_model="numpy", cache=True, nogil=True)
def add_pull(pull, work, k, x_error, y_error):
    """Add B^T M (x, y) of work column ``k`` to a pull (6,)."""
    a = work[WorkRow.A, k]
    b = work[WorkRow.B, k]
    i = work[WorkRow.INVERSE_Z, k]
    cross = work[WorkRow.M01, k]
    x = work[WorkRow.M00, k] * x_error + cross * y_error
    y = cross * x_error + work[WorkRow.M11, k] * y_error
    z = a * x + b * y
    pull[0] += x * i
    pull[1] += y * i
    pull[2] -= z * i
    pull[3] -= b * z + y
    pull[4] += a * z + x
    pull[5] += a * y - b * x


def coherent_fraction(
    samples: np.ndarray,
    h: int,
    w: int,
    pose: np.ndarray,
    K: np.ndarray,
    noise: ResidualNoise,
) -> float:
    """Return how much of the flow's variance neighbouring blocks share, from 0 to 1.

    It is the correlation of the errors of their pixels, less what independent errors give by
    chance. Compared are residuals across q, which no depth changes.

    Args:
        samples: pixel buffer of a grid.
        h: rows of the grid.
        w: columns of the grid.
        pose: (3, 4) motion.
        K: (fx, fy, cx, cy) of the current camera.
        noise: of flow and depth.
    """
    return float(block_correlation(samples, h, w, pose, K, noise, SHARED_BLOCK))


@njit(error_model="numpy", cache=True, nogil=True)
def block_correlation(samples, h, w, pose, K, noise, side):
    """Return the same for blocks of ``side`` pixels."""
    entries = kernels.pose_entries(pose)
    # a row and a column more, which stay empty
    rows = -(-h // side) + 1
    columns = -(-w // side) + 1
    counts = np.zeros((rows, columns))
    sums = np.zeros((rows, columns))
    squares = 0.0
    for v in range(h):
        for u in range(w):
            across, is_inlier = whitened_across(
                samples, v * w + u, entries, K, noise
            )
            if is_inlier:
                row = v // side
                column = u // side
                counts[row, column] += 1.0
                sums[row, column] += across
                squares += across * across

    pairs = 0.0
    products = 0.0
    for row in range(rows - 1):
        for column in range(columns - 1):
            beside = sums[row, column + 1] + sums[row + 1, column]
            products += sums[row, column] * beside
            count = counts[row, column + 1] + counts[row + 1, column]
            pairs += counts[row, column] * count
    if not (pairs > 0 and squares > 0):
        # nothing states that errors are independent
        return 1.0
    correlation = products / pairs * np.sum(counts) / squares
    by_chance = COHERENT_STDS / math.sqrt(pairs)
    # what the noise is set to at least is not measured
    measured = 1.0 - FLOW_NOISE_FLOOR_PX**2 * noise.flow_information
    return min(max(correlation - by_chance, 0.0), 1.0) * max(measured, 0.0)


@njit(error_model="numpy", cache=True, nogil=True)
def whitened_across(samples, k, entries, K, noise):
    """Return the residual of pixel ``k`` across q, standard deviations, and if it is an inlier."""
    ru, rv, qu, qv, front = kernels.residual(samples, k, entries, K)
    q2 = qu * qu + qv * qv
    if q2 < NO_PARALLAX2:
        # no parallax: any axis will do
        qu = 1.0
        qv = 0.0
        length2 = 1.0
    else:
        length2 = q2
    information = samples[PF, k] * noise.flow_information
    along = ru * qu + rv * qv
    across = rv * qu - ru * qv
    ratio = noise.depth_variance * samples[PD, k] * information
    across2 = across * across / length2 * information
    along2 = along * along / length2 * information / (1.0 + ratio * q2)
    usable = front and samples[W, k] > 0
    is_inlier = usable and across2 + along2 <= COHERENCE_CUTOFF**2
    return across * math.sqrt(information / length2), is_inlier

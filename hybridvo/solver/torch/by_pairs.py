"""The motions of a batch by the fit of a pair, one sample after the other.

On a CPU a pair alone is fitted ten times faster by numba than a batch of one by torch, and then
both give one motion, noise, covariance and status. Where the motions start, and how far from there
they are sought, is decided in :mod:`hybridvo.solver.torch.solve`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from hybridvo.core.options import RefineOptions
from hybridvo.core.results import StageFailed
from hybridvo.core.torch_geometry import pp, to_matrix
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.solver import kernels
from hybridvo.solver.covariance import MotionCovariance, unknown_motion
from hybridvo.solver.depths import DepthAgreement, compare_depths
from hybridvo.solver.newton import tile_size
from hybridvo.solver.noise_estimation import FINAL_NOISE_PIXELS, START_NOISE
from hybridvo.solver.pixels import PixelGrid, coarse_grid
from hybridvo.solver.refine_flow import FlowFit, Selection, fit_flow
from hybridvo.solver.robust_fit import reestimate
from hybridvo.solver.torch.newton import Rested


class PairFit(NamedTuple):
    """The fit of one sample, and the pixels that it was made on."""

    pair: FramePair
    grid: PixelGrid
    fit: FlowFit


class BatchStated(NamedTuple):
    """What the fits of a batch state of its motions."""

    motions: list[MotionCovariance]
    depths: list[DepthAgreement | None]  # how those of both frames compare
    weights: torch.Tensor  # (B, H, W) robust, 0 where no pixel is usable
    inlier_ratio: torch.Tensor  # (B,) fraction of the weight within the cutoff
    cost: torch.Tensor  # (B,) robust cost per unit of weight


def fit_pairs(
    batch: PairBatch,
    weights: torch.Tensor | None,
    T: pp.LieTensor,
    options: RefineOptions,
) -> list[PairFit | None]:
    """Fit every sample of a batch from a motion that is right to a pixel.

    Args:
        batch: checked.
        weights: (B, H, W) factors on the information, or None.
        T: (B, 7) the motions.
        options: of the refinement.

    Returns:
        The fits; None of a sample with too few pixels.
    """
    poses = to_matrix(T).detach().double().cpu().numpy()
    poses = np.where(
        np.isfinite(poses).all(axis=(1, 2))[:, None, None], poses, np.eye(4)
    )
    factors = [None] * len(poses)
    if weights is not None:
        factors = list(weights.detach().float().cpu().numpy())
    fits: list[PairFit | None] = []
    for pair, pose, own in zip(batch.pairs(), poses, factors, strict=True):
        try:
            grid = coarse_grid(pair, own, options)
        except StageFailed:
            fits.append(None)
            continue
        pixels = (grid.samples, grid.count, grid.K, options.cutoff)
        # moves the pose
        noise, _, steps = reestimate(*pixels, FINAL_NOISE_PIXELS, pose[:3])
        start = Selection(pose, noise, iterations=steps)
        fits.append(PairFit(pair, grid, fit_flow(pair, start, grid, options)))
    return fits


def rested_at(
    fits: Sequence[PairFit | None], like: pp.LieTensor
) -> tuple[Rested[pp.LieTensor], torch.Tensor]:
    """Return where fits ended, and their noise (B, 2); at no motion where there is none."""
    poses = [np.eye(4) if each is None else each.fit.T_curr_prev for each in fits]
    noise = [START_NOISE if each is None else each.fit.noise for each in fits]
    matrix = like.tensor().new_tensor(np.stack(poses), dtype=torch.float64)
    T = pp.mat2SE3(matrix, check=False).to(like.dtype)
    converged = torch.tensor(
        [each is not None and each.fit.converged for each in fits]
    )
    steps = torch.tensor(
        [0 if each is None else each.fit.iterations for each in fits]
    )
    rested = Rested(T, converged, steps, solved=True)
    return rested, like.tensor().new_tensor(np.array(noise))


def stated_by(fits: Sequence[PairFit | None], like: torch.Tensor) -> BatchStated:
    """Return what the fits of a batch state of its motions; nothing where there is none.

    Args:
        fits: of the samples.
        like: (B, H, W) of the images, in the type of the batch.
    """

    def numbers(values: Iterable[float]) -> torch.Tensor:
        return like.new_tensor(list(values))

    unknown = unknown_motion(np.zeros(6))
    nothing = np.zeros(like.shape[1:], np.float32)
    known = [None if each is None else each.fit for each in fits]
    weights = [nothing if each is None else each.at.weights for each in known]
    return BatchStated(
        [unknown if each is None else each.stated for each in known],
        [None if each is None else each.depths for each in known],
        torch.as_tensor(np.stack(weights)).to(like.dtype),
        numbers(0.0 if each is None else each.inlier_ratio for each in known),
        numbers(0.0 if each is None else each.cost for each in known),
    )


def at_seed(
    each: PairFit, T: np.ndarray, covariance: np.ndarray, options: RefineOptions
) -> PairFit:
    """Return the fit of a sample whose motion is that of its seed, and not the solution.

    Args:
        each: the fit.
        T: (4, 4) of the seed.
        covariance: (6, 6) of it.
        options: of the refinement.
    """
    fit = each.fit
    noise = kernels.residual_noise(*fit.noise, options.cutoff)
    tile = tile_size(each.grid.size, options.tiles)
    sums = each.grid.full_pass(T[:3], noise, tile)
    totals = sums.totals.sum(axis=0)
    depths = None
    if fit.depths is not None:
        depths = compare_depths(each.pair, T, sums.robust)
    at = replace(
        fit.at,
        cost=float(totals[kernels.COST]),
        external_sum=float(totals[kernels.EXTERNAL_SUM]),
        inlier_sum=float(totals[kernels.INLIER_SUM]),
        weights=sums.robust,
    )
    stated = fit.stated.of_seed(covariance)
    return each._replace(
        fit=replace(fit, T_curr_prev=T, at=at, stated=stated, depths=depths)
    )

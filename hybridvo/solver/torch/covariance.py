"""The covariance of the motions of a batch, as that of a pair: over tiles of the image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from hybridvo.core.options import RefineOptions
from hybridvo.core.torch_geometry import to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver import kernels
from hybridvo.solver.covariance import (
    MotionCovariance,
    ScoreStatistics,
    motion_covariance,
    unknown_motion,
)
from hybridvo.solver.depths import DepthAgreement, compare_depths
from hybridvo.solver.newton import tile_size
from hybridvo.solver.noise_estimation import Noise
from hybridvo.solver.pixels import grid_stride
from hybridvo.solver.score_blocks import UPPER
from hybridvo.solver.shared_errors import SharedErrors, coherent_fraction
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.by_pairs import BatchStated, at_seed, stated_by
from hybridvo.solver.torch.factors import Pixels, ResidualModel, Weighted
from hybridvo.solver.torch.solve import BatchFit, coarse_buffers
from hybridvo.solver.torch.tools import to_tiles


class PixelStatistics(NamedTuple):
    """What the motions give each pixel."""

    robust: torch.Tensor  # (B, N) robust weight, without the external one
    distance2: torch.Tensor  # (B, N) squared Mahalanobis distance
    cost: torch.Tensor  # (B, N) robust cost, without the external weight

    def followed(self, pixels: Pixels) -> torch.Tensor:
        """(B, N) robust weight of the usable pixels, 0 of the others."""
        return torch.nan_to_num(self.robust) * (pixels.weight > 0)


def batch_covariances(
    batch: PairBatch,
    pixels: Pixels,
    fit: BatchFit,
    model: ResidualModel,
    options: RefineOptions,
) -> BatchStated:
    """Return the covariance of every motion, and what a last pass states about the pixels.

    Args:
        batch: checked.
        pixels: of the batch, without gradient.
        fit: the motions.
        model: noise and robust kernel.
        options: number of tiles.
    """
    height, width = batch.depth_prev.shape[1:]
    matrix = to_matrix(fit.T)
    of_seeds = fit.region.covariance_to(fit.solution).cpu().numpy()
    if fit.by_pair is not None:
        return _of_pairs(fit, matrix, of_seeds, options, batch.depth_prev)
    tile = tile_size((height, width), options.tiles)
    sums = []
    pulls = []
    per_pixel = []
    for part in pixels.parts(tile * width):
        at = factors.weigh(part, matrix, model)
        sums.append(_tile_sums(at, width, tile))
        pulls.append(_tile_pulls(part, at, model.noise, width, tile))
        per_pixel.append((at.robust, at.distance2, at.cost))
    columns = -(-width // tile)
    tiles = torch.cat(sums, dim=1).unflatten(1, (-1, columns))
    values = (
        tiles,
        torch.cat(pulls, dim=1).unflatten(1, (-1, columns)),
        _coherent_fractions(batch, pixels, matrix, model, options),
        fit.curvature,
        fit.meat,
        pixels.total,
        _inverse_depth(fit.subset),
        pixels.K[:, 0, 0],
        fit.T.translation(),
        model.noise,
    )
    samples = zip(*(x.double().cpu().numpy() for x in values), strict=True)
    statistics = PixelStatistics._make(
        torch.cat(x, dim=1) for x in zip(*per_pixel, strict=True)
    )
    motions = matrix.double().cpu().numpy()
    robust = statistics.followed(pixels).view_as(batch.depth_prev)
    depths = _depth_agreements(batch, motions, robust, options)
    by_pixels = [
        _sample_covariance(compared, *sample)
        for sample, compared in zip(samples, depths, strict=True)
    ]
    covariances = [
        checked(estimate.of_seed(of_seed) if kept else estimate, T)
        for estimate, of_seed, kept, T in zip(
            by_pixels, of_seeds, fit.is_seed.tolist(), motions, strict=True
        )
    ]
    weight = pixels.weight
    total = weight.sum(dim=1).clamp(min=1e-30)
    near = (statistics.robust > 0) & (statistics.distance2 <= options.cutoff**2)
    return BatchStated(
        covariances,
        depths,
        robust,
        torch.nan_to_num((weight * near).sum(dim=1) / total),
        torch.nan_to_num((weight * statistics.cost).sum(dim=1) / total),
    )


def _of_pairs(
    fit: BatchFit,
    matrix: torch.Tensor,
    of_seeds: np.ndarray,
    options: RefineOptions,
    like: torch.Tensor,
) -> BatchStated:
    """Return what the fits of a batch state that was answered by pairs, or its seeds."""
    assert fit.by_pair is not None
    motions = matrix.double().cpu().numpy()
    samples = zip(fit.by_pair, fit.is_seed.tolist(), motions, of_seeds, strict=True)
    fits = [
        at_seed(each, T, of_seed, options) if each and is_seed else each
        for each, is_seed, T, of_seed in samples
    ]
    stated = stated_by(fits, like)
    return stated._replace(motions=list(map(checked, stated.motions, motions)))


def checked(estimate: MotionCovariance, T: np.ndarray) -> MotionCovariance:
    """Return the covariance of a motion (4, 4); no tiles where one of them cannot be used."""
    is_valid = estimate.is_definite and bool(np.isfinite(T).all())
    return estimate if is_valid else estimate._replace(tiles=0)


def _tile_sums(at: Weighted, width: int, tile: int) -> torch.Tensor:
    """Return upper triangle of the Hessian and score of the tiles of some rows, (B, tiles, 27)."""

    def cut(x: torch.Tensor) -> torch.Tensor:
        return to_tiles(x.unflatten(-1, (-1, width)), tile)

    roots = cut(at.whitened_jacobian())
    scores = cut(torch.stack(at.scores(), dim=1))
    roots = roots.permute(1, 3, 2, 0, 4).flatten(3)  # (B, tiles, 6, 2 n)
    H = roots @ roots.mT
    upper = H[..., UPPER[0], UPPER[1]]
    return torch.cat([upper, scores.sum(dim=3).mT], dim=2)


def _tile_pulls(
    part: Pixels, at: Weighted, noise: torch.Tensor, width: int, tile: int
) -> torch.Tensor:
    """Return the pulls of :class:`SharedErrors` of the tiles of some rows, (B, tiles, 3, 6)."""
    flow_std = noise[:, :1] * part.flow_variance.sqrt()
    depth_std = noise[:, 1:] * part.depth_variance.sqrt()
    none = torch.zeros_like(flow_std)
    by_depth = depth_std * at.q.transpose(0, 1)
    # (3, B, N) errors along x and y: of the flow along each, and of log depth
    x = torch.stack([flow_std, none, by_depth[0]])
    y = torch.stack([none, flow_std, by_depth[1]])
    qx, qy = at.q.unbind(1)
    along = at.kappa * (qx * x + qy * y)
    rows = at.jacobian_transpose(
        at.information * (x - along * qx), at.information * (y - along * qy)
    )
    pixels = torch.stack(rows, dim=1).unflatten(-1, (-1, width))
    # (3, 6, B, tiles)
    sums = to_tiles(pixels, tile).sum(dim=-1)
    return sums.permute(2, 3, 0, 1)


def _coherent_fractions(
    batch: PairBatch,
    pixels: Pixels,
    matrix: torch.Tensor,
    model: ResidualModel,
    options: RefineOptions,
) -> torch.Tensor:
    """Return the fractions (B,) of :func:`coherent_fraction`, on the coarse grid."""
    height, width = batch.depth_prev.shape[1:]
    stride = grid_stride((height, width), options.coarse_pixels)
    first = stride // 2
    rows = len(range(first, height, stride))
    columns = len(range(first, width, stride))
    buffers = coarse_buffers(batch, pixels, options)
    K = batch.K_curr[:, [0, 1, 0, 1], [0, 1, 2, 2]].float().cpu().numpy()
    poses = matrix[:, :3].double().cpu().numpy()
    fractions = []
    for k, (flow_px, log_depth) in enumerate(model.noise.tolist()):
        weighting = kernels.residual_noise(flow_px, log_depth, options.cutoff)
        fraction = coherent_fraction(
            buffers[k], rows, columns, poses[k], K[k], weighting
        )
        fractions.append(fraction)
    return model.noise.new_tensor(fractions)


def _inverse_depth(subset: Pixels) -> torch.Tensor:
    """Return 1 / typical depth (B,), 1 / m, of the usable pixels.

    External weights are left out, as on the coarse grid of a pair: half of them may lie on a sky
    at 30 km.
    """
    usable = subset.weight > 0
    inverse2 = (usable / subset.points[:, 2] ** 2).sum(dim=1)
    mean = inverse2 / usable.sum(dim=1).clamp(min=1)
    return mean.sqrt().clamp(min=1e-9)


def _sample_covariance(
    depths: DepthAgreement | None,
    tiles: np.ndarray,
    pulls: np.ndarray,
    coherent: np.ndarray,
    curvature: np.ndarray,
    meat: np.ndarray,
    weight: np.ndarray,
    inverse_depth: np.ndarray,
    focal: np.ndarray,
    t: np.ndarray,
    noise: np.ndarray,
) -> MotionCovariance:
    """Return the covariance of one motion; no tiles where it is not finite."""
    shared = SharedErrors(pulls, float(coherent))
    scalars = (weight, inverse_depth, focal)
    values = (*shared, tiles, curvature, meat, *scalars, t, noise)
    if not all(np.isfinite(x).all() for x in values):
        return unknown_motion(np.zeros(6))
    statistics = ScoreStatistics(tiles, curvature, meat, float(weight), shared)
    return motion_covariance(
        statistics, float(inverse_depth), float(focal), t, Noise(*noise), depths
    )


def _depth_agreements(
    batch: PairBatch,
    motions: np.ndarray,
    robust: torch.Tensor,
    options: RefineOptions,
) -> list[DepthAgreement | None]:
    """Compare the two depths of each sample along its motion; None where that is impossible."""
    if batch.depth_curr is None or options.current_depth == "off":
        return [None] * len(motions)
    weights = robust.detach().cpu().numpy()
    samples = zip(batch.pairs(), motions, weights, strict=True)
    return [compare_depths(*sample) for sample in samples]

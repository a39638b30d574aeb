"""Sandwich covariance of a batch of poses, in torch: the twin of the numpy refinement's."""

from __future__ import annotations

import torch

from hybridvo.pose.pixels import Pixels
from hybridvo.pose.residuals import NormalEquations

__all__ = ["sandwich_covariance"]


def sandwich_covariance(
    system: NormalEquations,
    pixels: Pixels,
    kernel: str,
    cutoff: float,
    depth: torch.Tensor,
    tile: int,
    height: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sandwich covariance (B, 6, 6), and whether the information is definite (B,).

    As in the numpy refinement. Bread: the Gauss-Newton Hessian less the curvature of the robust
    weights. Meat: outer products of the scores summed over tiles, so that errors correlated within
    a tile count as such, with the small-sample factor of a cluster-robust covariance. In float64
    but for the scores.
    """
    dtype = pixels.depth.dtype
    scores = system.scores
    assert scores is not None
    unit = torch.eye(6, dtype=torch.float64, device=scores.device)
    # translations in units of the typical depth, so that all six are radians of the picture
    scaling = torch.cat([depth[:, None].expand(-1, 3), unit.new_ones(len(depth), 3)], dim=1)
    outer = scaling[:, :, None] * scaling[:, None, :]
    H = system.H.double() * outer
    good = torch.isfinite(H).flatten(1).all(dim=1)
    H = torch.where(good[:, None, None], H, unit)
    values = torch.linalg.eigvalsh(H)
    definite = good & (values[:, 0] > (1e-8 * values[:, 5]).clamp(min=1e-12))
    H = torch.where(definite[:, None, None], H, unit)
    scores = torch.where(definite[:, None, None], scores, torch.zeros_like(scores))
    curvature = _curvature(scores, system, pixels, kernel, cutoff).double() * outer
    bread = H - curvature
    sound = torch.linalg.eigvalsh(bread)[:, 0] > 0.2 * torch.linalg.eigvalsh(H)[:, 0]
    bread = torch.where(sound[:, None, None], bread, H)
    batch, width = scores.shape[0], scores.shape[2] // height
    image = scores.reshape(batch, 6, height, width)
    pad = (0, -width % tile, 0, -height % tile)
    image = torch.nn.functional.pad(image, pad)
    rows, columns = image.shape[2] // tile, image.shape[3] // tile
    tiles = image.reshape(batch, 6, rows, tile, columns, tile).sum(dim=(3, 5)).flatten(2).double()
    tiles = tiles * scaling[:, :, None]
    clusters = (tiles.abs().amax(dim=1) > 0).sum(dim=1).double()
    factor = clusters / (clusters - 6).clamp(min=1)
    inverse = torch.linalg.inv(bread)
    sandwich = inverse @ (tiles @ tiles.transpose(1, 2)) @ inverse
    sandwich = (
        sandwich * torch.where(clusters >= 12, factor, torch.zeros_like(factor))[:, None, None]
    )
    model = torch.linalg.inv(H)
    cautious = (24 / clusters.clamp(min=1)).clamp(min=1)[:, None, None] * (model + sandwich)
    covariance = torch.where((clusters >= 24)[:, None, None], sandwich, cautious) * outer
    covariance = 0.5 * (covariance + covariance.transpose(1, 2))
    definite = definite & torch.isfinite(covariance).flatten(1).all(dim=1)
    return torch.where(definite[:, None, None], covariance, unit).to(dtype), definite


def _curvature(
    scores: torch.Tensor, system: NormalEquations, pixels: Pixels, kernel: str, cutoff: float
) -> torch.Tensor:
    """(B, 6, 6) sum of -2 w (d weight / d distance2) s s^T, s = J^T Sigma^-1 r."""
    d2, c2 = system.distance2, cutoff * cutoff
    if kernel == "geman-mcclure":
        ratio = 4 / (c2 + d2)  # -2 (d weight / d distance2) / weight
    elif kernel == "cauchy":
        ratio = 2 / (c2 + d2)
    elif kernel == "huber":
        ratio = torch.where(d2 > c2, 1 / d2.clamp(min=c2), torch.zeros_like(d2))
    else:
        return torch.zeros_like(system.H)
    w = pixels.weight * system.weights
    factor = torch.where(w > 1e-12, ratio / w.clamp(min=1e-12), torch.zeros_like(w))
    return (scores * factor[:, None]) @ scores.transpose(1, 2)

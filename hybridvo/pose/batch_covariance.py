"""Sandwich covariance of a batch of poses, in torch: the twin of the numpy refinement's."""

from __future__ import annotations

import torch

from hybridvo.pose.pixels import Pixels
from hybridvo.pose.residuals import NormalEquations
from hybridvo.refinement.covariance import CLUSTERED, FEW_TILES, SIZES, SMALLEST_REST, long_range

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

    As in the numpy refinement (:mod:`hybridvo.refinement.covariance`): the Gauss-Newton Hessian
    less the
    curvature of the robust weights about the outer products of scores summed over overlapping
    blocks of tiles. What independent errors would give is summed over every pixel here, and stands
    for the information of the tiles as well. In float64 but for the scores.
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
    tiles, alone = _tiles(scores, height, tile)
    tiles = tiles * scaling[:, :, None, None]
    alone = alone * outer.flatten(1)[:, :, None, None]
    occupied = (alone[:, 0] > 0).flatten(1).sum(dim=1).clamp(min=1).double()
    independent = alone.sum(dim=(2, 3)).reshape(-1, 6, 6)
    whole, singular = torch.linalg.inv_ex(independent)
    whole = torch.where((singular == 0)[:, None, None], whole, torch.zeros_like(whole))
    meats, inflation = [], []
    for width, step in SIZES.tolist():
        share = (step / width) ** 2
        score, information = (_blocks(value, width, step) for value in (tiles, alone))
        X = whole[:, None] @ information.transpose(1, 2).reshape(len(H), -1, 6, 6)
        lost = share * (X * X.transpose(2, 3)).sum(dim=(1, 2, 3)) / 6
        meat = share * score @ score.transpose(1, 2)
        meats.append(meat / (1 - lost).clamp(min=SMALLEST_REST)[:, None, None])
        inflation.append((whole * meats[-1]).sum(dim=(1, 2)) / 6)
    growth = inflation[2] / inflation[0].clamp(min=1e-30)
    reach = H.new_tensor(
        [long_range(g, int(n)) for g, n in zip(growth.tolist(), occupied.tolist(), strict=True)]
    )[:, None, None]
    scaled = inflation[1].clamp(min=1)[:, None, None] * independent
    clustered = CLUSTERED * meats[1] + (1 - CLUSTERED) * scaled
    extra = (FEW_TILES / occupied - 1).clamp(min=0)[:, None, None]
    inverse = torch.linalg.inv(bread)
    covariance = inverse @ (reach * clustered + extra * independent) @ inverse
    # exact data leave no residuals to learn from
    covariance = (covariance + 0.01 * torch.linalg.inv(H)) * outer
    covariance = 0.5 * (covariance + covariance.transpose(1, 2))
    definite = definite & torch.isfinite(covariance).flatten(1).all(dim=1)
    return torch.where(definite[:, None, None], covariance, unit).to(dtype), definite


def _tiles(scores: torch.Tensor, height: int, tile: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Scores of (B, 6, N) pixels summed over tiles (B, 6, rows, columns), and the sums of their
    outer products (B, 36, rows, columns), in float64.
    """
    image = scores.reshape(len(scores), 6, height, -1)
    image = torch.nn.functional.pad(image, (0, -image.shape[3] % tile, 0, -height % tile))
    rows, columns = image.shape[2] // tile, image.shape[3] // tile
    image = image.reshape(-1, 6, rows, tile, columns, tile).permute(0, 2, 4, 1, 3, 5).flatten(4)
    alone = (image @ image.transpose(3, 4)).double().flatten(3)
    return image.sum(dim=4).double().permute(0, 3, 1, 2), alone.permute(0, 3, 1, 2)


def _blocks(values: torch.Tensor, width: int, step: int) -> torch.Tensor:
    """(B, C, blocks) sums over blocks of tiles, those that reach over the border included."""
    pads = []
    for size in (values.shape[3], values.shape[2]):
        count = -(-(size + width - step) // step)
        pads += [width - step, (count - 1) * step + width - (width - step) - size]
    padded = torch.nn.functional.pad(values, pads)
    sums = padded.unfold(2, width, step).unfold(3, width, step)
    return sums.sum(dim=(4, 5)).flatten(2)


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

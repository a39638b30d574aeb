"""Batches of pairs with known motions, for the tests of the torch refinement."""

from __future__ import annotations

import torch

from hybridvo.core.torch_geometry import pixel_grid, pp, reproject
from hybridvo.core.types import PairBatch

F64 = torch.float64


def noisy_batch(
    batch: int = 2,
    size: tuple[int, int] = (24, 32),
    seed: int = 0,
    outliers: float = 0.1,
    dtype: torch.dtype = F64,
    outlier_px: float = 20.0,
    flow_noise: float = 0.3,
    depth_noise: float = 0.02,
) -> tuple[PairBatch, torch.Tensor]:
    """B smooth scenes seen by two different cameras, with noise and outliers, and T_curr_prev."""
    height, width = size
    g = torch.Generator().manual_seed(seed)
    K_prev, K_curr = (
        torch.tensor([[a * width, 0, width / 2], [0, b * width, height / 2], [0, 0, 1]], dtype=F64)
        .repeat(batch, 1, 1)
        for a, b in ((1.1, 1.15), (1.2, 1.1))
    )  # fmt: skip
    grid = pixel_grid(height, width, K_prev)
    phase = torch.rand(batch, 1, 1, generator=g, dtype=F64)
    u, v = grid[..., 0] / width, grid[..., 1] / height
    depth = 4 + torch.sin(6 * u + 6 * phase) + 2 * torch.cos(6 * v)
    scale = torch.tensor([0.1] * 3 + [0.02] * 3, dtype=F64)
    T = pp.se3(torch.randn(batch, 6, generator=g, dtype=F64) * scale).Exp().matrix()
    flow = reproject(depth, T, K_prev, K_curr)[0] - grid
    flow = flow + flow_noise * torch.randn(flow.shape, generator=g, dtype=F64)
    gross = torch.rand(depth.shape, generator=g, dtype=F64) < outliers
    flow = flow + gross[..., None] * outlier_px * torch.randn(
        flow.shape, generator=g, dtype=F64
    )
    depth = depth * torch.exp(
        depth_noise * torch.randn(depth.shape, generator=g, dtype=F64)
    )
    return PairBatch(*(x.to(dtype) for x in (flow, depth, K_prev, K_curr))), T

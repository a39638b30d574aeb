"""Camera geometry and rigid motions in torch, on kornia and pypose; see :mod:`hybridvo.types`."""

from __future__ import annotations

import warnings
from typing import Any

import torch

with warnings.catch_warnings():
    # both packages warn of their own use of torch.jit while they are loaded
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.simplefilter("ignore", FutureWarning)
    import pypose as pp
    from kornia.geometry.conversions import denormalize_points_with_intrinsics
    from kornia.geometry.depth import unproject_meshgrid

# metres, as in the numba kernels
MIN_DEPTH = 1e-6
MAX_DEPTH = 1e9
# of the middle Euler angle: a quarter turn beyond
MIN_COS2 = 1e-12
MAX_SIN = 1 - 1e-6


def rays(height: int, width: int, K: torch.Tensor) -> torch.Tensor:
    """(B, H, W, 3) K^-1 (u, v, 1) of every pixel, for (B, 3, 3) intrinsics."""
    return unproject_meshgrid(height, width, K, device=K.device, dtype=K.dtype)


def pixel_grid(height: int, width: int, like: torch.Tensor) -> torch.Tensor:
    """(H, W, 2) coordinates (u, v) of the pixel centres, of the type and device of ``like``."""
    v, u = (
        torch.arange(n, dtype=like.dtype, device=like.device)
        for n in (height, width)
    )
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def se3(T: Any) -> pp.LieTensor:
    """Pypose SE3 (..., 7) of (..., 4, 4) matrices, with the rotations nearest to theirs."""
    U, _, Vh = torch.linalg.svd(T[..., :3, :3])
    flip = torch.linalg.det(U @ Vh)[..., None, None]
    T = T.clone()
    T[..., :3, :3] = torch.cat([U[..., :2], U[..., 2:] * flip], dim=-1) @ Vh
    return pp.mat2SE3(T, check=False)


def left_update(delta: torch.Tensor, T: pp.LieTensor) -> pp.LieTensor:
    """Exp(delta) T for (B, 6) tangents (translation, rotation) and pypose SE3 (B, 7)."""
    return pp.se3(delta).Exp() @ T


def move(T: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """(B, 3, N) points under (B, 4, 4) transforms; pypose's ``Act`` takes 20 times as long."""
    return torch.baddbmm(T[:, :3, 3:], T[:, :3, :3], points)


def to_pixels(ab: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """(B, 2, N) px of X/Z and Y/Z (B, 2, N) seen by cameras (B, 3, 3)."""
    return denormalize_points_with_intrinsics(ab.transpose(1, 2), K).transpose(1, 2)


def reproject(
    depth: torch.Tensor,
    T: torch.Tensor,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor,
    min_depth: float = MIN_DEPTH,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where the pixels of the previous frame are seen by the current one: x + ego flow.

    For depth (B, H, W) and T_curr_prev (B, 4, 4): (B, H, W, 2) px, finite;
    (B, H, W) whether the point is farther than ``min_depth``; (B, H, W) its depth there, else 1.
    """
    valid = (depth > 0) & (depth < MAX_DEPTH)
    with torch.autocast(depth.device.type, enabled=False):
        safe = torch.where(valid, depth, 1.0)
        points = rays(depth.shape[1], depth.shape[2], K_prev) * safe[..., None]
        moved = move(T, points.flatten(1, 2).transpose(1, 2))
        z = torch.where(valid, moved[:, 2].unflatten(1, depth.shape[1:]), 1.0)
        front = z >= min_depth
        # before the division: a masked quotient would still give NaN gradients
        ahead = torch.where(front, z, 1.0).flatten(1)[:, None]
        pixels = to_pixels(moved[:, :2] / ahead, K_curr)
    return pixels.transpose(1, 2).unflatten(1, depth.shape[1:]), valid & front, z


def euler_transform(motion: torch.Tensor) -> torch.Tensor:
    """(B, 4, 4) of Euler angles X-Y-Z in degrees, then metres (B, 6); differentiable everywhere."""
    # Written out, not multiplied: a matrix product would run in bfloat16 under autocast.
    angles = torch.deg2rad(motion[:, :3])
    cx, cy, cz, sx, sy, sz = torch.cat([angles.cos(), angles.sin()], dim=1).unbind(
        1
    )
    rows = (
        (cy * cz, -cy * sz, sy),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    )
    R = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    last = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(R), 1, 4)
    return torch.cat([torch.cat([R, motion[:, 3:, None]], dim=2), last], dim=1)


def euler_motion(T: torch.Tensor) -> torch.Tensor:
    """(B, 6) of (B, 4, 4), the inverse of :func:`euler_transform`, with a finite gradient."""
    R = T[:, :3, :3]
    # a quarter turn about y leaves only the sum or difference of the others: rz = 0 there, and no
    # 0 / 0 in the gradient
    locked = R[:, 0, 0] ** 2 + R[:, 0, 1] ** 2 < MIN_COS2
    angles = (
        torch.where(locked, R[:, 2, 1], -R[:, 1, 2]).atan2(
            torch.where(locked, R[:, 1, 1], R[:, 2, 2])
        ),
        torch.asin(R[:, 0, 2].clamp(-MAX_SIN, MAX_SIN)),
        torch.where(locked, 0.0, -R[:, 0, 1]).atan2(
            torch.where(locked, 1.0, R[:, 0, 0])
        ),
    )
    return torch.cat(
        [torch.rad2deg(torch.stack(angles, dim=1)), T[:, :3, 3]], dim=1
    )

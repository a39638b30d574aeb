"""The Euler angles in which networks predict motions, in torch and differentiable."""

from __future__ import annotations

import torch

# Squared cosine of the middle Euler angle below which it counts as a quarter turn.
MIN_COS2 = 1e-12
# Largest sine of the middle Euler angle: the derivative of asin is infinite at 1.
MAX_SIN = 1 - 1e-6


def euler_transform(motion: torch.Tensor) -> torch.Tensor:
    """Turn Euler angles X-Y-Z and translations into transforms, differentiable everywhere.

    The rotation is written out: a matrix product would run in bfloat16 under autocast.

    Args:
        motion: (B, 6) degrees, then metres.

    Returns:
        (B, 4, 4) with R = Rx Ry Rz.
    """
    angles = torch.deg2rad(motion[:, :3])
    cx, cy, cz = angles.cos().unbind(1)
    sx, sy, sz = angles.sin().unbind(1)
    rows = (
        (cy * cz, -cy * sz, sy),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    )
    R = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    top = torch.cat([R, motion[:, 3:, None]], dim=2)
    bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(R), 1, 4)
    return torch.cat([top, bottom], dim=1)


def euler_motion(T: torch.Tensor) -> torch.Tensor:
    """Turn transforms (B, 4, 4) into (B, 6) degrees and metres, with a finite gradient.

    The inverse of :func:`euler_transform`. A quarter turn about y leaves only the sum or the
    difference of the other angles open: there rz is 0, which also avoids 0 / 0 in the gradient.
    """
    R = T[:, :3, :3]
    locked = R[:, 0, 0] ** 2 + R[:, 0, 1] ** 2 < MIN_COS2
    sin_x = torch.where(locked, R[:, 2, 1], -R[:, 1, 2])
    cos_x = torch.where(locked, R[:, 1, 1], R[:, 2, 2])
    sin_y = R[:, 0, 2].clamp(-MAX_SIN, MAX_SIN)
    sin_z = torch.where(locked, 0.0, -R[:, 0, 1])
    cos_z = torch.where(locked, 1.0, R[:, 0, 0])
    angles = (sin_x.atan2(cos_x), torch.asin(sin_y), sin_z.atan2(cos_z))
    degrees = torch.rad2deg(torch.stack(angles, dim=1))
    return torch.cat([degrees, T[:, :3, 3]], dim=1)
